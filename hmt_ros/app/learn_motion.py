"""learn-motion: learns the motion prior of a body from recorded motions.

    learn-motion FILES_OR_FOLDERS ... -o human37_motion.npz

The filter, the smoother and the prediction of poses take the file that lies beside the body's YAML
file, in `hmt_ros/body/models`, as BODY_motion.npz.
"""

from __future__ import annotations

import argparse
import fnmatch
import os
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import TypeVar

import numpy as np

from hmt_ros.app.command_line import CommandParser, add_sources, model_file, run_command
from hmt_ros.app.progress import show_progress, tell_user, with_progress
from hmt_ros.body import Body, load_body
from hmt_ros.experts.model_file import write_arrays
from hmt_ros.experts.training_set import (
    MOTION_SUFFIXES,
    RATE,
    PoseSequence,
    motion_files,
    recorded_sequence,
)
from hmt_ros.motion.motion_file import read_motion
from hmt_ros.motion.motion_learning import learned_motion
from msg_tools.files.error_line import error_line

# Relative difference of a motion's rate from that of the poses which is put up with.
SAME_RATE = 0.01

Item = TypeVar('Item')


def main(argv: list[str] | None = None) -> int:
    """Runs the command; returns 0, or 1 after bad input, which one line on stderr explains."""
    return run_command(_parser(), _learn, argv)


def _parser() -> CommandParser:
    parser = CommandParser(
        prog='learn-motion', description='Learns how the poses of a body move, from motions.'
    )
    parser.add_motions()
    parser.add_model()
    add_sources(parser)
    return parser


def _learn(arguments: argparse.Namespace) -> int:
    output = model_file(arguments.output, overwrite=arguments.overwrite)
    body, quiet = load_body(arguments.body), arguments.quiet
    paths = chosen_motions(arguments.motions, arguments.without)
    sequences = read_motions('learn-motion', paths, arguments.body, _at_rate, quiet=quiet)
    card = data_card(sequences, arguments.acknowledgement)
    with show_progress('learning', quiet=quiet):
        model = learned_motion(body, [one.poses for one in sequences], RATE, card)
    write_arrays(output, model.arrays())
    if not quiet:
        skipped = len(paths) - len(sequences)
        skips = f', {skipped} skipped' if skipped else ''
        size = output.stat().st_size / 1e3
        print(f'{output}: {len(sequences)} motions{skips}, {size:.0f} kB', flush=True)
    return 0


def _at_rate(path: Path, body: Body) -> PoseSequence:
    """The motion in a file, whose rate has to be that of the poses, or a multiple."""
    fps = read_motion(path).fps
    rate = fps / max(round(fps / RATE), 1)
    if abs(rate / RATE - 1.0) > SAME_RATE:
        raise ValueError(f'{fps:g} frames per second, wanted a multiple of {RATE:g}')
    return recorded_sequence(path, body)


def chosen_motions(motions: list[Path], without: list[str]) -> list[Path]:
    """Motion files, and those in folders, but some names of files without suffix (cmu_02_*).

    Raises:
        ValueError: a file that is no motion, a folder without any, or a name of none of them.
    """
    found: list[Path] = []
    for path in motions:
        if path.is_dir():
            found += motion_files(path)
        elif path.suffix.lower() in MOTION_SUFFIXES:
            found.append(path)
        else:
            raise ValueError(f'{path}: wanted a folder or a motion ({", ".join(MOTION_SUFFIXES)})')
    names = [path.stem for path in found]
    left_out: set[str] = set()
    for pattern in without:
        meant = fnmatch.filter(names, pattern)
        if not meant:
            raise ValueError(f'--without: no motion is called {pattern!r}')
        left_out |= set(meant)
    return [path for path in found if path.stem not in left_out]


def read_motions(
    command: str,
    paths: list[Path],
    body: str,
    read: Callable[[Path, Body], Item],
    *,
    quiet: bool = False,
) -> list[Item]:
    """What is read from motions for a body; a line on stderr for each that can not be used.

    Args:
        command: that reads them, for that line.
        paths: of motions.
        body: name or file of the body.
        read: reads one; errors of input and of arithmetic say that it can not be used.
        quiet: no progress.

    Raises:
        ValueError: there are motions, and none can be used.
    """
    found = []
    # Not by a fork: threads of other libraries may run in this process.
    context = get_context('spawn')
    with ProcessPoolExecutor(min(os.cpu_count() or 1, 8), context) as pool:
        reading = pool.map(partial(_read_one, read=read, body=body), paths, chunksize=2)
        shown = with_progress(reading, 'reading', 'motions', len(paths), quiet=quiet)
        for path, (one, why) in zip(paths, shown, strict=True):
            if one is None:
                tell_user(command, f'skipped {path.name}: {why}')
            else:
                found.append(one)
    if paths and not found:
        raise ValueError(f'none of the {len(paths)} motions can be used')
    return found


def _read_one(path: Path, read: Callable[[Path, Body], Item], body: str) -> tuple[Item | None, str]:
    """What is read from a motion; or why it can not be used."""
    try:
        return read(path, load_body(body)), ''
    except (ValueError, OSError, ArithmeticError, np.linalg.LinAlgError) as error:
        return None, error_line(error)


def shares_of(sequences: list[PoseSequence], alike: str, share: float) -> list[float]:
    """How often each motion is drawn: those whose names start with `alike` less often."""
    return [share if alike and one.name.startswith(alike) else 1.0 for one in sequences]


def data_card(sequences: list[PoseSequence], acknowledgement: str) -> str:
    """What the file says of its motions."""
    seconds = sum(len(one.poses) for one in sequences) / RATE
    names = ', '.join(sorted(one.name for one in sequences))
    said = f'{acknowledgement.strip()}\n' if acknowledgement.strip() else ''
    return f'{said}Learned from {len(sequences)} motions, {seconds:.0f} s: {names}.'
