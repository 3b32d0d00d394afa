"""What VMS reports of its sequence, on a synthetic one: numbers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.arm_waving import STEP, Waving, waving
from hmt_ros.inference.energy import Derivatives
from hmt_ros.smoothing.embedded_network import k_best_paths
from hmt_ros.smoothing.likelihood import MixtureLikelihood
from hmt_ros.smoothing.mode_sequence import ModeSequence
from hmt_ros.smoothing.trajectory_refinement import RefinedTrajectories, refine
from hmt_ros.smoothing.variational_mixture import (
    VariationalMixture,
    minimise_free_energy,
    peak_weights,
)

Array = NDArray[np.float64]

# The two answers of an ambiguous segment, where the free energy has something to find: closer than
# their deviations at times, so that trajectories overlap; and no trajectory dominates.
CLOSE = 0.2
SAMPLES = 32
ITERATIONS = 15


@dataclass(frozen=True, eq=False)
class Analysis:
    """The arm-waving sequence, smoothed step by step.

    Attributes:
        sequence: the sequence.
        starts: (P, T, d) poses along the best paths between each pair of ends.
        refined: the optimum that each of them leads to.
        start_energies: (P,) -log p of the observations along the paths.
    """

    sequence: Waving
    starts: Array
    refined: RefinedTrajectories
    start_energies: Array


def analysis(times: int) -> Analysis:
    """Network, paths and optima."""
    sequence = waving(times)
    layers = layers_of(sequence)
    paths = k_best_paths(layers.network, 1)
    starts = layers.states(paths)
    refined = refine(starts, layers.prior, layers.likelihood, sequence.lower, sequence.upper)
    at = np.tile(np.arange(times), len(starts))
    flat = starts.reshape(-1, starts.shape[2])
    observed = layers.likelihood.energy(flat, at, derivatives=Derivatives.NONE)
    energies = observed.value.reshape(len(starts), -1).sum(1)
    return Analysis(sequence, starts, refined, energies)


def layers_of(sequence: Waving) -> ModeSequence:
    """The modes of a sequence under its dynamics."""
    intervals = np.full(len(sequence.mixtures) - 1, STEP)
    return ModeSequence(tuple(sequence.mixtures), sequence.dynamics, intervals)


def descent(times: int) -> VariationalMixture:
    """The descent of the free energy from where VMS begins: optima weighed by their height.

    The modes of the other sequence lie far apart in units of their deviations, so that one
    trajectory has almost all the weight and its Gaussian is all but exact: there is nothing left
    to descend. Here modes come close enough to overlap.
    """
    sequence = waving(times, reach=CLOSE, alike=True)
    layers = layers_of(sequence)
    starts = layers.states(layers.paths(64))
    refined = refine(starts, layers.prior, layers.likelihood, sequence.lower, sequence.upper)
    distinct = refined.without_duplicates()
    return minimise_free_energy(
        peak_weights(distinct.energies), distinct.states, distinct.factors, layers.prior,
        layers.likelihood, low=sequence.lower, high=sequence.upper, samples=SAMPLES,
        max_iterations=ITERATIONS,
    )  # fmt: skip


def relations(times: int) -> dict[str, Any]:
    """Eigenvalues, differences, roughness, likelihood and free energy."""
    found = analysis(times)
    refined, starts = found.refined, found.starts
    trace = descent(times).held_out
    before = found.start_energies
    fall = float(trace[0] - trace.min())
    return {
        'eigenvalue_ratio': {
            str(frames): eigenvalue_ratio(eigenvalues(found.sequence, refined.states[0], frames))
            for frames in sorted({1, min(8, times), times})
        },
        'difference_deg': float(np.degrees(np.abs(refined.states - starts).mean())),
        'roughness_ratio': roughness(refined.states) / roughness(starts),
        'log_likelihood_change': float(
            np.mean((refined.observation_energies - before) / abs(before))
        ),
        'free_energy': trace.tolist(),
        'free_energy_fall': fall,
        'free_energy_iterations': int(np.argmin(trace)),
        'share_of_fall_within_8': float((trace[0] - trace[:9].min()) / max(fall, 1e-12)),
    }


def eigenvalues(sequence: Waving, states: Array, frames: int) -> Array:
    """Of the Hessian of the first frames at an optimum, the largest first."""
    likelihood = MixtureLikelihood.of(sequence.mixtures[:frames])
    poses = states[:frames]
    _, hessian = likelihood.energy(poses, np.arange(frames)).derivatives()
    d = poses.shape[1]
    precision = sequence.dynamics.prior(np.full(frames - 1, STEP)).precision
    dense = np.zeros((frames, d, frames, d))
    for t in range(frames):
        dense[t, :, t] = precision.diagonal[t] + hessian[t]
    for t, block in enumerate(precision.lower):
        dense[t + 1, :, t], dense[t, :, t + 1] = block, block.T
    return np.linalg.eigvalsh(dense.reshape(frames * d, -1))[::-1]


def eigenvalue_ratio(values: Array) -> float:
    """Largest over smallest; of one image it is the constant that its modes are generated with."""
    return float(values[0] / values[-1])


def roughness(states: Array) -> float:
    """Mean square of second differences."""
    return float((np.diff(states, n=2, axis=1) ** 2).mean())
