"""A 32-d.o.f. person waving the arms, as a filter sees one camera's images: eight modes an image.

Three limb segments may point towards the camera or away from it, which makes eight modes. While a
segment is near the image plane its two answers lie close to each other and merge: the bottlenecks
of VMS fig. 2. Depth is badly determined, the rest well, so that the covariances are
ill-conditioned.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hmt_ros.inference import GaussianMixture
from hmt_ros.smoothing import LinearGaussianDynamics, MixtureSmoother

Array = NDArray[np.float64]

DOFS = 32
STEP = 0.05
# Greatest deviation of a mode over its least: the ratio of eigenvalues of one image is its square.
SPREAD = 70.0


@dataclass(frozen=True, eq=False)
class Waving:
    """The sequence.

    Attributes:
        truth: (T, d) rad.
        mixtures: T likelihoods.
        dynamics: a random walk that fits the motion.
        lower, upper: (d,) limits.
    """

    truth: Array
    mixtures: list[GaussianMixture]
    dynamics: LinearGaussianDynamics
    lower: Array
    upper: Array


def waving(
    times: int = 47, seed: int = 0, flips: int = 3, *, reach: float = 1.1, alike: bool = False
) -> Waving:
    """The sequence with 2^flips modes at each of T times, 20 images a second.

    Args:
        times: T.
        seed: of all randomness.
        flips: segments that are ambiguous.
        reach: how far the two answers of a segment are apart at most, rad; small: they overlap.
        alike: errors of an image move its modes alike, as the reflections of a pose explain an
            image equally well: no explanation of the sequence dominates. Else each mode has its
            own.
    """
    rng = np.random.default_rng(seed)
    t = np.arange(times) * STEP
    amplitude = np.where(np.arange(DOFS) < 12, rng.uniform(0.3, 0.9, DOFS), 0.05)
    frequency = rng.uniform(0.3, 0.8, DOFS)
    phase = rng.uniform(0, 2 * np.pi, DOFS)
    truth = amplitude * np.sin(2 * np.pi * frequency * t[:, None] + phase)
    # Which way a flip moves the pose: a few angles of a limb, by how far it is out of the plane.
    directions = np.zeros((flips, DOFS))
    for i in range(flips):
        directions[i, 4 * i : 4 * i + 4] = rng.normal(size=4)
        directions[i] /= np.linalg.norm(directions[i])
    turn = rng.uniform(0, 2 * np.pi, flips)
    out = reach * np.abs(np.sin(2 * np.pi * rng.uniform(0.15, 0.3, flips) * t[:, None] + turn))
    signs = np.array(list(itertools.product((0.0, 1.0), repeat=flips)))
    basis = np.linalg.qr(rng.normal(size=(DOFS, DOFS)))[0]
    mixtures = []
    for truth_t, out_t in zip(truth, out):
        centres = truth_t + (signs * out_t) @ directions
        means, covariances = [], []
        shared = rng.bit_generator.state
        for centre in centres:
            if alike:
                rng.bit_generator.state = shared
            turned = np.linalg.qr(basis + 0.1 * rng.normal(size=(DOFS, DOFS)))[0]
            sigma = 0.01 * np.exp(np.linspace(0.0, np.log(SPREAD), DOFS))
            covariances.append((turned * sigma**2) @ turned.T)
            means.append(centre + turned @ (0.25 * sigma * rng.normal(size=DOFS)))
        weights = rng.dirichlet(np.full(len(signs), 8.0))
        weights[0] += 0.05
        mixtures.append(GaussianMixture(weights, np.array(means), np.array(covariances)))
    rates = (2 * np.pi * frequency * amplitude) ** 2 * STEP + 0.02
    limit = amplitude + 0.6
    return Waving(
        truth, mixtures, LinearGaussianDynamics.random_walk(rates, step=STEP), -limit, limit
    )


def smooth_waving(times: int) -> None:
    """Smooths the sequence; here, so that a process that measures it imports nothing else."""
    sequence = waving(times)
    smoother = MixtureSmoother(sequence.dynamics, sequence.lower, sequence.upper)
    smoother.smooth(sequence.mixtures).marginal(0)
