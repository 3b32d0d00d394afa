"""Optimise: every hypothesis descends to a minimum of E (KJS figure 4, step 3).

x_k = argmin E(x)          bounded Newton from x_k^0, within the joint limits
"""

from __future__ import annotations

from dataclasses import dataclass

from hmt_ros.image.observation import Observation
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.error_model import ERRORS
from hmt_ros.inference.motion_states import PredictedStates
from hmt_ros.tracking.hypotheses import Hypotheses, Modes, Optimised
from hmt_ros.tracking.pose_prediction import PosePrediction
from hmt_ros.tracking.posterior import Posterior
from hmt_ros.tracking.settings import EvaluationPlan
from hmt_ros.tracking.weighting import Continuity


@dataclass(frozen=True, eq=False)
class Search:
    """Inputs of the proposals and optima of one image.

    Attributes:
        posterior: whose energy is minimised.
        observation: of the image.
        states: of the modes of the image before, predicted.
        precisions: (K, d, d) inverse covariances of their poses.
        continuity: with the modes of the image before.
        plan: allocation of the evaluations of the image.
        modes: of the image before.
        contradicted: whether these missed more than a quarter of the keypoints there.
        prediction: pose hypotheses from an external predictor, if any.
    """

    posterior: Posterior
    observation: Observation
    states: PredictedStates
    precisions: Array
    continuity: Continuity
    plan: EvaluationPlan
    modes: Modes
    contradicted: bool
    prediction: PosePrediction | None

    @property
    def dt(self) -> float:
        """Time since the image before, s."""
        return self.continuity.dt

    def rated(self, poses: Array, energies: Array) -> Array:
        """About the log weights (N,) that poses (N, d) of these energies (N,) would have."""
        return self.continuity.rated(poses) - ERRORS['image'].share(self.dt) * energies

    def optimise(self, hypotheses: Hypotheses) -> Optimised:
        """Hypotheses (N, d) at their optima."""
        posterior = self.posterior
        # Each has a precision of its own, where it jumped a lower one.
        own = self.states.precisions_of(hypotheses.ancestors, hypotheses.jumped, self.precisions)
        term = posterior.given(self.observation, hypotheses.expected, own, hypotheses.exchanges)
        solved = posterior.minimise(term, hypotheses.poses, self.plan.iterations)
        return Optimised(hypotheses, solved)

    def evidence(self, optimised: Optimised) -> Array:
        """Energies (N,) that the image adds to minus the log weights, nats."""
        exchanges = optimised.hypotheses.exchanges
        return self.posterior.evidence(optimised.minima.x, self.observation, exchanges, self.dt)
