"""Predict: expected hypotheses in the next image (KJS figure 4, step 1).

    (x, v)_{t+1} ~ N(A (x, v)_t, A S_t A' + Q)

v is the velocity of the mode; the motion prior gives A and Q (`motion_prior`). The optical flow
then corrects the means, before the image terms are evaluated.
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
    """Dynamics of a body's poses, selected by the setting `motion`."""
    learned = motion == 'learned'
    return motion_prior(body) if learned else LinearGaussianDynamics.random_walk(body.rates)


def predict(
    modes: Modes, body: Body, dynamics: LinearGaussianDynamics, dt: float
) -> tuple[Hypotheses, PredictedStates]:
    """Predicts hypotheses, within the limits, and their states, from modes.

    Args:
        modes: modes of the last image.
        body: body that defines the limits, and the rates of variables that jump.
        dynamics: dynamics of the modes.
        dt: time since the last image, s.
    """
    states = predicted_states(modes, modes.state_covariances, body, dynamics, dt)
    moved = np.clip(states.poses, body.lower, body.upper)
    exchanges = predicted_exchanges(modes.exchanges, dt)
    return new_hypotheses(moved, modes.log_weights, exchanges), states


def predicted_states(
    modes: Modes, covariances: Array, body: Body, dynamics: LinearGaussianDynamics, dt: float
) -> PredictedStates:
    """Predicts the states of modes with covariances (K, n, n) dt seconds ahead."""
    known = np.concatenate([modes.poses, modes.velocities], axis=1)
    means = np.ascontiguousarray(known[:, : dynamics.state_dimension])
    has_velocities = dynamics.state_dimension > dynamics.dimension
    wandered = body.rates * dt if has_velocities else np.zeros(body.dimension)
    return PredictedStates(dynamics, *dynamics.predict(means, covariances, dt), wandered)


@dataclass(frozen=True, eq=False)
class Forecaster:
    """Predicts a track after an image; immutable and therefore thread-safe.

    Attributes:
        modes: published modes of that image.
        body: body that defines the limits.
        motion: value of the setting `motion`.
        stamp_ns: timestamp of the image.
    """

    modes: Modes
    body: Body
    motion: str
    stamp_ns: int

    def at(self, stamp_ns: int) -> GaussianMixture:
        """Predicts the mixture over poses at a later time, without images in between.

        Raises:
            ValueError: the time is earlier than the image.
        """
        if stamp_ns < self.stamp_ns:
            raise ValueError(
                f'{stamp_ns} ns is before the image of {self.stamp_ns} ns that is predicted from'
            )
        modes, body, d = self.modes, self.body, self.body.dimension
        known = modes.state_covariances.copy()
        # The published covariances of the poses are larger than the propagated covariances.
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
    """Corrects predictions by the optical flow.

    Args:
        predicted: K predicted hypotheses.
        precisions: (K, d, d) precisions of the predictions.
        points: visible points of each mode in the last image; None: unknown.
        observation: observation of the image.
        posterior: energies of poses of the body.
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
