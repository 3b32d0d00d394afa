"""Optimise: every hypothesis descends to a minimum of E (KJS figure 4, step 3).

x_k = argmin E(x)          bounded Newton from x_k^0, within the joint limits

An image that moves the modes far, for example in fast motion, is surprising, and is given more
evaluations. The condition is

    m' P m  >  `SURPRISING_RATIO` E m' P m  =  `SURPRISING_RATIO` tr(I - P H^-1)

m is the vector from the prediction of the heaviest mode, with the precision P, to its optimum,
where the energy has the Hessian H; the covariance of m is therefore P^-1 - H^-1. The expected size
of m grows with the information in the image, and so with the time between two images.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hmt_ros.image.observation import Observation
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.bounded_newton import Minimum
from hmt_ros.inference.error_model import ERRORS
from hmt_ros.inference.linear_algebra import product, solve
from hmt_ros.inference.motion_states import PredictedStates
from hmt_ros.tracking.hypotheses import Hypotheses, Modes, Optimised, PosePrediction
from hmt_ros.tracking.posterior import Posterior
from hmt_ros.tracking.selection import choose_hypotheses
from hmt_ros.tracking.settings import SURPRISING_RATIO, EvaluationPlan
from hmt_ros.tracking.weighting import TransitionPrior


@dataclass(frozen=True, eq=False)
class Search:
    """Inputs of the proposals for an image, and optima found so far.

    Attributes:
        posterior: energies of poses, which are minimised.
        observation: observation of the image.
        states: predicted states of the previous modes.
        precisions: (K, d, d) inverse covariances of the predicted poses.
        transition_prior: transition densities from the previous modes.
        plan: allocation of the evaluations of the image.
        modes: modes of the previous image.
        prediction: pose hypotheses from an external predictor, if any.
        base: optima in the image, one for each mode, then one for the pose fitted to keypoints, if
            any.
    """

    posterior: Posterior
    observation: Observation
    states: PredictedStates
    precisions: Array
    transition_prior: TransitionPrior
    plan: EvaluationPlan
    modes: Modes
    prediction: PosePrediction | None
    base: Minimum

    @property
    def dt(self) -> float:
        """Time since the previous image, s."""
        return self.transition_prior.dt

    @cached_property
    def base_joints(self) -> Array:
        """Joints (K, J, 3) of the optima `base`, m."""
        return self.posterior.body.joint_positions(self.base.x)

    @cached_property
    def base_rated(self) -> Array:
        """Approximate log weights (K,) of the optima `base`."""
        return self._rated(self.base_joints, self.base.value)

    def _rated(self, joints: Array, energies: Array) -> Array:
        return (
            self.transition_prior.log_predictive(joints) - ERRORS['image'].share(self.dt) * energies
        )

    def best(self, poses: Array, energies: Array) -> Index:
        """Rows of at most `candidates` representatives of poses (N, d) with energies (N,)."""
        joints = self.posterior.body.joint_positions(poses)
        return choose_hypotheses(
            joints - joints[:, :1],
            self._rated(joints, energies),
            self.plan.candidates,
            same=self.posterior.settings.hypothesis_merge_distance,
        ).chosen

    def optimise(self, hypotheses: Hypotheses) -> Optimised:
        """Moves hypotheses (N, d) to their optima."""
        posterior = self.posterior
        # The precision of variables that jumped is lower.
        own = self.states.precisions_of(hypotheses.ancestors, hypotheses.jumped, self.precisions)
        term = posterior.given(self.observation, hypotheses.expected, own, hypotheses.exchanges)
        solved = posterior.minimise(term, hypotheses.poses, self.plan.iterations)
        return Optimised(hypotheses, solved)

    def evidence(self, optimised: Optimised) -> Array:
        """Energies (N,) of the image, to subtract from the log weights, nats."""
        exchanges = optimised.hypotheses.exchanges
        return self.posterior.evidence(optimised.minima.x, self.observation, exchanges, self.dt)


def is_surprising(moved: Array, precision: Array, hessian: Array) -> bool:
    """Whether an image has moved a mode far, relative to the information in the image.

    Args:
        moved: (d,) vector from the prediction of the mode to its optimum.
        precision: (d, d) precision of the prediction.
        hessian: (d, d) Hessian of the energy at the optimum, including the motion prior.
    """
    expected = len(moved) - np.trace(solve(hessian, precision))
    return bool(product(product(moved, precision), moved) > SURPRISING_RATIO * max(expected, 1.0))
