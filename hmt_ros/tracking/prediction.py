"""Predict: the expected hypotheses in the next image (KJS figure 4, step 1).

    (x, v)_{t+1} ~ N(A (x, v)_t, A S_t A' + Q)

v is the velocity of the mode; A and Q are those of the motion prior (`motion_prior`).
The optical flow then corrects the means, before shapes are compared.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.body.motion_prior import motion_prior
from hmt_ros.image.observation import Observation
from hmt_ros.image.optical_flow import FlowTerm
from hmt_ros.image.pose_energy import PoseEnergy
from hmt_ros.image.surface_points import SurfacePoints
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.energy import Quadratic
from hmt_ros.inference.error_model import seconds
from hmt_ros.inference.linear_gaussian_dynamics import LinearGaussianDynamics
from hmt_ros.inference.mixture import GaussianMixture
from hmt_ros.inference.motion_states import PredictedStates
from hmt_ros.tracking.classes import predicted_exchanges
from hmt_ros.tracking.hypotheses import Hypotheses, Modes, new_hypotheses
from hmt_ros.tracking.posterior import Posterior


def dynamics_of(body: Body, motion: str) -> LinearGaussianDynamics:
    """The dynamics of the poses of a body, by the setting `motion`."""
    learned = motion == 'learned'
    return motion_prior(body) if learned else LinearGaussianDynamics.random_walk(body.rates)


def predict(
    modes: Modes, body: Body, dynamics: LinearGaussianDynamics, dt: float
) -> tuple[Hypotheses, PredictedStates]:
    """Hypotheses that the modes predict, within the limits, and their states.

    Args:
        modes: that were selected in the last image.
        body: with the limits, and the rates of variables that jump.
        dynamics: of the modes.
        dt: time since the last image, s.
    """
    states = predicted_states(modes, modes.state_covariances, body, dynamics, dt)
    moved = np.clip(states.poses, body.lower, body.upper)
    exchanges = predicted_exchanges(modes.exchanges, dt)
    return new_hypotheses(moved, modes.log_weights, exchanges), states


def predicted_states(
    modes: Modes, covariances: Array, body: Body, dynamics: LinearGaussianDynamics, dt: float
) -> PredictedStates:
    """States of modes with covariances (K, n, n) after dt seconds."""
    known = np.concatenate([modes.poses, modes.velocities], axis=1)
    means = np.ascontiguousarray(known[:, : dynamics.state_dimension])
    has_velocities = dynamics.state_dimension > dynamics.dimension
    wandered = body.rates * dt if has_velocities else np.zeros(body.dimension)
    return PredictedStates(dynamics, *dynamics.predict(means, covariances, dt), wandered)


@dataclass(frozen=True, eq=False)
class Forecaster:
    """Predicts a track from one image on; immutable, so any thread may use it.

    Attributes:
        modes: published modes of that image.
        body: with the limits.
        motion: the setting.
        stamp_ns: of the image.
    """

    modes: Modes
    body: Body
    motion: str
    stamp_ns: int

    def at(self, stamp_ns: int) -> GaussianMixture:
        """The mixture over poses at a later time, without any image in between.

        Raises:
            ValueError: the time is before the image.
        """
        if stamp_ns < self.stamp_ns:
            raise ValueError(
                f'{stamp_ns} ns is before the image of {self.stamp_ns} ns that is predicted from'
            )
        modes, body, d = self.modes, self.body, self.body.dimension
        known = modes.state_covariances.copy()
        # The published covariances of the poses are larger than the propagated ones.
        known[:, :d, :] = known[:, :, :d] = 0.0
        known[:, :d, :d] = modes.covariances
        dynamics = dynamics_of(body, self.motion)
        states = predicted_states(modes, known, body, dynamics, seconds(stamp_ns - self.stamp_ns))
        means = np.clip(states.poses, body.lower, body.upper)
        return GaussianMixture(modes.mixture.weights, means, states.pose_covariances)


def follow_flow(
    predicted: Hypotheses,
    precisions: Array,
    points: SurfacePoints | None,
    observation: Observation,
    posterior: Posterior,
) -> Hypotheses:
    """Predictions corrected by the optical flow.

    Args:
        predicted: K of them.
        precisions: (K, d, d) of the predictions.
        points: visible points of each mode in the last image; None: unknown.
        observation: of the image.
        posterior: of the body.
    """
    s = posterior.settings
    if observation.flow is None or points is None:
        return predicted
    flow = FlowTerm(points, observation.flow, float(s.flow_weight))
    term = PoseEnergy(
        posterior.likelihood,
        (flow, posterior.likelihood.pose_prior),
        Quadratic(predicted.poses, precisions),
    )
    moved = posterior.minimise(term, predicted.poses, s.plan.iterations).x
    return replace(predicted, poses=moved, expected=moved)
