"""Parameters of the smoother node, which are the settings of offline replay as well.

`hmt_ros/config/smoother_node.yaml` lists them with their defaults; it is written by

    python -m hmt_ros.sessions.smoother_parameters > hmt_ros/config/smoother_node.yaml
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field

import numpy as np

from hmt_ros.body.skeleton import Skeleton
from hmt_ros.sessions.declared_parameters import (
    AT_LAUNCH,
    AT_ONCE,
    EFFECT,
    LIMITS,
    NEXT_WINDOW,
    parameter_field,
)
from hmt_ros.sessions.parameter_file import parameter_file_text
from hmt_ros.smoothing import LinearGaussianDynamics
from hmt_ros.tracking.dynamics import MODELS, PoseRates

METHODS = ('paths', 'variational')


@dataclass(frozen=True)
class SmootherDynamics(PoseRates):
    """Motion model of the smoother.

    Attributes:
        model: 'random_walk', or 'constant_velocity', whose state has velocities besides the pose
            and costs several times as much.
        velocity_time: how long a velocity lasts at constant velocity, s; velocities then gain so
            much that after it poses have moved as the deviations say.
        translation: standard deviation of the root's position after one second, m.
        root, trunk, hip, knee, shoulder, elbow, neck, extremity: of the angles, rad after one
            second. Deviations grow with the square root of time.
    """

    model: str = 'random_walk'
    velocity_time: float = 0.3

    def __post_init__(self) -> None:
        if self.model not in MODELS:
            raise ValueError(f'dynamics.model must be one of {MODELS}, saw {self.model!r}')
        for name in PoseRates.__dataclass_fields__:
            if not getattr(self, name) > 0:
                raise ValueError(f'dynamics.{name} must be positive, saw {getattr(self, name)}')

    def of(self, skeleton: Skeleton) -> LinearGaussianDynamics:
        """The dynamics of the poses of a skeleton."""
        rates = self.rates(skeleton)
        if self.model == 'random_walk':
            return LinearGaussianDynamics.random_walk(rates)
        # A velocity that is forgotten after a time tau moves the pose as a random walk of these
        # rates when its variance is rates / (2 tau).
        time = self.velocity_time
        return LinearGaussianDynamics.constant_velocity(
            rates / time**2, np.sqrt(rates / (2 * time))
        )


@dataclass(frozen=True)
class SmootherParameters:
    """All parameters of the smoother node.

    Attributes:
        body_model: a name or a YAML file, where the name in the mixtures is not one that
            is known; empty: that name.
        method: 'paths', the most probable paths in closed form, or 'variational', refined as in
            VMS, which takes seconds an image.
        fixed_lag: a pose is final when so many later ones have been seen.
        window_length: mixtures that are kept for ~/smooth_window, the newest.
        max_trajectories: components of a mixture over trajectories at most.
        max_hypotheses: components of smoothed_pose_mixture at most.
        through_modes: whether the best path through every single mode is a candidate, besides the
            best between first and last modes.
        merge_distance: modes of an image that are closer, in standard deviations, are one.
        error_correlation: for how long the errors of images persist, s; 0: they are independent.
            Where they last, images are less evidence, and the mixtures wider.
        random_seed: of all that is random. The same mixtures give the same numbers.
        reset_on_time_jump: whether a mixture that is older than the one before starts a new window;
            otherwise such mixtures are skipped.
        longest_interval: a longer one between two mixtures is told as a gap, s. The dynamics bridge
            it.
        publish_covariances: whether trajectory_mixture has covariances, which makes it forty times
            as large.
        queue_size: mixtures that wait at most; when the node is late the oldest are dropped.
        status_interval: a line on the console says every so many seconds what the node does, while
            messages come, s; 0: never.
        autostart: whether the node configures and activates itself; otherwise it waits for its
            lifecycle services.
        dynamics: settings of the motion model.
    """

    body_model: str = parameter_field('', NEXT_WINDOW)
    method: str = parameter_field('paths', NEXT_WINDOW)
    fixed_lag: int = parameter_field(7, NEXT_WINDOW, (0, 1000))
    window_length: int = parameter_field(47, AT_ONCE, (1, 10_000))
    max_trajectories: int = parameter_field(16, NEXT_WINDOW, (1, 1024))
    max_hypotheses: int = parameter_field(8, AT_ONCE, (1, 1024))
    through_modes: bool = parameter_field(False, NEXT_WINDOW)
    merge_distance: float = parameter_field(1.75, NEXT_WINDOW, (0.0, 100.0))
    error_correlation: float = parameter_field(0.05, NEXT_WINDOW, (0.0, 100.0))
    random_seed: int = parameter_field(0, NEXT_WINDOW, (0, 2**31 - 1))
    reset_on_time_jump: bool = parameter_field(False, AT_ONCE)
    longest_interval: float = parameter_field(0.25, AT_ONCE, (0.0, 3600.0))
    publish_covariances: bool = parameter_field(False, AT_ONCE)
    queue_size: int = parameter_field(50, AT_ONCE, (1, 1000))
    status_interval: int = parameter_field(1, AT_ONCE, (0, 3600))
    autostart: bool = parameter_field(True, AT_LAUNCH)
    dynamics: SmootherDynamics = field(
        default_factory=SmootherDynamics,
        metadata={EFFECT: NEXT_WINDOW, LIMITS: {'velocity_time': (0.01, 100.0)}},
    )

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise ValueError(f'method must be one of {METHODS}, saw {self.method!r}')


if __name__ == '__main__':
    sys.stdout.write(parameter_file_text('smoother_node', SmootherParameters()))
