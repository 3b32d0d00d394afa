"""Figures of a training set: affinities (BME fig. 7), multimodality (BME fig. 6), examples."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from hmt_ros.app.report.skeletons import STYLE
from hmt_ros.body import Body
from hmt_ros.experts.descriptor.silhouette_descriptor import silhouette_parts
from hmt_ros.experts.pose_encoding import AXES
from hmt_ros.experts.predictor_learning import Described, affinities, multimodality
from hmt_ros.experts.training_set import PoseSequence, TrainingSet, seen_from
from hmt_ros.inference.arrays import Array

ACTIVITIES = 3  # maximum number of activities whose affinities are drawn
FRAMES = 120  # maximum number of frames of each
ANALYSED = 2000  # maximum number of samples whose multimodality is counted
FINE, COARSE = 0.956, 0.70  # clusters per sample, as in the paper: 1912 and 1409 of 2000
EXAMPLES = (4, 12)  # rows and columns of silhouettes


def write_report(
    folder: Path,
    body: Body,
    sequences: Sequence[PoseSequence],
    pairs: TrainingSet,
    training: Described,
) -> list[tuple[Path, str]]:
    """Draws the figures into a folder.

    Args:
        folder: Folder that exists.
        body: Body of the poses.
        sequences: Motions.
        pairs: Silhouettes and poses.
        training: Descriptors and targets.

    Returns:
        The path of each figure, and a description.
    """
    figures = [
        (
            _affinity_figure(body, sequences, training),
            'affinities.png',
            'affinity of joint angles and descriptors over time',
        ),
        (
            _multimodality_figure(training),
            'multimodality.png',
            'clusters of poses under one cluster of descriptors',
        ),
        (_example_figure(pairs), 'silhouettes.png', 'silhouettes of the training set'),
    ]
    result = []
    for figure, name, what in figures:
        figure.savefig(folder / name)
        result.append((folder / name, what))
    return result


def _affinity_figure(body: Body, sequences: Sequence[PoseSequence], training: Described) -> Figure:
    chosen = _of_different_activities(sequences)
    columns = ('joint angles', 'shape contexts', 'edge pairs', 'descriptor')
    with mpl.rc_context(STYLE):
        figure = Figure((1.9 * len(columns) + 0.4, 1.9 * len(chosen) + 0.5), dpi=110)
        axes = figure.subplots(len(chosen), len(columns), squeeze=False)
        for number, sequence in enumerate(chosen):
            row = axes[number]
            # The person on average looks across the image; long motions have half the rate.
            step = 2 if len(sequence.poses) >= 2 * FRAMES else 1
            poses, masks = seen_from(body, sequence, 90.0, frames=slice(0, FRAMES * step, step))
            parts = [silhouette_parts(mask, training.descriptor.points) for mask in masks]
            histograms = [training.descriptor.codebook_.histogram(part.contexts) for part in parts]
            vectors = (
                poses[:, AXES:],
                np.sqrt(np.array(histograms)),
                np.sqrt(np.array([part.edge_pairs for part in parts])),
                training.descriptor.describe(parts),
            )
            for one, title, values in zip(row, columns, vectors, strict=True):
                one.imshow(affinities(values), cmap='viridis', vmin=0.0, vmax=1.0)
                one.set_xticks([])
                one.set_yticks([])
                if number == 0:
                    one.set_title(title)
            row[0].set_ylabel(f'{sequence.activity}, {len(masks)} frames')
        figure.tight_layout()
    return figure


def _of_different_activities(sequences: Sequence[PoseSequence]) -> list[PoseSequence]:
    """The longest motion of some activities, walking first."""
    longest: dict[str, PoseSequence] = {}
    for sequence in sequences:
        known = longest.get(sequence.activity)
        if known is None or len(sequence.poses) > len(known.poses):
            longest[sequence.activity] = sequence
    order = sorted(longest.values(), key=lambda x: (x.activity != 'walk', -len(x.poses), x.name))
    return order[:ACTIVITIES]


def _multimodality_figure(training: Described) -> Figure:
    count = min(ANALYSED, len(training.targets))
    rows = np.sort(np.random.default_rng(0).permutation(len(training.targets))[:count])
    inputs, targets = training.descriptors[rows], _scaled(training.targets[rows])
    before = _scaled(training.previous[rows])
    before *= np.sqrt(inputs.var(0).sum() / max(before.var(0).sum(), 1e-12))
    cases = (
        ('p(x | r)', inputs, FINE),
        ('p(x | x-, r)', np.hstack([before, inputs]), FINE),
        ('p(x | x-, r)', np.hstack([before, inputs]), COARSE),
    )
    with mpl.rc_context(STYLE):
        figure = Figure((8.0, 2.6), dpi=110)
        for one, (title, values, share) in zip(figure.subplots(1, 3), cases, strict=True):
            clusters = max(int(share * count), 1)
            found = multimodality(values, targets, clusters)
            one.bar(np.arange(1, len(found) + 1), np.maximum(found, 0.5), color='#3b6ea5')
            one.set_yscale('log')
            one.set_title(f'{title}, {clusters} clusters of {count}')
            one.set_xlabel('clusters of poses')
        figure.axes[0].set_ylabel('clusters of descriptors')
        figure.tight_layout()
    return figure


def _scaled(values: Array) -> Array:
    result: Array = values / np.maximum(values.std(0), 1e-6)
    return result


def _example_figure(pairs: TrainingSet) -> Figure:
    rows, columns = EXAMPLES
    chosen = np.linspace(0, len(pairs) - 1, rows * columns).astype(int)
    with mpl.rc_context(STYLE):
        figure = Figure((0.8 * columns, 1.0 * rows), dpi=110)
        grid: Any = figure.subplots(rows, columns, squeeze=False)
        for one, sample in zip(grid.ravel(), chosen, strict=True):
            one.imshow(pairs.mask(int(sample)), cmap='gray_r')
            one.set_axis_off()
            one.set_title(pairs.activities[sample], fontsize=6.0, pad=1.0)
        figure.subplots_adjust(0.01, 0.01, 0.99, 0.95, 0.05, 0.2)
    return figure
