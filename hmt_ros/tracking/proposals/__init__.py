"""Propose: functions that propose hypotheses (KJS 3 and 5)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Protocol

import numpy as np

from hmt_ros.tracking.hypotheses import Hypotheses, joined
from hmt_ros.tracking.optimisation import Search
from hmt_ros.tracking.proposals.kinematic_jumps import jumped_poses
from hmt_ros.tracking.proposals.sampling import covariance_scaled_poses, spherical_poses
from hmt_ros.tracking.proposals.whole_poses import predicted_poses, reversed_poses


class Proposal(Protocol):
    """A function that proposes hypotheses for an image."""

    def __call__(
        self, search: Search, sources: Hypotheses, rng: np.random.Generator, /
    ) -> Hypotheses:
        """Proposes hypotheses to optimise, if any, without setting their weights.

        Args:
            search: inputs and optima of the image.
            sources: hypotheses at the starting points of the optima `search.base`.
            rng: source of randomness.
        """
        ...


# Proposals that every tracker uses, before the proposal selected by the setting `proposals`. Each
# proposal decides whether it applies to an image. To add a proposal, add a file in this folder and
# a name here.
USUAL_PROPOSALS: tuple[Proposal, ...] = (predicted_poses, reversed_poses)
SELECTABLE_PROPOSALS: Mapping[str, Proposal] = MappingProxyType(
    {'kjs': jumped_poses, 'css': covariance_scaled_poses, 'ss': spherical_poses}
)


def proposals_of(selected: str) -> tuple[Proposal, ...]:
    """Returns the proposals that a tracker uses.

    Raises:
        ValueError: the name is unknown.
    """
    if selected not in SELECTABLE_PROPOSALS:
        raise ValueError(
            f'proposals must be one of {tuple(SELECTABLE_PROPOSALS)}, saw {selected!r}'
        )
    return (*USUAL_PROPOSALS, SELECTABLE_PROPOSALS[selected])


def propose(
    proposals: Sequence[Proposal],
    search: Search,
    sources: Hypotheses,
    rng: np.random.Generator,
) -> Hypotheses:
    """Concatenates the hypotheses from all proposals; see `Proposal` for the other arguments."""
    return joined([each(search, sources, rng) for each in proposals])
