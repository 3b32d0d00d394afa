#!/usr/bin/env python3
"""Experts learn within seconds to predict poses from silhouettes, and give several answers.

You learn to make pairs of silhouettes and poses from motions, to train experts with them, and to
measure them on motions left out. Run python examples/tutorials/train_experts.py, with --samples
and --model of your choice. The picture shows silhouettes of motions left out, and from the side
the truth, the heaviest answer and the best of five.
"""

from __future__ import annotations

import sys
from argparse import Namespace

import numpy as np
import tutorial
from matplotlib.figure import Figure

from hmt_learning.motion.procedural_motion import PROCEDURAL_MOTIONS
from hmt_learning.training.predictor_learning import (
    KINDS,
    described,
    learned_predictor,
    new_model,
)
from hmt_learning.training.training_set import (
    TrainingSet,
    TrainingSettings,
    procedural_sequence,
    training_set,
)
from hmt_ros.app.command_line import run_command, whole_number
from hmt_ros.body import Body, load_body
from hmt_ros.evaluation.pose_scores import EVALUATED_JOINTS

LEARNED, LEFT_OUT, TESTED, SHOWN, BEST_OF = (0, 1, 2, 3), (9,), 60, 4, 5


def main(argv: list[str] | None = None) -> int:
    """Runs the tutorial; returns 1 for bad input."""
    parser = tutorial.parser_of(__file__, __doc__)
    parser.add_argument('--samples', type=whole_number(100, 100_000), default=500)
    parser.add_argument('--model', choices=('local', 'conditional', 'joint'), default='local')
    return run_command(parser, run, argv)


def run(options: Namespace) -> int:
    """The pairs, the experts, their errors, and the picture."""
    body = load_body('human37')
    learned, tested = pairs(body, LEARNED, options.samples), pairs(body, LEFT_OUT, TESTED)
    training = described(body, learned)
    few = training.with_components(KINDS[options.model].components)
    predictor = learned_predictor(body, few, new_model(options.model, samples=len(learned)))
    print(
        f'{len(learned)} silhouettes of {len(PROCEDURAL_MOTIONS)} kinds of motion: {options.model}'
    )

    # Of each silhouette left out: joints of the five heaviest answers, and of the mean pose.
    seen = [tested.parts(i, predictor.descriptor.points) for i in range(len(tested))]
    average = training.targets.mean(0)[None]
    answers, means = [], []
    for row, pose in zip(predictor.descriptor.describe(seen), tested.poses):
        answers.append(body.joint_positions(predictor.poses_at(row, pose[:3], BEST_OF)[0]))
        means.append(body.joint_positions(predictor.encoding.decode(average, pose[None, :3])))
    true, names = body.joint_positions(tested.poses), body.joint_names
    errors = [distances(*each, names) for each in zip(answers, true)]
    heaviest, best = np.array([(one[0], one.min()) for one in errors]).T
    mean = np.mean([distances(*each, names) for each in zip(means, true)])
    print(f'on {len(true)} silhouettes left out the joints err by')
    print(f'{heaviest.mean():.3f} m in the heaviest answer')
    print(f'{best.mean():.3f} m in the best of {BEST_OF}')
    print(f'{mean:.3f} m in the mean pose')

    figure = Figure((10, 6.4), layout='constrained')
    grid = figure.subplots(2, SHOWN, height_ratios=[1, 1.5])
    # From silhouettes where the other answers help least to some where they help most.
    ranks = (np.linspace(0.4, 0.97, SHOWN) * len(true)).astype(int)
    for (above, side), i in zip(grid.T, np.argsort(heaviest - best)[ranks]):
        rows, columns = np.nonzero(tested.mask(i))
        above.imshow(1 - tested.mask(i), cmap='gray')
        above.set(xlim=(columns.min(), columns.max()), ylim=(rows.max(), rows.min()))
        above.set_axis_off()
        poses = [(1.0, 'the heaviest answer', answers[i][0], tutorial.BLUE)]
        if best[i] < heaviest[i]:
            closest = answers[i][np.argmin(errors[i])]
            poses.append((1.0, f'the best of {BEST_OF}, if another', closest, tutorial.RED))
        tutorial.show_side(side, names, poses, true[i])
        side.get_legend().remove()
        side.set(
            title=f'error {heaviest[i]:.2f} m, best {best[i]:.2f} m',
            xlim=(-0.9, 0.9),
            ylim=(-1.15, 0.8),
        )
        side.label_outer()
    entries = {x.get_label(): x for side in grid[1] for x in side.collections}
    figure.legend(entries.values(), entries.keys(), loc='outside lower center', ncols=3)
    figure.suptitle(
        f'A silhouette has several answers: the heaviest errs by {heaviest.mean():.2f} m, '
        f'the best of {BEST_OF} by {best.mean():.2f} m'
    )
    tutorial.save(figure, options.output)
    return 0


def pairs(body: Body, seeds: tuple[int, ...], count: int) -> TrainingSet:
    """Silhouettes and poses of procedural motions, seen from anywhere."""
    motions = [
        procedural_sequence(x, body, 16.0, seed) for x in PROCEDURAL_MOTIONS for seed in seeds
    ]
    settings = TrainingSettings(samples=count, dressed=0.0, cut=0.0, seed=seeds[0])
    return training_set(body, motions, settings)


def distances(joints: np.ndarray, true: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """Mean distances (K,) of joints (K, J, 3) from the true ones (J, 3), from the pelvis, m."""
    scored, pelvis = [names.index(x) for x in EVALUATED_JOINTS], names.index('pelvis')
    off = (joints - joints[:, [pelvis]]) - (true - true[pelvis])
    return np.linalg.norm(off[:, scored], axis=2).mean(1)


if __name__ == '__main__':
    sys.exit(main())
