"""Draws the modes as skeletons, on the images and from the side.

Left limbs are orange and right limbs blue, which colour-blind people can distinguish; modes of
smaller weight are fainter.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib import patheffects
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from PIL import Image as Picture

from hmt_ros.app.report.mixtures import Layer, Moment
from hmt_ros.body import Camera
from hmt_ros.evaluation.pose_scores import HIPS, ORIGIN, origin_joints, relative_positions
from hmt_ros.evaluation.track_scores import Truth
from hmt_ros.inference.arrays import Array, Image

Track = Layer[Moment]

# Colours from the palette of Okabe and Ito.
LEFT_COLOUR, RIGHT_COLOUR, TRUNK_COLOUR, TRUTH_COLOUR = '#e69f00', '#0072b2', '#666666', '#000000'
LIMBS = ('hip', 'knee', 'ankle', 'toe'), ('shoulder', 'elbow', 'wrist', 'hand')
BONES = (
    *(('pelvis', 'neck', TRUNK_COLOUR), ('neck', 'head', TRUNK_COLOUR)),
    *(
        bone
        for side, colour in (('left', LEFT_COLOUR), ('right', RIGHT_COLOUR))
        for start, limb in (('pelvis', LIMBS[0]), ('neck', LIMBS[1]))
        for bone in (
            (start, f'{side}_{limb[0]}', colour),
            *((f'{side}_{a}', f'{side}_{b}', colour) for a, b in pairwise(limb)),
        )
    ),
)
# Trunk bones of a skeleton without a pelvis.
_HIP_TRUNK_BONES = ((*HIPS, TRUNK_COLOUR), *(('neck', hip, TRUNK_COLOUR) for hip in HIPS))
STYLE: Any = {
    'font.size': 9.0,
    'axes.spines.top': False,
    'axes.spines.right': False,
    'axes.titlesize': 9.0,
    'savefig.facecolor': 'white',
}
# Maximum number of modes on an image, because more modes would hide the image.
MAX_MODES_ON_IMAGE = 3
MIN_OPACITY = 0.12
_DASH_PATTERN: Any = (0, (2, 1.2))


def bones_of(names: Sequence[str]) -> list[tuple[int, int, str]]:
    """Joint indices and colour of each bone whose two joints are among the names."""
    bones = BONES if ORIGIN in names else (*BONES, *_HIP_TRUNK_BONES)
    return [(names.index(a), names.index(b), c) for a, b, c in bones if {a, b} <= set(names)]


def draw_overview(
    path: Path,
    track: Track,
    camera: Camera,
    images: dict[int, Image],
    truth: Truth | None,
) -> None:
    """Draws the heaviest modes on images and, below each image, all modes from the side.

    Args:
        path: path of the PNG file.
        track: mixtures; only mixtures with an image are drawn.
        camera: camera of the images.
        images: images by stamp.
        truth: true joint positions, drawn from the side; None if unknown.
    """
    moments = _with_images(track, images)
    box = _crop(moments, camera)
    view = _SideView(track, moments, truth)
    ratios = ((box[3] - box[1]) / (box[2] - box[0]), view.ratio)
    width = 9.0
    cell = width / len(moments)
    with new_picture(path, (width, cell * sum(ratios) + 1.0)) as figure:
        axes = figure.subplots(
            2, len(moments), squeeze=False, gridspec_kw={'height_ratios': list(ratios)}
        )
        for column, moment in enumerate(moments):
            above, below = axes[0, column], axes[1, column]
            _draw_on_image(above, track, moment, camera, images[moment.stamp_ns], box)
            above.set_title(_seconds(track, moment))
            view.draw(below, moment)
            if column == 0:
                above.set_ylabel('from the camera')
                below.set_ylabel('from the side, m')
            else:
                below.set_yticklabels([])
        axes[1, len(moments) // 2].set_xlabel('towards the camera, m')
        _add_legend(figure, truth is not None)
        figure.subplots_adjust(
            left=0.65 / width,
            right=1 - 0.1 / width,
            top=1 - 0.25 / figure.get_figheight(),
            bottom=0.75 / figure.get_figheight(),
            wspace=0.06,
            hspace=0.06,
        )


def draw_overlays(path: Path, track: Track, camera: Camera, images: dict[int, Image]) -> None:
    """Draws a sheet of images with the heaviest modes."""
    moments = _with_images(track, images)
    box = _crop(moments, camera)

    def draw(axes: Any, moment: Moment) -> None:
        _draw_on_image(axes, track, moment, camera, images[moment.stamp_ns], box)

    ratio = (box[3] - box[1]) / (box[2] - box[0])
    title = f'the {MAX_MODES_ON_IMAGE} heaviest modes'
    _draw_sheet(path, track, moments, ratio, draw, title, truth=False)


def draw_side_views(path: Path, track: Track, stamps: Sequence[int], truth: Truth | None) -> None:
    """Draws a sheet of side views of all modes at the given stamps."""
    moments = list(track.at(stamps).mixtures.values())
    view = _SideView(track, moments, truth)
    title = 'all modes from the side; horizontal axis: towards the camera, m'
    _draw_sheet(path, track, moments, view.ratio, view.draw, title, truth=truth is not None)


@contextmanager
def new_picture(path: Path, size: tuple[float, float], layout: Any = None) -> Iterator[Figure]:
    """Yields a figure in the style of the report, and saves it at the end.

    Args:
        size: width and height, inches.
    """
    with mpl.rc_context(STYLE):
        figure = Figure(size, dpi=110, layout=layout)
        yield figure
        save_picture(figure, path)


def save_picture(figure: Figure, path: Path) -> None:
    """Writes a PNG with 256 colours, which has a third of the size of a full-colour PNG."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    pixels = np.asarray(canvas.buffer_rgba())[..., :3]
    picture = Picture.fromarray(np.ascontiguousarray(pixels))
    picture.quantize(256, dither=Picture.Dither.NONE).save(path, format='PNG', optimize=True)


