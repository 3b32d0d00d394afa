"""Pictures of a track: on the images that it explains, from the side, and its weights over time.

Left limbs are orange and right limbs blue, which colour-blind people tell apart; the lighter a
mode, the smaller its weight.
"""

from __future__ import annotations

from collections.abc import Sequence
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
from numpy.typing import NDArray
from PIL import Image as Picture

from hmt_ros.app.report.recorded_track import Moment, RecordedTrack, mode_errors
from hmt_ros.app.truth import Truth
from hmt_ros.body import Camera
from hmt_ros.evaluation.pose_scores import LOST, ORIGIN

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

# Okabe and Ito's palette.
LEFT, RIGHT, TRUNK, TRUTH = '#e69f00', '#0072b2', '#666666', '#000000'
LIMBS = ('hip', 'knee', 'ankle', 'toe'), ('shoulder', 'elbow', 'wrist', 'hand')
BONES = (
    *(('pelvis', 'neck', TRUNK), ('neck', 'head', TRUNK)),
    *(
        bone
        for side, colour in (('left', LEFT), ('right', RIGHT))
        for start, limb in (('pelvis', LIMBS[0]), ('neck', LIMBS[1]))
        for bone in (
            (start, f'{side}_{limb[0]}', colour),
            *((f'{side}_{a}', f'{side}_{b}', colour) for a, b in pairwise(limb)),
        )
    ),
)
STYLE: Any = {
    'font.size': 9.0,
    'axes.spines.top': False,
    'axes.spines.right': False,
    'axes.titlesize': 9.0,
    'savefig.facecolor': 'white',
}
# Modes that are drawn on an image: more would hide it.
ON_IMAGE = 3
FAINTEST = 0.12


