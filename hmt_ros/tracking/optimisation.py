"""Optimise: every hypothesis descends to a minimum of E, in rounds (KJS figure 4, step 3).

    x_k = argmin E(x)          bounded Newton from x_k^0, within the joint limits
    E_k = E(x_k) + room_k      what a jump pays for its wider motion prior; see `weighting`
    search again while         min_k E_k >= u + rise,  in `rounds` rounds at most
    u <- u + gain min(min_k E_k - u, rise)

u is the usual energy of the track: the least one of its images, smoothed. Where the least energy of
an image is higher than that, the search has probably missed the pose.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hmt_ros.image.observation import Observation
from hmt_ros.inference.arrays import Array
from hmt_ros.tracking.hypotheses import Hypotheses, Optimised
from hmt_ros.tracking.motion_states import PredictedStates
from hmt_ros.tracking.posterior import Posterior
from hmt_ros.tracking.proposals import Proposal
from hmt_ros.tracking.proposals.sampling import covariance_scaled_samples
from hmt_ros.tracking.weighting import cost_of_room

# How far the usual energy follows that of the last image.
USUAL_GAIN = 0.1


class UsualEnergy:
    """The least energy that images of a track usually have.

    Args:
        rise: most that counts of what an energy is above the usual one, nats.

    Attributes:
        value: u, nats; infinite before the first image.
    """

    def __init__(self, rise: float) -> None:
        self.value = np.inf
        self._rise = rise

    def update(self, least_energy: float) -> None:
        """Takes in the least energy of an image, nats."""
        if not np.isfinite(self.value):
            self.value = least_energy
        else:
            # What is unusual is not learned at once.
            self.value += USUAL_GAIN * min(least_energy - self.value, self._rise)


@dataclass(frozen=True, eq=False)
class Search:
    """The search for the optima of one image.

    Attributes:
        posterior: whose energy is minimised.
        observation: of the image.
        states: of the ancestors, predicted.
        precisions: (K, d, d) inverse covariances of their poses.
    """

    posterior: Posterior
    observation: Observation
    states: PredictedStates
    precisions: Array

    def optimise(self, hypotheses: Hypotheses) -> Optimised:
        """Hypotheses (N, d) at their optima; the energies contain the cost of room."""
        posterior, precisions = self.posterior, self.precisions
        # Each has a precision of its own, where it jumped a lower one.
        own = self.states.precisions_of(hypotheses.ancestors, hypotheses.jumped, precisions)
        term = posterior.given(self.observation, hypotheses, own)
        solved = posterior.minimise(term, hypotheses.poses, posterior.settings.iterations)
        hessian = posterior.gaussian_hessians(solved, hypotheses, own)
        room = cost_of_room(hessian, own, precisions[hypotheses.ancestors], hypotheses.jumped)
        return Optimised(hypotheses, replace(solved, value=solved.value + room, hessian=hessian))

    def search_again(
        self,
        optimised: Optimised,
        proposal: Proposal,
        usual_energy: float,
        rng: np.random.Generator,
    ) -> Optimised:
        """Adds further rounds of proposals, while the least energy is unusually high.

        Args:
            optimised: of the first round.
            proposal: of jumps.
            usual_energy: u, nats.
            rng: source of randomness.
        """
        s = self.posterior.settings
        for _ in range(s.rounds - 1):
            if optimised.minima.value.min() < usual_energy + s.energy_rise:
                break
            around = self._sources_around(optimised, rng)
            more = proposal.propose(
                around.minima, around.hypotheses, self.states.searched, self.observation, rng
            )
            optimised = optimised.joined(self.optimise(more))
        return optimised

    def _sources_around(self, optimised: Optimised, rng: np.random.Generator) -> Optimised:
        """What a further round of jumps starts from: the best optima, and samples near the best.

        Jumps change limbs; a trunk that was predicted badly needs covariance-scaled samples.
        """
        s, h = self.posterior.settings, optimised.hypotheses
        order = np.argsort(optimised.minima.value, kind='stable')
        best = order[: max(s.max_hypotheses // 2, 1)]
        lead = best[:1]
        drawn = covariance_scaled_samples(
            self.posterior.body, optimised.minima.x[lead], self.states.searched[h.ancestors[lead]],
            s.samples, s.sample_scale, rng,
        )[0]  # fmt: skip
        rows = np.full(len(drawn), h.texture_rows[lead[0]])
        value = self.posterior.values(drawn, self.observation, h.textures, rows)
        drawn = drawn[np.argsort(value, kind='stable')[: s.max_hypotheses]]
        n = len(drawn)
        sampled = Hypotheses(
            drawn,
            np.full(n, h.log_weights[lead[0]] + np.log(s.jump_probability)),
            np.full(n, h.ancestors[lead[0]]),
            drawn,
            np.ones(drawn.shape, dtype=np.bool_),
            h.textures,
            rows[:n],
        )
        return optimised[best].joined(self.optimise(sampled))
