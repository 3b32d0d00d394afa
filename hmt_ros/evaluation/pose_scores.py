"""Errors and calibration of mixtures over poses, against the true joint positions.

All is measured on the joints, relative to the pelvis, so that bodies with other degrees of freedom
can be compared: a component N(m, S) over poses becomes one over joint positions by linearisation,

    N(f(m), J S J^T + s^2 I),   f: joints minus pelvis,   J = df/dx at m.

The isotropic part s stands for what no pose of the body can meet, because lengths and joint centres
of the model are not exactly those of the person. Without it the density would be confined to a
surface: 13 joints have 39 coordinates, and a body has fewer degrees of freedom that move them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.inference.calibration import (
    calibration_error,
    coverage,
    levels_of,
    marginal_log_densities,
    stratified_samples,
)
from hmt_ros.inference.mixture import GaussianMixture

Array = NDArray[np.float64]

EVALUATED_JOINTS = (
    'neck', 'left_shoulder', 'right_shoulder', 'left_elbow', 'right_elbow', 'left_wrist',
    'right_wrist', 'left_hip', 'right_hip', 'left_knee', 'right_knee', 'left_ankle', 'right_ankle',
)  # fmt: skip
ORIGIN = 'pelvis'
# Standard deviation of a coordinate that the body model gets wrong whatever the pose, m.
MODEL_SIGMA = 0.02
# A frame whose best hypothesis is further off than this on average is lost, m.
LOST = 0.15
# Samples of a density that a level is estimated with.
SAMPLES = 500
# Mixtures whose kinematics is computed together.
BATCH = 32


@dataclass(frozen=True, eq=False)
class JointMixture:
    """Hypotheses about joint positions at one time, relative to the pelvis.

    Attributes:
        weights: (K,) sum to 1.
        joints: (K, J, 3) m.
        covariances: (K, 3J, 3J) m^2, or None: not known.

    Raises:
        ValueError: shapes that do not fit, values that are not finite.
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
        """The mixture over 3J coordinates.

        Raises:
            ValueError: the covariances are not known.
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
) -> list[JointMixture]:
    """Joint positions relative to the pelvis that mixtures over poses say, by linearisation.

    Args:
        body: whose poses they are.
        mixtures: (T,) over poses (d,).
        names: joints, J of them.
        model_sigma: standard deviation of what the body itself gets wrong, a coordinate, m.
        positions: for each mixture (K, J', 3) of all joints of the body at the means, where they
            are known, m; None: computed.

    Raises:
        KeyError: a joint that the body does not have.
        ValueError: a mixture over poses of another body.
    """
    which = body.skeleton.joint_index([ORIGIN, *names])
    own = model_sigma**2 * np.eye(3 * len(names))
    result = []
    # Kinematics in batches: one frame alone would cost ten times as much a pose.
    for first in range(0, len(mixtures), BATCH):
        batch = mixtures[first : first + BATCH]
        means = np.concatenate([mixture.means for mixture in batch])
        jacobians = body.joint_jacobians(means)[:, which]
        jacobians = (jacobians[:, 1:] - jacobians[:, :1]).reshape(len(means), -1, body.dimension)
        if positions is None:
            joints = body.joint_positions(means)
        else:
            joints = np.concatenate(positions[first : first + BATCH])
        joints = joints[:, which[1:]] - joints[:, which[:1]]
        ends = np.cumsum([len(mixture) for mixture in batch])
        for mixture, end in zip(batch, ends, strict=True):
            mine = slice(int(end) - len(mixture), int(end))
            factors = jacobians[mine] @ mixture.cholesky()
            covariances = factors @ factors.transpose(0, 2, 1) + own
            result.append(JointMixture(mixture.normalised().weights, joints[mine], covariances))
    return result


@dataclass(frozen=True, eq=False)
class Scores:
    """How far mixtures are from the truth, frame by frame: T frames, J joints.

    Attributes:
        names: (J,) joints.
        heaviest: (T, J) distances of the joints of the heaviest component, m.
        best: (T, J) of the component whose joints are nearest on average.
        expected: (T, J) mean over the components, by weight.
        modes: (T,) number of components.
        perplexity: (T,) exp of the entropy of the weights: how many components share the weight.
        log_densities: (T,) log p(true joint positions), positions in m; None: covariances unknown.
        levels: (T,) of the true positions of all joints together, see `inference.calibration`.
        joint_levels: (T, J) of the true position of each joint alone.
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

    def __len__(self) -> int:
        return len(self.heaviest)

    @staticmethod
    def concatenate(parts: Sequence[Scores]) -> Scores:
        """Scores of stretches of time in turn; densities are known where those of all parts are."""

        def joined(name: str) -> Any:
            values = [getattr(part, name) for part in parts]
            return None if any(value is None for value in values) else np.concatenate(values)

        return Scores(parts[0].names, *(joined(field.name) for field in fields(Scores)[1:]))

    def summary(self) -> dict[str, Any]:
        """Means over the frames; errors in mm, None where covariances are not known."""
        errors = {
            key: 1e3 * value.mean(1)
            for key, value in (
                ('heaviest', self.heaviest), ('best', self.best), ('expected', self.expected),
            )
        }  # fmt: skip
        result: dict[str, Any] = {
            'frames': len(self),
            'modes': float(self.modes.mean()),
            'perplexity': float(self.perplexity.mean()),
        }
        for key, value in errors.items():
            result[f'{key}_mm'] = float(value.mean())
            result[f'{key}_max_mm'] = float(value.max())
        result['frames_lost'] = int((errors['best'] >= 1e3 * LOST).sum())
        result['fraction_tracked'] = float((errors['best'] < 1e3 * LOST).mean())
        known = self.levels is not None
        result['negative_log_likelihood'] = (
            -float(np.mean(self.log_densities)) if self.log_densities is not None else None
        )
        for kind, levels in (('', self.levels), ('joint_', self.joint_levels)):
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


def score(
    mixtures: Sequence[JointMixture],
    truth: Array,
    names: Sequence[str] = EVALUATED_JOINTS,
    *,
    seed: int | np.random.Generator = 0,
    samples: int = SAMPLES,
) -> Scores:
    """Scores of mixtures at T times.

    Args:
        mixtures: (T,) of the same joints, relative to the pelvis.
        truth: (T, J, 3) true positions relative to the true pelvis, m.
        names: (J,) of the joints.
        seed: of the samples that levels are estimated with, or their generator.
        samples: how many of them a frame.

    Raises:
        ValueError: no frames, or shapes that do not fit.
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
        tuple(names), heaviest, best, expected, modes, perplexity,
        log_densities if known else None, levels if known else None,
        joint_levels if known else None,
    )  # fmt: skip
