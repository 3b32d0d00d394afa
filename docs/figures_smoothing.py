"""Draws the figures of smoothing.md: what VMS shows of its sequence, on a synthetic one.

python docs/figures_smoothing.py     minutes
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
from matplotlib.ticker import MaxNLocator  # noqa: E402

from benchmarks.arm_waving import STEP  # noqa: E402
from benchmarks.smoothing_relations import Analysis, analysis, descent, eigenvalues  # noqa: E402

TIMES = 47
FRAMES = (1, 8, TIMES)
# The angles that are drawn: those whose paths and optima differ most.
ANGLES = 3
DARK, LIGHT, ACCENT = '#1f3a5f', '#9db4c8', '#c8553d'


def main() -> int:
    """Draws all figures."""
    plt.switch_backend('Agg')
    plt.rcParams.update({'font.size': 8, 'axes.spines.top': False, 'axes.spines.right': False})
    found = analysis(TIMES)
    figure, (left, right) = plt.subplots(
        1, 2, figsize=(8.4, 2.8), gridspec_kw={'width_ratios': [2, 1]}, layout='constrained'
    )
    draw_visiting(left, found)
    draw_eigenvalues(right, found)
    save(figure, 'smoothing_network.png')

    figure, axes = plt.subplots(1, ANGLES, figsize=(8.4, 2.4), layout='constrained', sharex=True)
    draw_angles(axes, found)
    save(figure, 'smoothing_angles.png')

    figure, axes = plt.subplots(1, 3, figsize=(8.4, 2.4), layout='constrained')
    draw_distances(axes[0], found)
    draw_likelihood(axes[1], found)
    draw_free_energy(axes[2], descent(TIMES).held_out)
    save(figure, 'smoothing_trajectories.png')
    return 0


def draw_visiting(axes: Axes, found: Analysis) -> None:
    """Modes of all times in a row, those of every second time downwards."""
    values, owners = [], []
    for t, table in enumerate(found.visiting):
        values.append(table * (1 if t % 2 == 0 else -1))
        owners.append(np.full(table.shape[1], t))
    value, owner = np.concatenate(values, axis=1), np.concatenate(owners)
    at = np.arange(value.shape[1])
    for row in value:
        axes.vlines(at, 0, row, color=DARK, lw=0.6, alpha=0.35)
    axes.axhline(0, color='black', lw=0.5)
    ticks = [int(np.flatnonzero(owner == t)[0]) for t in range(0, TIMES, 10)]
    axes.set_xticks(ticks, [str(t) for t in range(0, TIMES, 10)])
    axes.set(
        xlabel='image, its modes side by side', ylabel='probability',
        title='Visiting probability of modes, per first mode (odd images downwards)',
    )  # fmt: skip


def draw_eigenvalues(axes: Axes, found: Analysis) -> None:
    """Spectra of the Hessian of the first 1, 8 and 47 images."""
    for frames, colour in zip(FRAMES, (LIGHT, ACCENT, DARK), strict=True):
        values = eigenvalues(found.sequence, found.refined.states[0], frames)
        share = np.linspace(0, 1, len(values))
        ratio = values[0] / values[-1]
        axes.semilogy(share, values, color=colour, label=f'{frames} ({ratio:.0f})')
    axes.legend(title='images (ratio)', frameon=False)
    # The ratio of one image is the generator's constant, that of `arm_waving.SPREAD` squared.
    axes.set(xlabel='rank / size', ylabel='1 / rad²', title='Eigenvalues (1 image: as generated)')


def draw_angles(axes: np.ndarray, found: Analysis) -> None:
    """The best path and the optimum that it leads to."""
    best = int(np.argmin(found.refined.energies))
    path, optimum = found.starts[best], found.refined.states[best]
    time = np.arange(TIMES) * STEP
    chosen = np.argsort(-np.abs(optimum - path).max(0))[:ANGLES]
    for ax, angle in zip(axes, np.sort(chosen), strict=True):
        ax.plot(time, np.degrees(path[:, angle]), '.-', ms=3, lw=0.8, color=LIGHT, label='path')
        ax.plot(time, np.degrees(optimum[:, angle]), lw=1.4, color=DARK, label='optimum')
        truth = found.sequence.truth[:, angle]
        ax.plot(time, np.degrees(truth), lw=0.8, ls=':', color=ACCENT, label='truth')
        ax.set(xlabel='s', title=f'angle {angle}')
    axes[0].set_ylabel('degrees')
    axes[0].legend(frameon=False, loc='upper left')


def draw_distances(axes: Axes, found: Analysis) -> None:
    """Mean difference of a variable."""
    difference = np.degrees(np.abs(found.refined.states - found.starts).mean((1, 2)))
    axes.plot(difference, color=DARK, lw=1)
    axes.set(
        xlabel='trajectory', ylabel='degrees', title='Optimum from path, a variable',
        ylim=(0, 1.15 * difference.max()),
    )  # fmt: skip


def draw_likelihood(axes: Axes, found: Analysis) -> None:
    """-log p of the observations along paths and at optima."""
    axes.plot(found.start_energies, color=LIGHT, lw=1, label='path')
    axes.plot(found.refined.observation_energies, color=DARK, lw=1, label='optimum')
    axes.legend(frameon=False)
    axes.set(xlabel='trajectory', ylabel='nats', title='-log likelihood')


def draw_free_energy(axes: Axes, trace: np.ndarray) -> None:
    """Over the iterations."""
    axes.plot(trace, '.-', color=DARK)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set(xlabel='iteration', ylabel='nats', title='Free energy')


def save(figure: plt.Figure, name: str) -> None:
    """Without the date and versions, so that the same figure is the same file."""
    figure.savefig(DOCS / name, dpi=110, metadata={'Software': None})
    plt.close(figure)


if __name__ == '__main__':
    sys.exit(main())
