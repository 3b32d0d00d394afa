"""Kinematic jump sampling: other configurations of the limbs and of the trunk (KJS 3, 4).

For each trunk that the modes have, every limb has alternatives: those of the modes, all their
flips, and what a search of the image found. Combinations of alternatives are rated on the trunk as
it is, with limbs exchanged that were taken for each other, and with the torso flipped; the best
that stand for all become candidates.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.skeleton import other_side
from hmt_ros.flips.best_combinations import Alternatives, best_combinations, distinct_alternatives
from hmt_ros.flips.interpretation_tree import chain_points, enumerate_flips, rehang_chain
from hmt_ros.flips.torso_flips import flip_torso
from hmt_ros.image.observation import Observation
from hmt_ros.image.texture import Textures, with_swapped_sides
from hmt_ros.inference.bounded_newton import Minimum
from hmt_ros.tracking.candidates import Candidates, relative_joints
from hmt_ros.tracking.chain_search import ChainSearch
from hmt_ros.tracking.chain_votes import chain_votes
from hmt_ros.tracking.edge_jumps import EdgeJumps
from hmt_ros.tracking.limb_votes import LimbVotes, displaced, exchanged
from hmt_ros.tracking.pruning import choose_hypotheses
from hmt_ros.tracking.tracker_settings import TrackerSettings

Array = NDArray[np.float64]
Index = NDArray[np.intp]

# Groups of modes with a trunk of their own whose products are rated.
MOST_GROUPS = 3


@dataclass(frozen=True, eq=False)
class _Lead:
    """The pose of a trunk, and the image in which its limbs are rated.

    Attributes:
        pose: (d,).
        covariance: (d, d) of its prediction.
        observation: of the image.
        textures: of the last image.
        row: of the textures, which the pose carries.
    """

    pose: Array
    covariance: Array
    observation: Observation
    textures: Textures | None
    row: int


@dataclass(frozen=True, eq=False)
class _Product:
    """A trunk, configurations of each limb, and what they cost.

    Attributes:
        modes, members, log_weights: (G, d), (G,), (G,) of the modes with this trunk.
        alternatives: one entry a chain.
        changes: energy change that each alternative makes alone.
        energy: of the first mode.
        row: of the textures.
    """

    modes: Array
    members: Index
    log_weights: Array
    alternatives: list[Alternatives]
    changes: list[Array]
    energy: float
    row: int


@dataclass(frozen=True, eq=False)
class KinematicJumps:
    """Proposes poses far from those that are known, which fit the image as well.

    Attributes:
        body, camera: who is seen by what.
        settings: of the tracker.
        evaluate: energies (N,) of poses (N, d) in an image, with textures and their rows (N,).
        count: told how many evaluations were made besides.
        votes: what the limbs usually cost; learns.
    """

    body: Body
    camera: Camera
    settings: TrackerSettings
    evaluate: Callable[[Array, Observation, Textures | None, Index], Array]
    count: Callable[[int], None]
    votes: LimbVotes = field(default_factory=LimbVotes)

    @cached_property
    def _searches(self) -> dict[str, ChainSearch]:
        s = self.settings
        return {
            chain: ChainSearch(self.body, self.camera, s.likelihood, chain, s.search)
            for pair in self.body.chain_pairs
            for chain in pair
        }

    @cached_property
    def _edge_jumps(self) -> dict[str, EdgeJumps]:
        s = self.settings
        return {
            chain: EdgeJumps(self.body, self.camera, s.likelihood, chain)
            for pair in self.body.chain_pairs
            for chain in pair
        }

    def propose(
        self,
        base: Minimum,
        sources: Candidates,
        covariances: Array,
        observation: Observation,
        rng: np.random.Generator,
        *,
        again: bool = False,
    ) -> Candidates:
        """Candidates of kinematic jump sampling, from optima and how each of them came about.

        Args:
            base: optima of the image, and
            sources: what each of them started from.
            covariances: (K, d, d) of the predictions, which the parents of the sources index.
            observation: of the image.
            rng: source of randomness.
            again: whether the image was searched before, and surprised: other edges are looked for.
        """
        s, textures = self.settings, sources.textures
        everything: list[tuple[Array, Index, Array, Array, Index]] = []
        first = int(np.argmin(base.value))
        for group in self._groups(base)[:MOST_GROUPS]:
            lead = _Lead(
                base.x[group[0]], covariances[sources.parents[group[0]]], observation, textures,
                int(sources.texture_rows[group[0]]),
            )  # fmt: skip
            found = self._search(lead, base.x, rng)
            excess = self._excess(lead, learn=group[0] == first and not again)
            edges = self._on_other_edges(lead, excess) if s.edge_jumps > 0 and again else {}
            alternatives = [
                self._alternatives(base.x[group], chain, found.get(chain), edges.get(chain))
                for chain in self.body.chains
            ]
            products, textures = self._products(
                lead, base.x[group], group, sources.log_priors[group], alternatives, excess
            )
            for product in products:
                combined = best_combinations(
                    self.body, product.modes, product.log_weights, product.energy,
                    product.alternatives, product.changes, s.temperature, s.combinations,
                )  # fmt: skip
                members = product.members[combined.parents]
                rows = np.full(len(members), product.row)
                if product.row == lead.row:
                    rows = sources.texture_rows[members]
                everything.append(
                    (combined.poses, members, combined.log_priors, combined.energies, rows)
                )
        poses, members, log_priors, energies, rows = (
            np.concatenate([part[i] for part in everything]) for i in range(5)
        )
        kept = choose_hypotheses(
            relative_joints(self.body, poses),
            s.exploration * (log_priors - s.temperature * energies),
            s.candidates,
            same=s.hypothesis_merge_distance,
        ).chosen
        poses, members = poses[kept], members[kept]
        # A chain that jumped is expected where it landed, the rest where it was predicted.
        changed = np.abs(poses - base.x[members]) > 1e-9
        return Candidates(
            poses,
            sources.parents[members],
            log_priors[kept],
            np.where(changed, poses, sources.centres[members]),
            changed | sources.jumped[members],
            textures,
            rows[kept],
        )

    def _groups(self, base: Minimum) -> list[Index]:
        """Modes with nearly the same trunk, each group with its best mode first."""
        which = self.body.skeleton.joint_index(self.body.trunk_joints)
        trunk = self.body.joint_positions(base.x)[:, which]
        left = list(np.argsort(base.value, kind='stable'))
        groups = []
        while left:
            gaps = np.linalg.norm(trunk[left] - trunk[left[0]], axis=2).max(1)
            near = gaps < 0.06
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
        excess: dict[str, float],
    ) -> tuple[list[_Product], Textures | None]:
        """The product of a group, those with limbs exchanged, and those with the torso flipped.

        Args:
            lead: first mode of the group.
            modes, members, log_weights: (G, d), (G,), (G,) of the group.
            alternatives: one entry a chain.
            excess: votes for the limbs.

        Returns:
            The products, and the textures of which they have rows.
        """
        changes, energy = self._rate(lead, alternatives)
        products = [_Product(modes, members, log_weights, alternatives, changes, energy, lead.row)]
        weight = np.array(
            [np.logaddexp.reduce(log_weights) + np.log(self.settings.jump_probability)]
        )
        for pair in self.body.chain_pairs:
            if not self._may_be_exchanged(lead, pair, excess):
                continue
            swapped = self._swap(lead, pair)
            if swapped is None:
                continue
            other, hung = swapped
            lead = replace(lead, textures=other.textures)
            rated, energy = self._rate(other, hung)
            choices, joined = [], []
            for chain, change in zip(alternatives, changes, strict=True):
                if chain.chain in pair:
                    i = pair.index(chain.chain)
                    choices.append(hung[i])
                    joined.append(rated[i])
                else:
                    choices.append(Alternatives(chain.chain, chain.angles, chain.penalties[:1]))
                    joined.append(change)
            products.append(
                _Product(other.pose[None], members[:1], weight, choices, joined, energy, other.row)
            )
        for flipped, hung in self._torso_flips(lead.pose, [a.chain for a in alternatives]):
            rated, energy = self._rate(replace(lead, pose=flipped), hung)
            products.append(
                _Product(flipped[None], members[:1], weight, hung, rated, energy, lead.row)
            )
        return products, lead.textures

    def _search(self, lead: _Lead, known: Array, rng: np.random.Generator) -> dict[str, Array]:
        """Configurations of some chains, chosen by vote, that fit the image."""
        pose, observation = lead.pose, lead.observation
        shape = observation.distance is not None or observation.edges is not None
        names = list(self._searches) if shape else []
        count = min(self.settings.searched_chains, len(names))
        if count == 0:
            return {}
        votes = chain_votes(
            self.body, lead.covariance[None], names, self.settings.vote, pose[None], known
        )[0]
        chosen = rng.choice(len(names), size=count, replace=False, p=votes)
        result = {}
        for i in sorted(chosen):
            search = self._searches[names[i]]
            result[names[i]] = search.find(
                pose, lead.covariance, observation, lead.textures, lead.row, rng
            )
            own = self.settings.search
            self.count(own.samples + own.refined * own.iterations)
        return result

    def _on_other_edges(self, lead: _Lead, excess: dict[str, float]) -> dict[str, Array]:
        """Configurations of limbs on other edges, where a limb costs much and is uncertain.

        Only those that by themselves take the surprise out of the image.
        """
        s, result = self.settings, {}
        for chain, share in excess.items():
            jumps = self._edge_jumps[chain]
            deviation, width = jumps.deviation(lead.pose, lead.covariance)
            if not self.votes.drawn(share * displaced(width, deviation)):
                continue
            found = jumps.find(lead.pose, lead.observation, s.edge_jumps)
            poses = np.repeat(lead.pose[None], len(found) + 1, axis=0)
            poses[1:, jumps.dofs] = found
            value = self._values(lead, poses)
            result[chain] = found[value[1:] < value[0] - s.surprise]
        return result

    def _excess(self, lead: _Lead, *, learn: bool) -> dict[str, float]:
        """By how much more than usual the contours of the limbs cost."""
        s = self.settings
        if lead.observation.edges is None or not (s.edge_jumps > 0 or s.voted_swaps):
            return {}
        residuals = {
            chain: jumps.residual(lead.pose, lead.observation)
            for chain, jumps in self._edge_jumps.items()
        }
        excess = self.votes.excess(residuals)
        if learn:
            self.votes.learn(residuals)
        return excess

    def _may_be_exchanged(
        self, lead: _Lead, pair: tuple[str, str], excess: dict[str, float]
    ) -> bool:
        """Whether the votes ask for two limbs to be exchanged."""
        if not self.settings.voted_swaps or not excess:
            return True
        pixels = [
            self.camera.project(chain_points(self.body, lead.pose[None], chain)[0, 1:3])
            for chain in pair
        ]
        width = max(self._edge_jumps[chain].width(lead.pose) for chain in pair)
        near = exchanged(np.linalg.norm(pixels[0] - pixels[1], axis=1), 2.0 * width)
        share = max(near, *(excess[chain] for chain in pair), self.settings.jump_probability)
        return self.votes.drawn(share)

    def _alternatives(
        self, modes: Array, chain: str, found: Array | None, edges: Array | None
    ) -> Alternatives:
        """Configurations of a chain in a group.

        The modes' own, what was found, all flips, and what lies on other edges.
        """
        s = self.settings
        own = self.body.skeleton.chain_dofs[chain]
        jump = -np.log(s.jump_probability)
        angles, penalties = [modes[:, own]], [np.where(np.eye(len(modes)) > 0, 0.0, jump)]
        if found is not None:
            angles.append(found)
            penalties.append(np.full((len(modes), len(found)), jump))
        sibling = other_side(chain)
        if sibling != chain:
            # Limbs that cross in the image are easily taken for each other.
            swapped, _ = rehang_chain(self.body, modes[:1], modes[:1], chain, image_of=sibling)
            angles.append(swapped[:, own])
            penalties.append(np.full((len(modes), len(swapped)), jump))
        sources = np.concatenate(angles)
        poses = np.repeat(modes[:1], len(sources), axis=0)
        poses[:, own] = sources
        flips, parents = enumerate_flips(self.body, poses, chain)
        first = np.concatenate([[True], parents[1:] != parents[:-1]])
        flips, parents = flips[~first], parents[~first]
        angles.append(flips[:, own])
        penalties.append(np.full((len(modes), len(flips)), jump))
        most = s.alternatives
        if edges is not None and len(edges):
            # After all others, for which there is as much room as without.
            angles.append(edges)
            penalties.append(np.full((len(modes), len(edges)), -np.log(s.edge_probability)))
            most += len(edges)
        return distinct_alternatives(
            self.body, modes[0], chain, np.concatenate(angles), np.concatenate(penalties, axis=1),
            apart=0.08, most=most,
        )  # fmt: skip

    def _torso_flips(
        self, pose: Array, chains: list[str]
    ) -> list[tuple[Array, list[Alternatives]]]:
        """The pose with its torso flipped, and its limbs in all ways that keep their image."""
        result = []
        for flipped in flip_torso(self.body, pose[None])[0]:
            base, alternatives = flipped.copy(), []
            for chain in chains:
                own = self.body.skeleton.chain_dofs[chain]
                hung, _ = rehang_chain(self.body, pose[None], flipped[None], chain)
                angles = hung[:, own] if len(hung) else flipped[None, own]
                base[own] = angles[0]
                distinct = distinct_alternatives(
                    self.body, flipped, chain, angles, np.zeros((1, len(angles))),
                    apart=0.08, most=self.settings.alternatives,
                )  # fmt: skip
                alternatives.append(distinct)
            result.append((base, alternatives))
        return result

    def _swap(self, lead: _Lead, pair: tuple[str, str]) -> tuple[_Lead, list[Alternatives]] | None:
        """The pose with two limbs each on the other's image, in all ways; None if they reach not.

        Limbs that cross in the image are easily taken for each other, and one alone that changes
        sides leaves its own place empty.
        """
        pose, textures, row = lead.pose, lead.textures, lead.row
        base, alternatives = pose.copy(), []
        for chain, sibling in (pair, pair[::-1]):
            own = self.body.skeleton.chain_dofs[chain]
            hung, _ = rehang_chain(self.body, pose[None], pose[None], chain, image_of=sibling)
            if len(hung) == 0:
                return None
            base[own] = hung[0, own]
            distinct = distinct_alternatives(
                self.body, pose, chain, hung[:, own], np.zeros((1, len(hung))),
                apart=0.08, most=self.settings.alternatives,
            )  # fmt: skip
            alternatives.append(distinct)
        if textures is not None:
            row = len(textures.counts)
            segments = (self.body.skeleton.chains[chain] for chain in pair)
            textures = with_swapped_sides(textures, lead.row, *segments)
        return replace(lead, pose=base, textures=textures, row=row), alternatives

    def _rate(self, lead: _Lead, alternatives: list[Alternatives]) -> tuple[list[Array], float]:
        """Energy change that each alternative makes alone, and the energy of the pose itself."""
        poses = [lead.pose[None]]
        for chain in alternatives:
            block = np.repeat(lead.pose[None], len(chain.angles), axis=0)
            block[:, self.body.skeleton.chain_dofs[chain.chain]] = chain.angles
            poses.append(block)
        value = self._values(lead, np.concatenate(poses))
        ends = np.cumsum([1] + [len(c.angles) for c in alternatives])
        return [value[a:b] - value[0] for a, b in pairwise(ends)], float(value[0])

    def _values(self, lead: _Lead, poses: Array) -> Array:
        """Energies (N,) of poses (N, d) that carry the textures of a lead."""
        rows = np.full(len(poses), lead.row)
        return self.evaluate(poses, lead.observation, lead.textures, rows)
