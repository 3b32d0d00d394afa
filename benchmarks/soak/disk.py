"""The soak of a disk that gets full: what is written is whole, or not there."""

from __future__ import annotations

import contextlib
import io
import resource
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.clips import ROOT
from benchmarks.soak.faults import place
from benchmarks.soak.outcome import Amount, Outcome
from benchmarks.soak.scenes import CLIP
from hmt_ros.app import make_bag
from hmt_ros.app.replay import command as replay
from hmt_ros.experts import load_predictor
from hmt_ros.experts.model_file import read_arrays, write_arrays
from msg_tools import BagReader

MODEL = ROOT / 'hmt_ros' / 'experts' / 'models' / 'silhouettes.npz'
_CHEAP = ('--set', 'max_hypotheses=1', '--set', 'evaluation_budget=20')


def disk(amount: Amount) -> Iterator[Outcome]:
    """Commands and writers, where files must not get larger than some size.

    The limit of the process stands for a disk that is full: writing fails in the same places.
    """
    with TemporaryDirectory(prefix='hmt_ros.') as folder:
        root = Path(folder)
        replayed = amount.part(0.1)
        yield _limited('replay', replayed, root / 'a', _replays, _is_whole_bag)
        yield _limited('make-bag', amount.part(0.3), root / 'b', _makes, _is_whole_bag)
        yield _limited('a model file', amount.part(0.6), root / 'c', _writes_model, _is_whole_model)


def _limited(
    what: str,
    amount: Amount,
    folder: Path,
    write: Callable[[Path], str],
    check: Callable[[Path], None],
) -> Outcome:
    """Writes with limits from nothing to more than is needed."""
    outcome = Outcome(what, 'written to a disk that gets full')
    folder.mkdir()
    whole = folder / 'whole'
    if error := write(whole):
        outcome.fault(f'does not work at all: {error}')
        return outcome
    check(whole)
    needed = _largest_file(whole)
    for number in amount.counted():
        limit = int(1.1 * needed * number / max(amount.times - 1, 1))
        target = folder / f'target{number}'
        # What is there already has to stay: the second time an older one is in the way.
        outcome.times += 1
        with _largest_size(limit):
            try:
                error = write(target)
            except Exception as fault:  # noqa: BLE001
                outcome.fault(place(fault))
                error = 'raised'
        if error:
            outcome.refused += 1
            if error.strip().count('\n') or 'Traceback' in error:
                outcome.fault(f'more than one line: {error.strip()[:100]}')
            left = [
                path.name for path in folder.iterdir() if path.name.strip('.').startswith('target')
            ]
            if left:
                outcome.fault(f'left behind: {left[0]}')
        else:
            try:
                check(target)
            except Exception as fault:  # noqa: BLE001
                # It was said to be written.
                outcome.lost += 1
                outcome.fault(f'not whole: {place(fault)}')
        for path in folder.iterdir():
            if path != whole:
                _remove(path)
    return outcome


@contextlib.contextmanager
def _largest_size(size: int) -> Iterator[None]:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def _command(run: Callable[[list[str]], int], *arguments: str) -> str:
    """What a command says when it fails; '' where it does not."""
    said = io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
        code = run(list(arguments))
    return said.getvalue() or f'exit code {code}' if code else ''


def _replays(target: Path) -> str:
    return _command(
        replay.main, str(CLIP), '-o', str(target), '--subject', str(CLIP / 'subject.yaml'),
        '--background', str(CLIP / 'background.png'), '--no-smoother', '--quiet', *_CHEAP,
    )  # fmt: skip


def _makes(target: Path) -> str:
    return _command(
        make_bag.main, 'reach', '-o', str(target), '--duration', '0.2', '--size', '64x48',
        '--quiet',
    )  # fmt: skip


def _writes_model(target: Path) -> str:
    try:
        write_arrays(target.with_suffix('.npz'), read_arrays(MODEL))
    except OSError as error:
        return str(error)
    return ''


def _is_whole_bag(path: Path) -> None:
    with BagReader(path) as bag:
        if bag.damage is not None:
            raise ValueError(bag.damage)
        if not sum(1 for _ in bag.messages()):
            raise ValueError('nothing is in it')


def _is_whole_model(path: Path) -> None:
    load_predictor(path.with_suffix('.npz'))


def _largest_file(path: Path) -> int:
    files = path.rglob('*') if path.is_dir() else path.parent.glob(f'{path.name}*')
    return max(file.stat().st_size for file in files if file.is_file())


def _remove(path: Path) -> None:
    if not path.is_dir():
        path.unlink()
        return
    for inner in path.iterdir():
        _remove(inner)
    path.rmdir()
