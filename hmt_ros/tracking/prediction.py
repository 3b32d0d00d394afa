"""Predict: where hypotheses are expected in the next image (KJS figure 4, step 1).

    x_{t+1} ~ N(x_t + kappa dt v_t, S_t + Q dt)

v is the velocity of the mode, of which a share kappa lasts, and Q holds the rates of the body's
degrees of freedom. The optical flow then corrects the means, before shapes are compared.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.body.pose_terms import Posed
from hmt_ros.image.likelihood import ObservedImage
from hmt_ros.image.observation import Observation
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.energy import Quadratic, Sum
from hmt_ros.inference.linear_gaussian_dynamics import LinearGaussianDynamics
from hmt_ros.tracking.hypotheses import Hypotheses, Modes, new_hypotheses
from hmt_ros.tracking.posterior import Posterior

# Newton steps that follow the optical flow.
FLOW_ITERATIONS = 5


def predict(modes: Modes, body: Body, dt: float, velocity_kept: float) -> tuple[Hypotheses, Array]:
    """Hypotheses that the modes predict, within the limits, and their covariances (K, d, d).

    Args:
        modes: that were selected in the last image.
        body: with the motion prior and the limits.
        dt: time since the last image, s.
        velocity_kept: share kappa of the velocity that lasts.
    """
    dynamics = LinearGaussianDynamics.random_walk(body.rates)
    means, covariances = dynamics.predict(modes.poses, modes.filtered, dt)
    moved = np.clip(means + velocity_kept * dt * modes.velocities, body.lower, body.upper)
    predicted = replace(
        new_hypotheses(moved, modes.log_weights),
        textures=modes.textures,
        texture_rows=modes.texture_rows,
    )
    return predicted, covariances


def follow_flow(
    predicted: Hypotheses, precisions: Array, observation: Observation, posterior: Posterior
) -> Hypotheses:
    """Predictions corrected by the optical flow.

    Args:
        predicted: with the textures of the last image.
        precisions: (K, d, d) of the predictions.
        observation: of the image.
        posterior: of the body.
    """
    s, body = posterior.settings.likelihood, posterior.body
    if 'motion' not in observation.evidence or s.motion.weight == 0:
        return predicted
    seen = ObservedImage(
        posterior.flow_likelihood, observation, predicted.textures, predicted.texture_rows
    )
    term = Sum(
        (
            Posed(body.skeleton, (seen, posterior.likelihood.pose_prior)),
            Quadratic(predicted.poses, precisions),
        )
    )
    moved = posterior.minimise(term, predicted.poses, FLOW_ITERATIONS).x
    return replace(predicted, poses=moved, expected=moved)


def updated_velocities(
    velocities: Array, before: Array, after: Array, dt: float, gain: float
) -> Array:
    """Velocities (N, d) of modes that moved from `before` to `after` (N, d) in dt seconds.

    Args:
        velocities: (N, d) before, per second.
        before, after: (N, d).
        dt: s.
        gain: how far velocities follow the newest displacement, 0 to 1.
    """
    return (1.0 - gain) * velocities + gain * (after - before) / dt
