"""Draws the figure of sampling.md: how far from the start minima are found, as KJS fig. 6.

python docs/figures_sampling.py
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

from benchmarks import kjs  # noqa: E402
from hmt_ros.body import load_body  # noqa: E402
from hmt_ros.inference.bounded_newton import Status  # noqa: E402

SHOWN = {
    ('both arms, left calf', ''): 'kinematic jumps: both arms, left calf',
    ('CSS', '8'): 'CSS, scale 8',
}
SAMPLES, MINIMA = '#b8c4cf', '#c8553d'
FARTHEST = (5.0, 320.0)
BINS = 32


def main() -> int:
    """Draws it."""
    plt.switch_backend('Agg')
    plt.rcParams.update({'font.size': 8, 'axes.spines.top': False, 'axes.spines.right': False})
    body = load_body('human34')
    setting = kjs.setting_of(body, kjs.chosen_pose(body))
    figure, axes = plt.subplots(
        2, 2, figsize=(8.4, 4.2), sharex='col', sharey='row', layout='constrained'
    )
    rows = iter(axes)
    for found in kjs.all_samples(setting, 2000, 0):
        title = SHOWN.get((found.sampler, found.scale))
        if title is None:
            continue
        row = next(rows)
        converged = found.optimised.status == Status.CONVERGED
        samples = kjs.distances_from(setting, found.optimised.x[converged])
        minima = kjs.distances_from(setting, found.optimised.x[found.minima])
        for axis, every, distinct, farthest in zip(row, samples, minima, FARTHEST, strict=True):
            bins = np.linspace(0.0, farthest, BINS + 1)
            axis.hist(
                np.minimum(every, farthest), bins, color=SAMPLES,
                label=f'{len(every)} samples, optimised',
            )  # fmt: skip
            axis.hist(
                np.minimum(distinct, farthest), bins, color=MINIMA, rwidth=0.6,
                label=f'{len(distinct)} distinct minima',
            )  # fmt: skip
        row[0].set_title(title, loc='left')
        row[0].set_ylabel('number')
        row[0].legend(frameon=False)
    axes[1, 0].set_xlabel('distance from the start, m and rad together')
    axes[1, 1].set_xlabel('distance from the start, standard deviations')
    figure.savefig(DOCS / 'sampling_distances.png', dpi=130)
    plt.close(figure)
    return 0


if __name__ == '__main__':
    sys.exit(main())
