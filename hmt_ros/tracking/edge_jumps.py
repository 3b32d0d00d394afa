"""Jumps in the image: a limb on the wrong edge goes to another one (KJS 6, the outlook).

A limb has two long parallel contours, and so has what is beside it: the other limb, a sleeve, its
own other side. A descent that took one for the other stays there. Here the contour of the limb is
shifted sideways in the image, joint by joint, and compared with the edges and the silhouette; where
it lies well, the shifted joints are put back into space by the chain's interpretation tree.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.kinematics import forward
from hmt_ros.flips.interpretation_tree import chain_points, place_chain
from hmt_ros.image.likelihood import NO_MAP, LikelihoodSettings
from hmt_ros.image.observation import Observation
from hmt_ros.image.sampling import sample_distance
from hmt_ros.image.surface import (
    Contour,
    FleshTable,
    Lens,
    empty_contour,
    flesh_table_of,
    lens_of,
    trace_contour,
)
from hmt_ros.image.terms.robust_kernel import geman_mcclure

Array = NDArray[np.float64]
Index = NDArray[np.intp]

# Shifts of a joint that are tried, in widths of the limb in the image. Its own other edge lies at
# one width.
SHIFTS = np.arange(-9, 10) / 4.0
# Shifts within this are what the descent finds by itself, in widths.
OWN_BASIN = 0.6
# A segment that is seen shorter than this share of its width has no sideways.
SHORTEST = 0.5
# How far a joint that is out of the segment's reach may stay behind, m.
SLACK = 0.1


@dataclass(frozen=True, eq=False)
class EdgeJumps:
    """Other edges that a chain may lie on.

    Attributes:
        body, camera: who is seen by what.
        settings: of the likelihood, whose terms of edges and of containment rate contours.
        chain: name; of two links at least, the further ones move with the second.
    """

    body: Body
    camera: Camera
    settings: LikelihoodSettings
    chain: str

    @cached_property
    def dofs(self) -> Index:
        """Degrees of freedom of the chain."""
        return self.body.skeleton.chain_dofs[self.chain]

    @cached_property
    def _flesh(self) -> tuple[FleshTable, Lens, NDArray[np.bool_], Index]:
        flesh = flesh_table_of(self.body)
        segments = self.body.skeleton.chains[self.chain]
        wanted = np.isin(flesh.part_segments, segments)
        links = np.full(len(flesh.part_segments), -1)
        for k, segment in enumerate(segments):
            links[flesh.part_segments == segment] = min(k, 2)
        return flesh, lens_of(self.camera), wanted, links

    def residual(self, pose: Array, observation: Observation) -> float:
        """Mean energy of a point of the chain's contour, as a share of the most it can be."""
        costs = self._costs(pose, observation, np.zeros(1))
        return float('nan') if costs is None else float(costs[0][0, 0])

    def width(self, pose: Array) -> float:
        """How wide the chain's second link is seen at a pose (d,), px; 0: not from the side."""
        placed = self._sideways(pose)
        return 0.0 if placed is None else float(np.linalg.norm(placed[2][1]))

    def deviation(self, pose: Array, covariance: Array) -> tuple[float, float]:
        """How uncertain the chain's second joint is sideways, and how wide the chain is seen, px.

        Args:
            pose: (d,); its trunk is given.
            covariance: (d, d) of the pose.
        """
        own, step = self.dofs, 1e-5
        poses = np.repeat(pose[None], len(own) + 1, axis=0)
        poses[np.arange(len(own)), own] += step
        points = self.camera.project(chain_points(self.body, poses, self.chain)[:, 2])
        slopes = (points[:-1] - points[-1]) / step
        placed = self._sideways(pose)
        if placed is None or not np.isfinite(slopes).all():
            return 0.0, 0.0
        sideways = placed[2][1]
        width = float(np.linalg.norm(sideways))
        if width == 0.0:
            return 0.0, 0.0
        across = slopes @ (sideways / width)
        return float(np.sqrt(across @ covariance[np.ix_(own, own)] @ across)), width

    def find(self, pose: Array, observation: Observation, most: int) -> Array:
        """Angles (A, chain dofs) that put the chain onto other edges, best first.

        Args:
            pose: (d,) whose other chains are kept.
            observation: of the image, with edges.
            most: places in the image; each may be reached in several ways.
        """
        none = np.empty((0, len(self.dofs)))
        if observation.edges is None or most == 0:
            return none
        rated = self._costs(pose, observation, SHIFTS)
        if rated is None:
            return none
        costs, joints, sideways = rated
        lowest = costs <= minimum_filter(costs, size=3, mode='nearest')
        far = np.abs(SHIFTS) > OWN_BASIN
        first, second = np.nonzero(lowest & (far[:, None] | far[None]))
        best = np.argsort(costs[first, second], kind='stable')[:most]
        first, second = first[best], second[best]
        points = chain_points(self.body, pose[None], self.chain)[0, 1:]
        pixels = np.repeat(joints[None, 1:], len(best), axis=0)
        pixels[:, 0] += SHIFTS[first, None] * sideways[0]
        pixels[:, 1:] += (SHIFTS[second, None] * sideways[1])[:, None]
        away = self.camera.rays(pixels) * np.linalg.norm(points, axis=1)[:, None]
        poses, parents = place_chain(
            self.body, np.repeat(pose[None], len(best), axis=0), self.chain, away, slack=SLACK
        )
        # All ways of the best place stand before those of the next.
        found: Array = poses[np.argsort(parents, kind='stable')][:, self.dofs]
        return found

    def _costs(
        self, pose: Array, observation: Observation, shifts: Array
    ) -> tuple[Array, Array, Array] | None:
        """What shifts of the first and of the second joint cost; None: there is nothing to shift.

        Returns:
            costs (S, S), pixels (K + 1, 2) of the joints, and (2, 2) what a shift by one width is
            for the two joints, px.
        """
        placed = self._sideways(pose)
        if placed is None:
            return None
        contour, links, sideways, joints = placed
        s = self.settings
        costs = _shifted_costs(
            observation.edges or NO_MAP, observation.distance or NO_MAP,
            observation.distance is not None, contour.pixels, contour.normals, links, joints,
            sideways, shifts, s.edges.sigma, s.edges.scale, s.containment.sigma,
            s.containment.scale,
        )  # fmt: skip
        return costs, joints, sideways

    def _sideways(self, pose: Array) -> tuple[Contour, Index, Array, Array] | None:
        """Contour, link (P,) of each point, what a shift is (2, 2) px, joints (K + 1, 2) px."""
        flesh, lens, wanted, part_links = self._flesh
        frames = forward(self.body.skeleton, pose[None])
        columns, origins = frames.by_pose()
        contour = empty_contour(len(flesh.ring_parts))
        trace_contour(flesh, wanted, lens, columns[0], origins[0], contour)
        joints = self.camera.project(chain_points(self.body, pose[None], self.chain)[0])
        links = np.where(contour.valid, part_links[contour.parts], -1)
        if len(joints) < 3 or not np.isfinite(joints).all():
            return None
        along = np.diff(joints[:3], axis=0)
        length = np.linalg.norm(along, axis=1)
        across = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.maximum(length, 1e-9)[:, None]
        sideways = np.zeros((2, 2))
        for k in range(2):
            mine = links == k
            if not mine.any():
                return None
            width = 2.0 * np.abs((contour.pixels[mine] - joints[k]) @ across[k]).mean()
            if length[k] > SHORTEST * width:
                sideways[k] = width * across[k]
        return contour, links, sideways, joints


