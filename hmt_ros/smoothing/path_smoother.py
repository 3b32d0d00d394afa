"""Mixtures over trajectories in closed form, for windows that have to keep up with a camera.

The posterior of a sequence of Gaussian mixtures is a Gaussian mixture with a component for every
path through their modes. The most probable paths that differ are found by the embedded network, and
their components, with the weights that they have in the posterior, are the result: neither descent
to optima nor of the free energy, which cost fifty times as much. Modes that overlap share their
mass among many paths; they should be merged before (`reduction.merged_if_close`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from hmt_ros.inference.energy import Derivatives
from hmt_ros.smoothing.likelihood import SequenceLikelihood
from hmt_ros.smoothing.mixture_smoother import MixtureSmoother
from hmt_ros.smoothing.mode_sequence import ModeSequence
from hmt_ros.smoothing.path_gaussians import path_gaussians
from hmt_ros.smoothing.trajectory_mixture import TrajectoryMixture
from hmt_ros.smoothing.trajectory_refinement import limits_of_states


@dataclass(frozen=True, eq=False)
class PathSmoother(MixtureSmoother):
    """A `MixtureSmoother` that ends where the paths are found.

    `adapt`, `start` and `max_iterations` have no meaning for it, nor has `seed`; the result has no
    free energy. Means beyond the limits are moved onto them.
    """

    def smooth_sequence(
        self,
        sequence: ModeSequence,
        seed: int = 0,
        stamps_ns: Sequence[int] | None = None,
        observation: SequenceLikelihood | None = None,
    ) -> TrajectoryMixture:
        """As `MixtureSmoother.smooth_sequence`.

        Raises:
            ValueError: another observation than the mixtures.
        """
        if observation is not None:
            raise ValueError('paths are smoothed by the mixtures alone, without an observation')
        prior, likelihood = sequence.prior, sequence.likelihood
        found = path_gaussians(self.paths(sequence).nodes, prior, likelihood)
        d, n = self.dynamics.dimension, self.dynamics.state_dimension
        low, high = limits_of_states(
            -np.inf if self.lower is None else self.lower,
            np.inf if self.upper is None else self.upper,
            d,
            n,
        )
        order = np.argsort(-found.log_weights, kind='stable')
        states = np.clip(found.states[order], low, high)
        count, times, _ = states.shape
        energies, _ = prior.energy(states)
        poses = states[:, :, : prior.dimension].reshape(-1, prior.dimension)
        at = np.tile(np.arange(times), count)
        energy = likelihood.energy(poses, at, derivatives=Derivatives.NONE)
        observed = energy.value.reshape(count, times).sum(1)
        log = found.log_weights[order]
        result = TrajectoryMixture(
            weights=np.exp(log - logsumexp(log)),
            states=states,
            factors=tuple(found.factors[i] for i in order),
            inflation=np.ones(count),
            log_joint=-(energies + observed),
            free_energy=np.empty(0),
            dimension=d,
            stamps_ns=None if stamps_ns is None else tuple(int(stamp) for stamp in stamps_ns),
            identities=tuple(range(count)),
            lower=low[:d],
            upper=high[:d],
        )
        return self.as_evidence(result, sequence.intervals)
