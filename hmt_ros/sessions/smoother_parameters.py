"""Parameters of the smoother node, which are the settings of offline replay as well."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from hmt_ros.body import Body
from hmt_ros.body.motion_prior import motion_prior
from hmt_ros.sessions.declared_parameters import (
    AT_ONCE,
    NEXT_WINDOW,
    NodeParameters,
    check_choices,
    parameter_field,
)
from hmt_ros.smoothing import LinearGaussianDynamics

MODELS = ('random_walk', 'constant_velocity', 'learned')
METHODS = ('paths', 'variational')
# Factor on the variance that the learned motion gains in a second. Sudden motion is more frequent
# than under a Gaussian of the mean variance; chosen on clips (docs/smoothing.md).
LIVELINESS = 2.0


@dataclass(frozen=True)
class SmootherDynamics:
    """Motion model of the smoother.

    Attributes:
        model: Motion model: 'random_walk' with the rates of the body, 'constant_velocity', whose
            state has velocities besides the pose and costs several times as much, or 'learned',
            that of the filter, but livelier: damped velocities that are coupled, where the body
            ships with them, else the random walk. It costs twice as much as the random walk.
        velocity_time: Time for which a velocity lasts at constant velocity, s; velocities then gain
            so much that after it poses have moved as far as the random walk.
    """

    model: str = 'learned'
    velocity_time: float = 0.3

    def __post_init__(self) -> None:
        if self.model not in MODELS:
            raise ValueError(f'dynamics.model must be one of {MODELS}, saw {self.model!r}')
        if not self.velocity_time > 0:
            raise ValueError(f'dynamics.velocity_time must be positive, saw {self.velocity_time}')

    def of(self, body: Body) -> LinearGaussianDynamics:
        """The dynamics of the poses of a body."""
        if self.model == 'learned':
            usual = motion_prior(body)
            return replace(usual, diffusion=LIVELINESS * usual.diffusion)
        rates = body.rates
        if self.model == 'random_walk':
            return LinearGaussianDynamics.random_walk(rates)
        # A velocity that is forgotten after a time tau moves the pose as a random walk of these
        # rates when its variance is rates / (2 tau).
        time = self.velocity_time
        return LinearGaussianDynamics.constant_velocity(
            rates / time**2, np.sqrt(rates / (2 * time))
        )


@dataclass(frozen=True)
class SmootherParameters(NodeParameters):
    """All parameters of the smoother node.

    Attributes:
        body_model: Body model, a name or a YAML file, where the name in the mixtures is not a known
            one; if empty, that name.
        method: Smoothing method: 'paths', the most probable paths in closed form, or 'variational',
            refined as in VMS, which takes seconds for an image.
        fixed_lag: Time by which a smoothed pose is older than the newest image, s, at any rate of
            images. It may be a fifth more; 0 is filtering.
        window_length: Number of the newest mixtures that are kept for ~/smooth_window.
        max_hypotheses: Maximum number of components of smoothed_pose_mixture.
        resting_feet: If true, feet that rest do not slide between images. The frame of the mixtures
            must then stand still (a still camera, or publish_in_fixed_frame of the filter).
        random_seed: Seed of all random numbers; the same mixtures give the same results.
        publish_covariances: If true, trajectory_mixture has covariances, which make it forty times
            as large.
        publish_tf: If true, the links of the heaviest smoothed pose are published on /tf.
        frame_prefix: Prefix of the names of these links, beside those of the filter.
        queue_size: Maximum number of mixtures that wait, while ~/smooth_window is answered for
            example; the oldest are dropped.
        max_trajectories: maximum number of components of a mixture over trajectories.
        longest_interval: interval between two mixtures above which a gap is reported, s; the
            dynamics bridge it.
        through_modes: whether the best path through every single mode is a candidate, besides the
            best between first and last modes.
        dynamics: settings of the motion model.
    """

    body_model: str = parameter_field('', NEXT_WINDOW)
    method: str = parameter_field('paths', NEXT_WINDOW)
    fixed_lag: float = parameter_field(0.5, NEXT_WINDOW, (0.0, 3600.0))
    window_length: int = parameter_field(47, AT_ONCE, (1, 10_000))
    max_hypotheses: int = parameter_field(8, AT_ONCE, (1, 1024))
    resting_feet: bool = parameter_field(True, NEXT_WINDOW)
    random_seed: int = parameter_field(0, NEXT_WINDOW, (0, 2**31 - 1))
    publish_covariances: bool = parameter_field(False, AT_ONCE)
    publish_tf: bool = parameter_field(False, AT_ONCE)
    frame_prefix: str = parameter_field('smoothed/', AT_ONCE)
    queue_size: int = parameter_field(100, AT_ONCE, (1, 1000))
    max_trajectories: int = 16
    longest_interval: float = 0.25
    through_modes: bool = False
    dynamics: SmootherDynamics = field(default_factory=SmootherDynamics)

    def __post_init__(self) -> None:
        check_choices(self, method=METHODS)
