"""Minus the log-likelihood of an image, for a batch of poses (KJS 2).

    E(x) = sum_t E_t(x) + E_keypoints(x) + E_prior(x) + E_intersection(x)

over the image terms t of `terms.registry`. `ImageLikelihood` makes the terms; a `PoseEnergy` sums
selected terms.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, make_dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.kinematics import Frames, tree_of
from hmt_ros.body.pose_prior import (
    LEARNED,
    AnglePrior,
    MixturePrior,
    check_kind,
    pose_prior,
)
from hmt_ros.body.self_intersection import SelfIntersection
from hmt_ros.core import RECORDED, record_residuals
from hmt_ros.image.keypoint_schemes import usual_exchanges
from hmt_ros.image.observation import Observation
from hmt_ros.image.surface import flesh_table_of
from hmt_ros.image.terms.image_term import TermSettings, Weighting
from hmt_ros.image.terms.keypoints import KEYPOINTS, KeypointTerm
from hmt_ros.image.terms.registry import TERMS, Model
from hmt_ros.inference.arrays import Array

OFF = TermSettings(0.0, 1.0, 1.0)

# One field per term of the registry, so that a new term needs no line here.
_ImageTerms: Any = make_dataclass(
    '_ImageTerms',
    [(term.name, TermSettings, field(default=term.settings)) for term in TERMS],
    frozen=True,
)


@dataclass(frozen=True)
class LikelihoodSettings(_ImageTerms):  # type: ignore[misc]
    """The terms of the likelihood and of the prior."""

    keypoints: TermSettings = KEYPOINTS
    prior_weight: float = 0.5
    pose_prior: str = LEARNED
    self_intersection_sigma: float = 0.03

    def __post_init__(self) -> None:
        check_kind(self.pose_prior)

    @classmethod
    def of_terms(cls, **settings: TermSettings) -> LikelihoodSettings:
        """Settings in which image terms and keypoints are switched off unless given."""
        names = [*(term.name for term in TERMS), 'keypoints']
        chosen: dict[str, Any] = {name: settings.get(name, OFF) for name in names}
        return cls(**chosen)


LikelihoodSettings.__doc__ = '\n'.join(
    [
        'The terms of the likelihood and of the prior.',
        '',
        'Attributes:',
        *(f'    {term.name}: {term.meaning}' for term in TERMS),
        '    keypoints: Distance of the joints from the keypoints.',
        '    prior_weight: Factor on the soft prior of the joint angles.',
        '    pose_prior: Soft prior of the joint angles: "learned", from motion capture, where the',
        '        body has one, or "angles", an independent Gaussian for each.',
        '    self_intersection_sigma: Overlap of two body parts that costs an energy of 1/2, m;',
        '        inf switches the term off.',
    ]
)


@dataclass(frozen=True, eq=False)
class ImageLikelihood:
    """Energy of a body's poses, given an image from a camera.

    Attributes:
        body, camera: body of the person, and camera that took the images.
        settings: settings of the terms.
        parts: indices of the parts of the flesh that are compared with the image; None: all.
        occluders: indices of the parts that can hide other parts; None: all.
        threads: number of threads among which the poses are divided; 0: one per core, see
            `in_threads`. Results do not depend on this number.
    """

    body: Body
    camera: Camera
    settings: LikelihoodSettings = field(default_factory=LikelihoodSettings)
    parts: tuple[int, ...] | None = None
    occluders: tuple[int, ...] | None = None
    threads: int = 0

    def seen(
        self,
        observation: Observation,
        exchanges: Array | None = None,
        share: float = 1.0,
        lifted_share: float = 1.0,
    ) -> tuple[ObservedImage | KeypointTerm, ...]:
        """The terms of the image and of the keypoints.

        Args:
            observation: evidence of the image.
            exchanges, share, lifted_share: as for `keypoint_term`.
        """
        image = observed(self, observation)
        if observation.keypoints is None or self.settings.keypoints.weight == 0:
            return (image,)
        return (image, self.keypoint_term(observation, exchanges, share, lifted_share))

    def keypoint_term(
        self,
        observation: Observation,
        exchanges: Array | None,
        share: float = 1.0,
        lifted_share: float = 1.0,
    ) -> KeypointTerm:
        """The keypoint term of an observation, which must have keypoints.

        Args:
            exchanges: log probabilities of exchanges of sides, see `KeypointTerm`; None:
                `usual_exchanges`.
            share: factor on the energy, but not on the prior of the exchanges.
            lifted_share: factor on the energy of lifted poses.
        """
        if exchanges is None and share == 1.0:
            return usual_keypoints(self, observation, lifted_share)
        assert observation.keypoints is not None
        s, beliefs = self.settings.keypoints, observation.beliefs
        return KeypointTerm(
            self.body.skeleton,
            self.camera,
            observation.keypoints,
            s if share == 1.0 else replace(s, weight=share * s.weight),
            observation.magnification,
            usual_exchanges() if exchanges is None else exchanges,
            None if beliefs is None else beliefs.keypoints,
            lifted_share,
            observation.factors('keypoints'),
        )

    @cached_property
    def priors(self) -> tuple[AnglePrior | MixturePrior | SelfIntersection, ...]:
        """The terms independent of images: prior of joint angles, and self-intersection."""
        s = self.settings
        if not np.isfinite(s.self_intersection_sigma):
            return (self.pose_prior,)
        return (self.pose_prior, SelfIntersection(self.body, s.self_intersection_sigma))

    @cached_property
    def pose_prior(self) -> AnglePrior | MixturePrior:
        """The prior of the joint angles."""
        s = self.settings
        return pose_prior(self.body, s.pose_prior, s.prior_weight)

    def recorded(self, frames: Frames, observation: Observation) -> Array:
        """The residuals of the image terms at N poses, given as frames.

        Returns:
            (N, 1 + M, RECORDED): the first number of row 0 is m; rows 1 to m are points and
            derivatives of the residuals.
        """
        n = frames.count
        image = observed(self, observation)
        outline = observation.outline
        samples = 0 if outline is None else len(outline.pixels)
        most = 1 + 6 * len(self.model.flesh.ring_parts) + 2 * samples
        result = np.zeros((n, most, RECORDED))
        if image.compiled['image']:
            record_residuals(self.model, image.compiled['inputs'], *frames.by_pose(), result)
        return result

    @cached_property
    def model(self) -> Model:
        """Body and camera, as inputs of the compiled core."""
        body = self.body
        flesh = flesh_table_of(body)
        count = len(flesh.part_segments)
        return Model(
            tree_of(body.skeleton),
            flesh,
            self.camera.lens,
            _selected(self.parts, count),
            _selected(self.occluders, count),
            0 if self.parts is None else 2 * len(flesh.ring_parts),
        )


@dataclass(frozen=True, eq=False)
class ObservedImage:
    """The image terms of an observation.

    Attributes:
        likelihood: likelihood that made the terms.
        observation: evidence of the image.
        explained: (N, M) or (1, M) maximum energy of each outline sample, for samples that
            something else may explain; None: unlimited.
    """

    likelihood: ImageLikelihood
    observation: Observation
    explained: Array | None = None

    @cached_property
    def compiled(self) -> dict[str, Any]:
        """The terms as inputs of compiled code: fields of `pose_energy.Compiled`."""
        found = _inputs(self.likelihood.settings, self.observation)
        if self.explained is not None:
            found = found | {
                'inputs': tuple(
                    x._replace(explained=self.explained) if hasattr(x, 'explained') else x
                    for x in found['inputs']
                )
            }
        return found | {'model': self.likelihood.model}


# Cached, because an image is compared with many sets of poses and with parts of the body.
@lru_cache(maxsize=4)
def _inputs(settings: LikelihoodSettings, observation: Observation) -> dict[str, Any]:
    """The inputs of all image terms, whether any term is on, and whether any needs the contour."""
    beliefs, result = observation.beliefs, []
    for term in TERMS:
        s: TermSettings = getattr(settings, term.name)
        evidence = observation.evidence.get(term.name)
        weight = 0.0 if evidence is None else float(s.weight)
        if beliefs is not None:
            weight *= beliefs.of_term(term.name)
        weighting = Weighting(
            weight,
            float(s.sigma),
            float(s.scale),
            float(observation.magnification),
            float(s.growth),
            observation.factors(term.name),
        )
        result.append(term.inputs(weighting, evidence))
    running = [term for term, one in zip(TERMS, result, strict=True) if one.term.weight > 0]
    contour = any(term.needs_contour for term in running)
    return {'inputs': tuple(result), 'image': bool(running), 'contour': contour}


@lru_cache(maxsize=4)
def usual_keypoints(
    likelihood: ImageLikelihood, observation: Observation, lifted_share: float
) -> KeypointTerm:
    """The keypoint term with the usual probabilities of exchanges; the result is cached."""
    return likelihood.keypoint_term(observation, usual_exchanges(), 1.0, lifted_share)


@lru_cache(maxsize=4)
def observed(likelihood: ImageLikelihood, observation: Observation) -> ObservedImage:
    """The image terms of an observation; the result is cached."""
    return ObservedImage(likelihood, observation)


def _selected(parts: Sequence[int] | None, count: int) -> NDArray[np.bool_]:
    result = np.ones(count, dtype=bool)
    if parts is not None:
        result[:] = False
        result[list(parts)] = True
    return result
