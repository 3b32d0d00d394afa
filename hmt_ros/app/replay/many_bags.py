"""Replay of many bags, one after the other or through Dask; complete bags are skipped.

Each new bag `<name>` has `<name>.replay.json` next to it, which records the inputs (sizes and times
of the input files, all parameters, checksums of the files that parameters name, the version of this
package) and whether the new bag is complete. The record is written before and after the replay.
"""

from __future__ import annotations

import ctypes
import hashlib
import importlib
import json
import logging
import os
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
from tqdm import tqdm

import hmt_ros
from hmt_ros.app.last_resort import INTERRUPTED
from hmt_ros.app.progress import Notify, say, show_progress
from hmt_ros.app.replay.one_bag import replay_bag
from hmt_ros.app.replay.options import ReplayOptions, parameters_of_bag
from hmt_ros.inference.threads import limit_threads
from msg_tools import BagError
from msg_tools.bags.bag_metadata import FILE_NAME, SUFFIXES
from msg_tools.files.error_line import MAX_LINE, error_line, one_line
from msg_tools.files.new_folder import locked, new_file
from msg_tools.files.plain_json import read_plain_json

# Options, other than parameters, that affect the new bag.
_DECISIVE_OPTIONS = (
    'image_topic',
    'camera_info_topic',
    'mask_topic',
    'depth_topic',
    'keypoints_topic',
    'namespace',
    'with_images',
    'keep_going',
    'times',
)

DONE, BEFORE, FAILED = 'done', 'done before', 'failed'

# Name of the scheduler that uses the cores of this machine.
LOCAL_SCHEDULER = 'local'
_MAX_RECORD_BYTES = 2**24  # maximum size, bytes
_SCHEDULER_TIMEOUT = 10.0  # maximum time until a scheduler answers, s


class Job(NamedTuple):
    """The replay of one of many bags; `name` is the new bag's path in the output folder.

    `shows` is true if the progress of this bag is shown in addition to the total progress.
    """

    name: str
    source: Path
    target: Path
    options: ReplayOptions
    shows: bool = False


# Parameters of glibc's mallopt and their values, bytes: see `_keep_memory`.
_TRIM_THRESHOLD, _MMAP_THRESHOLD = (-1, 256 << 20), (-3, 32 << 20)


@dataclass(frozen=True)
class Outcome:
    """The outcome of a job.

    Attributes:
        kind: `DONE`, `BEFORE` or `FAILED`.
    """

    name: str
    kind: str
    text: str
    notices: tuple[str, ...] = ()


def has_several_bags(sources: Sequence[Path], scheduler: str | None) -> bool:
    """Whether the command replays several bags."""
    if scheduler is not None or len(sources) > 1:
        return True
    path = sources[0]
    return path.is_dir() and not (path / FILE_NAME).exists() and any(_bags_in(path, None))


def replay_many(
    sources: Sequence[Path],
    output: Path,
    options: ReplayOptions,
    notify: Notify,
    scheduler: str | None = None,
) -> int:
    """Replays all bags.

    Args:
        scheduler: address of a Dask scheduler, or `LOCAL_SCHEDULER`; None replays the bags one by
            one.

    Returns:
        The exit code: 0 if all bags are done, 1 if some failed, or `INTERRUPTED`.

    Raises:
        ValueError: the replay can not be started.
    """
    if options.live:
        raise ValueError('--live replays one bag at a time; leave it out for several')
    shows = scheduler is None and not options.quiet
    jobs = _jobs(sources, output, options, shows=shows)
    counts = dict.fromkeys((DONE, BEFORE, FAILED), 0)
    try:
        with (
            _alone_in(output),
            show_progress(str(output), 'bags', len(jobs), quiet=options.quiet) as bar,
        ):
            outcomes = map(replay_job, jobs) if scheduler is None else _by_dask(jobs, scheduler)
            for outcome in outcomes:
                counts[outcome.kind] += 1
                for line in outcome.notices:
                    notify(line)
                if outcome.kind == FAILED:
                    notify(f'{outcome.name}: {outcome.text}')
                elif not options.quiet:
                    tqdm.write(one_line(f'{outcome.name}: {outcome.text}', MAX_LINE))
                bar.update()
    except KeyboardInterrupt:
        done = counts[DONE] + counts[BEFORE]
        notify(f'interrupted, {done} of {len(jobs)} bags are done; the same command resumes')
        return INTERRUPTED
    if not options.quiet:
        say(
            f'{output}: {counts[DONE]} replayed, {counts[BEFORE]} done before, '
            f'{counts[FAILED]} failed'
        )
    return 1 if counts[FAILED] else 0


def _by_dask(jobs: Sequence[Job], scheduler: str) -> Iterator[Outcome]:
    """Runs jobs through Dask, and yields their outcomes in order of completion."""
    try:
        distributed: Any = importlib.import_module('distributed')
    except ImportError as error:
        raise ValueError(
            f'--scheduler needs Dask, which is not installed ({error_line(error)}): '
            '`pip install distributed`, or leave --scheduler out'
        ) from error
    with ExitStack() as opened:
        try:
            address = scheduler
            if scheduler == LOCAL_SCHEDULER:
                address = opened.enter_context(
                    distributed.LocalCluster(
                        n_workers=max(1, min(len(jobs), len(os.sched_getaffinity(0)))),
                        threads_per_worker=1,
                        processes=True,
                        host='127.0.0.1',
                        dashboard_address=None,
                        silence_logs=logging.CRITICAL,
                    )
                )
            client = opened.enter_context(distributed.Client(address, timeout=_SCHEDULER_TIMEOUT))
        except (OSError, ValueError, RuntimeError) as error:
            raise ValueError(f'--scheduler {scheduler}: {error_line(error)}') from error
        job_of = {client.submit(_replay_in_worker, job, pure=False): job for job in jobs}
        for future in distributed.as_completed(job_of):
            # `replay_job` raises nothing: an error here is from Dask, such as a killed worker.
            fault = future.exception()
            yield future.result() if fault is None else _failed(job_of[future], fault, ())


