"""Learning of the descriptor of silhouettes: its codebook, weights and principal components.

K-means over shape contexts of the training silhouettes gives the codebook. The five parts of the
descriptor are weighted by their spread, and projected on their principal components.
"""

from __future__ import annotations

import numpy as np

from hmt_ros.experts.descriptor.silhouette_descriptor import (
    ShapeContextCodebook,
    SilhouetteDescriptor,
    SilhouetteParts,
    features_of,
)
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.clustering import k_means

FOR_CODEBOOK = 20_000  # maximum number of shape contexts that are clustered
# Weight of each part in the distance between two silhouettes.
WEIGHTS = {
    'shape_contexts': 1.0, 'edge_pairs': 0.5, 'distances': 1.0, 'moments': 0.5, 'edges': 0.7,
}  # fmt: skip
# Power of the standard deviation by which components are divided: 0 keeps the metric of the parts,
# 1 would give noise the same weight as everything else.
WHITENING = 0.3


def learned_codebook(contexts: Array, count: int = 50, seed: int = 0) -> ShapeContextCodebook:
    """The codebook of contexts (N, 60); the same contexts and seed give the same centres.

    Raises:
        ValueError: there are fewer contexts than centres, or some are not finite.
    """
    if len(contexts) < count:
        raise ValueError(f'{len(contexts)} shape contexts for {count} centres: give more masks')
    if not np.isfinite(contexts).all():
        raise ValueError('shape contexts must be finite')
    return ShapeContextCodebook(k_means(np.sqrt(contexts), count, np.random.default_rng(seed))[0])


def learned_descriptor(
    parts: list[SilhouetteParts],
    *,
    codebook_size: int = 50,
    points: int = 100,
    components: int = 96,
) -> SilhouetteDescriptor:
    """Learns the descriptor from silhouettes.

    Args:
        parts: Parts of silhouettes with `points` points each.
        codebook_size: Number of centres of the codebook.
        components: Maximum number of components of the descriptor.

    Raises:
        ValueError: there are fewer than two silhouettes, or too few for the codebook.
    """
    if len(parts) < 2:
        raise ValueError(f'a descriptor needs 2 silhouettes at least, saw {len(parts)}')
    total = len(parts) * points
    step = max(total // FOR_CODEBOOK, 1)
    chosen = np.random.default_rng(0).permutation(total)[: FOR_CODEBOOK * step : step]
    contexts = np.concatenate([part.contexts for part in parts])[np.sort(chosen)]
    codebook = learned_codebook(contexts, codebook_size)
    rows = [features_of(codebook, part) for part in parts]
    names = list(rows[0])
    columns = {name: np.array([row[name] for row in rows]) for name in names}
    scale = np.concatenate([_weights(name, columns[name]) for name in names])
    features = np.concatenate([columns[name] for name in names], axis=1) * scale
    unknown = np.isnan(features)
    centre = np.where(unknown, 0.0, features).sum(0) / np.maximum((~unknown).sum(0), 1)
    off = np.where(unknown, 0.0, features - centre)
    _, deviations, directions = np.linalg.svd(off, full_matrices=False)
    count = min(components, int((deviations > 1e-6 * deviations[0]).sum()))
    # The sign of a direction is arbitrary: make its largest entry positive.
    signs = np.sign(directions[np.arange(count), np.abs(directions[:count]).argmax(1)])
    stretch = (deviations[:count] / deviations[0]) ** -WHITENING
    basis = directions[:count].T * (signs * stretch)
    return SilhouetteDescriptor(codebook, scale, centre, basis, points)


def _weights(name: str, columns: Array) -> Array:
    """Weights (k,) of the features (N, k) of a part; each moment has its own weight."""
    if name == 'moments':
        spread = np.sqrt(columns.shape[1]) * np.maximum(columns.std(0), 1e-6)
    else:
        known = columns[~np.isnan(columns).any(1)]
        width = float(np.sqrt(known.var(0).sum())) if len(known) else 1.0
        spread = np.full(columns.shape[1], max(width, 1e-9))
    return np.asarray(WEIGHTS[name] / spread)
