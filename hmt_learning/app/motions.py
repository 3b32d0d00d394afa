"""Motions for a command that learns: arguments, files, and the person of each motion."""

from __future__ import annotations

import argparse
import csv
import fnmatch
import io
import os
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

import hmt_ros
from hmt_learning.training.training_set import MOTION_SUFFIXES, PoseSequence, motion_files
from hmt_ros.app.command_line import number, whole_number
from hmt_ros.app.progress import notify_user, with_progress
from hmt_ros.body import Body, load_body
from hmt_ros.experts.pose_predictor import RATE
from msg_tools.files.bounded_file import read_bytes
from msg_tools.files.error_line import error_line
from msg_tools.files.new_folder import check_file_place

MAX_TABLE = 2**22  # bytes
Item = TypeVar('Item')


def add_body(parser: argparse._ActionsContainer) -> None:
    """Adds --body."""
    parser.add_argument(
        '--body', default='human37', help='body model: a name or a YAML file (default: human37)'
    )


def add_motions(parser: argparse._ActionsContainer) -> None:
    """Adds the motions, the body and --quiet of a command that learns from recorded motions."""
    parser.add_argument(
        'motions',
        nargs='+',
        type=Path,
        metavar='MOTION',
        help='file (.bvh, or .amc beside its .asf), or folder of them with its subfolders',
    )
    add_body(parser)
    parser.add_argument('--quiet', action='store_true', help='no progress, no summary')


def add_model(parser: argparse._ActionsContainer) -> None:
    """Adds --output and --overwrite of a command that learns a model, for `model_file`."""
    parser.add_argument(
        '-o', '--output', type=Path, required=True, metavar='FILE.npz', help='file to write'
    )
    parser.add_argument('--overwrite', action='store_true', help='replace an existing file')


def add_seed(parser: argparse._ActionsContainer) -> None:
    """Adds --seed."""
    parser.add_argument(
        '--seed', type=whole_number(0), default=0, help='seed of all random numbers (default: 0)'
    )


def add_sources(parser: argparse._ActionsContainer) -> None:
    """Adds --without and --acknowledgement of a command that learns from motions."""
    parser.add_argument(
        '--without',
        nargs='+',
        default=[],
        metavar='NAME',
        help='motions to leave out: names of files without suffix, * stands for any letters',
    )
    parser.add_argument(
        '--acknowledgement',
        default='',
        metavar='TEXT',
        help='what the motions are, their licence and whom to acknowledge; kept in the file',
    )


def add_test(parser: argparse._ActionsContainer) -> None:
    """Adds --test."""
    parser.add_argument(
        '--test',
        type=Path,
        nargs='+',
        default=[],
        metavar='MOTION',
        help='motions of other people, or folders of them, for testing',
    )


def add_alike(parser: argparse._ActionsContainer) -> None:
    """Adds --alike and --alike-share, for `shares_of`."""
    parser.add_argument(
        '--alike',
        default='',
        metavar='PREFIX',
        help='prefix of the names of motions that are few exercises, each done many times',
    )
    parser.add_argument(
        '--alike-share',
        type=number(0.0, 1.0),
        default=0.35,
        metavar='SHARE',
        help='factor on the probability that these are drawn (0.35)',
    )


def add_people_tables(parser: argparse._ActionsContainer) -> None:
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


def model_file(output: Path, *, overwrite: bool) -> Path:
    """Path of a model file, with '.npz' appended if missing.

    Raises:
        ValueError: the file exists without `overwrite`, or its folder does not exist.
    """
    if output.suffix != '.npz':
        output = output.with_name(output.name + '.npz')
    check_file_place(output, overwrite=overwrite)
    return output


def chosen_motions(motions: list[Path], without: list[str]) -> list[Path]:
    """Motion files given directly or in folders, except some names without suffix (cmu_02_*).

    Raises:
        ValueError: a file has no motion, a folder has no motion file, or an exception matches no
            file.
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
    """Reads motions for a body; one line on stderr for each unusable file.

    Args:
        read: reads one motion; input and arithmetic errors mark it as unusable.

    Raises:
        ValueError: there are motions, and none can be used.
    """
    found = []
    # Not fork, because threads of other libraries may run in this process.
    context = get_context('spawn')
    with ProcessPoolExecutor(min(os.cpu_count() or 1, 8), context) as pool:
        reading = pool.map(partial(_read_one, read=read, body=body), paths, chunksize=2)
        shown = with_progress(reading, 'reading', 'motions', len(paths), quiet=quiet)
        for path, (one, why) in zip(paths, shown, strict=True):
            if one is None:
                notify_user(command, f'skipped {path.name}: {why}')
            else:
                found.append(one)
    if paths and not found:
        raise ValueError(f'none of the {len(paths)} motions can be used')
    return found


def _read_one(path: Path, read: Callable[[Path, Body], Item], body: str) -> tuple[Item | None, str]:
    """Content of a motion; or the reason why it can not be used."""
    try:
        return read(path, load_body(body)), ''
    except (ValueError, OSError, ArithmeticError, np.linalg.LinAlgError) as error:
        return None, error_line(error)


def person_of(name: str, owners: dict[str, str]) -> str:
    """The person of a motion file, from `people_in`, otherwise the first two words of its name."""
    return owners.get(name) or '_'.join(name.split('_')[:2])


def people_in(tables: Iterable[Path]) -> dict[str, str]:
    """The person of each motion file, keyed by the file's name without folder and suffix.

    Raises:
        ValueError: a table can not be read or lacks the columns file and subject.
    """
    found: dict[str, str] = {}
    for path in tables:
        try:
            text = read_bytes(path, MAX_TABLE).decode('utf-8')
            columns, *rows = csv.reader(io.StringIO(text, newline='')) if text else [[]]
        except (ValueError, csv.Error) as error:
            raise ValueError(f'{path}: {error}') from error
        missing = {'file', 'subject'} - {*columns}
        if missing:
            raise ValueError(f'{path}: no column {sorted(missing)[0]!r}')
        places = columns.index('file'), columns.index('subject')
        for row in rows:
            file, subject = (row[i] if i < len(row) else '' for i in places)
            # A question mark says that the person was guessed.
            found[Path(file).stem] = subject.rstrip('?')
    return found


def shares_of(sequences: list[PoseSequence], alike: str, share: float) -> list[float]:
    """Relative frequency of each motion: `share` if its name starts with `alike`, otherwise 1."""
    return [share if alike and one.name.startswith(alike) else 1.0 for one in sequences]


def data_card(sequences: list[PoseSequence], acknowledgement: str) -> dict[str, Any]:
    """Data card of a file learned from motions, by heading."""
    return {
        'source': acknowledgement.strip(),
        'motions': sorted(one.name for one in sequences),
        'seconds': round(sum(len(one.poses) for one in sequences) / RATE),
        'made by': f'hmt_ros {hmt_ros.__version__}',
    }
