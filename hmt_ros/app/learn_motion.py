"""learn-motion: learns the motion prior of a body from recorded motions.

    learn-motion FILES_OR_FOLDERS ... -o human37_motion.npz

The filter, the smoother and the prediction of poses take the file that lies beside the body's YAML
file, in `hmt_ros/body/models`, as BODY_motion.npz.
"""

from __future__ import annotations

import fnmatch
import os
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from hmt_ros.app.command_line import CommandParser, model_file, run_command
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


@dataclass(frozen=True)
class LearningOptions:
    """Options of the command.

    Attributes:
        motions: Files or folders of recorded motions.
        output: File to write; '.npz' is appended where it is missing.
        without: Names of motions that are left out, without suffix.
        body: Body model: a name or a YAML file.
        acknowledgement: What to say of the sources in the file.
        overwrite: Whether an existing file is replaced.
        quiet: Whether progress and summary are suppressed.
    """

    motions: list[Path]
    output: Path
    without: list[str]
    body: str
    acknowledgement: str
    overwrite: bool
    quiet: bool


def main(argv: list[str] | None = None) -> int:
    """Runs the command; returns 0, or 1 after bad input, which one line on stderr explains."""
    return run_command(
        _parser(), lambda arguments: _learn(LearningOptions(**vars(arguments))), argv
    )


def _parser() -> CommandParser:
    parser = CommandParser(
        prog='learn-motion', description='Learns how the poses of a body move, from motions.'
    )
    parser.add_motions()
    return parser


def _learn(options: LearningOptions) -> int:
    output = model_file(options.output, overwrite=options.overwrite)
    body = load_body(options.body)
    paths = chosen_motions(options.motions, options.without)
    quiet = options.quiet
    shown = with_progress(paths, 'reading', 'motions', len(paths), quiet=quiet)
    read = [_sequence(path, body) for path in shown]
    sequences = [one for one in read if one is not None]
    if not sequences:
        raise ValueError(f'none of the {len(paths)} motions can be used')
    card = data_card(sequences, options.acknowledgement)
    with show_progress('learning', quiet=quiet):
        model = learned_motion(body, [one.poses for one in sequences], RATE, card)
    write_arrays(output, model.arrays())
    if not options.quiet:
        skipped = len(paths) - len(sequences)
        skips = f', {skipped} skipped' if skipped else ''
        size = output.stat().st_size / 1e3
        print(f'{output}: {len(sequences)} motions{skips}, {size:.0f} kB', flush=True)
    return 0


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


def _sequence(path: Path, body: Body) -> PoseSequence | None:
    """The motion of a file; None, with one line on stderr, if the file cannot be used."""
    try:
        fps = read_motion(path).fps
        rate = fps / max(round(fps / RATE), 1)
        if abs(rate / RATE - 1.0) > SAME_RATE:
            raise ValueError(f'{fps:g} frames per second, wanted a multiple of {RATE:g}')
        return recorded_sequence(path, body)
    except (ValueError, OSError, ArithmeticError) as error:
        tell_user('learn-motion', f'skipped {path.name}: {error_line(error)}')
        return None


def read_motions(command: str, paths: list[Path], body: str, *, quiet: bool) -> list[PoseSequence]:
    """The motions that can be used, as poses of a body; a line on stderr for each other one.

    Args:
        command: that reads them, for that line.
        paths: of motions.
        body: name or file of the body.
        quiet: no progress.
    """
    sequences = []
    with ProcessPoolExecutor(min(os.cpu_count() or 1, 8)) as pool:
        found = pool.map(partial(_recorded, body=body), paths, chunksize=2)
        for path, one in zip(
            paths, with_progress(found, 'reading', 'motions', len(paths), quiet=quiet), strict=True
        ):
            if isinstance(one, str):
                tell_user(command, f'skipped {path.name}: {one}')
            else:
                sequences.append(one)
    return sequences


def _recorded(path: Path, body: str) -> PoseSequence | str:
    """The motion of a file, or why it can not be used."""
    try:
        return recorded_sequence(path, load_body(body))
    except (ValueError, OSError, ArithmeticError, np.linalg.LinAlgError) as error:
        return error_line(error)


def shares_of(sequences: list[PoseSequence], alike: str, share: float) -> list[float]:
    """How often each motion is drawn: those whose names start with `alike` less often."""
    return [share if alike and one.name.startswith(alike) else 1.0 for one in sequences]


def data_card(sequences: list[PoseSequence], acknowledgement: str) -> str:
    """What the file says of its motions."""
    seconds = sum(len(one.poses) for one in sequences) / RATE
    names = ', '.join(sorted(one.name for one in sequences))
    said = f'{acknowledgement.strip()}\n' if acknowledgement.strip() else ''
    return f'{said}Learned from {len(sequences)} motions, {seconds:.0f} s: {names}.'


if __name__ == '__main__':
    sys.exit(main())
