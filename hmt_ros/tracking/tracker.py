"""Follows one person through images: starts a track, moves it on, notices when it is lost.

    WAITING -> (a start) -> TRACKING -> (unexplained images) -> LOST -> (started anew) -> TRACKING

The tracker knows images, background and starts; the `Track` knows the person, its filters carry the
mixture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from enum import Enum
from typing import NamedTuple

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.pose_terms import FrameTerm
from hmt_ros.image.background import BackgroundModel
from hmt_ros.image.observation import Box, Observation, observe
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.image.terms.registry import TERMS
from hmt_ros.inference.arrays import Array, Image, Mask
from hmt_ros.inference.mixture import GaussianMixture
from hmt_ros.tracking.facing import Track
from hmt_ros.tracking.hypotheses import Modes
from hmt_ros.tracking.initialisation import (
    poses_from_keypoints,
    poses_from_outline,
    start_from_keypoints,
)
from hmt_ros.tracking.point_estimate import PointEstimate
from hmt_ros.tracking.proposals import PosePrediction
from hmt_ros.tracking.settings import TrackerSettings
from hmt_ros.tracking.silhouettes import Silhouettes
from hmt_ros.tracking.subject import Subject

# Fewest keypoints from which a lost track starts anew.
FEWEST_KEYPOINTS = 6
# The person may be where modes say that have at least this log weight, nats; the sign is changed.
LIKELY = 4.0
# Margin around all joints of all modes, as a fraction of their extent: where the silhouette may be.
REGION_MARGIN = 0.3


class Status(Enum):
    """What the tracker is doing."""

    WAITING = 'waiting'  # for the image that the subject's joints were seen in
    TRACKING = 'tracking'
    LOST = 'lost'


class _Beginning(NamedTuple):
    """What `Track.begin` is given of a start; see there."""

    body: Body
    start: GaussianMixture | Array
    both_ways: bool
    clicked: Keypoints | None = None

    @property
    def best(self) -> Array:
        """The most probable pose (1, d)."""
        if isinstance(self.start, GaussianMixture):
            return self.start.means[[int(np.argmax(self.start.weights))]]
        return self.start[:1]


class Tracker:
    """Follows one person through images; the posterior over poses is a mixture.

    Args:
        body: model of the person; a subject's lengths replace the model's when a track starts.
        camera: calibrated.
        settings: how.
        background: the empty scene; None, or a model that has learned nothing: learned from images
            before the track starts, and if there are none the silhouette is not used.
        seed: of all randomness. The same images, settings and seed give the same numbers.
        extra: further energy terms of the posterior, such as what is known of the floor.

    Attributes:
        silhouettes: where those of the images come from.
    """

    def __init__(
        self,
        body: Body,
        camera: Camera,
        settings: TrackerSettings | None = None,
        background: BackgroundModel | None = None,
        seed: int = 0,
        extra: Sequence[FrameTerm] = (),
    ) -> None:
        self.settings = settings or TrackerSettings()
        self.model = body
        self.camera = camera
        self.silhouettes = Silhouettes(background or BackgroundModel())
        self.evaluations = 0
        self._seed = seed
        self._start: Subject | GaussianMixture | None = None
        self._extra = tuple(extra)
        self._track = self._new_track(body)
        self._point = PointEstimate()
        self._last_image: Image | None = None
        self._last_stamp: int | None = None

    def reset(self, start: Subject | GaussianMixture | None = None) -> None:
        """Drops the track; the next image starts a new one.

        Args:
            start: a subject, whose track starts at the first image at or after its stamp, or a
                mixture over poses of the present body, or None: the start that was given last.
        """
        if isinstance(start, GaussianMixture) and start.dimension != self.body.dimension:
            raise ValueError(
                f'a start for {self.body.name} has {self.body.dimension} dimensions, '
                f'saw {start.dimension}'
            )
        if start is not None:
            self._start = start
        self._track = self._new_track(self.body)
        self._point = PointEstimate()
        self._last_image, self._last_stamp = None, None

    def step(
        self,
        image: Image,
        stamp: int,
        keypoints: Keypoints | None = None,
        prediction: PosePrediction | None = None,
        mask: Mask | None = None,
    ) -> tuple[GaussianMixture, GaussianMixture] | tuple[None, None]:
        """Takes the next image.

        Args:
            image: (H, W, 3) BGR uint8, of the camera's size.
            stamp: of the image, ns; later than the one before.
            keypoints: joints seen in this image, if any.
            prediction: poses that a regression expects by this image, if any. They start a track
                that has no other start, with the lengths that they assume, are among the hypotheses
                of every image, and of a lost track; they are no evidence, which would count the
                image twice.
            mask: (H, W) where a segmenter sees the person, which replaces background subtraction;
                all false: it sees nobody; None: unknown.

        Returns:
            The posterior p(x_t | R_t) and the likelihood p(r_t | x_t) as mixtures over poses,
            heaviest first with weights that sum to 1; (None, None) while there is no track.

        Raises:
            ValueError: an image or a mask of another size, a stamp that does not increase, or a
                prediction of a body with other degrees of freedom.
        """
        if prediction is not None:
            prediction.seen_as(self.body)
        size = (self.camera.height, self.camera.width)
        if image.shape[:2] != size:
            raise ValueError(f'the camera gives images of {size}, saw {image.shape[:2]}')
        if mask is not None and mask.shape != size:
            raise ValueError(f'the camera gives images of {size}, saw a mask of {mask.shape}')
        if self._last_stamp is not None and stamp <= self._last_stamp:
            raise ValueError(f'stamps must increase, saw {stamp} after {self._last_stamp} ns')
        if self._track.begun:
            observation = self._observe(image, keypoints, mask)
            self._follow(observation, stamp, prediction)
        else:
            start = self._start_at(stamp, prediction)
            if start is None:
                self.evaluations = 0
                self.silhouettes.learn(image, mask)
                return None, None
            beginning = self._beginning(start, keypoints)
            if mask is None:
                self.silhouettes.check(image, beginning.body, self.camera, beginning.best)
            observation = self._observe(image, keypoints, mask)
            self._begin(observation, beginning, stamp)
            if not self._track.believes_silhouettes:
                # The start is where the person is; the silhouette is not.
                observation = self._observe(image, keypoints, mask)
                self._begin(observation, beginning, stamp)
        if mask is None:
            likely = self.modes.log_weights > -LIKELY
            self.silhouettes.complete(image, self.body, self.camera, self.modes.poses[likely])
        dt = 0.0 if self._last_stamp is None else (stamp - self._last_stamp) * 1e-9
        modes = self._track.modes
        self._point.update(self.body, modes.poses, np.exp(modes.log_weights), dt)
        self._last_image, self._last_stamp = image, stamp
        self.evaluations = self._track.evaluations
        return self.posterior, self._track.likelihood_mixture(observation)

    @property
    def background(self) -> BackgroundModel:
        """The empty scene, as far as it is known."""
        return self.silhouettes.background

    @property
    def status(self) -> Status:
        """What the tracker is doing."""
        if not self._track.begun:
            return Status.WAITING
        return Status.LOST if self._track.lost else Status.TRACKING

    @property
    def body(self) -> Body:
        """The person, with what has been estimated of lengths and widths."""
        return self._track.body

    @property
    def misfit(self) -> float:
        """Share of the last image that no mode explains."""
        return self._track.misfit

    @property
    def modes(self) -> Modes:
        """The present modes, heaviest first.

        Raises:
            ValueError: there is no track.
        """
        return self._track.modes

    @property
    def point_estimate(self) -> Array:
        """One pose (d,) for those who want one, steady over time; see `PointEstimate`.

        Raises:
            ValueError: there is no track.
        """
        if self._point.pose is None:
            raise ValueError('there is no track yet')
        return self._point.pose

    @property
    def posterior(self) -> GaussianMixture:
        """The present posterior."""
        return self.modes.mixture(1.0 - self.settings.error_correlation)

    def _new_track(self, body: Body) -> Track:
        return Track(body, self.camera, self.settings, self._seed, self._extra)

    def _start_at(
        self, stamp: int, prediction: PosePrediction | None
    ) -> Subject | GaussianMixture | PosePrediction | None:
        """What a track starts from at an image; None: it does not start there."""
        start = self._start
        if start is None:
            return prediction
        return None if isinstance(start, Subject) and stamp < start.stamp_ns else start

    def _beginning(
        self, start: Subject | GaussianMixture | PosePrediction, keypoints: Keypoints | None
    ) -> _Beginning:
        """The body and the poses that a track begins with."""
        if isinstance(start, Subject):
            begun = start_from_keypoints(self.model, self.camera, start)
            return _Beginning(begun.body, begun.poses, both_ways=False, clicked=start.keypoints)
        if isinstance(start, PosePrediction):
            poses = start.both_ways(start.body)
            return _Beginning(start.body, poses, both_ways=keypoints is None)
        return _Beginning(self.body, start, both_ways=False)

    def _begin(self, observation: Observation, beginning: _Beginning, stamp: int) -> None:
        """Starts the track."""
        body, start, both_ways, clicked = beginning
        self._track.begin(body, start, observation, stamp, both_ways=both_ways, clicked=clicked)

    def _follow(
        self, observation: Observation, stamp: int, prediction: PosePrediction | None
    ) -> None:
        """Takes the next image of a track."""
        assert self._last_stamp is not None
        poses = self._poses_to_search(observation, prediction) if self._track.lost else None
        if poses is None:
            dt = (stamp - self._last_stamp) * 1e-9
            self._track.propagate(observation, stamp, dt, prediction)
        else:
            both_ways = observation.keypoints is None
            self._track.begin_anew(poses, observation, stamp, both_ways=both_ways)

    def _poses_to_search(
        self, observation: Observation, prediction: PosePrediction | None
    ) -> Array | None:
        """Poses (N, d) that a lost track starts anew from, by an image alone; None: it shows none.

        The body keeps its lengths and widths. From keypoints come all poses that explain them, from
        a silhouette mean poses of several headings at its place, and what was predicted.
        """
        found = []
        keypoints = observation.keypoints
        if keypoints is not None and np.isfinite(keypoints.pixels).all(1).sum() >= FEWEST_KEYPOINTS:
            found.append(poses_from_keypoints(self.body, self.camera, keypoints))
        elif observation.outline is not None:
            found.append(poses_from_outline(self.body, self.camera, observation.outline))
        if prediction is not None:
            found.append(prediction.both_ways(self.body).means)
        return np.concatenate(found) if found else None

    def _observe(self, image: Image, keypoints: Keypoints | None, mask: Mask | None) -> Observation:
        t = self.settings.likelihood
        shape = t.containment.weight > 0 or t.coverage.weight > 0
        textured = any(getattr(t, term.name).weight > 0 for term in TERMS if term.needs_texture)
        wanted = {'containment', 'coverage'}
        wanted |= {term.name for term in TERMS if getattr(t, term.name).weight > 0}
        wanted |= {'intensity'} if textured else set()  # the textures hold it
        silhouette = None
        if shape:
            silhouette = self.silhouettes.silhouette(image, mask, self._region())
        foreground, unsure = (None, None) if silhouette is None else silhouette
        believed = foreground if self._track.believes_silhouettes else None
        found = observe(
            image, believed, keypoints,
            last_image=self._last_image, wanted=wanted, unsure=unsure,
        )  # fmt: skip
        return replace(found, foreground=foreground)

    def _region(self) -> Box | None:
        """Where the person can be in the next image; None: anywhere."""
        if not self._track.begun or self._track.lost:
            return None
        pixels = self.camera.project(self.body.joint_positions(self.modes.poses)).reshape(-1, 2)
        pixels = pixels[np.isfinite(pixels).all(1)]
        if len(pixels) == 0:
            return None
        low, high = pixels.min(0), pixels.max(0)
        margin = REGION_MARGIN * max(float((high - low).max()), 1.0)
        size = (self.camera.width, self.camera.height)
        left, top = (int(x) for x in np.clip(np.floor(low - margin), 0, size))
        right, bottom = (int(x) for x in np.clip(np.ceil(high + margin), 0, size))
        if right - left < 2 or bottom - top < 2:
            return None
        return left, top, right, bottom
