"""Draws the figure of experts.md: the toy of BME fig. 2.

python docs/figures_experts.py
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

for _name in ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS'):
    os.environ.setdefault(_name, '1')
DOCS = Path(__file__).resolve().parent
sys.path.insert(0, str(DOCS.parent))

import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402
from matplotlib.axes import Axes  # noqa: E402

from hmt_ros.experts import (  # noqa: E402
    ConditionalDensity,
    ConditionalExperts,
    JointExperts,
)

EXPERTS = 5
COLOURS = ('#c8553d', '#1f3a5f', '#e0a458', '#588157', '#7b5e9a')
GREY = '#b8c4cf'
LIGHTEST = 0.02  # weight below which a branch is not drawn


def toy(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Inputs x = y + 0.3 sin(2 pi y) + noise and targets y uniform in (0, 1), (N, 1) each."""
    rng = np.random.default_rng(seed)
    y = rng.uniform(0.0, 1.0, count)
    x = y + 0.3 * np.sin(2.0 * np.pi * y) + 0.05 * rng.standard_normal(count)
    return x[:, None], y[:, None]


def main() -> int:
    """Draws the figure."""
    plt.switch_backend('Agg')
    plt.rcParams.update({'font.size': 8, 'axes.spines.top': False, 'axes.spines.right': False})
    inputs, targets = toy(250, 0)
    models: dict[str, ConditionalDensity] = {
        'conditional': ConditionalExperts(EXPERTS, seed=0),
        'joint': JointExperts(EXPERTS, seed=0),
        'one regression': ConditionalExperts(1, seed=0),
    }
    figure, axes = plt.subplots(
        2, 3, figsize=(8.4, 4.2), sharex=True, sharey='row', layout='constrained',
        gridspec_kw={'height_ratios': [2, 1]},
    )  # fmt: skip
    test = toy(5000, 1000)
    at = np.linspace(float(inputs.min()), float(inputs.max()), 400)[:, None]
    for column, (name, model) in zip(axes.T, models.items(), strict=True):
        model.fit(inputs, targets)
        score = float(model.log_density(*test).mean())
        column[0].set_title(f'{name}: {score:.2f} nats')
        column[0].scatter(inputs[:, 0], targets[:, 0], s=5, color=GREY, linewidths=0)
        draw(column[0], column[1], at, model)
        column[1].set_xlabel('input')
    axes[0, 0].set_ylabel('target')
    axes[1, 0].set_ylabel('gate')
    figure.savefig(DOCS / 'experts_toy.png', dpi=130)
    plt.close(figure)
    return 0


def draw(branches: Axes, gates: Axes, at: np.ndarray, model: ConditionalDensity) -> None:
    """Draws means and standard deviations of experts with weight, and the weights."""
    weights, means, covariances = model.predict_arrays(at)
    deviations = np.sqrt(covariances[..., 0, 0])
    for i in range(weights.shape[1]):
        colour = COLOURS[i % len(COLOURS)]
        shown = weights[:, i] > LIGHTEST
        mean = np.where(shown, means[:, i, 0], np.nan)
        branches.plot(at[:, 0], mean, color=colour, linewidth=1.4)
        low, high = (mean + sign * 2.0 * deviations[:, i] for sign in (-1.0, 1.0))
        branches.fill_between(at[:, 0], low, high, color=colour, alpha=0.15, linewidth=0)
        gates.plot(at[:, 0], weights[:, i], color=colour, linewidth=1.2)


if __name__ == '__main__':
    sys.exit(main())
