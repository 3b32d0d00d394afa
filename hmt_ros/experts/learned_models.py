"""The models that poses are predicted with, by name, with what each of them needs.

All are calibrated on motions left out. How many experts a model has, how stiff they are and how
many components of the descriptor it sees was chosen by looking at motions of other people, so that
numbers on those flatter it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from hmt_ros.experts.calibrated_experts import CalibratedExperts
from hmt_ros.experts.conditional_density import ConditionalDensity
from hmt_ros.experts.conditional_experts import ConditionalExperts
from hmt_ros.experts.joint_experts import JointExperts
from hmt_ros.experts.local_experts import LocalExperts
from hmt_ros.experts.nearest_neighbours import NearestNeighbours
from hmt_ros.experts.relevance_vector_regression import RelevanceVectorRegression

# A linear expert of the joint model wants so many samples at least.
SAMPLES_PER_EXPERT = 40
NEIGHBOURS = 40  # of the local model
# Of the kernels of the conditional model, in deviations of an input.
WIDTH = 3.0


@dataclass(frozen=True)
class ModelKind:
    """How a model is made.

    Attributes:
        make: from a number of experts, a seed and the number of samples, where it is known; the
            baselines take the first as that of neighbours, or do not take it.
        experts: M where nothing else is asked for.
        components: of the descriptor that it sees.
        dynamics_experts: M of p(x_t | x_t-1, r_t); None: as many.
        few: whether each expert wants many samples, so that few samples have few experts.
        folds: of the motions, each left out once to calibrate on: fewer where learning is slow.
    """

    make: Callable[[int, int, int | None], ConditionalDensity]
    experts: int
    components: int = 64
    dynamics_experts: int | None = None
    few: bool = False
    folds: int = 3


def _local(experts: int, seed: int, samples: int | None) -> ConditionalDensity:
    # Of few samples a third is left out at a time, and neighbours are to be some of the rest.
    neighbours = NEIGHBOURS if samples is None else max(min(NEIGHBOURS, samples // 3), 8)
    return LocalExperts(experts, neighbours, seed=seed)


def _conditional(experts: int, seed: int, _: int | None) -> ConditionalDensity:
    return ConditionalExperts(
        experts, scaling='common', seed=seed, width=WIDTH, n_starts=1, max_iterations=5,
        max_kernels=200,
    )  # fmt: skip


def _joint(experts: int, seed: int, _: int | None) -> ConditionalDensity:
    # Many linear experts follow the folds that a few with kernels are too stiff for.
    return JointExperts(
        experts, 'linear', scaling='common', seed=seed, n_starts=1, max_iterations=12
    )


KINDS = {
    'local': ModelKind(_local, 5),
    'conditional': ModelKind(_conditional, 16, 20, 6, few=True, folds=2),
    'joint': ModelKind(_joint, 120, 20, 40, few=True, folds=2),
    'relevance-vector': ModelKind(
        lambda _, seed, __: RelevanceVectorRegression(scaling='common', seed=seed), 1
    ),
    'nearest': ModelKind(lambda experts, _, __: NearestNeighbours(experts, scaling='common'), 5),
}


def new_model(
    name: str, experts: int | None = None, seed: int = 0, samples: int | None = None
) -> ConditionalDensity:
    """A calibrated model that has not learned yet.

    Args:
        name: one of `KINDS`.
        experts: M, fewer where there are few samples; None: what is usual.
        seed: of all that is random.
        samples: that it is going to learn from.

    Raises:
        ValueError: no such model.
    """
    if name not in KINDS:
        raise ValueError(f'no model {name!r}, wanted one of {", ".join(sorted(KINDS))}')
    kind = KINDS[name]
    count = kind.experts if experts is None else experts
    if kind.few and samples is not None:
        count = max(min(count, samples // SAMPLES_PER_EXPERT), 1)
    return CalibratedExperts(kind.make(count, seed, samples), kind.folds)
