"""Many bags that are replayed, one after the other or through Dask, and not twice.

Beside each new bag `<name>` stands `<name>.replay.json`: from what it was made (sizes and times of
the files of the input, all parameters, checksums of the files that they name, the version of this
package), and whether it is complete. It is written when a bag is begun and when it is done.
"""

from __future__ import annotations

import argparse
import copy
import fcntl
import hashlib
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

import hmt_ros
from hmt_ros.app.command_line import INTERRUPTED
from hmt_ros.app.replay.dask_cluster import through_dask
from hmt_ros.app.replay.replayed_bag import Tell, parameters_of, replay_bag
from msg_tools import BagError
from msg_tools.bags.bag_folder import unfinished_folders
from msg_tools.bags.bag_metadata import FILE_NAME, SUFFIXES
from msg_tools.files.error_line import error_line

# Stands for the folder of a bag in the options that name files of one person.
_BAG = '{bag}'
_OF_A_PERSON = ('subject', 'background', 'bme', 'body')
# What decides about a new bag besides the parameters.
_DECIDING = ('image_topic', 'camera_info_topic', 'with_images', 'keep_going')

DONE, BEFORE, FAILED = 'done', 'done before', 'failed'


@dataclass(frozen=True)
class Outcome:
    """What became of a bag.

    Attributes:
        name: of the new bag, in its folder.
        kind: `DONE`, `BEFORE` or `FAILED`.
        text: a line about it.
        told: lines that a person should know.
    """

    name: str
    kind: str
    text: str
    told: tuple[str, ...] = ()


def is_many(options: argparse.Namespace) -> bool:
    """Whether the command is about several bags."""
    if options.scheduler is not None or len(options.bags) > 1:
        return True
    path = options.bags[0]
    return path.is_dir() and not (path / FILE_NAME).exists() and any(_bags_in(path, None))


def of_bag(options: argparse.Namespace, source: Path, target: Path) -> argparse.Namespace:
    """The command for one bag."""
    one = copy.copy(options)
    one.bag, one.output = source, target
    folder = str(source if source.is_dir() else source.parent)
    for name in _OF_A_PERSON:
        value = getattr(options, name)
        if value is not None:
            setattr(one, name, type(value)(str(value).replace(_BAG, folder)))
    return one


def replay_many(options: argparse.Namespace, tell: Tell) -> int:
    """Replays all bags; the exit code.

    Args:
        options: of the command.
        tell: takes lines for stderr.

    Raises:
        ValueError: nothing can be begun.
    """
    if options.live:
        raise ValueError('--live replays one bag at a time; leave it out for several')
    jobs = _jobs(options)
    counts = dict.fromkeys((DONE, BEFORE, FAILED), 0)
    try:
        with (
            _alone_in(options.output),
            tqdm(total=len(jobs), unit='bag', disable=True if options.quiet else None) as bar,
        ):
            for outcome in _outcomes(jobs, options.scheduler):
                counts[outcome.kind] += 1
                for line in outcome.told:
                    tell(line)
                if outcome.kind == FAILED:
                    tell(f'{outcome.name}: {outcome.text}')
                elif not options.quiet:
                    tqdm.write(f'{outcome.name}: {outcome.text}')
                bar.update()
    except KeyboardInterrupt:
        done = counts[DONE] + counts[BEFORE]
        tell(f'interrupted, {done} of {len(jobs)} bags are done; the same command goes on')
        return INTERRUPTED
    if not options.quiet:
        print(
            f'{options.output}: {counts[DONE]} replayed, {counts[BEFORE]} done before, '
            f'{counts[FAILED]} failed'
        )
    return 1 if counts[FAILED] else 0


def _outcomes(jobs: list[argparse.Namespace], scheduler: str | None) -> Iterator[Outcome]:
    if scheduler is None:
        yield from map(replay_job, jobs)
        return
    for job, outcome in through_dask(replay_job, jobs, scheduler):
        # An error here is one of Dask: a worker that was killed, say.
        yield outcome if isinstance(outcome, Outcome) else Outcome(job.name, FAILED, outcome)


def replay_job(options: argparse.Namespace) -> Outcome:
    """Replays one bag of many, unless that has been done."""
    told: list[str] = []
    try:
        kind, text = _replayed_once(options, told.append)
    except Exception as error:  # noqa: BLE001 - whatever it is, the other bags are replayed
        text = error_line(error)
        kind = FAILED
        if not isinstance(error, (ValueError, OSError)):
            text = f'{type(error).__name__}: {text}'
    return Outcome(options.name, kind, text, tuple(told))


