"""The layers of a small network: units that leak, each layer added to the last."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hmt_ros.inference.arrays import Index

if TYPE_CHECKING:
    from typing_extensions import Self

LEAK = 0.1  # slope of a unit below 0

Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False, kw_only=True)
class Layers:
    """Layers of H units, after which come O numbers.

    Attributes:
        first, first_bias: (p, H), (H,).
        hidden, hidden_biases: (M, H, H), (M, H).
        last, last_bias: (H, O), (O,).
    """

    first: Floats
    first_bias: Floats
    hidden: Floats
    hidden_biases: Floats
    last: Floats
    last_bias: Floats

    def outputs(self, inputs: Floats) -> Floats:
        """The numbers (N, O) at inputs (N, p) that are whitened."""
        units = _leaky(inputs @ self.first + self.first_bias)
        for weights, bias in zip(self.hidden, self.hidden_biases, strict=True):
            units = units + _leaky(units @ weights + bias)
        result: Floats = units @ self.last + self.last_bias
        return result

    def jacobians(self, inputs: Floats, which: slice | Index) -> Floats:
        """Derivatives (N, o, p) of some of the numbers by inputs (N, p) that are whitened."""
        before = inputs @ self.first + self.first_bias
        units = _leaky(before)
        slopes = _slopes(before)[:, :, None] * self.first.T
        for weights, bias in zip(self.hidden, self.hidden_biases, strict=True):
            before = units @ weights + bias
            units = units + _leaky(before)
            slopes = slopes + _slopes(before)[:, :, None] * (weights.T @ slopes)
        result: Floats = self.last[:, which].T @ slopes
        return result

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays for a file: in half precision, but what is one row."""
        return {
            name: np.asarray(value, dtype=np.float16 if value.ndim > 1 else np.float32)
            for name, value in vars(self).items()
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Self:
        """The layers that `to_arrays` stored.

        Raises:
            KeyError, ValueError: arrays are missing or do not fit.
        """
        names = cls.__dataclass_fields__
        return cls(**{name: np.asarray(arrays[name], dtype=np.float32) for name in names})


def _leaky(x: Floats) -> Floats:
    """What units say."""
    result: Floats = np.maximum(x, np.float32(LEAK) * x)
    return result


def _slopes(x: Floats) -> Floats:
    return np.where(x > 0, np.float32(1.0), np.float32(LEAK))
