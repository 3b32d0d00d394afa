"""Tracks the same clips with two checkouts of the package and tells how far the poses differ.

    python -m benchmarks.checkouts OLD NEW --clips DIR --only walk kick

Each checkout tracks in a process of its own, one after the other, with the same seed.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

# Uses only names that every checkout has.
PROGRAM = """
import sys
from pathlib import Path
import numpy as np
from benchmarks.clips import read_clip
from hmt_ros.body import load_body
from hmt_ros.image.background import BackgroundModel
from hmt_ros.tracking import Tracker, read_subject

folder, out, frames, seed = Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
clip, body = read_clip(folder, frames or None), load_body('human37')
background = BackgroundModel()
background.learn(clip.background)
tracker = Tracker(body, clip.camera, background=background, seed=seed)
tracker.reset(read_subject(clip.subject, body))
steps = (tracker.step(image, stamp)[0] for stamp, image in zip(clip.stamps, clip.images))
found = [posterior for posterior in steps if posterior is not None]
first = np.cumsum([0] + [len(x) for x in found])
names = ('weights', 'means', 'covariances')
np.savez(out, first=first, **{n: np.concatenate([getattr(x, n) for x in found]) for n in names})
"""


def main(argv: list[str] | None = None) -> int:
    """Runs the comparison; 1: some pose differs by more than the tolerance."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('old', type=Path, help='a checkout')
    parser.add_argument('new', type=Path, help='another one')
    parser.add_argument('--clips', type=Path, required=True, help='folder that holds the clips')
    parser.add_argument('--only', nargs='+', metavar='NAME', help='some of them')
    parser.add_argument('--frames', type=int, default=0, help='first images of each clip; 0: all')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--tolerance', type=float, default=1e-9, help='rad or m')
    parser.add_argument('--keep', type=Path, help='folder for what each checkout gave, used again')
    options = parser.parse_args(argv)
    names = options.only or sorted(x.name for x in options.clips.iterdir() if x.is_dir())
    worst = 0.0
    with tempfile.TemporaryDirectory() as scratch:
        for name in names:
            results = []
            for checkout in (options.old, options.new):
                kept = checkout.resolve() == options.old.resolve() and options.keep
                folder = options.keep if kept else Path(scratch)
                folder.mkdir(parents=True, exist_ok=True)
                out = folder / f'{name}-{options.seed}-{options.frames}-{len(results)}.npz'
                if not out.is_file():
                    _track(checkout, options.clips / name, out, options.frames, options.seed)
                results.append(dict(np.load(out)))
            distance = difference(*results)
            worst = max(worst, distance)
            print(f'{name}: {len(results[0]["first"]) - 1} images, largest difference {distance:g}')
    return int(worst > options.tolerance)


def difference(old: dict[str, np.ndarray], new: dict[str, np.ndarray]) -> float:
    """Largest difference of weights and poses; inf where the number of modes differs."""
    if not np.array_equal(old['first'], new['first']):
        return float('inf')
    return max(float(np.abs(old[name] - new[name]).max()) for name in ('weights', 'means'))


def _track(checkout: Path, clip: Path, out: Path, frames: int, seed: int) -> None:
    path = {**os.environ, 'PYTHONPATH': str(checkout.resolve())}
    words = [sys.executable, '-c', PROGRAM, str(clip.resolve()), str(out), str(frames), str(seed)]
    subprocess.run(words, cwd=checkout, env=path, check=True)


if __name__ == '__main__':
    sys.exit(main())