def draw_overview(
    path: Path, track: RecordedTrack, camera: Camera, images: dict[int, Image], truth: Truth | None,
    *, width: float = 9.0, dpi: int = 110,
) -> None:  # fmt: skip
    """Images with the heaviest modes, and under each the same person from the side, all modes.

    Args:
        path: of the PNG file.
        track: mixtures; those whose stamps are in `images` are shown, in their order.
        camera: that took the images.
        images: by stamp.
        truth: where the joints were, drawn from the side where it is known.
        width: of the picture, inches.
        dpi: pixels per inch.
    """
    moments = _shown(track, images)
    box = _crop(track, moments, camera)
    bounds = _side_bounds(track, moments, truth)
    ratios = (
        (box[3] - box[1]) / (box[2] - box[0]),
        (bounds[3] - bounds[2]) / (bounds[1] - bounds[0]),
    )
    cell = width / len(moments)
    with mpl.rc_context(STYLE):
        figure = Figure((width, cell * sum(ratios) + 1.0), dpi=dpi)
        axes = figure.subplots(
            2, len(moments), squeeze=False, gridspec_kw={'height_ratios': list(ratios)}
        )
        start = track.moments[0].stamp_ns
        for column, moment in enumerate(moments):
            above, below = axes[0, column], axes[1, column]
            _draw_on_image(above, track, moment, camera, images[moment.stamp_ns], box)
            above.set_title(f'{(moment.stamp_ns - start) * 1e-9:.2f} s')
            _draw_from_side(below, track, moment, truth, bounds)
            if column == 0:
                above.set_ylabel('from the camera')
                below.set_ylabel('from the side, m')
            else:
                below.set_yticklabels([])
        axes[1, len(moments) // 2].set_xlabel('to the camera, m')
        _add_legend(figure, truth is not None)
        figure.subplots_adjust(
            left=0.65 / width, right=1 - 0.1 / width, top=1 - 0.25 / figure.get_figheight(),
            bottom=0.75 / figure.get_figheight(), wspace=0.06, hspace=0.06,
        )  # fmt: skip
        save_picture(figure, path)


def draw_overlays(
    path: Path, track: RecordedTrack, camera: Camera, images: dict[int, Image], columns: int = 4
) -> None:
    """A sheet of images with the heaviest modes on them."""
    moments = _shown(track, images)
    box = _crop(track, moments, camera)

    def draw(axes: Any, moment: Moment) -> None:
        _draw_on_image(axes, track, moment, camera, images[moment.stamp_ns], box)

    _draw_sheet(
        path, moments, columns, (box[3] - box[1]) / (box[2] - box[0]), track, draw,
        f'the {ON_IMAGE} heaviest modes', truth=False,
    )  # fmt: skip


def draw_side_views(
    path: Path, track: RecordedTrack, stamps: Sequence[int], truth: Truth | None, columns: int = 4
) -> None:
    """A sheet of the person from the side, all modes."""
    moments = [moment for moment in track.moments if moment.stamp_ns in set(stamps)]
    bounds = _side_bounds(track, moments, truth)
    _draw_sheet(
        path, moments, columns, (bounds[3] - bounds[2]) / (bounds[1] - bounds[0]), track,
        lambda axes, moment: _draw_from_side(axes, track, moment, truth, bounds),
        'all modes from the side; across: towards the camera, m', truth=truth is not None,
    )  # fmt: skip


def draw_weights(path: Path, track: RecordedTrack, truth: Truth | None) -> None:
    """Weights of the modes over time and, where the truth is known, errors."""
    start = track.moments[0].stamp_ns
    seconds = np.array([(moment.stamp_ns - start) * 1e-9 for moment in track.moments])
    most = max(len(moment.weights) for moment in track.moments)
    weights = np.zeros((most, len(seconds)))
    for t, moment in enumerate(track.moments):
        weights[: len(moment.weights), t] = moment.weights
    with mpl.rc_context(STYLE):
        known = truth is not None
        figure = Figure((9.0, 5.0 if known else 2.8), dpi=110, layout='constrained')
        axes = figure.subplots(2 if known else 1, 1, squeeze=False, sharex=True)[:, 0]
        colours = mpl.colormaps['cividis'](np.linspace(0.95, 0.1, most))
        axes[0].stackplot(seconds, weights, colors=colours, linewidth=0.4, edgecolor='white')
        axes[0].set(ylim=(0, 1), ylabel='weight')
        if len(seconds) > 1:
            axes[0].set_xlim(seconds[0], seconds[-1])
        axes[0].set_title(f'weights of the {most} modes, heaviest at the bottom', loc='left')
        if truth is not None:
            _draw_errors(axes[1], track, truth, seconds)
        axes[-1].set_xlabel('s')
        save_picture(figure, path)


def _draw_errors(axes: Any, track: RecordedTrack, truth: Truth, seconds: Array) -> None:
    errors = mode_errors(track, truth)
    curves = np.full((3, len(seconds)), np.nan)
    for t, moment in enumerate(track.moments):
        if moment.stamp_ns in errors:
            error = 1e3 * errors[moment.stamp_ns]
            curves[:, t] = error[0], error.min(), moment.weights @ error
    styles = (
        ('heaviest mode', '#d55e00', '-'),
        ('best of all', '#009e73', '-'),
        ('expected', '#555555', ':'),
    )
    for curve, (label, colour, style) in zip(curves, styles, strict=True):
        axes.plot(seconds, curve, color=colour, linestyle=style, label=label, linewidth=1.6)
    axes.axhline(1e3 * LOST, color='#bbbbbb', linewidth=0.8, zorder=0)
    axes.annotate('lost', (seconds[-1], 1e3 * LOST), ha='right', va='bottom', color='#888888')
    axes.set(ylabel='mean joint error, mm', ylim=(0, None))
    axes.legend(frameon=False, ncols=3, loc='upper left', bbox_to_anchor=(0, 1.12))


def _draw_sheet(
    path: Path, moments: list[Moment], columns: int, ratio: float, track: RecordedTrack, draw: Any,
    title: str, *, truth: bool,
) -> None:  # fmt: skip
    columns = min(columns, len(moments))
    rows = -(-len(moments) // columns)
    cell = 2.4
    height = rows * (cell * ratio + 0.25) + 0.7
    with mpl.rc_context(STYLE):
        figure = Figure((columns * cell + 0.4, height), dpi=110)
        grid = figure.subplots(rows, columns, squeeze=False)
        start = track.moments[0].stamp_ns
        for axes in grid.flat:
            axes.set_axis_off()
        for i, (axes, moment) in enumerate(zip(grid.flat, moments, strict=False)):
            axes.set_axis_on()
            draw(axes, moment)
            axes.set_title(f'{(moment.stamp_ns - start) * 1e-9:.2f} s')
            if i % columns:
                axes.set_yticklabels([])
            if i + columns < len(moments):
                axes.set_xticklabels([])
        figure.text(0.02, 1 - 0.1 / height, title, va='top', fontsize=10)
        _add_legend(figure, truth)
        figure.subplots_adjust(
            left=0.04, right=0.99, top=1 - 0.5 / height, bottom=0.4 / height, wspace=0.08,
            hspace=0.25 / (cell * ratio),
        )  # fmt: skip
        save_picture(figure, path)


def _draw_on_image(
    axes: Any, track: RecordedTrack, moment: Moment, camera: Camera, image: Image, box: Any
) -> None:
    axes.imshow(image[..., ::-1], interpolation='lanczos')
    for rank in reversed(range(min(ON_IMAGE, len(moment.weights)))):
        pixels = camera.project(moment.joints[rank])
        share = moment.weights[rank] / moment.weights[0]
        _add_skeleton(
            axes, track.joint_names, pixels, 2.4 if rank == 0 else 1.4,
            1.0 if rank == 0 else FAINTEST + 0.6 * share, halo=rank == 0,
        )  # fmt: skip
    left, top, right, bottom = box
    axes.set(xlim=(left, right), ylim=(bottom, top), xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set_visible(False)


def _draw_from_side(
    axes: Any, track: RecordedTrack, moment: Moment, truth: Truth | None, bounds: Any
) -> None:
    for rank in reversed(range(len(moment.weights))):
        share = moment.weights[rank] / moment.weights[0]
        _add_skeleton(
            axes, track.joint_names, _from_side(moment.joints[rank], track.joint_names),
            2.2 if rank == 0 else 1.5, FAINTEST + (1 - FAINTEST) * share,
        )  # fmt: skip
    if truth is not None and moment.stamp_ns in truth.joints:
        points = _from_side(truth.joints[moment.stamp_ns], truth.joint_names)
        _add_skeleton(axes, truth.joint_names, points, 1.3, 1.0, colour=TRUTH, style=(0, (2, 1.2)))
    axes.set(xlim=bounds[:2], ylim=bounds[2:], aspect='equal')
    axes.tick_params(length=2, labelsize=7, color='#888888')
    axes.grid(color='#eeeeee', linewidth=0.6)
    axes.set_axisbelow(True)


def _from_side(joints: Array, names: tuple[str, ...]) -> Array:
    """(J, 2): towards the camera and up, from the pelvis, m."""
    relative = joints - joints[names.index(ORIGIN)]
    return np.stack([-relative[:, 2], -relative[:, 1]], axis=1)


def _add_skeleton(
    axes: Any, names: tuple[str, ...], points: Array, width: float, alpha: float,
    *, colour: str | None = None, style: Any = 'solid', halo: bool = False,
) -> None:  # fmt: skip
    bones = [
        (points[[names.index(a), names.index(b)]], own)
        for a, b, own in BONES
        if a in names and b in names
    ]
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
        Line2D([], [], color=LEFT, linewidth=2.4, label='left limbs'),
        Line2D([], [], color=RIGHT, linewidth=2.4, label='right limbs'),
        Line2D([], [], color=RIGHT, linewidth=1.5, alpha=0.35, label='fainter: less probable'),
    ]
    if truth:
        entries.append(
            Line2D([], [], color=TRUTH, linewidth=1.3, linestyle=(0, (2, 1.2)), label='truth')
        )
    figure.legend(handles=entries, loc='lower center', ncols=len(entries), frameon=False)


def _shown(track: RecordedTrack, images: dict[int, Image]) -> list[Moment]:
    moments = [moment for moment in track.moments if moment.stamp_ns in images]
    if not moments:
        raise ValueError('none of the images belongs to the track')
    return moments


def _crop(track: RecordedTrack, moments: list[Moment], camera: Camera) -> tuple[float, ...]:
    """Left, top, right, bottom of what the heaviest modes need, px."""
    pixels = np.concatenate([camera.project(m.joints[:ON_IMAGE]).reshape(-1, 2) for m in moments])
    pixels = pixels[np.isfinite(pixels).all(1)]
    low, high = pixels.min(0), pixels.max(0)
    margin = 0.12 * (high - low).max()
    low = np.maximum(low - margin, -0.5)
    high = np.minimum(high + margin, [camera.width - 0.5, camera.height - 0.5])
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def _side_bounds(
    track: RecordedTrack, moments: list[Moment], truth: Truth | None
) -> tuple[float, ...]:
    """Limits across and up, m."""
    points = [
        _from_side(joints, track.joint_names) for moment in moments for joints in moment.joints
    ]
    if truth is not None:
        points += [
            _from_side(truth.joints[moment.stamp_ns], truth.joint_names)
            for moment in moments
            if moment.stamp_ns in truth.joints
        ]
    everything = np.concatenate(points)
    low, high = everything.min(0) - 0.08, everything.max(0) + 0.08
    return float(low[0]), float(high[0]), float(low[1]), float(high[1])


def save_picture(figure: Figure, path: Path) -> None:
    """Writes a PNG of 256 colours, a third of the size of one of all colours."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    pixels = np.asarray(canvas.buffer_rgba())[..., :3]
    picture = Picture.fromarray(np.ascontiguousarray(pixels))
    picture.quantize(256, dither=Picture.Dither.NONE).save(path, format='PNG', optimize=True)
