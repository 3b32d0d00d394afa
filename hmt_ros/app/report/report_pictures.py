"""The pictures of a report: those of a track, calibration, and free energy."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from hmt_ros.app.bag_scores import TopicScores
from hmt_ros.app.report.film_strip import FilmStrip
from hmt_ros.app.report.page import PROBABILITIES
from hmt_ros.app.report.pictures import (
    STYLE,
    draw_overlays,
    draw_overview,
    draw_side_views,
    draw_weights,
    save_picture,
)
from hmt_ros.app.report.recorded_mixtures import RecordedMixtures, Trajectories
from hmt_ros.app.report.recorded_track import RecordedTrack, spread
from hmt_ros.app.truth import Truth
from hmt_ros.inference.calibration import coverage

# Times that are shown in the overview and on the sheets.
IN_OVERVIEW, ON_SHEETS = 4, 8
PICTURES = {
    'overview.png': 'images with the heaviest modes, and the same from the side',
    'overlays.png': 'the heaviest modes on more images',
    'side_views.png': 'all modes from the side',
    'weights.png': 'weights of the modes over time',
    'calibration.png': 'how often the truth lies where the mixtures say',
    'free_energy.png': 'free energy of the trajectory mixtures',
}
_COLOURS = ('#0072b2', '#d55e00', '#009e73', '#cc79a7', '#e69f00', '#56b4e9', '#000000')


def shown_in_pictures(track: RecordedTrack) -> set[int]:
    """Stamps whose images `draw_pictures` needs."""
    return {*spread(track, IN_OVERVIEW), *spread(track, ON_SHEETS)} if track.moments else set()


def draw_pictures(
    folder: Path,
    mixtures: RecordedMixtures,
    images: FilmStrip,
    truth: Truth | None,
    scores: dict[str, TopicScores],
) -> list[str]:
    """Draws what there is to be drawn; the names of the files.

    Args:
        folder: for the pictures.
        mixtures: the first layer is drawn.
        images: those of `shown_in_pictures`, where there are some.
        truth: None: not known.
        scores: by topic; empty: not known.
    """
    drawn = []
    if mixtures.layers:
        track = mixtures.layers[0].track
        few, many = spread(track, IN_OVERVIEW), spread(track, ON_SHEETS)
        if images.camera is not None:
            for name, stamps in (('overview.png', few), ('overlays.png', many)):
                kept = {t: images.kept[t] for t in stamps if t in images.kept}
                if not kept:
                    continue
                if name == 'overview.png':
                    draw_overview(folder / name, track, images.camera, kept, truth)
                else:
                    draw_overlays(folder / name, track, images.camera, kept)
                drawn.append(name)
        draw_side_views(folder / 'side_views.png', track, many, truth)
        draw_weights(folder / 'weights.png', track, truth)
        drawn += ['side_views.png', 'weights.png']
    if any(topic.scores.levels is not None for topic in scores.values()):
        draw_calibration(folder / 'calibration.png', scores)
        drawn.append('calibration.png')
    recorded = [
        topic for topic in mixtures.trajectories if any(len(w.free_energy) for w in topic.windows)
    ]
    if recorded:
        draw_free_energy(folder / 'free_energy.png', recorded)
        drawn.append('free_energy.png')
    return drawn


def draw_calibration(path: Path, scores: dict[str, TopicScores]) -> None:
    """Coverage of the highest-density regions over their probability."""
    with mpl.rc_context(STYLE):
        figure = Figure((7.6, 4.8), dpi=110, layout='constrained')
        axes: Any = figure.subplots(1, 2, sharey=True)
        for number, (name, topic) in enumerate(scores.items()):
            pair = topic.scores.levels, topic.scores.joint_levels
            for one, levels in zip(axes, pair, strict=True):
                if levels is not None:
                    covered = [coverage(levels, q) for q in PROBABILITIES]
                    colour = _COLOURS[number % len(_COLOURS)]
                    one.plot(PROBABILITIES, covered, color=colour, label=name, linewidth=1.6)
        for one, title in zip(axes, ('all joints together', 'each joint alone'), strict=True):
            one.plot([0, 1], [0, 1], color='#bbbbbb', linewidth=0.8, zorder=0)
            one.set(title=title, xlim=(0, 1), ylim=(0, 1), aspect='equal')
            one.set_xlabel('probability of the region')
        axes[0].set_ylabel('share of truths in it')
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, frameon=False, loc='outside lower center', ncols=2)
        save_picture(figure, path)


def draw_free_energy(path: Path, trajectories: Sequence[Trajectories]) -> None:
    """Free energy of each window, where its iterations began and where they ended."""
    start = min(topic.windows[0].stamp_ns for topic in trajectories)
    with mpl.rc_context(STYLE):
        figure = Figure((9.0, 2.8), dpi=110, layout='constrained')
        axes: Any = figure.subplots()
        for number, topic in enumerate(trajectories):
            windows = [window for window in topic.windows if len(window.free_energy)]
            seconds = np.array([(window.stamp_ns - start) * 1e-9 for window in windows])
            colour = _COLOURS[number % len(_COLOURS)]
            for which, style, label in ((0, ':', 'first'), (-1, '-', 'last')):
                values = [window.free_energy[which] for window in windows]
                axes.plot(
                    seconds, values, color=colour, linestyle=style, marker='.', markersize=3,
                    label=f'{topic.topic}, {label} iteration',
                )  # fmt: skip
        axes.set(xlabel='s', ylabel='free energy, nats')
        axes.legend(frameon=False, fontsize=8)
        save_picture(figure, path)
