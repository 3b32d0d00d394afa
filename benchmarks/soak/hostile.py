"""Soak test of every command that reads files, with well-formed hostile files.

A command runs in a forked child of this process, which has the modules loaded, or sometimes in its
own interpreter. It is allowed 5 s of processor time, including its start, and 1 GB; it must print
one line of at most 300 characters, and leave nothing but its output.
"""

from __future__ import annotations

import importlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NoReturn

import cv2
import numpy as np

from benchmarks.clips import COMPRESSED, read_messages
from benchmarks.machine import forget_peak, peak_memory
from benchmarks.soak.hostile_file import Hostile
from benchmarks.soak.hostile_files import hostile_files
from benchmarks.soak.outcome import Amount, Outcome
from benchmarks.soak.scenes import CLIP
from msg_tools import BagWriter

# Limits of a command: processor time, s; wall time on a busy machine, s; memory, bytes; characters
# in a line; lines, because warnings may precede the error.
SECONDS, WALL_SECONDS, MEMORY, CHARACTERS, LINES = 5.0, 40.0, 1e9, 300, 3
# Processor time for imports, which a forked child saves, s.
_START = 1.5
# One run of this many uses its own interpreter.
_ALONE = 20
_LOOKS = 0.02  # interval between two checks of a child, s

_BAGS = '.mcap .db3 .zst .zstd folder'
_TABLES = '.json .npz .csv .trc folder'
_VIDEOS = '.mp4 .avi .mkv .gif .y4m .m3u8 folder'
_PICTURES = '.png .jpg .bmp .tif .webp .exr .hdr .pgm .jp2 .gif'
_REPLAY = 'hmt_ros replay FILE -o OUT --quiet --set max_hypotheses=2 --set threads=1'
_TRACK = _REPLAY.replace('FILE', 'GOOD/bag')
_IMPORT = 'hmt_ros import-video GOOD/video.avi -o OUT --quiet'
_LIFT = 'hmt_ros lift GOOD/keypoints.npz -o OUT --fov 60 --size 640x480 --quiet'
_LIFTED = 'GOOD/lifted/lifted'
_MAKE = 'hmt_learning make-bag -o OUT --duration 0.1 --size 64x48'
# Suffixes of the files that a command takes, and its arguments. FILE is the file, OUT the output,
# GOOD a folder of good files.
ROUTES: dict[str, tuple[str, str]] = {
    'replay': (_BAGS, _REPLAY),
    'replay on': (_BAGS, f'{_REPLAY} --keep-going --people'),
    'evaluate': (_BAGS, 'hmt_ros evaluate FILE --quiet'),
    'truth': (f'{_BAGS} .npz', f'hmt_ros evaluate {_LIFTED} --truth FILE --quiet'),
    'report': (_BAGS, 'hmt_ros report FILE -o OUT --quiet'),
    'report images': (_BAGS, f'hmt_ros report {_LIFTED} --images FILE -o OUT --quiet'),
    'export': (_BAGS, 'hmt_ros export FILE -o OUT.npz --quiet'),
    'camera': ('.yaml .xml .json .toml', f'{_IMPORT} --camera FILE'),
    'lift': (_TABLES, _LIFT.replace('GOOD/keypoints.npz', 'FILE')),
    'keypoints': (_TABLES, f'{_IMPORT} --fov 60 --keypoints FILE'),
    'video': (_VIDEOS, 'hmt_ros track-video FILE --fov 60 --no-detector --fps 5 -o OUT --quiet'),
    'masks': (_VIDEOS, f'{_IMPORT} --fov 60 --masks FILE'),
    'background': (_PICTURES, f'{_TRACK} --background FILE'),
    'subject': ('.yaml', f'{_TRACK} --subject FILE'),
    'lengths': ('.yaml', f'{_LIFT} --subject FILE'),
    'config': ('.yaml', f'{_TRACK} --config FILE'),
    'body': ('.yaml', f'hmt_ros evaluate {_LIFTED} --truth GOOD/bag --body FILE --quiet'),
    'body of a bag': ('.yaml', f'{_MAKE} reach --body FILE'),
    'model': ('.npz', f'{_TRACK} --bme FILE'),
    'lifter': ('.npz', f'{_LIFT} --lifter FILE'),
    'motion': ('.bvh .amc', f'{_MAKE} x --mocap FILE'),
    'motions': ('.bvh .amc folder', 'hmt_learning learn lengths FILE --quiet'),
    'people': ('.csv', 'hmt_learning learn lengths GOOD --people FILE --quiet'),
    'output': ('.out', f'hmt_ros export {_LIFTED} -o FILE/x.npz --overwrite'),
    'written over': ('.out', f'hmt_ros report {_LIFTED} -o FILE --overwrite --quiet'),
}


@dataclass
class _Run:
    """Result of a command: exit code or minus its signal, time, memory and output."""

    code: int
    seconds: float
    memory: float
    said: str
    stopped: str = ''


