"""learn-lengths: learns how the lengths of a body vary over people, from motion files.

learn-lengths FILES... --people index.csv

It prints the entries `lengths` and `stature_spread` of the body's YAML file, and how likely they
make people left out.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from hmt_ros.app.command_line import CommandParser, run_command
from hmt_ros.app.learn_motion import chosen_motions, read_motions
from hmt_ros.app.learn_prior import add_people_tables, people_in, person_of
from hmt_ros.body import Body, load_body
from hmt_ros.inference.arrays import Array
from hmt_ros.motion.length_learning import (
    held_out,
    learned_spread,
    own_skeletons,
    relative_lengths,
    usual_spread,
)
from hmt_ros.motion.motion_file import read_motion
from hmt_ros.motion.retarget import body_from_motion

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
    parser.add_motions()
    add_people_tables(parser)
    return parser


def _learn(arguments: argparse.Namespace) -> int:
    body = load_body(arguments.body)
    usual, owners = usual_spread(body), people_in(arguments.people)
    found = read_motions(
        'learn-lengths', chosen_motions(arguments.motions, []), arguments.body, _lengths
    )
    people = [person_of(name, owners) for name, _ in found]
    rows = np.array([lengths for _, lengths in found])
    names, relative = own_skeletons(body, people, rows)
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


def _lengths(path: Path, body: Body) -> tuple[str, Array]:
    """Name of a motion without suffix, and the lengths of its skeleton, m."""
    motion = read_motion(path)
    motion = motion.part(0, None, max(len(motion.poses) // FRAMES, 1))
    lengths = body_from_motion(motion, body).skeleton.lengths
    relative_lengths(body, lengths[None])
    return path.stem, lengths
