"""The figures of the paper on experts, from recorded motions of people left out (BME 6 to 11, 16).

    python -m benchmarks experts --only figures --figures OUT

multimodality, affinities   of the training set (figures 6 and 7)
walk, run, turns            silhouettes, and under them the two most probable poses from the camera
                            and the first from the side, against the truth (8 to 10)
angles                      a joint angle and the heading over time: truth, first and second expert,
                            and what nearest neighbours and one regression answer (11)
hypotheses                  the error over time of one hypothesis against five, propagated (16)
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from benchmarks.experts_motion import (
    BEST_OF,
    SeenMotion,
    frame_scores,
    learn_from,
    predictor_of,
    recorded,
    sequence_mixtures,
    wrapped,
)
from hmt_learning.app.train import write_report
from hmt_learning.training.predictor_learning import described
from hmt_learning.training.training_set import (
    PoseSequence,
    TrainingSettings,
    seen_from,
    training_set,
)
from hmt_ros.app.report.skeletons import STYLE, bones_of
from hmt_ros.body import Body
from hmt_ros.body.mirror import root_rotations
from hmt_ros.experts.descriptor.silhouette_descriptor import silhouette_parts
from hmt_ros.experts.pose_predictor import ALONE, BY_DYNAMICS, PosePredictor, load_predictor
from hmt_ros.inference.arrays import Array

# Motions of people left out that stand for those of the paper; heading, degrees.
WALK, RUN, TURNS = 'cmu_06_01_walk', 'cmu_run_c', 'cmu_06_10_turns'
SHOWN = {'walk': (WALK, 60.0), 'run': (RUN, 60.0), 'turns': (TURNS, 20.0)}
TALKS = 'cmu_signals_b'
FRAMES, COLUMNS, SAMPLES = 90, 6, 2000
# The joint of an angle that changes, and the heading.
BENDING = {TURNS: ('right_knee', 20.0), TALKS: ('right_elbow', 0.0)}
COLOURS = {'truth': '#000000', 'first expert': '#d55e00', 'second expert': '#e69f00',
           'nearest neighbours': '#009e73', 'one regression': '#0072b2'}  # fmt: skip


def draw(folder: Path, *, quick: bool = False) -> list[str] | str:
    """Draws all figures; their names, or the reason why there are none."""
    try:
        train, test = recorded('train'), {x.name: x for x in recorded('dev')}
    except ValueError as error:
        return f'skipped: {error}'
    folder.mkdir(parents=True, exist_ok=True)
    predictor = load_predictor()
    samples = 400 if quick else SAMPLES
    pairs = training_set(predictor.body, train, TrainingSettings(samples=samples))
    training = described(predictor.body, pairs)
    write_report(folder, predictor.body, [test[x] for x in (WALK, TURNS, TALKS)], pairs, training)
    for title, (name, heading) in SHOWN.items():
        _sequence_figure(predictor, test[name], heading).savefig(folder / f'{title}.png')
    learned = learn_from(train, samples)
    baselines = {
        what: predictor_of(learned, name, dynamics=False)[0]
        for what, name in (('nearest neighbours', 'nearest'),
                           ('one regression', 'relevance-vector'))
    }  # fmt: skip
    _angle_figure(predictor, baselines, test).savefig(folder / 'angles.png')
    _hypotheses_figure(predictor, test).savefig(folder / 'hypotheses.png')
    return sorted(path.name for path in folder.glob('*.png'))


def seen(
    predictor: PosePredictor, sequence: PoseSequence, heading: float
) -> tuple[SeenMotion, Any]:
    """A motion as a camera sees it, and its silhouettes."""
    count = min(FRAMES, len(sequence.poses))
    poses, masks = seen_from(
        predictor.body, sequence, heading, 5.0, frames=slice(0, count), boundary_noise=1.0
    )
    parts = [silhouette_parts(mask, predictor.descriptor.points) for mask in masks]
    rows = predictor.descriptor.describe(parts)
    return SeenMotion(sequence.activity, poses, rows), masks


def _sequence_figure(predictor: PosePredictor, sequence: PoseSequence, heading: float) -> Figure:
    motion, masks = seen(predictor, sequence, heading)
    found = sequence_mixtures(predictor, motion)
    rows = np.linspace(0, len(masks) - 1, COLUMNS).astype(int)
    body = predictor.body
    with mpl.rc_context(STYLE):
        figure = Figure((1.4 * COLUMNS, 6.2), dpi=110)
        axes = figure.subplots(4, COLUMNS, squeeze=False)
        for column, i in enumerate(rows.tolist()):
            axes[0, column].imshow(masks[i], cmap='gray_r')
            axes[0, column].set_title(f'{i / 30.0:.1f} s')
            for row, which, side in ((1, 0, False), (2, 1, False), (3, 0, True)):
                one = axes[row, column]
                _draw(one, body, motion.poses[i], '#bbbbbb', side=side)
                if which < len(found[i]):
                    _draw(one, body, found[i].means[which], None, side=side)
                    one.set_title(f'{found[i].weights[which]:.2f}', fontsize=7.0, pad=1.0)
        for row, label in enumerate(('silhouette', 'first expert', 'second', 'first, from aside')):
            axes[row, 0].set_ylabel(label)
        for one in axes.ravel():
            one.set_xticks([])
            one.set_yticks([])
        figure.suptitle(f'{sequence.name}; grey: truth', fontsize=9.0)
        figure.tight_layout()
    return figure


def _draw(axes: Any, body: Body, pose: Array, colour: str | None, *, side: bool) -> None:
    """A skeleton from the camera, or from its right."""
    joints = body.joint_positions(pose[None])[0]
    joints = joints - joints[body.skeleton.joint_index(('pelvis',))]
    across = -joints[:, 2] if side else joints[:, 0]
    for a, b, own in bones_of(body.joint_names):
        axes.plot(across[[a, b]], -joints[[a, b], 1], color=colour or own, linewidth=1.4)
    axes.set_xlim(-1.0, 1.0)
    axes.set_ylim(-1.15, 0.95)
    axes.set_aspect('equal')


def _heading(body: Body, poses: Array) -> Array:
    """Where the front of the pelvis points, degrees: 0 to the camera, 90 to the image's right."""
    x, _, z = root_rotations(body, poses)[:, :, 1].T
    return np.asarray(np.degrees(np.arctan2(x, -z)))


