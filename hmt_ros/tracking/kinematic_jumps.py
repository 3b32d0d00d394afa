"""Kinematic jump sampling: other configurations of the limbs and of the trunk (KJS 3, 4).

For each trunk that the modes have, every limb has alternatives: those of the modes, all their
flips, and what a search of the image found. Combinations of alternatives are rated on the trunk as
it is, with limbs exchanged that were taken for each other, and with the torso flipped; the best
that stand for all become candidates.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.interpretation_tree import chain_points, enumerate_flips, rehang_chain
from hmt_ros.body.torso_flips import flip_torso
from hmt_ros.image.observation import Observation
from hmt_ros.image.texture import Textures, with_swapped_sides
from hmt_ros.inference.bounded_newton import Minimum
from hmt_ros.tracking.candidates import Candidates, relative_joints
from hmt_ros.tracking.chain_product import Alternatives, best_combinations, distinct_alternatives
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
TRUNK = ('pelvis', 'neck', 'left_hip', 'right_hip', 'left_shoulder', 'right_shoulder')
CHAINS = ('left_arm', 'right_arm', 'left_leg', 'right_leg', 'neck')
PAIRS = (('left_arm', 'right_arm'), ('left_leg', 'right_leg'))
SIBLINGS = {a: b for pair in PAIRS for a, b in (pair, pair[::-1])}


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
            for chain in CHAINS[:4]
            if chain in self.body.chains
        }

    @cached_property
    def _edge_jumps(self) -> dict[str, EdgeJumps]:
        s = self.settings
        return {
            chain: EdgeJumps(self.body, self.camera, s.likelihood, chain)
            for chain in CHAINS[:4]
            if chain in self.body.chains
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
            lead = int(group[0])
            pose, lead_row = base.x[lead], int(sources.texture_rows[lead])
            found = self._search(
                pose,
                covariances[sources.parents[lead]],
                observation,
                textures,
                lead_row,
                base.x,
                rng,
            )
            excess = self._excess(pose, observation, learn=lead == first and not again)
            edges: dict[str, Array] = {}
            if s.edge_jumps > 0 and again:
                covariance = covariances[sources.parents[lead]]
                edges = self._on_other_edges(
                    pose, covariance, observation, textures, lead_row, excess
                )
            log_weights = sources.log_priors[group]
            alternatives = [
                self._alternatives(base.x[group], chain, found.get(chain), edges.get(chain))
                for chain in CHAINS
                if chain in self.body.chains
            ]
            changes, energy = self._rate(pose, alternatives, observation, textures, lead_row)
            products = [
                _Product(base.x[group], group, log_weights, alternatives, changes, energy, lead_row)
            ]
            weight = np.array([np.logaddexp.reduce(log_weights) + np.log(s.jump_probability)])
            for pair in PAIRS:
                if not set(pair) <= set(self.body.chains):
                    continue
                if not self._may_be_exchanged(pose, pair, excess):
                    continue
                swapped = self._swap(pose, pair)
                if swapped is None:
                    continue
                row = lead_row
                if textures is not None:
                    row = len(textures.counts)
                    textures = with_swapped_sides(
                        textures, lead_row, *(self.body.skeleton.chains[chain] for chain in pair)
                    )
                rated, energy = self._rate(swapped[0], swapped[1], observation, textures, row)
                choices, joined = [], []
                for chain, change in zip(alternatives, changes, strict=True):
                    if chain.chain in pair:
                        i = pair.index(chain.chain)
                        choices.append(swapped[1][i])
                        joined.append(rated[i])
                    else:
                        choices.append(Alternatives(chain.chain, chain.angles, chain.penalties[:1]))
                        joined.append(change)
                products.append(
                    _Product(swapped[0][None], group[:1], weight, choices, joined, energy, row)
                )
            for flipped, hung in self._torso_flips(pose, [a.chain for a in alternatives]):
                changes, energy = self._rate(flipped, hung, observation, textures, lead_row)
                products.append(
                    _Product(flipped[None], group[:1], weight, hung, changes, energy, lead_row)
                )
            for product in products:
                combined = best_combinations(
                    self.body, product.modes, product.log_weights, product.energy,
                    product.alternatives, product.changes, s.temperature, s.combinations,
                )  # fmt: skip
                members = product.members[combined.parents]
                rows = np.full(len(members), product.row)
                if product.row == lead_row:
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
        names = [name for name in TRUNK if name in self.body.joint_names]
        which = self.body.skeleton.joint_index(names)
        trunk = self.body.joint_positions(base.x)[:, which]
        left = list(np.argsort(base.value, kind='stable'))
        groups = []
        while left:
            gaps = np.linalg.norm(trunk[left] - trunk[left[0]], axis=2).max(1)
            near = gaps < 0.06
            groups.append(np.array([i for i, ok in zip(left, near) if ok], dtype=np.intp))
            left = [i for i, ok in zip(left, near) if not ok]
        return groups

    def _search(
        self,
        pose: Array,
        covariance: Array,
        observation: Observation,
        textures: Textures | None,
        row: int,
        known: Array,
        rng: np.random.Generator,
    ) -> dict[str, Array]:
        """Configurations of some chains, chosen by vote, that fit the image."""
        shape = observation.distance is not None or observation.edges is not None
        names = list(self._searches) if shape else []
        count = min(self.settings.searched_chains, len(names))
        if count == 0:
            return {}
        votes = chain_votes(
            self.body, covariance[None], names, self.settings.vote, pose[None], known
        )[0]
        chosen = rng.choice(len(names), size=count, replace=False, p=votes)
        result = {}
        for i in sorted(chosen):
            search = self._searches[names[i]]
            result[names[i]] = search.find(pose, covariance, observation, textures, row, rng)
            own = self.settings.search
            self.count(own.samples + own.refined * own.iterations)
        return result

    def _on_other_edges(
        self,
        pose: Array,
        covariance: Array,
        observation: Observation,
        textures: Textures | None,
        row: int,
        excess: dict[str, float],
    ) -> dict[str, Array]:
        """Configurations of limbs on other edges, where a limb costs much and is uncertain.

        Only those that by themselves take the surprise out of the image.
        """
        s, result = self.settings, {}
        for chain, share in excess.items():
            jumps = self._edge_jumps[chain]
            deviation, width = jumps.deviation(pose, covariance)
            if not self.votes.drawn(share * displaced(width, deviation)):
                continue
            found = jumps.find(pose, observation, s.edge_jumps)
            poses = np.repeat(pose[None], len(found) + 1, axis=0)
            poses[1:, jumps.dofs] = found
            value = self.evaluate(poses, observation, textures, np.full(len(poses), row))
            result[chain] = found[value[1:] < value[0] - s.surprise]
        return result

    def _excess(self, pose: Array, observation: Observation, *, learn: bool) -> dict[str, float]:
        """By how much more than usual the contours of the limbs cost."""
        s = self.settings
        if observation.edges is None or not (s.edge_jumps > 0 or s.voted_swaps):
            return {}
        residuals = {c: jumps.residual(pose, observation) for c, jumps in self._edge_jumps.items()}
        excess = self.votes.excess(residuals)
        if learn:
            self.votes.learn(residuals)
        return excess

    def _may_be_exchanged(
        self, pose: Array, pair: tuple[str, str], excess: dict[str, float]
    ) -> bool:
        """Whether the votes ask for two limbs to be exchanged."""
        if not self.settings.voted_swaps or not excess:
            return True
        pixels = [
            self.camera.project(chain_points(self.body, pose[None], chain)[0, 1:3])
            for chain in pair
        ]
        width = max(self._edge_jumps[chain].width(pose) for chain in pair)
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
        if chain in SIBLINGS:
            # Limbs that cross in the image are easily taken for each other.
            swapped, _ = rehang_chain(
                self.body, modes[:1], modes[:1], chain, image_of=SIBLINGS[chain]
            )
            angles.append(swapped[:, own])
            penalties.append(np.full((len(modes), len(swapped)), jump))
        sources = np.concatenate(angles)
        poses = np.repeat(modes[:1], len(sources), axis=0)
        poses[:, own] = sources
        flips, parents = enumerate_flips(self.body, self.camera, poses, chain)
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

    def _swap(self, pose: Array, pair: tuple[str, str]) -> tuple[Array, list[Alternatives]] | None:
        """The pose with two limbs each on the other's image, in all ways; None if they reach not.

        Limbs that cross in the image are easily taken for each other, and one alone that changes
        sides leaves its own place empty.
        """
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
        return base, alternatives

    def _rate(
        self,
        pose: Array,
        alternatives: list[Alternatives],
        observation: Observation,
        textures: Textures | None,
        row: int,
    ) -> tuple[list[Array], float]:
        """Energy change that each alternative makes alone, and the energy of the pose itself."""
        poses = [pose[None]]
        for chain in alternatives:
            block = np.repeat(pose[None], len(chain.angles), axis=0)
            block[:, self.body.skeleton.chain_dofs[chain.chain]] = chain.angles
            poses.append(block)
        everything = np.concatenate(poses)
        value = self.evaluate(everything, observation, textures, np.full(len(everything), row))
        ends = np.cumsum([1] + [len(c.angles) for c in alternatives])
        return [value[a:b] - value[0] for a, b in pairwise(ends)], float(value[0])