@njit(cache=True, nogil=True)
def _shifted_costs(  # type: ignore[no-untyped-def]
    edges, distance, silhouette, pixels, normals, links, joints, sideways, shifts,
    edge_sigma, edge_scale, inside_sigma, inside_scale,
):  # fmt: skip
    """Mean cost (S, S), 0 to 1, of the contour with its first and its second joint shifted.

    Args:
        edges, distance: maps.
        silhouette: whether there is a map of distances.
        pixels, normals: (P, 2) of the contour.
        links: (P,) 0, 1 or 2: further ones; negative: no point.
        joints: (K + 1, 2) pixels, the root first.
        sideways: (2, 2) what shifts are multiples of, px.
        shifts: (S,).
        edge_sigma, edge_scale, inside_sigma, inside_scale: of the kernels, px and sigmas.
    """
    count = len(shifts)
    upper, lower, end = np.zeros(count), np.zeros((count, count)), np.zeros(count)
    points = 0
    for i in range(len(links)):
        k = links[i]
        if k < 0:
            continue
        points += 1
        u, v, nu, nv = pixels[i, 0], pixels[i, 1], normals[i, 0], normals[i, 1]
        if k == 2:
            for b in range(count):
                x, y = u + shifts[b] * sideways[1, 0], v + shifts[b] * sideways[1, 1]
                end[b] += _cost(
                    edges, distance, silhouette, x, y, nu, nv,
                    edge_sigma, edge_scale, inside_sigma, inside_scale,
                )  # fmt: skip
            continue
        # The point in coordinates of its link: a share of its length, and pixels beside it.
        su, sv = joints[k, 0], joints[k, 1]
        eu, ev = joints[k + 1, 0], joints[k + 1, 1]
        length = max(np.hypot(eu - su, ev - sv), 1e-6)
        du, dv = (eu - su) / length, (ev - sv) / length
        t, w = ((u - su) * du + (v - sv) * dv) / length, (v - sv) * du - (u - su) * dv
        n_along, n_across = nu * du + nv * dv, nv * du - nu * dv
        for a in range(count):
            au, av = shifts[a] * sideways[0, 0], shifts[a] * sideways[0, 1]
            for b in range(count if k == 1 else 1):
                if k == 0:
                    fu, fv, gu, gv = su, sv, eu + au, ev + av
                else:
                    fu, fv = su + au, sv + av
                    gu, gv = eu + shifts[b] * sideways[1, 0], ev + shifts[b] * sideways[1, 1]
                size = max(np.hypot(gu - fu, gv - fv), 1e-6)
                hu, hv = (gu - fu) / size, (gv - fv) / size
                value = _cost(
                    edges, distance, silhouette,
                    fu + t * (gu - fu) - w * hv, fv + t * (gv - fv) + w * hu,
                    n_along * hu - n_across * hv, n_along * hv + n_across * hu,
                    edge_sigma, edge_scale, inside_sigma, inside_scale,
                )  # fmt: skip
                if k == 0:
                    upper[a] += value
                else:
                    lower[a, b] += value
    for a in range(count):
        for b in range(count):
            lower[a, b] = (lower[a, b] + upper[a] + end[b]) / max(points, 1)
    return lower


@njit(cache=True, nogil=True, inline='always')
def _cost(  # type: ignore[no-untyped-def]
    edges, distance, silhouette, u, v, nu, nv, edge_sigma, edge_scale, inside_sigma, inside_scale
):
    """What a point of the contour costs: as far from an edge of its direction, or outside."""
    bins = edges.values.shape[0]
    channel = int(np.round(np.arctan2(nv, nu) * (bins / np.pi))) % bins
    away = sample_distance(edges, channel, u, v)[0]
    value = geman_mcclure(away / edge_sigma, edge_scale, 2.0 / (edge_scale * edge_scale))[0]
    if silhouette:
        outside = max(sample_distance(distance, 0, u, v)[0], 0.0)
        weight = 2.0 / (inside_scale * inside_scale)
        value = 0.5 * (value + geman_mcclure(outside / inside_sigma, inside_scale, weight)[0])
    return value
