"""The motion prior of a body: one object for the filter, the smoother and the prediction of poses.

For a body with a learned file (`models/<name>_motion.npz`) poses have damped velocities whose
changes are coupled; without one they walk randomly at the rates of the body's YAML file. The card
of the shipped file is in `docs/motion_prior.md`, and in the file itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.model_file import shipped_file
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.damped_velocity import DampedVelocity
from hmt_ros.inference.linear_gaussian_dynamics import LinearGaussianDynamics
from msg_tools.files.array_file import read_archive

FORMAT, VERSION = 'hmt_ros motion prior', 1
LARGEST_FILE = 1_000_000  # bytes of its arrays; a file has some kB
_ENTRIES = ('format', 'version', 'body', 'dof_names', 'damping', 'diffusion', 'white', 'card')


@dataclass(frozen=True, eq=False)
class LearnedMotion:
    """A motion prior of the poses of a body that was learned; see `DampedVelocity`.

    Attributes:
        body: name of the body.
        dof_names: (d,) names of its degrees of freedom.
        damping: (d,) share of the velocity lost per second.
        diffusion: (d, d) covariance that the velocity gains per second, (m/s)^2 and (rad/s)^2.
        white: (d,) variance that the pose gains per second besides, m^2 and rad^2.
        card: data and method of the learning; plain text.

    Raises:
        ValueError: values that make no motion prior.
    """

    body: str
    dof_names: tuple[str, ...]
    damping: Array
    diffusion: Array
    white: Array
    card: str

    def __post_init__(self) -> None:
        if self.dynamics.dimension != len(self.dof_names):
            raise ValueError(
                f'{len(self.dof_names)} degrees of freedom are named, and '
                f'{self.dynamics.dimension} move'
            )

    @cached_property
    def dynamics(self) -> DampedVelocity:
        """The dynamics of poses and velocities."""
        return DampedVelocity.of(self.damping, self.diffusion, self.white)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays of a file, with a precision of 32 bits."""
        return {
            'format': np.array(FORMAT),
            'version': np.array(VERSION),
            'body': np.array(self.body),
            'dof_names': np.array(self.dof_names),
            'damping': self.damping.astype(np.float32),
            'diffusion': self.diffusion.astype(np.float32),
            'white': self.white.astype(np.float32),
            'card': np.array(self.card),
        }


def motion_prior(body: Body) -> LinearGaussianDynamics:
    """The dynamics of the poses of a body, learned if the body ships with a file."""
    learned = shipped_motion(body.name)
    if learned is None or learned.dof_names != tuple(body.dof_names):
        return LinearGaussianDynamics.random_walk(body.rates)
    return learned.dynamics


@cache
def shipped_motion(name: str) -> LearnedMotion | None:
    """The motion prior that ships for the body of a name; None: there is none.

    Raises:
        ValueError: the file that ships is damaged.
    """
    file = shipped_file(name, 'motion')
    return None if file is None else read_motion_prior(file)


def read_motion_prior(path: str | Path) -> LearnedMotion:
    """A learned motion prior from a file.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is no motion prior, or damaged; one line.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f'{path}: no such file; `learn motion` makes one')
    try:
        return _checked(read_archive(path, LARGEST_FILE))
    except (OSError, KeyError, TypeError, ValueError, IndexError) as fault:
        text = ' '.join(str(fault).split())
        raise ValueError(
            f'{path}: not a motion prior ({text}); make one with `learn motion`'
        ) from fault


def _checked(content: Mapping[str, NDArray[Any]]) -> LearnedMotion:
    missing = [name for name in _ENTRIES if name not in content]
    if missing or str(content['format']) != FORMAT:
        raise ValueError(f'it lacks {missing}' if missing else f'it is {content["format"]}')
    if str(content['version']) != str(VERSION):
        raise ValueError(f'it has version {content["version"]}, wanted {VERSION}')
    numbers: dict[str, Array] = {}
    for name in ('damping', 'diffusion', 'white'):
        value = content[name]
        if value.dtype.kind != 'f' or not np.isfinite(value).all():
            raise ValueError(f'{name} has values that are not finite numbers')
        numbers[name] = np.asarray(value, dtype=np.float64)
    names = tuple(str(name) for name in np.atleast_1d(content['dof_names']).tolist())
    return LearnedMotion(str(content['body']), names, **numbers, card=str(content['card']))
