"""train: learns to predict poses from silhouettes of recorded or procedural motions.

    train --mocap DIR DIR ... --test PEOPLE_LEFT_OUT -o MODEL.npz
    train --motions procedural --model local -o MODEL.npz

A report beside the model shows affinities, multimodality and silhouettes of the training set.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from hmt_learning.app.motions import (
    add_alike,
    add_body,
    add_model,
    add_seed,
    add_sources,
    add_test,
    chosen_motions,
    data_card,
    model_file,
    read_motions,
    shares_of,
)
from hmt_learning.motion.procedural_motion import PROCEDURAL_MOTIONS
from hmt_learning.training.network_learning import check_tools
from hmt_learning.training.predictor_learning import (
    KINDS,
    Described,
    affinities,
    described,
    learned_predictor,
    multimodality,
    new_model,
)
from hmt_learning.training.training_set import (
    PoseSequence,
    TrainingSet,
    TrainingSettings,
    procedural_sequence,
    recorded_sequence,
    seen_from,
    training_set,
    typical_body,
)
from hmt_ros.app.command_line import CommandParser, run_command, whole_number
from hmt_ros.app.progress import say, show_progress, with_progress
from hmt_ros.app.report.skeletons import STYLE
from hmt_ros.body import Body, load_body
from hmt_ros.evaluation.pose_scores import EVALUATED_JOINTS, ORIGIN
from hmt_ros.experts.descriptor.silhouette_descriptor import silhouette_parts
from hmt_ros.experts.pose_encoding import AXES
from hmt_ros.experts.pose_predictor import PosePredictor
from hmt_ros.inference.arrays import Array
from msg_tools.files.new_folder import new_file

Item = TypeVar('Item')

PROCEDURAL_SEEDS, PROCEDURAL_SECONDS = 5, 12.0
# Number of silhouettes for the scores, and of predicted components for the best-of score.
TESTED, BEST_OF = 1000, 5
# Figures of the training set: affinities (BME fig. 7), multimodality (BME fig. 6), examples.
ACTIVITIES = 3  # maximum number of activities whose affinities are drawn
FRAMES = 120  # maximum number of frames per activity
ANALYSED = 2000  # maximum number of samples whose multimodality is counted
FINE, COARSE = 0.956, 0.70  # clusters per sample, as in the paper: 1912 and 1409 of 2000
EXAMPLES = (4, 12)  # rows and columns of silhouettes


def main(argv: list[str] | None = None) -> int:
    """Runs the command; returns 0, or 1 after bad input, which one line on stderr explains."""
    return run_command(_parser(), _train, argv)


def _parser() -> CommandParser:
    parser = CommandParser(
        prog='train', description='Learns to predict poses from silhouettes of motions.'
    )
    add_model(parser)
    parser.add_argument('--quiet', action='store_true', help='no progress, no summary')
    add_seed(parser)
    parser.add_argument(
        '--report', type=Path, metavar='DIR', help='folder for the figures (FILE_report)'
    )

    motion = parser.add_argument_group('motions')
    motion.add_argument(
        '--mocap',
        nargs='+',
        type=Path,
        default=[],
        metavar='DIR',
        help='folders of recorded motions (.bvh, or .amc beside its .asf) with their subfolders',
    )
    add_sources(motion)
    add_test(motion)
    add_alike(motion)
    motion.add_argument(
        '--motions',
        metavar='NAMES',
        help=f'"procedural" for all, or names with commas ({", ".join(PROCEDURAL_MOTIONS)})',
    )
    add_body(motion)

    learning = parser.add_argument_group('learning')
    learning.add_argument(
        '--model',
        choices=sorted(KINDS),
        default='network',
        help='kind of model; network, the default, needs jax and optax',
    )
    learning.add_argument(
        '--experts',
        type=whole_number(1, 1000),
        help='number of experts; maximum number of modes of the local model (5)',
    )
    learning.add_argument(
        '--samples',
        type=whole_number(50, 1_000_000),
        default=6000,
        help='number of silhouettes (6000); a network can use ten times as many',
    )
    learning.add_argument(
        '--dynamics',
        action=argparse.BooleanOptionalAction,
        default=False,
        help='learn p(x_t | x_t-1, r_t) as well, for rule (1) (no)',
    )
    return parser


def _train(options: argparse.Namespace) -> int:
    output = model_file(options.output, overwrite=options.overwrite)
    if options.model == 'network':
        check_tools()
    body = load_body(options.body)
    if not body.shapes:
        raise ValueError(f'body {options.body} has no flesh: wanted one such as human37')
    sequences, skipped = _sequences(options, body)
    body = typical_body(body, sequences)
    settings = TrainingSettings(samples=options.samples, seed=options.seed)
    bar = _bars(options.quiet)
    shares = shares_of(sequences, options.alike, options.alike_share)
    pairs = training_set(body, sequences, settings, bar('rendering', 'groups'), shares)
    training = described(body, pairs, progress=bar('describing', 'silhouettes'))
    kind, count = KINDS[options.model], len(pairs)
    model = new_model(options.model, options.experts, options.seed, count)
    dynamics = None
    if options.dynamics:
        experts = options.experts or kind.dynamics_experts
        dynamics = new_model(options.model, experts, options.seed, count)
    seen = training.with_components(kind.components)
    notes = {
        'model': options.model,
        'samples': len(pairs),
        'seed': options.seed,
        **data_card(sequences, options.acknowledgement),
    }
    _say(options, f'learning {options.model} from {len(pairs)} silhouettes')
    with show_progress('learning', quiet=options.quiet):
        predictor = learned_predictor(body, seen, model, dynamics, notes, options.seed)
    if options.test:
        files = chosen_motions(options.test, [])
        tested = read_motions('train', files, options.body, recorded_sequence, quiet=options.quiet)
        predictor.notes['scored on'] = sorted(one.name for one in tested)
        with show_progress('scoring', quiet=options.quiet):
            predictor.notes['scores'] = _scores(predictor, tested)
    predictor.save(output)
    report = options.report or output.with_name(f'{output.stem}_report')
    report.mkdir(parents=True, exist_ok=True)
    with show_progress('drawing', quiet=options.quiet):
        figures = write_report(report, body, sequences, pairs, training)
    skips = f', {skipped} skipped' if skipped else ''
    _say(
        options, f'{output}: {len(sequences)} motions{skips}, {output.stat().st_size / 1e6:.1f} MB'
    )
    if 'scores' in predictor.notes:
        _say(options, f'  other people: {predictor.notes["scores"]}')
    for path, what in figures:
        _say(options, f'  {path}: {what}')
    return 0


def _bars(quiet: bool) -> Callable[[str, str], Callable[[Iterable[Item], int], Iterable[Item]]]:
    def bar(what: str, unit: str) -> Callable[[Iterable[Item], int], Iterable[Item]]:
        def through(items: Iterable[Item], count: int) -> Iterable[Item]:
            return with_progress(items, what, unit, count, quiet=quiet)

        return through

    return bar


def _say(options: argparse.Namespace, text: str) -> None:
    if not options.quiet:
        say(text)


def _sequences(options: argparse.Namespace, body: Body) -> tuple[list[PoseSequence], int]:
    """Motions to learn from, and the number of files that cannot be used."""
    if not options.mocap and options.motions is None:
        raise ValueError('nothing to learn from: give --mocap DIR or --motions procedural')
    sequences: list[PoseSequence] = []
    if options.motions is not None:
        for name in _procedural_names(options.motions):
            sequences += [
                procedural_sequence(name, body, PROCEDURAL_SECONDS, options.seed + i)
                for i in range(PROCEDURAL_SEEDS)
            ]
    files = chosen_motions(options.mocap, options.without)
    read = read_motions('train', files, options.body, recorded_sequence, quiet=options.quiet)
    return [*sequences, *read], len(files) - len(read)


def _scores(predictor: PosePredictor, tested: list[PoseSequence]) -> str:
    """Scores on silhouettes of other people, rendered like the training set, as text."""
    body, descriptor = predictor.body, predictor.descriptor
    pairs = training_set(body, tested, TrainingSettings(samples=TESTED))
    rows = descriptor.describe([pairs.parts(i, descriptor.points) for i in range(len(pairs))])
    scored, pelvis = (body.skeleton.joint_index(x) for x in (EVALUATED_JOINTS, (ORIGIN,)))
    heaviest, best = [], []
    for row, pose in zip(rows, pairs.poses, strict=True):
        found, _ = predictor.poses_at(row, pose[:3], BEST_OF)
        joints = body.joint_positions(np.concatenate([pose[None], found]))
        relative = joints[:, scored] - joints[:, pelvis]
        distances = np.linalg.norm(relative[1:] - relative[0], axis=2).mean(1)
        heaviest.append(distances[0])
        best.append(distances.min())
    states = predictor.encoding.encode(pairs.poses) @ predictor.target_basis
    density = predictor.model.log_density(rows, states) / states.shape[1]
    return (
        f'{1e3 * np.mean(heaviest):.0f} mm heaviest, {1e3 * np.mean(best):.0f} best of {BEST_OF}, '
        f'{density.mean():.2f} nats a number'
    )


def _procedural_names(text: str) -> list[str]:
    names = list(PROCEDURAL_MOTIONS) if text == 'procedural' else text.split(',')
    unknown = [name for name in names if name not in PROCEDURAL_MOTIONS]
    if unknown:
        raise ValueError(
            f'--motions: no motion {unknown[0]!r}, wanted procedural, or some of '
            f'{", ".join(PROCEDURAL_MOTIONS)}'
        )
    return names


def write_report(
    folder: Path,
    body: Body,
    sequences: Sequence[PoseSequence],
    pairs: TrainingSet,
    training: Described,
) -> list[tuple[Path, str]]:
    """Draws the figures into a folder.

    Returns:
        The path of each figure, and a description.
    """
    figures = [
        (
            _affinity_figure(body, sequences, training),
            'affinities.png',
            'affinity of joint angles and descriptors over time',
        ),
        (
            _multimodality_figure(training),
            'multimodality.png',
            'clusters of poses under one cluster of descriptors',
        ),
        (_example_figure(pairs), 'silhouettes.png', 'silhouettes of the training set'),
    ]
    result = []
    for figure, name, what in figures:
        with new_file(folder / name) as file:
            figure.savefig(file)
        result.append((folder / name, what))
    return result


def _affinity_figure(body: Body, sequences: Sequence[PoseSequence], training: Described) -> Figure:
    chosen = _of_different_activities(sequences)
    columns = ('joint angles', 'shape contexts', 'edge pairs', 'descriptor')
    with mpl.rc_context(STYLE):
        figure = Figure((1.9 * len(columns) + 0.4, 1.9 * len(chosen) + 0.5), dpi=110)
        axes = figure.subplots(len(chosen), len(columns), squeeze=False)
        for number, sequence in enumerate(chosen):
            row = axes[number]
            # The person on average faces across the image; long motions are shown at half the rate.
            step = 2 if len(sequence.poses) >= 2 * FRAMES else 1
            poses, masks = seen_from(body, sequence, 90.0, frames=slice(0, FRAMES * step, step))
            parts = [silhouette_parts(mask, training.descriptor.points) for mask in masks]
            histograms = [training.descriptor.codebook.histogram(part.contexts) for part in parts]
            vectors = (
                poses[:, AXES:],
                np.sqrt(np.array(histograms)),
                np.sqrt(np.array([part.edge_pairs for part in parts])),
                training.descriptor.describe(parts),
            )
            for one, title, values in zip(row, columns, vectors, strict=True):
                one.imshow(affinities(values), cmap='viridis', vmin=0.0, vmax=1.0)
                one.set_xticks([])
                one.set_yticks([])
                if number == 0:
                    one.set_title(title)
            row[0].set_ylabel(f'{sequence.activity}, {len(masks)} frames')
        figure.tight_layout()
    return figure


def _of_different_activities(sequences: Sequence[PoseSequence]) -> list[PoseSequence]:
    """The longest motion of some activities, walking first."""
    longest: dict[str, PoseSequence] = {}
    for sequence in sequences:
        known = longest.get(sequence.activity)
        if known is None or len(sequence.poses) > len(known.poses):
            longest[sequence.activity] = sequence
    order = sorted(longest.values(), key=lambda x: (x.activity != 'walk', -len(x.poses), x.name))
    return order[:ACTIVITIES]


def _multimodality_figure(training: Described) -> Figure:
    count = min(ANALYSED, len(training.targets))
    rows = np.sort(np.random.default_rng(0).permutation(len(training.targets))[:count])
    inputs, targets = training.descriptors[rows], _scaled(training.targets[rows])
    before = _scaled(training.previous[rows])
    before *= np.sqrt(inputs.var(0).sum() / max(before.var(0).sum(), 1e-12))
    cases = (
        ('p(x | r)', inputs, FINE),
        ('p(x | x-, r)', np.hstack([before, inputs]), FINE),
        ('p(x | x-, r)', np.hstack([before, inputs]), COARSE),
    )
    with mpl.rc_context(STYLE):
        figure = Figure((8.0, 2.6), dpi=110)
        for one, (title, values, share) in zip(figure.subplots(1, 3), cases, strict=True):
            clusters = max(int(share * count), 1)
            found = multimodality(values, targets, clusters)
            one.bar(np.arange(1, len(found) + 1), np.maximum(found, 0.5), color='#3b6ea5')
            one.set_yscale('log')
            one.set_title(f'{title}, {clusters} clusters of {count}')
            one.set_xlabel('clusters of poses')
        figure.axes[0].set_ylabel('clusters of descriptors')
        figure.tight_layout()
    return figure


def _scaled(values: Array) -> Array:
    return values / np.maximum(values.std(0), 1e-6)


def _example_figure(pairs: TrainingSet) -> Figure:
    rows, columns = EXAMPLES
    chosen = np.linspace(0, len(pairs) - 1, rows * columns).astype(int)
    with mpl.rc_context(STYLE):
        figure = Figure((0.8 * columns, 1.0 * rows), dpi=110)
        grid: Any = figure.subplots(rows, columns, squeeze=False)
        for one, sample in zip(grid.ravel(), chosen, strict=True):
            one.imshow(pairs.mask(int(sample)), cmap='gray_r')
            one.set_axis_off()
            one.set_title(pairs.activities[sample], fontsize=6.0, pad=1.0)
        figure.subplots_adjust(0.01, 0.01, 0.99, 0.95, 0.05, 0.2)
    return figure