def _replayed_once(options: argparse.Namespace, tell: Tell) -> tuple[str, str]:
    target = options.output
    record = target.with_name(f'{target.name}.replay.json')
    made_from = _made_from(options)
    known = _read_record(record)
    if known.get('made_from') == made_from:
        if known.get('done') and known.get('files') == _sizes(target):
            return BEFORE, 'done before'
        # Begun by this command, and not completed: what lies there is ours.
        options.overwrite = True
        for folder in unfinished_folders(target):
            shutil.rmtree(folder, ignore_errors=True)
    elif os.path.lexists(target) and not options.overwrite:
        raise BagError(
            f'{target} is there, made from something else or with other parameters; --overwrite '
            'replaces it, or give another folder'
        )
    target.parent.mkdir(parents=True, exist_ok=True)
    _write_record(record, {'done': False, 'made_from': made_from})
    replayed = replay_bag(options, tell)
    _write_record(
        record,
        {
            'done': True,
            'images': replayed.images,
            'tracked': replayed.tracked,
            'files': _sizes(target),
            'made_from': made_from,
        },
    )
    return DONE, f'{replayed.tracked} of {replayed.images} images tracked'


# What a bag was made from


def _made_from(options: argparse.Namespace) -> dict[str, Any]:
    parameters = {
        node: None if values is None else _without_paths(asdict(values))
        for node, values in parameters_of(options)._asdict().items()
    }
    source = options.bag
    files = sorted(source.iterdir()) if source.is_dir() else [source]
    made_from = {
        'version': hmt_ros.__version__,
        'input': {
            path.name: [path.stat().st_size, path.stat().st_mtime_ns]
            for path in files
            if path.name == FILE_NAME or path.name.endswith(SUFFIXES)
        },
        'parameters': parameters,
        'options': {name: getattr(options, name) for name in _DECIDING},
    }
    # As it will be read again.
    result: dict[str, Any] = json.loads(json.dumps(made_from, default=str))
    return result


def _without_paths(value: Any) -> Any:
    """Values with the checksums of files in place of their names."""
    if isinstance(value, dict):
        return {key: _without_paths(entry) for key, entry in value.items()}
    if isinstance(value, str) and value and len(value) < 4096 and Path(value).is_file():
        return f'sha256:{hashlib.sha256(Path(value).read_bytes()).hexdigest()}'
    return value


def _sizes(folder: Path) -> dict[str, int]:
    return {p.name: p.stat().st_size for p in sorted(folder.iterdir())} if folder.is_dir() else {}


def _read_record(path: Path) -> dict[str, Any]:
    """A record, empty where it is not one."""
    with suppress(OSError, ValueError):
        content = json.loads(path.read_text('utf-8'))
        if isinstance(content, dict):
            return content
    return {}


def _write_record(path: Path, content: dict[str, Any]) -> None:
    partial = path.with_name(f'.{path.name}.partial')
    with partial.open('w', encoding='utf-8') as file:
        json.dump(content, file, indent=1)
        file.flush()
        os.fsync(file.fileno())
    partial.replace(path)


# Which bags


def _jobs(options: argparse.Namespace) -> list[argparse.Namespace]:
    """The command for each bag, with names that mean the same everywhere."""
    found: dict[str, Path] = {}
    for path in options.bags:
        several = path.is_dir() and not (path / FILE_NAME).exists()
        if several and path.resolve() == options.output.resolve():
            raise ValueError(f'{path} is the folder that is read; give another name')
        bags = dict(_bags_in(path, options.output)) if several else {_name(path): path}
        if not bags:
            raise BagError(f'{path} has no bags in it')
        for name, bag in bags.items():
            if found.setdefault(name, bag) != bag:
                raise ValueError(
                    f'{found[name]} and {bag} would both become {options.output / name}'
                )
    jobs = []
    for name, bag in found.items():
        job = of_bag(options, bag.absolute(), options.output.absolute() / name)
        job.name, job.quiet = name, True
        job.config = [file.absolute() for file in options.config]
        for option in _OF_A_PERSON:
            value = getattr(job, option)
            if value and Path(value).is_file():
                setattr(job, option, type(value)(Path(value).absolute()))
        del job.bags
        jobs.append(job)
    return jobs


def _bags_in(folder: Path, output: Path | None) -> Iterator[tuple[str, Path]]:
    """Names and places of the bags in a folder, at any depth, without those of the output."""
    avoided = None if output is None else output.resolve()
    for here, folders, files in os.walk(folder):
        place = Path(here)
        inside = []
        for name in sorted(folders):
            path = place / name
            if name.startswith('.') or path.resolve() == avoided:
                continue
            if (path / FILE_NAME).is_file():
                yield str(path.relative_to(folder)), path
            else:
                inside.append(name)
        folders[:] = inside
        for name in sorted(files):
            if name.endswith(SUFFIXES) and not name.startswith('.'):
                path = place / name
                yield str(path.relative_to(folder).with_name(_name(path))), path


def _name(path: Path) -> str:
    name = path.resolve().name
    for suffix in ('.zstd', '.mcap', '.db3') if path.is_file() else ():
        name = name.removesuffix(suffix)
    return name


@contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Two commands that write into one folder would take each other's bags for left half done."""
    folder.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ValueError(f'another replay writes into {folder}') from None
        except OSError:
            # A file system without locks, of the network say: as one is told, there is but one.
            pass
        yield
    finally:
        os.close(descriptor)
