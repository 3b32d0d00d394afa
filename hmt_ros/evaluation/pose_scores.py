"""Errors and calibration of mixtures over poses, against the true joint positions.

Scores compare joint positions relative to an origin, so that scores of bodies with different
degrees of freedom are comparable. The origin is the pelvis, or the centre of the hips if the truth
has no pelvis. By linearisation, a component N(m, S) over poses becomes the following component over
joint positions:

    N(f(m), J S J^T + D + s^2 I),   f: joints minus origin,   J = df/dx at m.

The diagonal matrix D contains the variances of errors that remain in every pose, because the joints
of the body model are not exactly the person's (`Body.joint_errors`). Published covariances of
joints include D as well. Without D the density would be confined to a surface, because the 39
coordinates of 13 joints depend on fewer degrees of freedom. s is an additional standard deviation
for evaluation, usually 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.calibration import (
    calibration_error,
    coverage,
    levels_of,
    marginal_log_densities,
    stratified_samples,
)
from hmt_ros.inference.mixture import GaussianMixture

EVALUATED_JOINTS = (
    'neck',
    'left_shoulder',
    'right_shoulder',
    'left_elbow',
    'right_elbow',
    'left_wrist',
    'right_wrist',
    'left_hip',
    'right_hip',
    'left_knee',
    'right_knee',
    'left_ankle',
    'right_ankle',
)
ORIGIN = 'pelvis'
# Joints whose centre is the origin if the truth has no pelvis.
HIPS = ('left_hip', 'right_hip')
# Additional standard deviation of a coordinate (s above), m.
MODEL_SIGMA = 0.0
# Mean joint error of the best component at or above which a frame counts as lost, m.
LOST_ERROR = 0.15
# Number of samples used to estimate a level.
LEVEL_SAMPLES = 500
# Number of mixtures whose kinematics are computed together.
BATCH_SIZE = 32


def origin_joints(names: Sequence[str], source: str = 'truth') -> tuple[str, ...]:
    """Return the joints whose mean position is the origin: the pelvis, or else both hips.

    Args:
        names: names of the joints whose true positions are known.
        source: name of the source of the positions, for the error message.

    Raises:
        ValueError: neither the pelvis nor both hips are known.
    """
    for origin in ((ORIGIN,), HIPS):
        if set(origin) <= set(names):
            return origin
    raise ValueError(
        f'{source} has neither a {ORIGIN} nor {" and ".join(HIPS)}; it has {list(names)}'
    )


def relative_positions(
    positions: Array, names: Sequence[str], joints: Sequence[str], origin: Sequence[str] = (ORIGIN,)
) -> Array:
    """Return the positions (..., J, 3) of some joints relative to the origin.

    Args:
        positions: (..., J', 3) positions of all joints.
        names: (J',) names of all joints.
        joints: (J,) names of the joints to return.
        origin: joints whose mean position is the origin.

    Raises:
        ValueError: a joint is not among the names.
    """
    missing = [name for name in (*origin, *joints) if name not in names]
    if missing:
        raise ValueError(f'a skeleton has no joints {missing}, it has {list(names)}')
    centre = positions[..., [names.index(name) for name in origin], :].mean(-2, keepdims=True)
    return np.asarray(positions[..., [names.index(name) for name in joints], :] - centre)


@dataclass(frozen=True, eq=False)
class JointMixture:
    """A mixture over joint positions at one time, relative to the origin.

    Attributes:
        weights: (K,) weights; they sum to 1.
        joints: (K, J, 3) joint positions, m.
        covariances: (K, 3J, 3J) covariances of the coordinates, m^2; None if unknown.

    Raises:
        ValueError: shapes do not match, or values are not finite.
    """

    weights: Array
    joints: Array
    covariances: Array | None = None

    def __post_init__(self) -> None:
        k, j = self.joints.shape[:2]
        wanted = {'weights': (k,), 'joints': (k, j, 3), 'covariances': (k, 3 * j, 3 * j)}
        for name, shape in wanted.items():
            value = getattr(self, name)
            if value is None:
                continue
            if k == 0 or value.shape != shape or not np.isfinite(value).all():
                raise ValueError(f'{name} must be finite and have shape {shape}, saw {value.shape}')

    def density(self) -> GaussianMixture:
        """Return the mixture over 3J coordinates.

        Raises:
            ValueError: the covariances are unknown.
        """
        if self.covariances is None:
            raise ValueError('joint positions without covariances have no density')
        k = len(self.weights)
        return GaussianMixture(self.weights, self.joints.reshape(k, -1), self.covariances)


def joint_mixtures(
    body: Body,
    mixtures: Sequence[GaussianMixture],
    names: Sequence[str] = EVALUATED_JOINTS,
    *,
    model_sigma: float = MODEL_SIGMA,
    positions: Sequence[Array] | None = None,
    origin: Sequence[str] = (ORIGIN,),
) -> list[JointMixture]:
    """Compute mixtures over joint positions relative to the origin, by linearisation.

    Args:
        mixtures: (T,) mixtures over poses (d,).
        names: (J,) names of the joints.
        model_sigma: additional standard deviation of a coordinate, m.
        positions: (K, J', 3) positions, m, of all joints of the body at the means of each mixture;
            None: computed by this function.
        origin: joints whose mean position is the origin; empty: the origin of the camera frame is
            used.

    Raises:
        KeyError: the body does not have a joint.
        ValueError: a mixture is over poses of a different body.
    """
    which = body.skeleton.joint_index([*names])

    def relative(positions: Array) -> Array:
        at = positions[:, which]
        if not origin:
            return at
        centre = body.skeleton.joint_index([*origin])
        return np.asarray(at - positions[:, centre].mean(1, keepdims=True))

    own = np.diag(np.repeat(np.square(body.joint_errors[which]) + model_sigma**2, 3))
    result = []
    # Kinematics in batches are ten times as fast as frame by frame.
    for first in range(0, len(mixtures), BATCH_SIZE):
        batch = mixtures[first : first + BATCH_SIZE]
        means = np.concatenate([mixture.means for mixture in batch])
        jacobians = relative(body.joint_jacobians(means)).reshape(len(means), -1, body.dimension)
        if positions is None:
            joints = body.joint_positions(means)
        else:
            joints = np.concatenate(positions[first : first + BATCH_SIZE])
        joints = relative(joints)
        ends = np.cumsum([len(mixture) for mixture in batch])
        for mixture, end in zip(batch, ends, strict=True):
            mine = slice(int(end) - len(mixture), int(end))
            factors = jacobians[mine] @ mixture.cholesky()
            covariances = factors @ factors.transpose(0, 2, 1) + own
            result.append(JointMixture(mixture.normalised().weights, joints[mine], covariances))
    return result


@dataclass(frozen=True, eq=False)
class Scores:
    """Errors of mixtures against the truth, frame by frame: T frames, J joints.

    Attributes:
        names: (J,) names of the joints.
        heaviest: (T, J) joint errors of the heaviest component, m.
        best: (T, J) joint errors of the component with the smallest mean joint error, m.
        expected: (T, J) weighted mean of the errors of all components, m.
        modes: (T,) number of components.
        perplexity: (T,) exp of the entropy of the weights: the effective number of components.
        log_densities: (T,) log p(true joint positions), positions in m; None without covariances.
        levels: (T,) levels of the true positions, all joints taken together, see
            `inference.calibration`; None without covariances.
        joint_levels: (T, J) levels of each joint's true position under its marginal density; None
            without covariances.
        absolute_levels: (T, J) levels of each joint's true position in the camera frame; None if
            unknown.
    """

    names: tuple[str, ...]
    heaviest: Array
    best: Array
    expected: Array
    modes: Array
    perplexity: Array
    log_densities: Array | None
    levels: Array | None
    joint_levels: Array | None
    absolute_levels: Array | None = None

    def __len__(self) -> int:
        return len(self.heaviest)

    @staticmethod
    def concatenate(parts: Sequence[Scores]) -> Scores:
        """Concatenate scores of consecutive frames; a field is None if it is None in any part."""

        def joined(name: str) -> Any:
            values = [getattr(part, name) for part in parts]
            return None if any(value is None for value in values) else np.concatenate(values)

        return Scores(parts[0].names, *(joined(field.name) for field in fields(Scores)[1:]))

    @staticmethod
    def of_nobody(names: Sequence[str], frames: int = 0) -> Scores:
        """Return scores for frames without an estimate; all are NaN."""
        errors, each = np.full((frames, len(names)), np.nan), np.full(frames, np.nan)
        return Scores(tuple(names), errors, errors, errors, each, each, None, None, None)

    def summary(self) -> dict[str, Any]:
        """Return means over the frames, errors in mm; densities and coverages are None if unknown.

        Without frames the means are NaN.
        """
        if not len(self):
            return self.of_nobody(self.names, 1).summary() | {'frames': 0}
        errors = {
            key: 1e3 * value.mean(1)
            for key, value in (
                ('heaviest', self.heaviest),
                ('best', self.best),
                ('expected', self.expected),
            )
        }
        result: dict[str, Any] = {
            'frames': len(self),
            'modes': float(self.modes.mean()),
            'perplexity': float(self.perplexity.mean()),
        }
        for key, value in errors.items():
            result[f'{key}_mm'] = float(value.mean())
            result[f'{key}_max_mm'] = float(value.max())
        result['frames_lost'] = int((errors['best'] >= 1e3 * LOST_ERROR).sum())
        result['fraction_tracked'] = float((errors['best'] < 1e3 * LOST_ERROR).mean())
        known = self.levels is not None
        result['negative_log_likelihood'] = (
            -float(np.mean(self.log_densities)) if self.log_densities is not None else None
        )
        for kind, levels in (
            ('', self.levels),
            ('joint_', self.joint_levels),
            ('absolute_', self.absolute_levels),
        ):
            for percent in (50, 90):
                result[f'{kind}coverage_{percent}'] = (
                    coverage(levels, percent / 100) if levels is not None else None
                )
            result[f'{kind}calibration_error'] = (
                calibration_error(levels) if known and levels is not None else None
            )
        result['by_joint'] = {
            name: {
                'heaviest_mm': float(1e3 * self.heaviest[:, j].mean()),
                'best_mm': float(1e3 * self.best[:, j].mean()),
                'expected_mm': float(1e3 * self.expected[:, j].mean()),
                'coverage_90': (
                    coverage(self.joint_levels[:, j], 0.9)
                    if self.joint_levels is not None
                    else None
                ),
            }
            for j, name in enumerate(self.names)
        }
        return result


def marginal_regions(
    mixtures: Sequence[JointMixture],
    truth: Array,
    *,
    seed: int | np.random.Generator = 0,
    samples: int = LEVEL_SAMPLES,
) -> tuple[Array, Array]:
    """Compute levels of the true positions and volumes of the credible regions, joint by joint.

    Args:
        mixtures: (T,) mixtures over positions of the same joints.
        truth: (T, J, 3) true positions relative to the same origin, m.

    Returns:
        Levels (T, J) of the true positions, see `Scores`; volumes (T, J) of the 90 % regions, m^3:
        the mean of 1 / p over samples of p, with 0 for samples outside the region.

    Raises:
        ValueError: a mixture has no covariances.
    """
    rng = np.random.default_rng(seed)
    levels, volumes = np.empty(truth.shape[:2]), np.empty(truth.shape[:2])
    for t, (mixture, true) in enumerate(zip(mixtures, truth, strict=True)):
        density = mixture.density()
        drawn = stratified_samples(density, samples, rng)
        alone = marginal_log_densities(density, np.concatenate([true.reshape(1, -1), drawn]), 3)
        levels[t] = levels_of(alone[:1], alone[1:])[0]
        inside = np.sort(alone[1:], axis=0)[samples - round(0.9 * samples) :]
        volumes[t] = np.exp(-inside).sum(0) / samples
    return levels, volumes


def score(
    mixtures: Sequence[JointMixture],
    truth: Array,
    names: Sequence[str] = EVALUATED_JOINTS,
    *,
    seed: int | np.random.Generator = 0,
    samples: int = LEVEL_SAMPLES,
) -> Scores:
    """Score mixtures at T times.

    Args:
        mixtures: (T,) mixtures over positions of the same joints, relative to the origin.
        truth: (T, J, 3) true positions relative to the true origin, m.
        names: (J,) names of the joints.

    Raises:
        ValueError: there are no frames, or shapes do not match.
    """
    if len(mixtures) == 0 or truth.shape != (len(mixtures), len(names), 3):
        raise ValueError(
            f'{len(mixtures)} mixtures, truth of shape {truth.shape}: wanted (T, {len(names)}, 3)'
        )
    rng = np.random.default_rng(seed)
    heaviest, best, expected = (np.empty(truth.shape[:2]) for _ in range(3))
    modes, perplexity = np.empty(len(truth)), np.empty(len(truth))
    known = all(mixture.covariances is not None for mixture in mixtures)
    log_densities, levels = np.empty(len(truth)), np.empty(len(truth))
    joint_levels = np.empty(truth.shape[:2])
    for t, (mixture, true) in enumerate(zip(mixtures, truth, strict=True)):
        error = np.linalg.norm(mixture.joints - true, axis=2)
        weights = mixture.weights
        heaviest[t] = error[np.argmax(weights)]
        best[t] = error[np.argmin(error.mean(1))]
        expected[t] = weights @ error
        modes[t] = len(weights)
        used = weights[weights > 0]
        perplexity[t] = np.exp(-(used * np.log(used)).sum())
        if known:
            density = mixture.density()
            drawn = stratified_samples(density, samples, rng)
            both = np.concatenate([true.reshape(1, -1), drawn])
            together = density.log_density(both)
            alone = marginal_log_densities(density, both, 3)
            log_densities[t] = together[0]
            levels[t] = levels_of(together[:1], together[1:])[0]
            joint_levels[t] = levels_of(alone[:1], alone[1:])[0]
    return Scores(
        tuple(names),
        heaviest,
        best,
        expected,
        modes,
        perplexity,
        log_densities if known else None,
        levels if known else None,
        joint_levels if known else None,
    )
