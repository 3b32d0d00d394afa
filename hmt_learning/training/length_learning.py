"""Learning of the variation of body lengths over people, from skeletons.

Lengths vary by a common stature and by proportions:

    x_ni = log l_ni - mean_n log l_ni = s_n + e_ni,    s_n ~ N(0, t^2),  e_ni ~ N(0, p_i^2)
    t^2  <- (m t0^2 + sum_n E[s_n^2]) / (m + N - 1)
    p_i^2 <- (m p0_i^2 + sum_n E[(x_ni - s_n)^2]) / (m + N - 1)

This is EM for one factor with equal loadings; t0 and p0 are the usual spreads, with the weight of m
people. For an additive length (`shoulder_rise`, which may be negative) the ratio to the model's
length replaces the logarithm. Means are not learned, because skeletons differ in the definition of
trunk, neck and hips.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hmt_ros.body import Body
from hmt_ros.inference.arrays import Array

# Weight m of the body model's spreads, in people.
USUAL_PEOPLE = 10.0
ADDITIVE = ('shoulder_rise',)
# Lengths that are constant in any skeleton; their maximum log difference in copies of a skeleton.
RIGID, ALIKE = ('thigh', 'shin', 'upper_arm', 'forearm'), 0.02
ITERATIONS = 500


@dataclass(frozen=True, eq=False)
class LengthSpread:
    """Variation of lengths over people.

    Attributes:
        stature: relative standard deviation of the stature.
        proportions: (L,) relative standard deviations of the proportions.
    """

    stature: float
    proportions: Array

    @property
    def covariance(self) -> Array:
        """Covariance (L, L) of relative lengths."""
        count = len(self.proportions)
        return np.asarray(np.diag(self.proportions**2) + np.full((count, count), self.stature**2))


def usual_spread(body: Body) -> LengthSpread:
    """The spread in a body model's file.

    Raises:
        ValueError: the length covariance is not that of a stature and proportions.
    """
    lengths = body.skeleton.lengths
    relative = body.length_covariance / np.outer(lengths, lengths)
    common = relative[~np.eye(len(lengths), dtype=bool)]
    own = np.diagonal(relative) - common.min(initial=np.inf)
    if not (len(common) and np.allclose(common, common[0]) and common[0] > 0 and (own > 0).all()):
        raise ValueError(f'{body.name} has no spreads of stature and proportions to start from')
    return LengthSpread(float(np.sqrt(common[0])), np.sqrt(own))


def relative_lengths(body: Body, lengths: Array) -> Array:
    """Logarithms of lengths (N, L) in m; additive ones are divided by the model's.

    Raises:
        ValueError: a length is not positive.
    """
    names = body.skeleton.length_names
    additive = np.array([name in ADDITIVE for name in names])
    bad = np.argwhere((lengths <= 0) & ~additive)
    if len(bad):
        row, column = bad[0]
        raise ValueError(
            f'{names[column]} must be positive, saw {lengths[row, column]:.3f} m: the joints of '
            f'this skeleton are not those of a person'
        )
    logarithms = np.log(np.where(additive, 1.0, lengths))
    return np.where(additive, lengths / body.skeleton.lengths, logarithms)


def own_skeletons(
    body: Body, people: Sequence[str], lengths: Array
) -> tuple[tuple[str, ...], Array]:
    """People with their own skeleton, each once, and its relative lengths (n, L).

    Motions are often retargeted to a shared skeleton; nothing is learned from such skeletons.

    Args:
        people: (N,) person of each skeleton.
        lengths: (N, L) lengths of each skeleton, m.
    """
    relative = relative_lengths(body, lengths)
    rigid = relative[:, [body.skeleton.length_names.index(name) for name in RIGID]]
    alike = np.abs(rigid[:, None] - rigid[None]).max(2) < ALIKE
    own: dict[str, list[Array]] = {}
    for name, row, copies in zip(people, relative, alike, strict=True):
        if {people[i] for i in np.flatnonzero(copies).tolist()} == {name}:
            own.setdefault(name, []).append(row)
    names = tuple(sorted(own))
    rows = [np.mean(own[name], axis=0) for name in names]
    return names, np.array(rows).reshape(len(rows), relative.shape[1])


def learned_spread(
    relative: Array, usual: LengthSpread, usual_people: float = USUAL_PEOPLE
) -> LengthSpread:
    """Maximum a posteriori estimate of the spread.

    Args:
        relative: (N, L) relative lengths of N people.
        usual: prior spread.
        usual_people: weight m of the prior spread, in people.

    Raises:
        ValueError: fewer than two people.
    """
    if len(relative) < 2:
        raise ValueError(f'{len(relative)} people have a skeleton of their own, wanted at least 2')
    x = relative - relative.mean(0)
    total = usual_people + len(x) - 1
    stature, own = usual.stature**2, usual.proportions**2
    for _ in range(ITERATIONS):
        variance = 1.0 / (1.0 / stature + (1.0 / own).sum())
        mean = variance * (x / own).sum(1)
        # The mean takes one of the N degrees of freedom.
        left = variance * (len(x) - 1)
        stature = (usual_people * usual.stature**2 + mean @ mean + left) / total
        rest = ((x - mean[:, None]) ** 2).sum(0) + left
        own = (usual_people * usual.proportions**2 + rest) / total
    return LengthSpread(float(np.sqrt(stature)), np.sqrt(own))


def log_likelihoods(relative: Array, mean: Array, covariance: Array) -> Array:
    """Log densities (N,) of relative lengths (N, L) under a Gaussian, nats."""
    off = relative - mean
    sign, determinant = np.linalg.slogdet(covariance)
    distance = (off * np.linalg.solve(covariance, off.T).T).sum(1)
    result: Array = -0.5 * (distance + determinant + off.shape[1] * np.log(2.0 * np.pi))
    return result if sign > 0 else np.full(len(off), -np.inf)


def held_out(
    relative: Array, usual: LengthSpread, usual_people: float = USUAL_PEOPLE
) -> tuple[Array, Array]:
    """Log likelihoods (N,) of each person given the others, for learned and usual spreads, nats.

    Both use the mean of the others and include its uncertainty.

    Raises:
        ValueError: fewer than three people.
    """
    if len(relative) < 3:
        raise ValueError(f'{len(relative)} people, wanted at least 3 to leave one out')
    scores = []
    for n in range(len(relative)):
        others = np.delete(relative, n, axis=0)
        more = 1.0 + 1.0 / len(others)
        spreads = learned_spread(others, usual, usual_people), usual
        scores.append(
            [
                log_likelihoods(relative[[n]], others.mean(0), more * spread.covariance)[0]
                for spread in spreads
            ]
        )
    learned, plain = np.array(scores).T
    return learned, plain
