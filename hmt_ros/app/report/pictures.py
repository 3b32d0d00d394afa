"""The pictures of a report: skeletons, weights and errors over time, calibration, free energy."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np

from hmt_ros.app.report.images import FilmStrip
from hmt_ros.app.report.mixtures import Layer, Moment, RecordedMixtures, Window
from hmt_ros.app.report.skeletons import (
    draw_overlays,
    draw_overview,
    draw_side_views,
    new_picture,
)
from hmt_ros.evaluation.pose_scores import LOST_ERROR
from hmt_ros.evaluation.track_scores import TrackScores, Truth, mode_errors
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.calibration import coverage

# Number of times in the overview and on the sheets.
OVERVIEW_TIMES, SHEET_TIMES = 4, 8
PICTURES = {
    'overview.png': 'images with the heaviest modes, and the same person from the side',
    'overlays.png': 'the heaviest modes on more images',
    'side_views.png': 'all modes from the side',
    'weights.png': 'weights of the modes and errors over time',
    'calibration.png': 'coverage of the regions of the mixtures over their probability',
    'free_energy.png': 'free energy of the trajectory mixtures',
}
PROBABILITIES = np.arange(1, 20) / 20
_COLOURS = ('#0072b2', '#d55e00', '#009e73', '#cc79a7', '#e69f00', '#56b4e9', '#000000')


def shown_in_pictures(track: Layer[Moment]) -> set[int]:
    """Stamps of the images that `draw_pictures` needs."""
    return {*track.spread(OVERVIEW_TIMES), *track.spread(SHEET_TIMES)} if track.mixtures else set()


def draw_pictures(
    folder: Path,
    mixtures: RecordedMixtures,
    images: FilmStrip,
    truth: Truth | None,
    scores: dict[str, TrackScores],
) -> list[str]:
    """Draws all pictures for which there are data.

    Args:
        folder: folder of the pictures.
        mixtures: mixtures of the bag; the first layer of mixtures over poses is drawn.
        images: images at the stamps of `shown_in_pictures`; some may be missing.
        truth: true joint positions; None if unknown.
        scores: scores by topic; empty without truth.

    Returns:
        Names of the files, keys of `PICTURES`.
    """
    if mixtures.layers:
        track = mixtures.layers[0]
        few, many = track.spread(OVERVIEW_TIMES), track.spread(SHEET_TIMES)
        chosen = [{t: images.kept[t] for t in own if t in images.kept} for own in (few, many)]
        if images.camera is not None and chosen[0]:
            draw_overview(folder / 'overview.png', track, images.camera, chosen[0], truth)
        if images.camera is not None and chosen[1]:
            draw_overlays(folder / 'overlays.png', track, images.camera, chosen[1])
        draw_side_views(folder / 'side_views.png', track, many, truth)
        _draw_weights(folder / 'weights.png', track, truth)
    if any(topic.scores.levels is not None for topic in scores.values()):
        _draw_calibration(folder / 'calibration.png', scores)
    recorded = [
        layer
        for layer in mixtures.trajectories
        if any(len(window.free_energy) for window in layer.mixtures.values())
    ]
    if recorded:
        _draw_free_energy(folder / 'free_energy.png', recorded)
    return [name for name in PICTURES if (folder / name).exists()]


def _draw_weights(path: Path, track: Layer[Moment], truth: Truth | None) -> None:
    """Draws the weights of the modes over time and, if the truth is known, errors."""
    moments = list(track.mixtures.values())
    seconds = np.array([(stamp - moments[0].stamp_ns) * 1e-9 for stamp in track.mixtures])
    most = max(len(moment.weights) for moment in moments)
    weights = np.zeros((most, len(seconds)))
    for t, moment in enumerate(moments):
        weights[: len(moment.weights), t] = moment.weights
    known = truth is not None
    with new_picture(path, (9.0, 5.0 if known else 2.8), 'constrained') as figure:
        axes = figure.subplots(2 if known else 1, 1, squeeze=False, sharex=True)[:, 0]
        colours = mpl.colormaps['cividis'](np.linspace(0.95, 0.1, most))
        axes[0].stackplot(seconds, weights, colors=colours, linewidth=0.4, edgecolor='white')
        axes[0].set(ylim=(0, 1), ylabel='weight')
        if len(seconds) > 1:
            axes[0].set_xlim(seconds[0], seconds[-1])
        axes[0].set_title(f'weights of the {most} modes, heaviest at the bottom', loc='left')
        if truth is not None:
            _draw_errors(axes[1], track, truth, seconds)
        axes[-1].set_xlabel('time, s')


def _draw_errors(axes: Any, track: Layer[Moment], truth: Truth, seconds: Array) -> None:
    joints = {stamp: moment.joints for stamp, moment in track.mixtures.items()}
    errors = mode_errors(joints, track.joint_names, truth)
    curves = np.full((3, len(seconds)), np.nan)
    for t, (stamp, moment) in enumerate(track.mixtures.items()):
        if stamp in errors:
            error = 1e3 * errors[stamp]
            curves[:, t] = error[0], error.min(), moment.weights @ error
    styles = (
        ('heaviest mode', '#d55e00', '-'),
        ('best of all modes', '#009e73', '-'),
        ('expected', '#555555', ':'),
    )
    for curve, (label, colour, style) in zip(curves, styles, strict=True):
        axes.plot(seconds, curve, color=colour, linestyle=style, label=label, linewidth=1.6)
    axes.axhline(1e3 * LOST_ERROR, color='#bbbbbb', linewidth=0.8, zorder=0)
    axes.annotate('lost', (seconds[-1], 1e3 * LOST_ERROR), ha='right', va='bottom', color='#888888')
    axes.set(ylabel='mean joint error, mm', ylim=(0, None))
    axes.legend(frameon=False, ncols=3, loc='upper left', bbox_to_anchor=(0, 1.12))


def _draw_calibration(path: Path, scores: dict[str, TrackScores]) -> None:
    """Plots the coverage of highest-density regions against their nominal probability."""
    with new_picture(path, (10.4, 4.8), 'constrained') as figure:
        axes: Any = figure.subplots(1, 3, sharey=True)
        for number, (name, topic) in enumerate(scores.items()):
            found = topic.scores
            every = found.levels, found.joint_levels, found.absolute_levels
            for one, levels in zip(axes, every, strict=True):
                if levels is not None:
                    covered = [coverage(levels, q) for q in PROBABILITIES]
                    colour = _COLOURS[number % len(_COLOURS)]
                    one.plot(PROBABILITIES, covered, color=colour, label=name, linewidth=1.6)
        titles = 'all joints together', 'each joint alone', 'each joint, from the camera'
        for one, title in zip(axes, titles, strict=True):
            one.plot([0, 1], [0, 1], color='#bbbbbb', linewidth=0.8, zorder=0)
            one.set(title=title, xlim=(0, 1), ylim=(0, 1), aspect='equal')
            one.set_xlabel('probability of the region')
        axes[0].set_ylabel('fraction of true positions in it')
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, frameon=False, loc='outside lower center', ncols=2)


def _draw_free_energy(path: Path, layers: Sequence[Layer[Window]]) -> None:
    """Draws the free energy of each window in the first and in the last iteration."""
    start = min(min(layer.mixtures) for layer in layers)
    with new_picture(path, (9.0, 2.8), 'constrained') as figure:
        axes: Any = figure.subplots()
        for number, layer in enumerate(layers):
            windows = [one for one in layer.mixtures.values() if len(one.free_energy)]
            seconds = np.array([(window.stamp_ns - start) * 1e-9 for window in windows])
            colour = _COLOURS[number % len(_COLOURS)]
            for which, style, label in ((0, ':', 'first'), (-1, '-', 'last')):
                values = [window.free_energy[which] for window in windows]
                axes.plot(
                    seconds,
                    values,
                    color=colour,
                    linestyle=style,
                    marker='.',
                    markersize=3,
                    label=f'{layer.topic}, {label} iteration',
                )
        axes.set(xlabel='end of the window, s', ylabel='free energy, nats')
        axes.legend(frameon=False, fontsize=8)