def _angle_figure(
    predictor: PosePredictor,
    baselines: dict[str, PosePredictor],
    test: dict[str, PoseSequence],
) -> Figure:
    with mpl.rc_context(STYLE):
        figure = Figure((9.0, 6.0), dpi=110)
        axes = figure.subplots(2, 2, squeeze=False)
        for column, (name, (joint, heading)) in enumerate(BENDING.items()):
            motion, _ = seen(predictor, test[name], heading)
            found = sequence_mixtures(predictor, motion)
            lines = {
                'truth': motion.poses,
                'first expert': np.array([x.means[0] for x in found]),
                'second expert': np.array([x.means[min(1, len(x) - 1)] for x in found]),
            }
            for what, one in baselines.items():
                again, _ = seen(one, test[name], heading)
                lines[what] = np.array([x.mean() for x in sequence_mixtures(one, again)])
            dof = _bending(predictor.body, joint)
            times = np.arange(len(motion.poses)) / 30.0
            for what, poses in lines.items():
                dots = {'marker': '.', 'linestyle': ''} if 'expert' in what else {}
                values = (_heading(predictor.body, poses), np.degrees(wrapped(poses[:, dof])))
                for row, value in enumerate(values):
                    axes[row, column].plot(times, value, color=COLOURS[what], label=what, **dots)
            axes[0, column].set_title(name)
            axes[1, column].set_xlabel('s')
            axes[1, column].set_ylabel(f'{joint.replace("_", " ")}, degrees')
        axes[0, 0].set_ylabel('heading, degrees')
        axes[0, 0].legend(fontsize=7.0)
        figure.tight_layout()
    return figure


def _bending(body: Body, joint: str) -> int:
    """The degree of freedom of a joint."""
    return next(i for i, name in enumerate(body.dof_names) if name.startswith(joint))


def _hypotheses_figure(predictor: PosePredictor, test: dict[str, PoseSequence]) -> Figure:
    with mpl.rc_context(STYLE):
        figure = Figure((9.0, 5.0), dpi=110)
        grid = figure.subplots(len(SHOWN), 1)
        for one, (title, (name, heading)) in zip(grid, SHOWN.items(), strict=True):
            motion, _ = seen(predictor, test[name], heading)
            for components, propagation, style in (
                (1, BY_DYNAMICS, ':'), (BEST_OF, BY_DYNAMICS, '-'), (BEST_OF, ALONE, '--'),
            ):  # fmt: skip
                found = sequence_mixtures(predictor, motion, propagation, components)
                best = frame_scores(predictor.body, found, motion)['best_mm']
                how = 'rule (9)' if propagation == BY_DYNAMICS else 'each image alone'
                label = f'best of {components}, {how}: {best.mean():.0f} mm'
                one.plot(np.arange(len(best)) / 30.0, best, style, label=label)
            one.set_ylabel(f'{title}, mm')
            one.legend(fontsize=6.5)
        figure.axes[-1].set_xlabel('s')
        figure.tight_layout()
    return figure
