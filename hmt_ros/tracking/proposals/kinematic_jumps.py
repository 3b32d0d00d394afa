"""Kinematic jump sampling: other configurations of the limbs and of the trunk (KJS 3, 4).

For each trunk that the modes have, every limb has alternatives: those of the modes, all their
flips, and what a search of the image found. Combinations of alternatives are rated on the trunk as
it is, with limbs exchanged that were taken for each other, and with the torso flipped; the best
that stand for all become candidates.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hmt_ros.body.skeleton import other_side
from hmt_ros.flips.best_combinations import Alternatives, best_combinations, distinct_alternatives
from hmt_ros.flips.interpretation_tree import enumerate_flips, rehang_chain
from hmt_ros.flips.torso_flips import flip_torso
from hmt_ros.image.observation import Observation
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.bounded_newton import Minimum
from hmt_ros.inference.error_model import ERRORS
from hmt_ros.tracking.hypotheses import LIKELY, Hypotheses, relative_joints
from hmt_ros.tracking.optimisation import Search
from hmt_ros.tracking.posterior import Posterior
from hmt_ros.tracking.proposals.limb_search import LimbSearch
from hmt_ros.tracking.selection import choose_hypotheses

# Groups of modes with a trunk of their own whose products are rated.
MOST_GROUPS = 3
# Modes have the same trunk when its joints are nowhere further apart, m.
SAME_TRUNK = 0.06
# Configurations of a limb are distinct when some joint is further apart, m.
DISTINCT = 0.08


@dataclass(frozen=True, eq=False)
class _Lead:
    """The pose of a trunk, and the image in which its limbs are rated.

    Attributes:
        pose: (d,).
        covariance: (d, d) of its prediction.
        observation: of the image.
    """

    pose: Array
    covariance: Array
    observation: Observation


@dataclass(frozen=True, eq=False)
class _Product:
    """A trunk, configurations of each limb, and what they cost.

    Attributes:
        modes, members, log_weights: (G, d), (G,), (G,) of the modes with this trunk.
        alternatives: one entry a chain.
        changes: energy change that each alternative makes alone.
        energy: of the first mode.
    """

    modes: Array
    members: Index
    log_weights: Array
    alternatives: list[Alternatives]
    changes: list[Array]
    energy: float


@dataclass(frozen=True, eq=False)
class KinematicJumps:
    """Proposes poses far from those that are known, which fit the image as well.

    Attributes:
        posterior: of the body before the camera.
    """

    posterior: Posterior

    def propose(
        self, search: Search, base: Minimum, sources: Hypotheses, rng: np.random.Generator
    ) -> Hypotheses:
        """See `Proposal`."""
        s, observation = self.posterior.settings, search.observation
        covariances = search.states.searched
        share = ERRORS['image'].share(search.dt)
        symmetries = self.posterior.body.symmetries
        prices = {name: symmetry.price(search.dt) for name, symmetry in symmetries.items()}
        everything: list[tuple[Array, Index, Array]] = []
        prior = search.rated(base.x, base.value)
        for group in self._groups(base)[:MOST_GROUPS]:
            likely = prior[group].max() > prior.max() - LIKELY
            ancestor = sources.ancestors[group[0]]
            lead = _Lead(base.x[group[0]], covariances[ancestor], observation)
            found = self._search(lead, rng) if likely else {}
            alternatives = [
                self._alternatives(base.x[group], chain, found.get(chain), prices['limb_flip'])
                for chain in self.posterior.body.chains
            ]
            products = self._products(
                lead, base.x[group], group, sources.log_weights[group], alternatives, prices
            )
            for product in products:
                combined = best_combinations(
                    self.posterior.body, product.modes, product.log_weights, product.energy,
                    product.alternatives, product.changes, share, s.combinations,
                )  # fmt: skip
                members = product.members[combined.parents]
                everything.append((combined.poses, members, combined.energies))
        poses, members, energies = (
            np.concatenate([part[i] for part in everything]) for i in range(3)
        )
        kept = choose_hypotheses(
            relative_joints(self.posterior.body, poses),
            search.rated(poses, energies),
            s.candidates,
            same=s.hypothesis_merge_distance,
        ).chosen
        poses, members = poses[kept], members[kept]
        # A chain that jumped is expected where it landed, the rest where it was predicted.
        changed = np.abs(poses - base.x[members]) > 1e-9
        return Hypotheses(
            poses,
            sources.log_weights[members],
            sources.ancestors[members],
            np.where(changed, poses, sources.expected[members]),
            changed | sources.jumped[members],
        )

    @cached_property
    def _searches(self) -> dict[str, LimbSearch]:
        pairs = self.posterior.body.chain_pairs
        return {chain: LimbSearch(self.posterior, chain) for pair in pairs for chain in pair}

    def _groups(self, base: Minimum) -> list[Index]:
        """Modes with nearly the same trunk, each group with its best mode first."""
        which = self.posterior.body.skeleton.joint_index(self.posterior.body.trunk_joints)
        trunk = self.posterior.body.joint_positions(base.x)[:, which]
        left = list(np.argsort(base.value, kind='stable'))
        groups = []
        while left:
            gaps = np.linalg.norm(trunk[left] - trunk[left[0]], axis=2).max(1)
            near = gaps < SAME_TRUNK
            groups.append(np.array([i for i, ok in zip(left, near) if ok], dtype=np.intp))
            left = [i for i, ok in zip(left, near) if not ok]
        return groups

    def _products(
        self,
        lead: _Lead,
        modes: Array,
        members: Index,
        log_weights: Array,
        alternatives: list[Alternatives],
        prices: Mapping[str, float],
    ) -> list[_Product]:
        """The product of a group, those with limbs exchanged, and those with the torso flipped.

        Args:
            lead: first mode of the group.
            modes, members, log_weights: (G, d), (G,), (G,) of the group.
            alternatives: one entry a chain.
            prices: of the symmetries of the body, nats.
        """
        swaps = [(pair, self._swap(lead, pair)) for pair in self.posterior.body.chain_pairs]
        known = [(pair, swapped) for pair, swapped in swaps if swapped is not None]
        flips = self._torso_flips(lead.pose, [a.chain for a in alternatives])
        trunks = [(lead.pose, alternatives), *(swapped for _, swapped in known), *flips]
        (changes, energy), *rated = self._rate(lead.observation, trunks)
        products = [_Product(modes, members, log_weights, alternatives, changes, energy)]
        weight = np.array([np.logaddexp.reduce(log_weights)])
        exchanged, flipped_over = (weight - prices[name] for name in ('exchange', 'trunk_flip'))
        for (pair, (other, hung)), (own, energy) in zip(known, rated[: len(known)], strict=True):
            choices, joined = [], []
            for chain, change in zip(alternatives, changes, strict=True):
                if chain.chain in pair:
                    i = pair.index(chain.chain)
                    choices.append(hung[i])
                    joined.append(own[i])
                else:
                    choices.append(Alternatives(chain.chain, chain.angles, chain.penalties[:1]))
                    joined.append(change)
            products.append(_Product(other[None], members[:1], exchanged, choices, joined, energy))
        for (flipped, hung), (own, energy) in zip(flips, rated[len(known) :], strict=True):
            products.append(_Product(flipped[None], members[:1], flipped_over, hung, own, energy))
        return products

    def _search(self, lead: _Lead, rng: np.random.Generator) -> dict[str, Array]:
        """Configurations of some limbs that fit the image."""
        s, evidence = self.posterior.settings, lead.observation.evidence
        shape = 'coverage' in evidence or 'edges' in evidence
        names = list(self._searches) if shape else []
        count = min(s.searched_chains, len(names))
        if count == 0:
            return {}
        chosen = rng.choice(len(names), size=count, replace=False)
        return {
            names[i]: self._searches[names[i]].find(
                lead.pose, lead.covariance, lead.observation, rng
            )
            for i in sorted(chosen)
        }

    def _alternatives(
        self, modes: Array, chain: str, found: Array | None, price: float
    ) -> Alternatives:
        """Configurations of a chain in a group: the modes' own, what was found, and all flips.

        Each has a price, nats, for the modes that do not have it.
        """
        s, body = self.posterior.settings, self.posterior.body
        own = body.skeleton.chain_dofs[chain]
        angles, penalties = [modes[:, own]], [np.where(np.eye(len(modes)) > 0, 0.0, price)]
        if found is not None:
            angles.append(found)
        if chain in self._searches:
            # Limbs that cross in the image are easily taken for each other.
            sibling = other_side(chain)
            swapped, _ = rehang_chain(body, modes[:1], modes[:1], chain, image_of=sibling)
            angles.append(swapped[:, own])
        sources = np.concatenate(angles)
        poses = np.repeat(modes[:1], len(sources), axis=0)
        poses[:, own] = sources
        flips, parents = enumerate_flips(body, poses, chain)
        first = np.concatenate([[True], parents[1:] != parents[:-1]])
        every = np.concatenate([sources, flips[~first][:, own]])
        penalties.append(np.full((len(modes), len(every) - len(modes)), price))
        return distinct_alternatives(
            body, modes[0], chain, every, np.concatenate(penalties, axis=1),
            apart=DISTINCT, most=s.alternatives,
        )  # fmt: skip

    def _torso_flips(
        self, pose: Array, chains: list[str]
    ) -> list[tuple[Array, list[Alternatives]]]:
        """The pose with its torso flipped, and its limbs in all ways that keep their image."""
        result = []
        for flipped in flip_torso(self.posterior.body, pose[None])[0]:
            base, alternatives = flipped.copy(), []
            for chain in chains:
                own = self.posterior.body.skeleton.chain_dofs[chain]
                hung, _ = rehang_chain(self.posterior.body, pose[None], flipped[None], chain)
                angles = hung[:, own] if len(hung) else flipped[None, own]
                base[own] = angles[0]
                distinct = distinct_alternatives(
                    self.posterior.body, flipped, chain, angles, np.zeros((1, len(angles))),
                    apart=DISTINCT, most=self.posterior.settings.alternatives,
                )  # fmt: skip
                alternatives.append(distinct)
            result.append((base, alternatives))
        return result

    def _swap(self, lead: _Lead, pair: tuple[str, str]) -> tuple[Array, list[Alternatives]] | None:
        """The pose with two limbs each on the other's image, in all ways; None if unreachable.

        Limbs that cross in the image are easily taken for each other, and one alone that changes
        sides leaves its own place empty.
        """
        pose = lead.pose
        base, alternatives = pose.copy(), []
        for chain, sibling in (pair, pair[::-1]):
            own = self.posterior.body.skeleton.chain_dofs[chain]
            hung, _ = rehang_chain(
                self.posterior.body, pose[None], pose[None], chain, image_of=sibling
            )
            if len(hung) == 0:
                return None
            base[own] = hung[0, own]
            distinct = distinct_alternatives(
                self.posterior.body, pose, chain, hung[:, own], np.zeros((1, len(hung))),
                apart=DISTINCT, most=self.posterior.settings.alternatives,
            )  # fmt: skip
            alternatives.append(distinct)
        return base, alternatives

    def _rate(
        self, observation: Observation, trunks: list[tuple[Array, list[Alternatives]]]
    ) -> list[tuple[list[Array], float]]:
        """Energy change that each alternative makes alone, and the energy of each pose itself.

        Args:
            observation: of the image.
            trunks: poses (d,), and alternatives for chains of each.
        """
        poses = []
        for pose, alternatives in trunks:
            poses.append(pose[None])
            for chain in alternatives:
                block = np.repeat(pose[None], len(chain.angles), axis=0)
                block[:, self.posterior.body.skeleton.chain_dofs[chain.chain]] = chain.angles
                poses.append(block)
        value = self.posterior.values(np.concatenate(poses), observation)
        parts = iter(np.split(value, np.cumsum([len(x) for x in poses])[:-1]))
        result = []
        for _, alternatives in trunks:
            energy = float(next(parts)[0])
            result.append(([next(parts) - energy for _ in alternatives], energy))
        return result