def hostile(amount: Amount, *, quick: bool = False, given: Path | None = None) -> Iterator[Outcome]:
    """Runs commands on every kind of hostile file, or on the files of a folder."""
    cv2.setNumThreads(1)
    for program in ('hmt_ros', 'hmt_learning'):
        for module, _ in importlib.import_module(f'{program}.app').COMMANDS.values():
            importlib.import_module(module)
    with TemporaryDirectory(prefix='hmt_ros.') as name:
        folder = Path(name)
        good = folder / 'good'
        _write_good_files(good)
        kinds = hostile_files(good) if given is None else {given.name: _given(given)}
        if quick:
            kinds = dict(list(kinds.items())[1::4])
        end = time.monotonic() + amount.seconds
        for number, (kind, found) in enumerate(kinds.items()):
            outcome = Outcome(kind, 'well-formed and hostile, read by commands')
            # Time that one kind does not need is left to the others.
            part = replace(amount, seconds=(end - time.monotonic()) / (len(kinds) - number))
            _read_all(list(found), good, folder / 'case', part, outcome, quick=quick)
            yield outcome


def _given(folder: Path) -> Iterator[Hostile]:
    for path in sorted(folder.iterdir()):
        if path.suffix != '.md':
            yield Hostile(path.name, write=partial(_copied, path))


def _copied(path: Path, at: Path) -> None:
    (shutil.copytree if path.is_dir() else shutil.copyfile)(path, at)


def _write_good_files(folder: Path) -> None:
    """Writes a short bag, a video of it, keypoints and their lifted poses."""
    folder.mkdir()
    info, images = read_messages(CLIP, [COMPRESSED])
    images = images[:3]
    with BagWriter(folder / 'bag') as bag:
        bag.add_topic('camera_info', info.__msgtype__)
        bag.add_topic('image/compressed', images[0].__msgtype__)
        for number, image in enumerate(images):
            bag.write('camera_info', number, info)
            bag.write('image/compressed', number, image)
    write_video(folder / 'video.avi')
    rng = np.random.default_rng(0)
    names = ('left_hip', 'right_hip', 'left_shoulder', 'right_shoulder', 'left_knee', 'nose')
    pixels = rng.uniform(100.0, 300.0, (3, len(names), 2))
    np.savez(folder / 'keypoints.npz', pixels=pixels, landmark_names=np.array(names))
    words = _filled(_LIFT, {'GOOD': folder, 'OUT': folder / 'lifted'})
    run = _finished(_forked(words, folder, {}), WALL_SECONDS)
    if run.code:
        raise ValueError(f'the keypoints of the soak can not be lifted: {run.said}')


def write_video(path: Path) -> None:
    """Writes a video of three images of the clip."""
    _, images = read_messages(CLIP, [COMPRESSED])
    pictures = [cv2.imdecode(image.data, cv2.IMREAD_COLOR) for image in images[:3]]
    size = pictures[0].shape[1::-1]
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*'MJPG'), 5.0, size)
    for picture in pictures:
        video.write(picture)
    video.release()


def _read_all(
    files: Sequence[Hostile],
    good: Path,
    case: Path,
    amount: Amount,
    outcome: Outcome,
    *,
    quick: bool,
) -> None:
    """Gives files to all commands that read them, in random order."""
    runs = [
        (file, route)
        for file in files
        for route, (suffixes, _) in ROUTES.items()
        if (route in file.routes if file.routes else file.suffix in suffixes.split())
    ]
    order = np.random.default_rng(0).permutation(len(runs))
    for number in Amount(min(len(runs), amount.times), amount.seconds).counted():
        file, route = runs[order[number]]
        outcome.times += 1
        alone = not quick and number % _ALONE == _ALONE - 1
        run, left = _read_one(file, ROUTES[route][1], good, case, alone=alone)
        outcome.refused += run.code == 1
        for what in [*_wrong(run), *left]:
            outcome.fault(f'{file.name}, {route}: {what}')


def _read_one(
    file: Hostile, words: str, good: Path, case: Path, *, alone: bool
) -> tuple[_Run, list[str]]:
    """Runs a command on a file; returns its result and the wrong files that it leaves."""
    for name in ('in', 'work', 'tmp', 'home', 'kept'):
        (case / name).mkdir(parents=True)
    try:
        path = case / 'in' / file.name
        (case / 'kept' / 'canary').write_text('alive')
        file.make(path)
        given = {'FILE': path, 'OUT': case / 'work' / 'out', 'GOOD': good}
        environment = {x: str(case / y) for x, y in (('TMPDIR', 'tmp'), ('HOME', 'home'))}
        environment['MPLCONFIGDIR'] = str(good / 'matplotlib')
        before = _there(case)
        start = (_spawned if alone else _forked)(_filled(words, given), case / 'work', environment)
        run = _finished(start, SECONDS if alone else SECONDS - _START)
        made = sorted(_there(case) ^ before)
        allowed = {str(case / 'work' / x) for x in ('out', 'out.npz') if run.code == 0}
        left = [
            f'leaves {x.removeprefix(str(case))[:60]!r}'
            for x in made
            if not run.stopped and not any(x == y or x.startswith(f'{y}/') for y in allowed)
        ]
        if (case / 'kept' / 'canary').read_bytes() != b'alive':
            left.append('writes through a link')
        return run, left[:1]
    finally:
        shutil.rmtree(case)


