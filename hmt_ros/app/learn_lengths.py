"""learn-lengths: learns how the lengths of a body vary over people, from motion files.

learn-lengths FILES... --people index.csv

It prints the entries `lengths` and `stature_spread` of the body's YAML file, and how likely they
make people left out.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from hmt_ros.app.command_line import CommandParser, run_command
from hmt_ros.app.learn_prior import people_in
from hmt_ros.app.progress import tell_user, with_progress
from hmt_ros.body import load_body
from hmt_ros.experts.training_set import motion_files
from hmt_ros.motion.length_learning import (
    held_out,
    learned_spread,
    own_skeletons,
    relative_lengths,
    usual_spread,
)
from hmt_ros.motion.motion_file import read_motion
from hmt_ros.motion.retarget import body_from_motion
from msg_tools.files.error_line import error_line

# Number of frames of a motion that its lengths are measured on.
FRAMES = 60


def main(argv: list[str] | None = None) -> int:
    """Runs the command; returns 0, or 1 after bad input, which one line on stderr explains."""
    return run_command(_parser(), _learn, argv)


def _parser() -> CommandParser:
    parser = CommandParser(
        prog='learn-lengths',
        description='Learns how lengths vary over people, from the skeletons of motion files.',
    )
    parser.add_argument(
        'files', type=Path, nargs='+', metavar='FILES',
        help='motion files (.bvh, or .amc beside its .asf), or folders of them',
    )  # fmt: skip
    parser.add_argument('--body', default='human37', help='body model: a name or a YAML file')
    parser.add_argument(
        '--people', type=Path, nargs='+', default=[], metavar='FILE.csv',
        help='tables with the columns file and subject: whose skeleton a file has (default: the '
        'first two words of its name)',
    )  # fmt: skip
    return parser


def _learn(arguments: argparse.Namespace) -> int:
    body = load_body(arguments.body)
    usual, owners = usual_spread(body), people_in(arguments.people)
    paths = [x for one in arguments.files for x in (motion_files(one) if one.is_dir() else [one])]
    people, rows = [], []
    for path in with_progress(paths, 'reading', 'motions', len(paths)):
        try:
            motion = read_motion(path)
            motion = motion.part(0, None, max(len(motion.poses) // FRAMES, 1))
            lengths = body_from_motion(motion, body).skeleton.lengths
            relative_lengths(body, lengths[None])
        except (ValueError, OSError, np.linalg.LinAlgError) as error:
            tell_user('learn-lengths', f'skipped {path.name}: {error_line(error)}')
            continue
        people.append(owners.get(path.stem) or '_'.join(path.stem.split('_')[:2]))
        rows.append(lengths)
    if not rows:
        raise ValueError(f'none of the {len(paths)} motions can be used')
    names, relative = own_skeletons(body, people, np.array(rows))
    spread = learned_spread(relative, usual)
    print(f'# {len(names)} people with a skeleton of their own: {", ".join(names)}')
    if len(names) > 2:
        learned, plain = held_out(relative, usual)
        print(f'# people left out: {learned.mean():.2f} nats, model file {plain.mean():.2f}')
    print('lengths:')
    for (name, value), own in zip(body.segment_lengths.items(), spread.proportions, strict=True):
        print(f'  {name}: [{value:.3f}, {own:.3f}]')
    print(f'stature_spread: {spread.stature:.3f}')
    return 0


if __name__ == '__main__':
    sys.exit(main())
