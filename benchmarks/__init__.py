"""The benchmarks: `python -m benchmarks NAME`; docs/generate.py writes results/."""

from __future__ import annotations

import importlib
import os
from types import ModuleType

# Description of each benchmark by its name, which is also that of its module.
BENCHMARKS = {
    'absence': 'whether a visible person is taken for nobody, or an empty scene for somebody',
    'bags': 'time that replay adds to the time of the estimate',
    'blind': 'states reported for a person whom nothing explains, and for one whom something does',
    'composites': 'whether people cut from clips, who cross in one image, keep their identities',
    'contenders': 'models of p(pose | image), trained on the same pairs in the same processor time',
    'contour_noise': "distances of people's contours from those of the model",
    'detectors': 'landmarks of each installed detector, and the poses from them',
    'experts': 'predictions of the shipped predictor from silhouettes, and its speed',
    'forecast': 'forecasts of where a person is soon, against holding the last pose',
    'gate': 'whether a step of the tracker costs more than a checked-in table allows',
    'joint_errors': 'joint errors common to all poses, and the covariance left after all images',
    'keep_out': 'how often a true joint is outside the space that a robot keeps out of',
    'keypoint_noise': "positions of a detector's landmarks on the body, and their errors",
    'kernels': 'time of compiled code, and of an evaluation of a pose, term by term',
    'kjs': 'kinematic jumps against random sampling at finding minima',
    'lifting': 'poses from keypoints alone, on clips with truth',
    'live': 'the nodes with images of a camera that does not wait for them',
    'motion_prior': 'how well the motion prior predicts motions of other people',
    'nodes': 'time that ROS adds to an image',
    'people': 'whether two people keep their identities when they cross',
    'real_clips': "real people, against the detector's own 3D positions",
    'real_video': 'real videos without truth: keypoints held out, feet, lengths',
    'rolled': 'errors with a camera on its side or upside down, with its gravity given',
    'smoothing': 'the smoother against the filter, on clips with known truth',
    'soak': 'nodes and files under load and fault',
    'strangers': 'files of other programs, as the commands read them',
    'symmetric': 'whether two motions with equal images and priors both keep their weight',
    'tracking': 'accuracy, calibration and speed of the tracker on clips with known truth',
    'unseen': 'estimates of limbs that no image shows',
    'vertical': 'accuracy and cost of the vertical from straight lines of a scene',
}

# Parts with their own page: module, command, description.
PARTS = {
    'oracles': (
        'tracking_oracles',
        'tracking --parts oracles --seeds 0',
        'gains of the tracker if one quantity at a time were true',
    ),
}


def benchmark(name: str) -> ModuleType:
    """The module of a benchmark, or of a part, which has no `main`.

    `main` runs the benchmark, `measure` returns its result, `as_text` makes tables of a result.
    """
    # Set before numpy is imported, because a second BLAS thread slows small matrices down.
    for library in ('OMP', 'OPENBLAS', 'MKL'):
        os.environ.setdefault(f'{library}_NUM_THREADS', '1')
    return importlib.import_module(f'benchmarks.{name}')