def _replay_in_worker(job: Job) -> Outcome:
    """Runs `replay_job` on one core, because each core has a worker."""
    limit_threads(1)
    cv2.setNumThreads(1)
    _keep_memory()
    return replay_job(job)


def _keep_memory() -> None:
    """Makes the C library keep the memory of an image for the next image.

    In Dask workers the library would return freed memory at once; the workers would then spend more
    than a quarter of their time on new pages, which the system fills with zeros.
    """
    mallopt = getattr(ctypes.CDLL(None), 'mallopt', None)  # only glibc has this function
    if mallopt is not None:
        for parameter, value in (_TRIM_THRESHOLD, _MMAP_THRESHOLD):
            mallopt(parameter, value)


def replay_job(job: Job) -> Outcome:
    """Replays one of many bags, unless it is complete."""
    notices: list[str] = []
    try:
        kind, text = _replayed_once(job, notices.append)
    except Exception as error:  # noqa: BLE001 - the other bags are replayed after any error
        return _failed(job, error, notices)
    return Outcome(job.name, kind, text, tuple(notices))


def _failed(job: Job, error: BaseException, notices: Sequence[str]) -> Outcome:
    text = error_line(error)
    if not isinstance(error, (ValueError, OSError)):
        text = f'{type(error).__name__}: {text}'
    return Outcome(job.name, FAILED, text, tuple(notices))


def _replayed_once(job: Job, notify: Notify) -> tuple[str, str]:
    target, options = job.target, job.options
    record = target.with_name(f'{target.name}.replay.json')
    made_from = _made_from(job)
    known = _read_record(record)
    if known.get('made_from') == made_from:
        if known.get('done') and known.get('files') == _sizes(target):
            return BEFORE, 'done before'
        # An earlier run of this command left the bag incomplete; it can be overwritten.
        options = replace(options, overwrite=True)
    elif os.path.lexists(target) and not options.overwrite:
        raise BagError(
            f'{target} exists, made from other input or with other parameters; --overwrite '
            'replaces it, or give another folder'
        )
    target.parent.mkdir(parents=True, exist_ok=True)
    _write_record(record, {'done': False, 'made_from': made_from})
    replayed = replay_bag(job.source, target, options, notify, shows=job.shows)
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
    return DONE, str(replayed)


# Input of a bag


def _made_from(job: Job) -> dict[str, Any]:
    source, options = job.source, job.options
    parameters = {
        node: None if values is None else _without_paths(asdict(values))
        for node, values in parameters_of_bag(source, options)._asdict().items()
    }
    files = sorted(source.iterdir()) if source.is_dir() else [source]
    made_from = {
        'version': hmt_ros.__version__,
        'input': {
            path.name: [path.stat().st_size, path.stat().st_mtime_ns]
            for path in files
            if path.name == FILE_NAME or path.name.endswith(SUFFIXES)
        },
        'parameters': parameters,
        'options': {name: getattr(options, name) for name in _DECISIVE_OPTIONS},
    }
    # Convert to the types that a record has when it is read again.
    result: dict[str, Any] = json.loads(json.dumps(made_from, default=str))
    return result


def _without_paths(value: Any) -> Any:
    """The value with file names replaced by checksums of the files."""
    if isinstance(value, dict):
        return {key: _without_paths(entry) for key, entry in value.items()}
    if isinstance(value, str) and value and len(value) < 4096 and Path(value).is_file():
        return f'sha256:{hashlib.sha256(Path(value).read_bytes()).hexdigest()}'
    return value


def _sizes(folder: Path) -> dict[str, int]:
    return {p.name: p.stat().st_size for p in sorted(folder.iterdir())} if folder.is_dir() else {}


def _read_record(path: Path) -> dict[str, Any]:
    """Reads a record; returns an empty one if the file is missing or invalid."""
    with suppress(ValueError):
        content = read_plain_json(path, _MAX_RECORD_BYTES)
        if isinstance(content, dict):
            return content
    return {}


def _write_record(path: Path, content: dict[str, Any]) -> None:
    with new_file(path) as file:
        file.write(json.dumps(content, indent=1).encode())


# Choice of bags


def _jobs(
    sources: Sequence[Path], output: Path, options: ReplayOptions, *, shows: bool
) -> list[Job]:
    """The jobs of the command, with absolute paths."""
    found: dict[str, Path] = {}
    for path in sources:
        several = path.is_dir() and not (path / FILE_NAME).exists()
        if several and path.resolve() == output.resolve():
            raise ValueError(f'{path} is the input folder; give another name')
        bags = dict(_bags_in(path, output)) if several else {_name(path): path}
        if not bags:
            raise BagError(f'{path} has no bags in it')
        for name, bag in bags.items():
            if found.setdefault(name, bag) != bag:
                raise ValueError(f'{found[name]} and {bag} would both become {output / name}')
    jobs = []
    for name, bag in found.items():
        source = bag.absolute()
        own = replace(options.of_bag(source).with_absolute_paths(), quiet=True)
        jobs.append(Job(name, source, output.absolute() / name, own, shows))
    return jobs


def _bags_in(folder: Path, output: Path | None) -> Iterator[tuple[str, Path]]:
    """Names and paths of the bags in a folder, at any depth, except bags in the output folder."""
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
    """Locks a folder, so that no other command replays into it."""
    folder.mkdir(parents=True, exist_ok=True)
    with locked(folder) as free:
        if free is False:
            raise ValueError(f'another replay writes into {folder}')
        yield
