"""Draws the figures of real_video.md: real clips with a detector's keypoints, like KJS figure 7.

python docs/figures_real_video.py                   minutes for each clip
python docs/figures_real_video.py leaflet -b bags   keeps the bags in the folder, and uses them
python docs/figures_real_video.py -b bags -l look   also draws over the images, to look at

The figures show stick figures on white, without images of the clips.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

for _name in ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS'):
    os.environ.setdefault(_name, '1')
DOCS = Path(__file__).resolve().parent
sys.path.insert(0, str(DOCS.parent))

import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402
from matplotlib.axes import Axes  # noqa: E402
from matplotlib.collections import LineCollection  # noqa: E402
from matplotlib.patches import Ellipse  # noqa: E402

from benchmarks.clips import read_messages  # noqa: E402
from hmt_ros.app import main as run_command  # noqa: E402
from hmt_ros.app.recorded_bodies import read_grounds  # noqa: E402
from hmt_ros.app.report.mixtures import Moment, read_mixtures  # noqa: E402
from hmt_ros.app.report.skeletons import STYLE, bones_of, draw_overlays  # noqa: E402
from hmt_ros.body import Camera  # noqa: E402
from msg_tools import BagReader  # noqa: E402
from msg_tools.messages.camera_info import camera_from_info  # noqa: E402
from msg_tools.messages.headers import time_ns  # noqa: E402
from msg_tools.messages.images import decode_image  # noqa: E402
from msg_tools.messages.pose_mixtures import pose_mixture_of  # noqa: E402

# Clips, and the end of the tracked part of each, s.
CLIPS = {'park_walk': 4.4, 'leaflet': 20.0}
COLUMNS = 8
TOPIC = 'pose_mixture'
DARK, ACCENT = '#1f3a5f', '#c8553d'
# Minimum probability of a drawn mode.
FAINTEST = 0.02
# Dimensions of the position of the root in a pose.
ROOT = ('root_tx', 'root_ty', 'root_tz')


@dataclass(frozen=True, eq=False)
class Path3D:
    """Path of the root of the heaviest mode.

    Attributes:
        stamps: (T,) timestamps, ns.
        positions: (T, 3) positions, camera frame, m.
        covariances: (T, 3, 3) covariances over the whole mixture, m^2.
        up: (3,) unit vector against gravity, camera frame.
    """

    stamps: np.ndarray
    positions: np.ndarray
    covariances: np.ndarray
    up: np.ndarray

    @property
    def from_above(self) -> np.ndarray:
        """Axes (2, 3) in the plane of the floor: to the right, and away from the camera."""
        away = np.array([0.0, 0.0, 1.0])
        away -= (away @ self.up) * self.up
        away /= np.linalg.norm(away)
        return np.stack([np.cross(away, self.up), away])


def main() -> int:
    """Draws a figure of each clip; returns 0 also if clips are missing."""
    parser = argparse.ArgumentParser(description=__doc__.partition('\n')[0])
    parser.add_argument('names', nargs='*', metavar='NAME', help='clips; default: all')
    parser.add_argument('-b', '--bags', type=Path, metavar='DIR', help='folder that keeps the bags')
    parser.add_argument('-l', '--look', type=Path, metavar='DIR', help='also draws over the images')
    arguments = parser.parse_args()
    unknown = sorted({*arguments.names} - {*CLIPS})
    if unknown:
        parser.error(f'no clip {unknown[0]!r}; wanted some of {", ".join(CLIPS)}')
    plt.switch_backend('Agg')
    clips = Path(os.environ.get('HMT_SHARED', DOCS.parent / '..' / 'shared')) / 'video'
    with tempfile.TemporaryDirectory() as scratch:
        for name in arguments.names or CLIPS:
            if not (clips / name / 'keypoints_mediapipe.npz').is_file():
                print(f'{name}: skipped, {clips / name} is absent (set HMT_SHARED)')  # noqa: T201
                continue
            bag = (arguments.bags or Path(scratch)) / name
            if not (bag / 'tracked').is_dir():
                track(clips / name, bag, CLIPS[name])
            moments, path, camera, names = read_track(bag)
            draw(DOCS / f'real_video_{name}.png', moments, path, camera, names)
            print(f'{name}: {summary(path)}')  # noqa: T201
            if arguments.look is not None:
                arguments.look.mkdir(parents=True, exist_ok=True)
                look(arguments.look / f'{name}.png', bag, camera)
    return 0


def track(clip: Path, bag: Path, end: float) -> None:
    """Imports a clip with its keypoints and tracks it, without a subject file.

    Raises:
        RuntimeError: a command failed and has printed the reason.
    """
    info, messages = read_messages(clip)
    frames = bag / 'frames'
    frames.mkdir(parents=True, exist_ok=True)
    for i, message in enumerate(messages):
        (frames / f'{i:04d}.jpg').write_bytes(bytes(message.data))
    stamps = [time_ns(message.header.stamp) for message in messages]
    rate = 1e9 * (len(stamps) - 1) / (stamps[-1] - stamps[0])
    view = math.degrees(2 * math.atan(0.5 * info.width / info.k[0]))
    for command in (
        ['import-video', frames, '-o', bag / 'video', '--fps', f'{rate:.3f}', '--fov',
         f'{view:.4f}', '--end', end, '--keypoints', clip / 'keypoints_mediapipe.npz'],
        ['replay', bag / 'video', '-o', bag / 'tracked', '--no-smoother', '--seed', 0],
    ):  # fmt: skip
        if run_command([str(word) for word in command]) != 0:
            raise RuntimeError(f'{command[0]} failed')


def read_track(bag: Path) -> tuple[list[Moment], Path3D, Camera, tuple[str, ...]]:
    """Mixtures, root path, camera and joint names, from the bags that `track` wrote.

    Raises:
        ValueError: nobody was tracked.
    """
    moments, positions, covariances = [], [], []
    names: tuple[str, ...] = ()
    with BagReader(bag / 'tracked') as reader:
        for stored in reader.messages([TOPIC]):
            found = pose_mixture_of(stored.message)
            if not len(found.weights):
                continue
            names = found.joint_names
            moments.append(Moment(found.stamp_ns, found.weights, found.joint_positions))
            root = [found.dof_names.index(name) for name in ROOT]
            means = found.means[:, root]
            inside = found.mixture.covariances[:, root][:, :, root]
            between = means - found.weights @ means
            spread = inside + between[:, :, None] * between[:, None]
            positions.append(means[0])
            covariances.append(np.tensordot(found.weights, spread, 1))
    if not moments:
        raise ValueError(f'{bag}: nobody was tracked')
    with BagReader(bag / 'video') as reader:
        camera = camera_from_info(next(reader.messages(['camera_info'])).message)
    (layer,) = (x for x in read_mixtures(bag / 'tracked').layers if x.topic.endswith(TOPIC))
    grounds = read_grounds(bag / 'tracked', layer.topic, layer.frame_id)
    up = np.mean([ground.up for ground in grounds.values()] or [[0.0, -1.0, 0.0]], axis=0)
    path = Path3D(
        np.array([moment.stamp_ns for moment in moments]),
        np.array(positions),
        np.array(covariances),
        up / np.linalg.norm(up),
    )
    return moments, path, camera, names


def summary(path: Path3D) -> str:
    """Numbers of a path for the page."""
    seen = path.positions @ path.from_above.T
    times = (path.stamps - path.stamps[0]) * 1e-9
    length = np.linalg.norm(np.diff(seen, axis=0), axis=1).sum()
    way = np.linalg.norm(seen[-1] - seen[0])
    away = path.from_above[1]
    depth = np.sqrt(np.einsum('i,tij,j->t', away, path.covariances, away))
    return (
        f'{len(times)} images tracked in {times[-1]:.1f} s, path {length:.1f} m, from start to end '
        f'{way:.1f} m, {way / times[-1]:.2f} m/s, depth {seen[:, 1].min():.1f} to '
        f'{seen[:, 1].max():.1f} m, its standard deviation {np.median(depth):.2f} m'
    )


def draw(
    file: Path, moments: list[Moment], path: Path3D, camera: Camera, names: tuple[str, ...]
) -> None:
    """Draws a film strip from the camera and from above, and the root path from above."""
    chosen = np.unique(np.rint(np.linspace(0, len(moments) - 1, COLUMNS)).astype(int))
    with plt.rc_context(STYLE):
        figure = plt.figure(figsize=(9.6, 6.6), layout='constrained')
        grid = figure.add_gridspec(3, len(chosen), height_ratios=[1.3, 0.9, 1.7])
        for column, index in enumerate(chosen):
            moment = moments[index]
            above, below = (figure.add_subplot(grid[row, column]) for row in (0, 1))
            seconds = (moment.stamp_ns - moments[0].stamp_ns) * 1e-9
            add_modes(above, moment, camera.project(moment.joints), names)
            above.set(title=f'{seconds:.1f} s')
            frame(above, camera.project(moment.joints[:1]), upside_down=True)
            centred = (moment.joints - moment.joints[0].mean(0)) @ path.from_above.T
            add_modes(below, moment, centred, names)
            below.set(xlim=(-0.9, 0.9), ylim=(-0.9, 0.9), aspect='equal', xticks=[], yticks=[])
            if column == 0:
                above.set_ylabel('from the camera')
                below.set_ylabel('from above')
        draw_path(figure.add_subplot(grid[2, :]), path, chosen)
        # Without date and versions, so that equal figures give equal files.
        figure.savefig(file, dpi=100, metadata={'Software': None})
        plt.close(figure)


def add_modes(axes: Axes, moment: Moment, points: np.ndarray, names: tuple[str, ...]) -> None:
    """Draws stick figures (K, J, 2); the heaviest mode is solid, lighter ones are paler."""
    for rank in reversed(range(len(points))):
        weight = float(moment.weights[rank])
        if rank and weight < FAINTEST:
            continue
        bones = [(points[rank][[a, b]], colour) for a, b, colour in bones_of(names)]
        bones = [(line, colour) for line, colour in bones if np.isfinite(line).all()]
        style: dict[str, Any] = {
            'linewidths': 1.8 if rank == 0 else 0.9,
            'alpha': 1.0 if rank == 0 else 0.15 + 0.5 * weight,
        }
        lines = LineCollection(
            [x for x, _ in bones], colors=[c for _, c in bones], capstyle='round', **style
        )
        axes.add_collection(lines)


def frame(axes: Axes, points: np.ndarray, *, upside_down: bool) -> None:
    """Sets the axes to a square that contains all points."""
    points = points.reshape(-1, 2)
    points = points[np.isfinite(points).all(1)]
    middle, half = (points.min(0) + points.max(0)) / 2, 0.62 * np.ptp(points, axis=0).max()
    (left, low), (right, high) = middle - half, middle + half
    bottom, top = (high, low) if upside_down else (low, high)
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect='equal', xticks=[], yticks=[])


def draw_path(axes: Axes, path: Path3D, chosen: np.ndarray) -> None:
    """Draws the root from above, with one-sigma ellipses at the times of the strip."""
    turn = path.from_above
    seen = path.positions @ turn.T
    axes.plot(*seen.T, '.-', color=DARK, ms=2.5, lw=0.9)
    for index in chosen:
        values, vectors = np.linalg.eigh(turn @ path.covariances[index] @ turn.T)
        width, height = 2 * np.sqrt(np.maximum(values, 0))
        angle = math.degrees(math.atan2(vectors[1, 0], vectors[0, 0]))
        ellipse = Ellipse(tuple(seen[index]), width, height, angle=angle, fill=False, color=ACCENT)
        axes.add_patch(ellipse)
    axes.plot(*seen[0], 'o', color=ACCENT, ms=5)
    axes.set(xlabel='to the right, m', ylabel='away from the camera, m', aspect='equal')
    axes.margins(0.15)
    axes.set_title('path of the pelvis from above (dot: start), ellipses: one standard deviation')


def look(file: Path, bag: Path, camera: Camera) -> None:
    """Draws the heaviest modes on the images, only for inspection because it shows the clip."""
    (layer,) = (x for x in read_mixtures(bag / 'tracked').layers if x.topic.endswith(TOPIC))
    wanted = {*layer.spread(COLUMNS)}
    images = {}
    with BagReader(bag / 'video') as reader:
        for stored in reader.messages(['image/compressed']):
            stamp = time_ns(stored.message.header.stamp)
            if stamp in wanted:
                images[stamp] = decode_image(stored.message)
    draw_overlays(file, layer, camera, images)


if __name__ == '__main__':
    sys.exit(main())
