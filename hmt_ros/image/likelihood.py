"""Negative log-likelihood of an image, and soft prior of the body, for a batch of poses (KJS 2)."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.kinematics import Frames, forward
from hmt_ros.body.self_intersection import self_intersection_energy
from hmt_ros.image.observation import Observation
from hmt_ros.image.sampling import ImageMap
from hmt_ros.image.surface import flesh_table_of, lens_of
from hmt_ros.image.terms.accumulation import tree_of
from hmt_ros.image.terms.compiled_pass import (
    TERM_COUNT,
    Evidence,
    Model,
    Placement,
    Term,
    Terms,
    add_energies,
)
from hmt_ros.image.terms.keypoints import joint_energy
from hmt_ros.image.texture import Textures, no_textures

Array = NDArray[np.float64]
Index = NDArray[np.intp]

TERMS = Terms._fields
NO_MAP = ImageMap(np.zeros((2, 2, 2), np.float32))


@dataclass(frozen=True)
class TermSettings:
    """One term of the likelihood.

    Attributes:
        weight: Number of independent measurements that the term counts for (a plain factor for
            keypoints); 0 switches the term off.
        sigma: Standard deviation of one measurement, px (grey levels for the intensity, a factor on
            the detector's own deviation for keypoints).
        scale: Width of the Geman-McClure kernel, in standard deviations.
    """

    weight: float
    sigma: float
    scale: float

    def __post_init__(self) -> None:
        if not (self.weight >= 0 and self.sigma > 0 and self.scale > 0):
            raise ValueError(f'a term needs weight >= 0, sigma > 0 and scale > 0, saw {self}')


@dataclass(frozen=True)
class LikelihoodSettings:
    """The terms of the likelihood and of the prior.

    Attributes:
        joints: Distance of the joints from the keypoints.
        containment: Distance of the model's contour from the inside of the silhouette.
        coverage: Distance of the silhouette's outline from the model's contour.
        edges: Distance of the visible contours from image edges.
        intensity: Difference of the texture from that of the last image.
        motion: Difference of the texture's motion from the optical flow.
        prior_weight: Factor on the soft prior of the joint angles.
        self_intersection_sigma: Overlap of two body parts that costs an energy of 1/2, m; inf
            switches the term off.
    """

    joints: TermSettings = field(default=TermSettings(1.0, 1.0, 5.0))
    containment: TermSettings = field(default=TermSettings(30.0, 3.0, 8.0))
    coverage: TermSettings = field(default=TermSettings(30.0, 3.0, 8.0))
    edges: TermSettings = field(default=TermSettings(20.0, 2.5, 3.0))
    intensity: TermSettings = field(default=TermSettings(4.0, 20.0, 2.0))
    motion: TermSettings = field(default=TermSettings(5.0, 1.5, 2.0))
    prior_weight: float = 1.0
    self_intersection_sigma: float = 0.03


@dataclass(frozen=True, eq=False)
class ImageEnergy:
    """Terms of an image at N poses.

    Attributes:
        terms: name -> (N,) energy.
        costs: (N, M) what each sample of the silhouette's outline costs.
        gradient, hessian: (N, d), (N, d, d) of the sum; None: not asked for.
    """

    terms: dict[str, Array]
    costs: Array
    gradient: Array | None
    hessian: Array | None

    @property
    def value(self) -> Array:
        """The sum of the terms, (N,)."""
        total: Array = np.sum(list(self.terms.values()), axis=0)
        return total


@dataclass(frozen=True, eq=False)
class ImageLikelihood:
    """-log p(image | pose) - log prior(pose) of a body before a camera.

    Attributes:
        body, camera: who is seen by what.
        settings: the terms.
        parts: the parts of the flesh that are compared with the image; None: all.
        occluders: the parts that hide others; None: all.
    """

    body: Body
    camera: Camera
    settings: LikelihoodSettings = field(default_factory=LikelihoodSettings)
    parts: tuple[int, ...] | None = None
    occluders: tuple[int, ...] | None = None

    def energy(
        self,
        poses: Array,
        observation: Observation,
        textures: Textures | None = None,
        which: Index | None = None,
    ) -> tuple[Array, Array, Array]:
        """Value (N,), gradient (N, d) and Gauss-Newton Hessian (N, d, d) at poses (N, d).

        Args:
            poses: (N, d).
            observation: of the image.
            textures: of the last image, for the terms of intensity and motion.
            which: (N,) the texture that each pose carries.
        """
        frames = forward(self.body.skeleton, poses)
        image = self.image_energy(frames, observation, textures, which)
        assert image.gradient is not None
        assert image.hessian is not None
        value, gradient, hessian = image.value, image.gradient, image.hessian
        for part in (self.prior(poses), self.intersection(frames)):
            value += part[0]
            gradient += part[1]
            hessian += part[2]
        return value, gradient, hessian

    def image_energy(
        self,
        frames: Frames,
        observation: Observation,
        textures: Textures | None = None,
        which: Index | None = None,
        *,
        explained: Array | None = None,
        derivatives: bool = True,
    ) -> ImageEnergy:
        """The terms of the image at the frames of N poses.

        Args:
            frames: of the poses.
            observation: of the image.
            textures, which: as for `energy`.
            explained: (N, M) or (1, M) what each sample of the outline costs at most, because
                something else explains it.
            derivatives: whether gradient and Hessian are wanted.
        """
        n, d = frames.count, self.body.dimension
        evidence, terms = _evidence(observation), self._terms(observation, textures)
        samples = len(evidence.outline_pixels)
        energies, costs = np.zeros((n, TERM_COUNT)), np.zeros((n, samples))
        gradient = np.zeros((n if derivatives else 0, d))
        hessian = np.zeros((n if derivatives else 0, d, d))
        if explained is None:
            explained = np.full((1, samples), np.inf)
        own = np.full(n, -1) if which is None else which
        textures = textures or no_textures()
        if any(term.weight > 0 for term in terms):
            placement = Placement(*frames.by_pose(), *frames.dofs_by_pose())

            def work(first: int, last: int) -> None:
                add_energies(
                    first, last, self._model, terms, evidence, textures, own, placement, explained,
                    energies, costs, gradient, hessian,
                )  # fmt: skip

            _in_threads(work, n)
        result = {
            name: energies[:, i] for i, name in enumerate(TERMS) if getattr(terms, name).weight > 0
        }
        if observation.keypoints is not None and self.settings.joints.weight > 0:
            s = self.settings.joints
            value, g, h = joint_energy(
                frames, self.camera, observation.keypoints,
                scale=s.scale, weight=s.weight / s.sigma**2,
            )  # fmt: skip
            result['joints'] = value
            if derivatives:
                gradient += g
                hessian += h
        result = result or {'nothing': np.zeros(n)}
        if not derivatives:
            return ImageEnergy(result, costs, None, None)
        return ImageEnergy(result, costs, gradient, hessian)

    def with_scaled_widths(self, factors: Array) -> ImageLikelihood:
        """The likelihood with the x and y radii of the parts (B,) multiplied.

        Made from what is compiled for this one: much cheaper than from a body with other widths,
        which `body` does not become.
        """
        flesh = self._model.flesh
        radii = flesh.part_radii.copy()
        radii[:, :2] *= factors[:, None]
        rings = flesh.ring_radii * factors[flesh.ring_parts][:, None]
        scaled = self._model._replace(flesh=flesh._replace(part_radii=radii, ring_radii=rings))
        result = replace(self)
        result.__dict__['_model'] = scaled
        return result

    def prior(self, poses: Array) -> tuple[Array, Array, Array]:
        """Energy, gradient and Hessian of the soft prior of the joint angles."""
        body = self.body
        precision = self.settings.prior_weight * body.prior_sigma**-2.0
        offset = poses - body.prior_mean
        value = 0.5 * (offset * offset) @ precision
        hessian = np.broadcast_to(np.diag(precision), (len(poses), body.dimension, body.dimension))
        return value, offset * precision, hessian

    def intersection(self, frames: Frames) -> tuple[Array, Array, Array]:
        """Energy, gradient and Hessian of the prior against self-intersection."""
        sigma = self.settings.self_intersection_sigma
        if not np.isfinite(sigma):
            n, d = frames.count, self.body.dimension
            return np.zeros(n), np.zeros((n, d)), np.zeros((n, d, d))
        return self_intersection_energy(self.body, frames, sigma=sigma)

    def _terms(self, observation: Observation, textures: Textures | None) -> Terms:
        s, o = self.settings, observation
        textured = textures is not None and len(textures.counts) > 0
        present = {
            'containment': o.distance is not None,
            'coverage': o.outline is not None and o.outline.pixels.size > 0,
            'edges': o.edges is not None,
            'intensity': o.intensity is not None and textured,
            'motion': o.flow is not None and textured,
        }
        return Terms(
            *(
                Term(t.weight if present[name] else 0.0, t.sigma, t.scale)
                for name in TERMS
                for t in (getattr(s, name),)
            )
        )

    @cached_property
    def _model(self) -> Model:
        body = self.body
        flesh = flesh_table_of(body)
        count = len(flesh.part_segments)
        traced = _selected(self.parts, count)
        textured = np.zeros(len(body.skeleton.parents), dtype=bool)
        textured[flesh.part_segments[traced]] = True
        return Model(
            tree_of(body.skeleton),
            flesh,
            lens_of(self.camera),
            traced,
            _selected(self.occluders, count),
            textured,
            0 if self.parts is None else 2 * len(flesh.ring_parts),
        )


def _selected(parts: Sequence[int] | None, count: int) -> NDArray[np.bool_]:
    result = np.ones(count, dtype=bool)
    if parts is not None:
        result[:] = False
        result[list(parts)] = True
    return result


def _evidence(observation: Observation) -> Evidence:
    o = observation
    outline = o.outline
    none = np.zeros((0, 2))
    return Evidence(
        o.distance or NO_MAP,
        o.edges or NO_MAP,
        o.intensity or NO_MAP,
        o.flow or NO_MAP,
        none if outline is None else outline.pixels,
        none if outline is None else outline.normals,
    )


@lru_cache(maxsize=1)
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(_thread_count(), thread_name_prefix='likelihood')


@lru_cache(maxsize=1)
def _thread_count() -> int:
    return min(len(os.sched_getaffinity(0)), 8)


def _in_threads(work: Callable[[int, int], None], count: int) -> None:
    """Shares poses among threads; each is worked on alone, so the result does not depend on it."""
    threads = min(_thread_count(), count // 4)
    if threads < 2:
        work(0, count)
        return
    ends = [count * i // threads for i in range(threads + 1)]
    jobs = [_pool().submit(work, a, b) for a, b in pairwise(ends[1:])]
    work(0, ends[1])
    for job in jobs:
        job.result()
