"""Checked training pairs of inputs and targets, and their standardisation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hmt_ros.body.learned_file import check_positive, require
from hmt_ros.inference.arrays import Array

SCALINGS = ('each', 'common')


@dataclass(frozen=True, eq=False)
class TrainingPairs:
    """N inputs with their targets.

    Attributes:
        inputs: (N, p).
        targets: (N, D).
        weights: (N,) positive; a sample of weight 2 counts as two equal samples.
    """

    inputs: Array
    targets: Array
    weights: Array

    def __len__(self) -> int:
        return len(self.inputs)

    def __getitem__(self, rows: NDArray[np.intp]) -> TrainingPairs:
        return TrainingPairs(self.inputs[rows], self.targets[rows], self.weights[rows])


@dataclass(frozen=True, eq=False)
class Standardisation:
    """Shifts and scales columns: z = (v - centre) / scale.

    Attributes:
        centre, scale: (p,) each.

    Raises:
        ValueError: the shapes differ, or a scale is not positive.
    """

    centre: Array
    scale: Array

    def __post_init__(self) -> None:
        require(self.scale.shape == self.centre.shape, 'centre and scale do not fit')
        check_positive('scales', self.scale)

    @classmethod
    def of(cls, values: Array, weights: Array, scaling: str = 'each') -> Standardisation:
        """The standardisation that makes the weighted mean 0 and the variance 1.

        Args:
            values: (N, p).
            weights: (N,).
            scaling: 'each' scales every column separately; 'common' uses one scale for all columns,
                which keeps ratios of distances. A constant column keeps its scale.

        Raises:
            ValueError: the scaling is unknown.
        """
        require(scaling in SCALINGS, f'scaling is {scaling!r}, wanted one of {", ".join(SCALINGS)}')
        share = weights / weights.sum()
        centre = share @ values
        variance = share @ (values - centre) ** 2
        if scaling == 'common':
            variance = np.full_like(variance, variance.mean())
        # Rounding errors give a constant column a tiny variance.
        constant = variance <= (1e-12 * np.maximum(1.0, np.abs(centre))) ** 2
        return cls(centre, np.where(constant, 1.0, np.sqrt(variance)))

    def apply(self, values: Array) -> Array:
        """Scaled values, of the same shape."""
        return (values - self.centre) / self.scale


def checked_pairs(
    inputs: ArrayLike,
    targets: ArrayLike,
    sample_weight: ArrayLike | None = None,
    *,
    at_least: int = 1,
    what: str = 'samples',
) -> TrainingPairs:
    """The pairs as arrays, without samples of weight zero.

    Args:
        sample_weight: (N,) nonnegative weights; None: all weights are 1.
        what: Reason for the minimum `at_least`, for the error message.

    Raises:
        ValueError: shapes are wrong, values are not finite, or there are too few samples.
    """
    inputs = finite_matrix(inputs, 'inputs', '(N, p)')
    targets = finite_matrix(targets, 'targets', '(N, D)')
    require(
        len(inputs) == len(targets),
        f'{len(inputs)} inputs and {len(targets)} targets, wanted as many of both; pair them up',
    )
    require(
        inputs.shape[1] > 0 and targets.shape[1] > 0,
        f'inputs {inputs.shape} and targets {targets.shape}, wanted at least one column each',
    )
    if sample_weight is None:
        weights = np.ones(len(inputs))
    else:
        weights = np.asarray(sample_weight, dtype=np.float64)
        require(
            weights.shape == (len(inputs),),
            f'sample_weight has shape {weights.shape}, wanted ({len(inputs)},)',
        )
        require(
            np.isfinite(weights).all() and (weights >= 0).all(),
            'sample_weight has values that are negative or not finite, wanted >= 0',
        )
    kept = np.flatnonzero(weights > 0)
    require(
        len(kept) >= at_least,
        f'{len(kept)} samples, wanted at least {at_least} ({what}); give more samples or ask for '
        'less',
    )
    return TrainingPairs(inputs[kept], targets[kept], weights[kept])


def finite_matrix(values: ArrayLike, name: str, wanted: str) -> Array:
    """Convert values to a matrix of finite numbers.

    Raises:
        ValueError: the values do not have two axes, or are not finite.
    """
    matrix = np.asarray(values, dtype=np.float64)
    require(matrix.ndim == 2, f'{name} have shape {matrix.shape}, wanted {wanted}')
    bad = ~np.isfinite(matrix)
    if bad.any():
        row, column = (int(i) for i in np.argwhere(bad)[0])
        raise ValueError(
            f'{name} have {int(bad.sum())} values that are not finite, the first in row {row}, '
            f'column {column}; leave such rows out'
        )
    return matrix
