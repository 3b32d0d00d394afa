"""What is measured: `python -m benchmarks NAME`; docs/generate.py writes it to results/."""

from __future__ import annotations

import importlib
import os
from types import ModuleType

# Benchmark, which is the module of that name: what it measures.
BENCHMARKS = {
    'absence': 'whether a visible person is taken for nobody, an empty scene for somebody',
    'bags': 'what replay adds to the time of the estimate',
    'blind': 'what is said of a person whom nothing explains, and of one whom something does',
    'composites': 'people cut from clips who cross in one image: are they told apart?',
    'contenders': 'models of p(pose | image) with the same pairs and the same processor time',
    'contour_noise': 'how far contours of people lie from those of the model',
    'detectors': 'what each detector that is installed sees, and what poses come of it',
    'experts': 'what the predictor that ships says of silhouettes, and its speed',
    'forecast': 'where a person is said to be soon, against holding the last pose',
    'gate': 'whether a step of the tracker costs more than a table that is checked in says',
    'joint_errors': 'what joints err by in every pose, and what all images leave of a covariance',
    'keep_out': 'how often a true joint is outside the space that a robot keeps out of',
    'keypoint_noise': 'where landmarks of a detector lie on the body, and how they err',
    'kernels': 'what compiled code takes, and an evaluation of a pose, term by term',
    'kjs': 'kinematic jumps against random sampling at finding minima',
    'lifting': 'poses from keypoints alone, on clips with truth',
    'live': 'the nodes at the images of a camera that does not wait for them',
    'motion_prior': 'how well the motion prior predicts motions of other people',
    'nodes': 'what ROS adds to an image',
    'people': 'two people cross: are they told apart afterwards?',
    'real_clips': 'real people, beside the own 3D of the detector',
    'real_video': 'real videos without truth: keypoints held out, feet, lengths',
    'rolled': 'what a camera on its side or upside down costs, its gravity given',
    'smoothing': 'the smoother against the filter, on clips with known truth',
    'soak': 'nodes and files under load and fault',
    'strangers': 'files of other programs, as their commands take them',
    'symmetric': 'whether two motions with one image and one prior both keep their weight',
    'tracking': 'accuracy, calibration and speed of the tracker on clips with known truth',
    'unseen': 'what is said of limbs that no image shows',
    'vertical': 'how well the lines of a scene tell which way is up, and what a look costs',
}

# Parts with a page of their own: module, command, what they measure.
PARTS = {
    'oracles': (
        'tracking_oracles',
        'tracking --parts oracles --seeds 0',
        'what the truth of one thing at a time would gain the tracker',
    ),
}


def benchmark(name: str) -> ModuleType:
    """The module of a benchmark, or of a part, which has no `main`.

    `main` runs the benchmark, `measure` returns its result, `as_text` makes tables of a result.
    """
    # Before numpy is imported: with small matrices a second BLAS thread costs more than it brings.
    for library in ('OMP', 'OPENBLAS', 'MKL'):
        os.environ.setdefault(f'{library}_NUM_THREADS', '1')
    return importlib.import_module(f'benchmarks.{name}')
