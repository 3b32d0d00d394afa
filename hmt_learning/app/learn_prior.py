"""learn-prior: learns the prior of the joint angles of a body from motion files.

learn-prior FILES... -o PRIOR.npz
learn-prior FILES... --people index.csv --test OTHER_FILES... -o PRIOR.npz
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from hmt_learning.app.learn_motion import chosen_motions, read_motions
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
from hmt_ros.app.command_line import (
    CommandParser,
    add_sources,
    model_file,
    run_command,
    whole_number,
)
from hmt_ros.app.progress import with_progress
from hmt_ros.body import Body, load_body
from hmt_ros.experts.model_file import write_arrays
from hmt_ros.inference.arrays import Array, Index


def main(argv: list[str] | None = None) -> int:
    """Runs the command; returns 0, or 1 after bad input, which one line on stderr explains."""
    return run_command(_parser(), _learn, argv)


def _parser() -> CommandParser:
    s = PriorSettings()
    parser = CommandParser(
        prog='learn-prior', description='Learns the prior of the joint angles from motion files.'
    )
    parser.add_motions()
    parser.add_model()
    add_sources(parser, '--source')
    add_people_tables(parser)
    parser.add_argument(
        '--test',
        type=Path,
        nargs='+',
        default=[],
        metavar='FILES',
        help='motions of other people, whose log likelihood is printed',
    )
    parser.add_argument(
        '--components',
        type=whole_number(1, 200),
        nargs='+',
        default=list(s.components),
        help='numbers of components to choose from, by the likelihood of people left out '
        f'({" ".join(map(str, s.components))})',
    )
    parser.add_argument(
        '--folds',
        type=whole_number(2, 1000),
        default=s.folds,
        help=f'number of groups of people, each left out once ({s.folds})',
    )
    parser.add_argument(
        '--seed', type=whole_number(0), default=s.seed, help=f'seed of the starts ({s.seed})'
    )
    return parser


def _learn(arguments: argparse.Namespace) -> int:
    output = model_file(arguments.output, overwrite=arguments.overwrite)
    settings = replace(
        PriorSettings(),
        components=tuple(arguments.components),
        folds=arguments.folds,
        seed=arguments.seed,
    )
    body = load_body(arguments.body)
    owners = people_in(arguments.people)
    quiet = arguments.quiet
    motions, name = arguments.motions, arguments.body
    sequences, people = _motions(motions, arguments.without, owners, name, quiet)
    dofs = recorded_dofs(body, sequences, people)
    data = prior_data(body, sequences, people, settings)

    def bar(counts: Iterable[int], total: int) -> Iterable[int]:
        return with_progress(counts, 'learning', 'mixtures', total, quiet=quiet)

    card = {'source': arguments.source, 'method': _method(settings, data.people)}
    found = learned_prior(data, dofs, card, settings, bar)
    write_arrays(output, found.mixture.arrays())
    if quiet:
        return 0
    _describe(output, found)
    if arguments.test:
        tested, others = _motions(arguments.test, [], owners, name, quiet)
        every = replace(settings, novelty=0.0, most_poses=max(len(x.poses) for x in tested))
        _describe_test(body, found, prior_data(body, tested, others, every), dofs)
    return 0


def add_people_tables(parser: CommandParser) -> None:
    """Adds --people, for `people_in`."""
    parser.add_argument(
        '--people',
        type=Path,
        nargs='+',
        default=[],
        metavar='FILE.csv',
        help='tables with the columns file and subject: whose motion a file is (default: the first '
        'two words of its name)',
    )


def person_of(name: str, owners: dict[str, str]) -> str:
    """The person of a motion file, by `people_in`, or else by its name without suffix."""
    return owners.get(name) or '_'.join(name.split('_')[:2])


def people_in(tables: Iterable[Path]) -> dict[str, str]:
    """The person of each motion file, by the name of the file without folder and suffix.

    Raises:
        ValueError: a table without the columns file and subject; one line.
    """
    found: dict[str, str] = {}
    for path in tables:
        with path.open(encoding='utf-8', newline='') as file:
            rows = csv.DictReader(file)
            missing = {'file', 'subject'} - set(rows.fieldnames or ())
            if missing:
                raise ValueError(f'{path}: no column {sorted(missing)[0]!r}')
            for row in rows:
                # A question mark: the person was guessed.
                found[Path(row['file'] or '').stem] = (row['subject'] or '').rstrip('?')
    return found


def _motions(
    sources: list[Path], without: list[str], owners: dict[str, str], body: str, quiet: bool
) -> tuple[list[PoseSequence], list[str]]:
    """Motions and their people; files that cannot be used give one line on stderr."""
    paths = chosen_motions(sources, without)
    sequences = read_motions('learn-prior', paths, body, recorded_sequence, quiet=quiet)
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
    print(
        f'{output}: {len(found.mixture.components) - 1} components over '
        f'{len(found.mixture.dofs)} angles, from {found.poses} poses of {found.motions} motions '
        f'of {found.people} people, {output.stat().st_size / 1e3:.0f} kB'
    )
    print('log likelihood of people left out, nats per pose:')
    for count, value in found.held_out.items():
        print(f'  {count:3d} components {value:8.2f}')
    print(f'  model file     {found.plain:8.2f}', flush=True)


def _describe_test(body: Body, found: LearnedPrior, data: PriorData, dofs: Index) -> None:
    def plain(poses: Array) -> Array:
        return plain_log_density(body, dofs, poses)

    print('log likelihood of the test motions, nats per pose: learned, model file')
    for person in [*sorted(set(data.people)), None]:
        own = data if person is None else data.of([person])
        name = 'mean of the people' if person is None else person
        learned, usual = own.score(found.mixture.log_density), own.score(plain)
        print(f'  {name:20s} {learned:8.2f} {usual:8.2f}')