def _draw_sheet(
    path: Path,
    track: Track,
    moments: list[Moment],
    ratio: float,
    draw: Callable[[Any, Moment], None],
    title: str,
    *,
    truth: bool,
) -> None:
    columns = min(4, len(moments))
    rows = -(-len(moments) // columns)
    cell = 2.4
    width, height = columns * cell + 0.5, rows * (cell * ratio + 0.25) + 0.7
    with new_picture(path, (width, height)) as figure:
        grid = figure.subplots(rows, columns, squeeze=False)
        for axes in grid.flat:
            axes.set_axis_off()
        for i, (axes, moment) in enumerate(zip(grid.flat, moments, strict=False)):
            axes.set_axis_on()
            draw(axes, moment)
            axes.set_title(_seconds(track, moment))
            if i % columns:
                axes.set_yticklabels([])
            if i + columns < len(moments):
                axes.set_xticklabels([])
        figure.text(0.02, 1 - 0.1 / height, title, va='top', fontsize=10)
        _add_legend(figure, truth)
        figure.subplots_adjust(
            left=0.5 / width,
            right=0.99,
            top=1 - 0.5 / height,
            bottom=0.4 / height,
            wspace=0.08,
            hspace=0.25 / (cell * ratio),
        )


def _draw_on_image(
    axes: Any, track: Track, moment: Moment, camera: Camera, image: Image, box: Sequence[float]
) -> None:
    axes.imshow(image[..., ::-1], interpolation='lanczos')
    for rank in reversed(range(min(MAX_MODES_ON_IMAGE, len(moment.weights)))):
        share = moment.weights[rank] / moment.weights[0]
        _add_skeleton(
            axes,
            track.joint_names,
            camera.project(moment.joints[rank]),
            2.4 if rank == 0 else 1.4,
            1.0 if rank == 0 else MIN_OPACITY + 0.6 * share,
            halo=rank == 0,
        )
    left, top, right, bottom = box
    axes.set(xlim=(left, right), ylim=(bottom, top), xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set_visible(False)


class _SideView:
    """A side view with one scale for all times; axes towards the camera and up, m."""

    def __init__(self, track: Track, moments: Sequence[Moment], truth: Truth | None) -> None:
        self._names, self._truth = track.joint_names, truth
        self._origin = origin_joints(track.joint_names if truth is None else truth.joint_names)
        points = [self._seen(moment.joints, self._names).reshape(-1, 2) for moment in moments]
        if truth is not None:
            points += [
                self._seen(truth.joints[moment.stamp_ns], truth.joint_names)
                for moment in moments
                if moment.stamp_ns in truth.joints
            ]
        everything = np.concatenate(points)
        self._low, self._high = everything.min(0) - 0.08, everything.max(0) + 0.08
        across, up = self._high - self._low
        self.ratio = float(up / across)

    def _seen(self, joints: Array, names: tuple[str, ...]) -> Array:
        relative = relative_positions(joints, names, names, self._origin)
        return np.stack([-relative[..., 2], -relative[..., 1]], axis=-1)

    def draw(self, axes: Any, moment: Moment) -> None:
        seen = self._seen(moment.joints, self._names)
        for rank in reversed(range(len(seen))):
            share = moment.weights[rank] / moment.weights[0]
            strength = MIN_OPACITY + (1 - MIN_OPACITY) * share
            _add_skeleton(axes, self._names, seen[rank], 2.2 if rank == 0 else 1.5, strength)
        if self._truth is not None and moment.stamp_ns in self._truth.joints:
            names = self._truth.joint_names
            points = self._seen(self._truth.joints[moment.stamp_ns], names)
            _add_skeleton(axes, names, points, 1.3, 1.0, colour=TRUTH_COLOUR, style=_DASH_PATTERN)
        (left, bottom), (right, top) = self._low, self._high
        axes.set(xlim=(left, right), ylim=(bottom, top), aspect='equal')
        axes.tick_params(length=2, labelsize=7, color='#888888')
        axes.grid(color='#eeeeee', linewidth=0.6)
        axes.set_axisbelow(True)


def _add_skeleton(
    axes: Any,
    names: tuple[str, ...],
    points: Array,
    width: float,
    alpha: float,
    *,
    colour: str | None = None,
    style: Any = 'solid',
    halo: bool = False,
) -> None:
    bones = [(points[[a, b]], own) for a, b, own in bones_of(names)]
    bones = [(line, own) for line, own in bones if np.isfinite(line).all()]
    lines = LineCollection(
        [line for line, _ in bones],
        colors=[colour or own for _, own in bones],
        linewidths=width,
        alpha=alpha,
        linestyles=[style],
        capstyle='round',
    )
    if halo:
        lines.set_path_effects(
            [patheffects.Stroke(linewidth=width + 1.6, foreground='white'), patheffects.Normal()]
        )
    axes.add_collection(lines)


def _add_legend(figure: Figure, truth: bool) -> None:
    entries = [
        Line2D([], [], color=LEFT_COLOUR, linewidth=2.4, label='left limbs'),
        Line2D([], [], color=RIGHT_COLOUR, linewidth=2.4, label='right limbs'),
        Line2D(
            [], [], color=RIGHT_COLOUR, linewidth=1.5, alpha=0.35, label='fainter: less probable'
        ),
    ]
    if truth:
        entries.append(
            Line2D(
                [], [], color=TRUTH_COLOUR, linewidth=1.3, linestyle=_DASH_PATTERN, label='truth'
            )
        )
    figure.legend(handles=entries, loc='lower center', ncols=len(entries), frameon=False)


def _seconds(track: Track, moment: Moment) -> str:
    return f'{(moment.stamp_ns - min(track.mixtures)) * 1e-9:.2f} s'


def _with_images(track: Track, images: dict[int, Image]) -> list[Moment]:
    moments = list(track.at(images).mixtures.values())
    if not moments:
        raise ValueError('none of the images belongs to the track')
    return moments


def _crop(moments: list[Moment], camera: Camera) -> tuple[float, ...]:
    """Left, top, right and bottom of the image region with the heaviest modes, px."""
    pixels = np.concatenate(
        [camera.project(m.joints[:MAX_MODES_ON_IMAGE]).reshape(-1, 2) for m in moments]
    )
    pixels = pixels[np.isfinite(pixels).all(1)]
    low, high = pixels.min(0), pixels.max(0)
    margin = 0.12 * (high - low).max()
    low = np.maximum(low - margin, -0.5)
    high = np.minimum(high + margin, [camera.width - 0.5, camera.height - 0.5])
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])
