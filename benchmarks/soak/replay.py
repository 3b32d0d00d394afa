"""The soak of replay --live: a node, or the recorder itself, is killed in the middle of a bag."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.clips import ROOT
from benchmarks.soak.outcome import Amount, Outcome
from benchmarks.soak.scenes import CLIP

# How long a bag may take to begin, and nodes to end, s.
_PATIENCE = 60.0
# Bytes of a bag in which messages stand already.
_BEGUN = 100_000
_REPLAY = (
    sys.executable, '-m', 'hmt_ros', 'replay', str(CLIP), '--subject', str(CLIP / 'subject.yaml'),
    '--background', str(CLIP / 'background.png'), '--live', '--quiet', '--no-smoother',
    '--set', 'max_hypotheses=2', '--set', 'evaluation_budget=100',
)  # fmt: skip


def replay(amount: Amount) -> Iterator[Outcome]:
    """A node, or the recorder itself, is killed in the middle of a bag, and all is done again."""
    with TemporaryDirectory(prefix='hmt_ros.') as folder:
        root = Path(folder)
        whole = root / 'whole'
        code, said = _replayed(whole)
        outcomes = [
            Outcome('replay --live', 'a node killed in the middle of a bag, done again'),
            Outcome('replay --live', 'killed itself in the middle of a bag, done again'),
        ]
        for outcome, of_node in zip(outcomes, (True, False), strict=True):
            if code:
                outcome.fault(f'does not work at all: {said}')
                yield outcome
                continue
            expected = (whole / 'whole.mcap').read_bytes()
            for number in amount.part(0.5).counted():
                name = root / f'{number}{of_node:d}' / 'whole'
                name.parent.mkdir()
                outcome.times += 1
                outcome.refused += 1
                _kill_midway(name, outcome, of_node)
                code, said = _replayed(name)
                if code:
                    outcome.fault(f'the second time: {said}')
                elif (name / 'whole.mcap').read_bytes() != expected:
                    outcome.lost += 1
                    outcome.fault('the bag of the second time differs')
            yield outcome


def _replayed(target: Path) -> tuple[int, str]:
    """Exit code and last line of a replay."""
    found = subprocess.run(
        [*_REPLAY, '-o', str(target)], cwd=ROOT, capture_output=True, text=True, check=False
    )
    return found.returncode, ' '.join(found.stderr.split())


def _kill_midway(target: Path, outcome: Outcome, of_node: bool) -> None:
    """Kills a replay, or its node, when a part of the bag is there."""
    with subprocess.Popen(
        [*_REPLAY, '-o', str(target)], cwd=ROOT, stderr=subprocess.PIPE, text=True
    ) as process:
        end = time.monotonic() + _PATIENCE
        while not (begun := _bytes_in(target.parent)) and time.monotonic() < end:
            time.sleep(0.05)
        children = _children(process.pid)
        if not begun or not children:
            outcome.fault('the replay does not begin')
        for killed in children if of_node else [process.pid]:
            os.kill(killed, signal.SIGKILL)
        _, said = process.communicate()
        if of_node:
            lines = said.strip().splitlines()
            if process.returncode != 1 or len(lines) != 1:
                outcome.fault(f'exit code {process.returncode}: {" ".join(lines)[:150]}')
            if left := sorted(path.name for path in target.parent.iterdir()):
                outcome.fault(f'left behind: {left[0]}')
        if target.exists():
            outcome.fault('a bag that is not whole is in its place')
        end = time.monotonic() + _PATIENCE
        while any(Path(f'/proc/{child}').exists() for child in children):
            if time.monotonic() > end:
                outcome.fault('a node outlives its replay')
                for child in children:
                    os.kill(child, signal.SIGKILL)
                return
            time.sleep(0.1)


def _bytes_in(folder: Path) -> int:
    """Size of what is there of bags, but for what stands at the begin of each."""
    begun = 0
    for path in folder.rglob('*.mcap'):
        with suppress(FileNotFoundError):
            begun = max(begun, path.stat().st_size)
    return begun if begun > _BEGUN else 0


def _children(process: int) -> list[int]:
    """Processes that a process has started."""
    tasks = Path(f'/proc/{process}/task').glob('*/children')
    return [int(child) for task in tasks for child in task.read_text('ascii').split()]
