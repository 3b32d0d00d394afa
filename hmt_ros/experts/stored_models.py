"""The models that a file may hold, by the kind that it names."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from numpy.typing import NDArray

from hmt_ros.experts.conditional_density import ConditionalDensity
from hmt_ros.experts.conditional_experts import ConditionalExperts
from hmt_ros.experts.joint_experts import JointExperts
from hmt_ros.experts.local_experts import LocalExperts
from hmt_ros.experts.nearest_neighbours import NearestNeighbours
from hmt_ros.experts.relevance_vector_regression import RelevanceVectorRegression

MODELS: tuple[type[ConditionalDensity], ...] = (
    LocalExperts,
    ConditionalExperts,
    JointExperts,
    RelevanceVectorRegression,
    NearestNeighbours,
)


def stored_model(
    arrays: Mapping[str, NDArray[Any]], where: str, *others: type[ConditionalDensity]
) -> ConditionalDensity:
    """The model that `ConditionalDensity.to_arrays` gave, whatever its kind.

    Args:
        arrays: of the model.
        where: the name of the file, for messages.
        others: models that it may be besides `MODELS`, such as those that hold one of these.

    Raises:
        KeyError: no kind is named.
        ValueError: a kind that is not known, or arrays that are missing or wrong.
    """
    known = {model.kind: model for model in (*MODELS, *others)}
    kind = str(arrays['kind'])
    if kind not in known:
        raise ValueError(f'a model of kind {kind!r}, wanted one of {sorted(known)}')
    return known[kind].from_arrays(arrays, where)
