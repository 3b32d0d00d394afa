"""learn: learns from motion files what the tracker knows of people.

learn lengths FILES_OR_FOLDERS ... --people index.csv
learn prior   FILES_OR_FOLDERS ... --people index.csv --test OTHERS ... -o human37_prior.npz
learn motion  FILES_OR_FOLDERS ... -o human37_motion.npz
learn lifter  FILES_OR_FOLDERS ... --test OTHERS ... -o keypoints.npz

The tracker takes the priors of angles and of motion that lie beside the body's YAML file, in
`hmt_ros/body/models`, and the lifter in `hmt_ros/experts/models`; any other lifter by its path.
`lengths` prints the entries `lengths` and `stature_spread` of that YAML file, and how likely they
make people left out.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from hmt_learning.app.motions import (
    add_alike,
    add_model,
    add_motions,
    add_people_tables,
    add_seed,
    add_sources,
    add_test,
    chosen_motions,
    data_card,
    model_file,
    people_in,
    person_of,
    read_motions,
    shares_of,
)
from hmt_learning.motion.motion_file import read_motion
from hmt_learning.motion.retarget import body_from_motion
from hmt_learning.training.keypoint_tracks import keypoint_tracks
from hmt_learning.training.keypoint_training import WindowSettings
from hmt_learning.training.length_learning import (
    held_out,
    learned_spread,
    own_skeletons,
    relative_lengths,
    usual_spread,
)
from hmt_learning.training.lifter_learning import LearningSettings, learn_lifter, scores_on
from hmt_learning.training.motion_learning import learned_motion
from hmt_learning.training.network_learning import check_tools
from hmt_learning.training.prior_learning import (
    LearnedPrior,
    PriorData,
    PriorSettings,
    learned_prior,
    plain_log_density,
    prior_data,
    recorded_dofs,
)
from hmt_learning.training.training_set import PoseSequence, recorded_sequence
from hmt_ros.app.command_line import CommandParser, number, run_command, whole_number
from hmt_ros.app.progress import say, show_progress, with_progress
from hmt_ros.body import Body, load_body, model_names
from hmt_ros.body.angle_mixture import AngleMixture
from hmt_ros.body.learned_file import write_model
from hmt_ros.body.motion_prior import LearnedMotion
from hmt_ros.experts.lifter import Lifter
from hmt_ros.experts.pose_predictor import RATE
from hmt_ros.inference.arrays import Array, Index

Item = TypeVar('Item')

# Approximate number of frames from which the lengths of a motion are measured.
FRAMES = 60
# Maximum relative difference between the frame rates of a motion and of the poses.
SAME_RATE = 0.01


def main(argv: list[str] | None = None) -> int:
    """Runs the command; returns 0, or 1 after bad input, which one line on stderr explains."""
    return run_command(_parser(), lambda arguments: int(arguments.work(arguments)), argv)


def _parser() -> CommandParser:
    parser = CommandParser('learn', "Learns the tracker's models of people from motion files.")
    what = parser.add_subparsers(required=True, metavar='WHAT', dest='what')
    parsers = {}
    for name, work, text in (
        ('lengths', _lengths, 'the distribution of segment lengths over people'),
        ('lifter', _lifter, 'experts that estimate the depths of joints from windows of keypoints'),
        ('motion', _motion, 'the motion prior of a body'),
        ('prior', _prior, 'the prior of the joint angles'),
    ):
        parsers[name] = what.add_parser(name, help=text, description=f'Learns {text}.')
        parsers[name].set_defaults(work=work)
        add_motions(parsers[name])
    for name in ('lifter', 'motion', 'prior'):
        add_model(parsers[name])
        add_sources(parsers[name])
    for name in ('lengths', 'prior'):
        add_people_tables(parsers[name])
    for name in ('lifter', 'prior'):
        add_seed(parsers[name])
        add_test(parsers[name])
    _add_lifter(parsers['lifter'])
    _add_prior(parsers['prior'])
    return parser


def _add_lifter(parser: CommandParser) -> None:
    usual = LearningSettings()
    add_alike(parser)
    parser.add_argument(
        '--steps',
        type=whole_number(1),
        default=usual.steps,
        help=f'number of steps ({usual.steps})',
    )
    parser.add_argument(
        '--batch', type=whole_number(2), default=usual.batch, help=f'windows a step ({usual.batch})'
    )
    parser.add_argument(
        '--experts',
        type=whole_number(1, 32),
        default=usual.experts,
        help=f'number of experts ({usual.experts})',
    )
    parser.add_argument(
        '--start-from',
        type=Path,
        metavar='LIFTER',
        help='lifter from which to continue, with fewer steps and a lower rate (default: none)',
    )
    parser.add_argument(
        '--rate',
        type=number(0.0, 1.0),
        default=usual.rate,
        help=f'maximum learning rate ({usual.rate:g})',
    )
    parser.add_argument(
        '--resume',
        action='store_true',
        help='continue an interrupted training, recorded in FILE.resume',
    )


def _add_prior(parser: CommandParser) -> None:
    usual = PriorSettings()
    parser.add_argument(
        '--components',
        type=whole_number(1, 200),
        nargs='+',
        default=list(usual.components),
        help='numbers of components to choose from, by the likelihood of people left out '
        f'({" ".join(map(str, usual.components))})',
    )
    parser.add_argument(
        '--folds',
        type=whole_number(2, 1000),
        default=usual.folds,
        help=f'number of groups of people, each left out once ({usual.folds})',
    )


def _read(
    arguments: argparse.Namespace, paths: list[Path], read: Callable[[Path, Body], Item]
) -> list[Item]:
    return read_motions('learn', paths, arguments.body, read, quiet=arguments.quiet)


def _lengths(arguments: argparse.Namespace) -> int:
    body = load_body(arguments.body)
    usual, owners = usual_spread(body), people_in(arguments.people)
    found = _read(arguments, chosen_motions(arguments.motions, []), _lengths_of)
    people = [person_of(name, owners) for name, _ in found]
    rows = np.array([lengths for _, lengths in found])
    names, relative = own_skeletons(body, people, rows)
    spread = learned_spread(relative, usual)
    say(f'# {len(names)} people with a skeleton of their own: {", ".join(names)}')
    if len(names) > 2:
        learned, plain = held_out(relative, usual)
        say(f'# people left out: {learned.mean():.2f} nats, model file {plain.mean():.2f}')
    say('lengths:')
    for (name, value), own in zip(body.segment_lengths.items(), spread.proportions, strict=True):
        say(f'  {name}: [{value:.3f}, {own:.3f}]')
    say(f'stature_spread: {spread.stature:.3f}')
    return 0


def _lengths_of(path: Path, body: Body) -> tuple[str, Array]:
    """Name of a motion without suffix, and the lengths of its skeleton, m."""
    motion = read_motion(path)
    motion = motion.part(0, None, max(len(motion.poses) // FRAMES, 1))
    lengths = body_from_motion(motion, body).skeleton.lengths
    relative_lengths(body, lengths[None])
    return path.stem, lengths


def _motion(arguments: argparse.Namespace) -> int:
    output = model_file(arguments.output, overwrite=arguments.overwrite)
    body, quiet = load_body(arguments.body), arguments.quiet
    paths = chosen_motions(arguments.motions, arguments.without)
    sequences = _read(arguments, paths, _at_rate)
    card = data_card(sequences, arguments.acknowledgement)
    with show_progress('learning', quiet=quiet):
        model = learned_motion(body, [one.poses for one in sequences], RATE, card)
    # The state at rest.
    example = np.zeros(model.dynamics.state_dimension)
    write_model(output, model, LearnedMotion.from_arrays, model.card, example)
    if not quiet:
        skipped = len(paths) - len(sequences)
        skips = f', {skipped} skipped' if skipped else ''
        size = output.stat().st_size / 1e3
        say(f'{output}: {len(sequences)} motions{skips}, {size:.0f} kB')
    return 0


def _at_rate(path: Path, body: Body) -> PoseSequence:
    """The motion in a file; its frame rate must be RATE or a multiple of it."""
    fps = read_motion(path).fps
    rate = fps / max(round(fps / RATE), 1)
    if abs(rate / RATE - 1.0) > SAME_RATE:
        raise ValueError(f'{fps:g} frames per second, wanted a multiple of {RATE:g}')
    return recorded_sequence(path, body)


def _lifter(arguments: argparse.Namespace) -> int:
    output, quiet = model_file(arguments.output, overwrite=arguments.overwrite), arguments.quiet
    mark = output.with_suffix('.resume')
    if mark.exists() and not arguments.resume:
        raise ValueError(f'{mark} records an interrupted training: give --resume, or remove it')
    taught = None if arguments.start_from is None else Lifter.load(arguments.start_from)
    check_tools()
    body = load_body(arguments.body)
    if body.name not in model_names():
        raise ValueError(f'--body {arguments.body}: wanted one that ships: {model_names()}')
    learned, tested = (
        _read(arguments, paths, recorded_sequence)
        for paths in (
            chosen_motions(arguments.motions, arguments.without),
            chosen_motions(arguments.test, []),
        )
    )
    shares = shares_of(learned, arguments.alike, arguments.alike_share)
    settings = LearningSettings(
        experts=arguments.experts,
        steps=arguments.steps,
        batch=arguments.batch,
        rate=arguments.rate,
        seed=arguments.seed,
    )
    windows = WindowSettings()
    with show_progress('placing', quiet=quiet):
        tracks = keypoint_tracks(body, learned, shares, seed=arguments.seed)
    notes = {
        **data_card(learned, arguments.acknowledgement),
        'scored on': sorted(one.name for one in tested),
        'learning': asdict(settings),
        'windows': asdict(windows),
    }
    if taught is not None:
        notes['started from'] = {x: taught.notes.get(x) for x in ('date', 'learning', 'windows')}
    with show_progress('learning', 'steps', arguments.steps, quiet=quiet) as bar:
        done = 0

        def told(step: int, _loss: float) -> None:
            nonlocal done
            bar.update(step - done)
            done = step

        lifter = learn_lifter(body, tracks, settings, windows, notes, told, mark, taught)
    if tested:
        lifter.notes['scores'] = scores_on(body, tested, lifter, windows)
    lifter.save(output)
    mark.unlink(missing_ok=True)
    if not quiet:
        size = output.stat().st_size / 1e6
        say(f'{output}: {len(learned)} motions, {size:.1f} MB')
        for name, value in lifter.notes.get('scores', {}).items():
            say(f'  {name}: {value}')
    return 0


def _prior(arguments: argparse.Namespace) -> int:
    output = model_file(arguments.output, overwrite=arguments.overwrite)
    settings = replace(
        PriorSettings(),
        components=tuple(arguments.components),
        folds=arguments.folds,
        seed=arguments.seed,
    )
    body, owners = load_body(arguments.body), people_in(arguments.people)
    sequences, people = _of_people(arguments, arguments.motions, arguments.without, owners)
    dofs = recorded_dofs(body, sequences, people)
    data = prior_data(body, sequences, people, settings)

    def bar(counts: Iterable[int], total: int) -> Iterable[int]:
        return with_progress(counts, 'learning', 'mixtures', total, quiet=arguments.quiet)

    card = data_card(sequences, arguments.acknowledgement)
    card['method'] = _method(settings, data.people)
    found = learned_prior(data, dofs, card, settings, bar)
    read = partial(AngleMixture.from_arrays, skeleton=body.skeleton)
    write_model(output, found.mixture, read, found.mixture.card, np.zeros(0))
    if arguments.quiet:
        return 0
    _describe(output, found)
    if arguments.test:
        tested, others = _of_people(arguments, arguments.test, [], owners)
        every = replace(settings, novelty=0.0, most_poses=max(len(x.poses) for x in tested))
        _describe_test(body, found, prior_data(body, tested, others, every), dofs)
    return 0


def _of_people(
    arguments: argparse.Namespace, sources: list[Path], without: list[str], owners: dict[str, str]
) -> tuple[list[PoseSequence], list[str]]:
    """Motions, and the person of each."""
    sequences = _read(arguments, chosen_motions(sources, without), recorded_sequence)
    return sequences, [person_of(one.name, owners) for one in sequences]


def _method(s: PriorSettings, people: Iterable[str]) -> str:
    names = ', '.join(sorted(set(people)))
    return (
        f'mixture of Gaussians by EM, mirror images included; people: {names}; poses {s.novelty} m '
        f'apart, at most {s.most_poses} of a motion, people weighted by the root of the number of '
        f'their poses; {s.folds} groups of people left out; shrinkage {s.shrinkage:g} poses, '
        f'bandwidth {s.bandwidth:g}, weight of the Gaussians of the model file {s.broad_weight:g}, '
        f'seed {s.seed}'
    )


def _describe(output: Path, found: LearnedPrior) -> None:
    say(
        f'{output}: {len(found.mixture.components) - 1} components over '
        f'{len(found.mixture.dofs)} angles, from {found.poses} poses of {found.motions} motions '
        f'of {found.people} people, {output.stat().st_size / 1e3:.0f} kB'
    )
    say('log likelihood of people left out, nats per pose:')
    for count, value in found.held_out.items():
        say(f'  {count:3d} components {value:8.2f}')
    say(f'  model file     {found.plain:8.2f}')


def _describe_test(body: Body, found: LearnedPrior, data: PriorData, dofs: Index) -> None:
    def plain(poses: Array) -> Array:
        return plain_log_density(body, dofs, poses)

    say('log likelihood of the test motions, nats per pose: learned, model file')
    for person in [*sorted(set(data.people)), None]:
        own = data if person is None else data.of([person])
        name = 'mean of the people' if person is None else person
        learned, usual = own.score(found.mixture.log_density), own.score(plain)
        say(f'  {name:20s} {learned:8.2f} {usual:8.2f}')
