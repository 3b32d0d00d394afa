"""Data whose conditional density is known: the toy of BME fig. 2, and motions of two styles."""

from __future__ import annotations

import numpy as np
from scipy.special import logsumexp
from scipy.stats import norm

NOISE = 0.05


def toy(count, seed):
    """Inputs x = y + 0.3 sin(2 pi y) + noise and targets y uniform in (0, 1), (N, 1) each."""
    rng = np.random.default_rng(seed)
    y = rng.uniform(0.0, 1.0, count)
    x = y + 0.3 * np.sin(2.0 * np.pi * y) + NOISE * rng.standard_normal(count)
    return x[:, None], y[:, None]


def true_log_density(inputs, targets):
    """log p(y | x) of the toy, (N,), by quadrature over y."""
    grid = (np.arange(4000) + 0.5) / 4000

    def noise(y, x):
        return norm.logpdf(x - y - 0.3 * np.sin(2.0 * np.pi * y), scale=NOISE)

    parts = np.array_split(inputs[:, 0], max(1, len(inputs) // 500))
    evidence = [logsumexp(noise(grid, x[:, None]), axis=1) - np.log(len(grid)) for x in parts]
    return noise(targets[:, 0], inputs[:, 0]) - np.concatenate(evidence)


def styles(count, seed, inputs=20, outputs=32):
    """A synthetic motion: inputs (N, p) that barely distinguish two styles, targets (N, D)."""
    shape = np.random.default_rng(0)
    into = shape.normal(size=(6, inputs))
    out = shape.normal(size=(8, outputs))
    rng = np.random.default_rng(seed)
    phase = rng.uniform(0.0, 2.0 * np.pi, count)
    style, lean = rng.integers(0, 2, count), 0.5 * rng.normal(size=count)
    seen = np.c_[
        np.cos(phase),
        0.03 * np.sin(phase) * (2 * style - 1),
        lean,
        np.cos(2 * phase),
        lean**2,
        np.cos(3 * phase),
    ]
    made = np.c_[
        np.cos(phase),
        np.sin(phase),
        style,
        lean,
        np.sin(2 * phase),
        style * np.cos(phase),
        np.cos(3 * phase),
        lean**2,
    ]
    return (
        seen @ into + 0.05 * rng.normal(size=(count, inputs)),
        made @ out + 0.1 * rng.normal(size=(count, outputs)),
    )