def _there(folder: Path) -> set[str]:
    return {
        str(Path(at) / name)
        for at, folders, names in os.walk(folder)
        for name in (*folders, *names)
        if name != 'said'
    }


def _filled(words: str, given: Mapping[str, Path]) -> list[str]:
    """The arguments of a command, with paths filled in."""
    filled = []
    for word in words.split():
        head = word.split('/')[0].split('.')[0]
        filled.append(word.replace(head, str(given[head]), 1) if head in given else word)
    return filled


def _forked(words: Sequence[str], folder: Path, environment: Mapping[str, str]) -> tuple[int, Path]:
    """Starts a command in a forked child; returns its process ID and output file."""
    program = importlib.import_module(f'{words[0]}.__main__')
    said = folder / 'said'
    sys.stdout.flush()
    sys.stderr.flush()
    if not (child := os.fork()):
        _be_the_command(program.main, words, said, folder, environment)
    return child, said


def _be_the_command(
    main: Any, words: Sequence[str], said: Path, folder: Path, environment: Mapping[str, str]
) -> NoReturn:
    code = 1
    try:
        os.setsid()
        output = os.open(said, os.O_WRONLY | os.O_CREAT)
        for stream in (1, 2):
            os.dup2(output, stream)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        sys.stdout, sys.stderr = (os.fdopen(x, 'w', closefd=False) for x in (1, 2))
        os.environ.update(environment)
        tempfile.tempdir = None
        os.chdir(folder)
        forget_peak()
        sys.argv = list(words)
        code = main()
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 1
    except BaseException:  # noqa: BLE001 - shown as by the interpreter
        traceback.print_exc()
    finally:
        with suppress(Exception):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)


def _spawned(
    words: Sequence[str], folder: Path, environment: Mapping[str, str]
) -> tuple[int, Path]:
    """As `_forked`, but in its own interpreter."""
    said = folder / 'said'
    with said.open('wb') as output:
        process = subprocess.Popen(
            [sys.executable, '-m', *words],
            cwd=folder,
            env={
                **os.environ,
                'PYTHONPATH': os.pathsep.join(filter(None, sys.path)),
                **environment,
            },
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
    process.returncode = 0  # it is waited for below
    return process.pid, said


def _finished(started: tuple[int, Path], seconds: float) -> _Run:
    """Waits for a command, and kills it if it exceeds a limit."""
    child, said = started
    peak, stopped = 0.0, ''
    end = time.monotonic() + WALL_SECONDS
    ticks = os.sysconf('SC_CLK_TCK')
    while True:
        done, status, usage = os.wait4(child, os.WNOHANG)
        if done:
            break
        # A process that has just ended has no memory.
        with suppress(OSError, StopIteration):
            peak = max(peak, peak_memory(child))
            used = Path(f'/proc/{child}/stat').read_text('utf-8').rpartition(')')[2].split()
            if sum(map(int, used[11:15])) > seconds * ticks:
                stopped = f'takes more than {SECONDS:g} s'
        if peak > MEMORY:
            stopped = f'takes {peak / 1e9:.1f} GB'
        if time.monotonic() > end:
            stopped = 'does not end'
        if stopped:
            os.killpg(child, signal.SIGKILL)
            _, status, usage = os.wait4(child, 0)
            break
        time.sleep(_LOOKS)
    text = said.read_bytes()[: 2**20].decode('utf-8', 'replace')
    code = os.waitstatus_to_exitcode(status)
    return _Run(code, usage.ru_utime + usage.ru_stime, peak, text, stopped)


def _wrong(run: _Run) -> Iterator[str]:
    """Describes what a command did wrong."""
    if run.stopped:
        yield run.stopped
    elif run.code not in (0, 1):
        yield f'ends with code {run.code}'
    lines = run.said.splitlines()
    if 'Traceback (most recent call last)' in run.said:
        yield f'traceback: {lines[-1][:80]}'
        return
    if longest := max((len(line) for line in lines if len(line) > CHARACTERS), default=0):
        yield f'says a line of {longest} characters'
    if strange := {x for x in run.said if not x.isprintable()} - {'\n', '\t', '\r'}:
        yield f'says control characters {sorted(strange)[:3]}'
    if run.code == 1 and not run.stopped and not 1 <= len(lines) <= LINES:
        yield f'says {len(lines)} lines: {" | ".join(lines)[:120]}'
