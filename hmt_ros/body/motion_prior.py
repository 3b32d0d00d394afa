"""The motion prior of a body: one object for the filter, the smoother and the prediction of poses.

For a body with a learned file (`models/<name>_motion.npz`), poses have damped velocities with
correlated changes. Without a file, poses are random walks with the rates of the body's YAML file.
The card of the shipped file is in `docs/motion_prior.md`, and in the file itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.body.learned_file import (
    Arrays,
    check_covariances,
    header,
    parameters_of,
    read_model,
    require,
)
from hmt_ros.body.model_file import shipped_file
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.damped_velocity import DampedVelocity
from hmt_ros.inference.linear_gaussian_dynamics import LinearGaussianDynamics
from hmt_ros.inference.mixture import GaussianMixture

KIND = 'motion_prior'
INTERVAL = 1.0 / 30.0  # interval of the example in a file, s


@dataclass(frozen=True, eq=False)
class LearnedMotion:
    """A learned motion prior of the poses of a body; see `DampedVelocity`.

    Attributes:
        body: name of the body.
        dof_names: (d,) names of its degrees of freedom.
        damping: (d,) share of the velocity lost per second.
        diffusion: (d, d) covariance that the velocity gains per second, (m/s)^2 and (rad/s)^2.
        white: (d,) additional variance that the pose gains per second, m^2 and rad^2.
        card: training data, method and licence, serialisable as JSON.

    Raises:
        ValueError: the values are not a valid motion prior.
    """

    body: str
    dof_names: tuple[str, ...]
    damping: Array
    diffusion: Array
    white: Array
    card: Mapping[str, Any]

    def __post_init__(self) -> None:
        named, moved = len(self.dof_names), self.dynamics.dimension
        require(named == moved, f'{named} degrees of freedom are named, and {moved} move')

    @cached_property
    def dynamics(self) -> DampedVelocity:
        """The dynamics of poses and velocities."""
        return DampedVelocity.of(self.damping, self.diffusion, self.white)

    def to_arrays(self) -> Arrays:
        """The arrays of a file, in single precision."""
        parameters = {'body': self.body, 'dof_names': list(self.dof_names)}
        return header(KIND, parameters) | {
            'damping': self.damping.astype(np.float32),
            'diffusion': self.diffusion.astype(np.float32),
            'white': self.white.astype(np.float32),
        }

    @classmethod
    def from_arrays(cls, arrays: Arrays) -> LearnedMotion:
        """The motion prior that `to_arrays` and a card describe.

        Raises:
            ValueError, KeyError, TypeError: arrays or parameters are missing or invalid.
        """
        parameters, card = parameters_of(arrays), parameters_of(arrays, 'card')
        names = tuple(map(str, parameters['dof_names']))
        damping, diffusion, white = (
            arrays[name].astype(np.float64) for name in ('damping', 'diffusion', 'white')
        )
        made = cls(str(parameters['body']), names, damping, diffusion, white, card)
        check_covariances('the velocity', made.dynamics.unknown_velocity)
        return made

    def answer(self, given: Array) -> GaussianMixture:
        """Predict the state after `INTERVAL` seconds from a given state (2 d,)."""
        nothing = np.zeros((1, len(given), len(given)))
        moved = self.dynamics.predict(given[None], nothing, INTERVAL)
        return GaussianMixture(np.ones(1), *moved)


def motion_prior(body: Body) -> LinearGaussianDynamics:
    """Return the dynamics of a body's poses, learned if a file ships with the body."""
    learned = shipped_motion(body.name)
    if learned is None or learned.dof_names != tuple(body.dof_names):
        return LinearGaussianDynamics.random_walk(body.rates)
    return learned.dynamics


@cache
def shipped_motion(name: str) -> LearnedMotion | None:
    """Return the shipped motion prior for a body name, or None if missing.

    Raises:
        ValueError: the shipped file is damaged.
    """
    file = shipped_file(name, 'motion')
    return None if file is None else read_motion_prior(file)


def read_motion_prior(path: str | Path) -> LearnedMotion:
    """Read a learned motion prior from a file.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file is not a motion prior, or is damaged; one-line message.
    """
    return read_model(path, KIND, LearnedMotion.from_arrays)
