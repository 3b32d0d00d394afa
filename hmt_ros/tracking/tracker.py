"""Follows one person through images: starts a track, moves it on, notices when it is lost.

What moves the mixture on is the `MixtureFilter`; while it is open which way the person faces there
are two of them.
"""

from __future__ import annotations

from dataclasses import replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.image.background import BackgroundModel
from hmt_ros.image.observation import Keypoints, Observation, observe
from hmt_ros.inference.bounded_newton import Minimum
from hmt_ros.inference.mixture import GaussianMixture
from hmt_ros.tracking.candidates import some_minima
from hmt_ros.tracking.facing_trial import DECIDED, faces_like, log_shares
from hmt_ros.tracking.initialisation import (
    poses_from_keypoints,
    poses_from_outline,
    start_from_keypoints,
)
from hmt_ros.tracking.mixture_filter import MixtureFilter
from hmt_ros.tracking.modes import Modes
from hmt_ros.tracking.pose_prediction import PosePrediction
from hmt_ros.tracking.subject import Subject
from hmt_ros.tracking.tracker_settings import TrackerSettings

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

# Keypoints from which a lost track starts anew.
FEWEST_KEYPOINTS = 6
# Around all joints of all modes, as a fraction of their extent: where the silhouette may be.
REGION_MARGIN = 0.3


class Status(Enum):
    """What the tracker is doing."""

    WAITING = 'waiting'  # for the image that the subject's joints were seen in
    TRACKING = 'tracking'
    LOST = 'lost'


class Tracker:
    """Follows one person through images; the posterior over poses is a mixture.

    Args:
        body: model of the person; a subject's lengths replace the model's when a track starts.
        camera: calibrated.
        settings: how.
        background: the empty scene; None: learned from images before the track starts, and if there
            are none the silhouette is not used.
        seed: of all randomness. The same images, settings and seed give the same numbers.
    """

    def __init__(
        self,
        body: Body,
        camera: Camera,
        settings: TrackerSettings | None = None,
        background: BackgroundModel | None = None,
        seed: int = 0,
    ) -> None:
        self.settings = settings or TrackerSettings()
        self.model = body
        self.camera = camera
        self.background = background or BackgroundModel()
        self.evaluations = 0
        self._learning = background is None
        self._seed = seed
        self._start: Subject | GaussianMixture | None = None
        self._filter = self._new_filter(body)
        # Of the other way to face, while it is open which one it is.
        self._other_way: MixtureFilter | None = None
        self._undecided_until = 0
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
        self._filter, self._other_way = self._new_filter(self.body), None
        self._last_image, self._last_stamp = None, None

    def step(
        self,
        image: Image,
        stamp: int,
        keypoints: Keypoints | None = None,
        prediction: PosePrediction | None = None,
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

        Returns:
            The posterior p(x_t | R_t) and the likelihood p(r_t | x_t) as mixtures over poses,
            heaviest first with weights that sum to 1; (None, None) while there is no track.

        Raises:
            ValueError: an image of another size, a stamp that does not increase, or a prediction
                of a body with other degrees of freedom.
        """
        if prediction is not None:
            prediction.seen_as(self.body)
        size = (self.camera.height, self.camera.width)
        if image.shape[:2] != size:
            raise ValueError(f'the camera gives images of {size}, saw {image.shape[:2]}')
        if self._last_stamp is not None and stamp <= self._last_stamp:
            raise ValueError(f'stamps must increase, saw {stamp} after {self._last_stamp} ns')
        for one in self._filters:
            one.evaluations = 0
        if not self._filter.begun:
            start = self._start_at(stamp, prediction)
            if start is None:
                self.evaluations = 0
                if self._learning:
                    self.background.learn(image)
                return None, None
            observation = self._observe(image, keypoints)
            self._begin(observation, start, stamp)
        else:
            observation = self._observe(image, keypoints)
            self._follow(observation, stamp, prediction)
        self._last_image, self._last_stamp = image, stamp
        for one in self._filters:
            one.judge(observation)
        self.evaluations = sum(one.evaluations for one in self._filters)
        if self._other_way is not None:
            self._decide_facing(self._other_way, observation, stamp)
        return self.posterior, self._filter.likelihood_mixture(self.modes, observation)

    @property
    def status(self) -> Status:
        """What the tracker is doing."""
        if not self._filter.begun:
            return Status.WAITING
        return Status.LOST if self._filter.lost else Status.TRACKING

    @property
    def body(self) -> Body:
        """The person, with what has been estimated of lengths and widths."""
        return self._filter.body

    @property
    def misfit(self) -> float:
        """Share of the last image that no mode explains."""
        return self._filter.misfit

    @property
    def modes(self) -> Modes:
        """The present modes; those of both ways to face while that is not decided.

        Raises:
            ValueError: there is no track.
        """
        mine, other = self._filter, self._other_way
        if other is None:
            return mine.modes
        return mine.modes.joined(other.modes, _shares(mine, other), self.settings.max_hypotheses)

    @property
    def posterior(self) -> GaussianMixture:
        """The present posterior."""
        m = self.modes
        return GaussianMixture(np.exp(m.log_weights), m.poses, m.covariances)

    @property
    def _filters(self) -> tuple[MixtureFilter, ...]:
        """One for each way to face that is followed."""
        return (self._filter,) if self._other_way is None else (self._filter, self._other_way)

    def _new_filter(self, body: Body) -> MixtureFilter:
        return MixtureFilter(body, self.camera, self.settings, self._seed)

    # The start of a track.

    def _start_at(
        self, stamp: int, prediction: PosePrediction | None
    ) -> Subject | GaussianMixture | PosePrediction | None:
        """What a track starts from at an image; None: it does not start there."""
        start = self._start
        if start is None:
            return prediction
        return None if isinstance(start, Subject) and stamp < start.stamp_ns else start

    def _begin(
        self,
        observation: Observation,
        start: Subject | GaussianMixture | PosePrediction,
        stamp: int,
    ) -> None:
        body = self.body
        known = not isinstance(start, PosePrediction) or observation.keypoints is not None
        if isinstance(start, Subject):
            begun = start_from_keypoints(self.model, self.camera, start)
            body, poses = begun.body, begun.poses
            observation = replace(observation, keypoints=start.keypoints)
            log_weights = np.zeros(len(poses))
            precisions = np.zeros((len(poses), body.dimension, body.dimension))
        else:
            if isinstance(start, PosePrediction):
                body = start.body
                start = start.both_ways(body)
            poses = start.means
            with np.errstate(divide='ignore'):
                log_weights = np.log(start.normalised().weights)
            precisions = np.asarray(np.linalg.inv(start.covariances), dtype=np.float64)
        solved = self._filter.begin(body, poses, log_weights, precisions, observation)
        if not known:
            self._follow_both_ways(solved, log_weights, observation, stamp)

    def _recover(
        self, observation: Observation, prediction: PosePrediction | None, stamp: int
    ) -> bool:
        """Starts anew from what an image alone shows; False where that is not enough.

        The body keeps its lengths and widths. From keypoints come all poses that explain them, from
        a silhouette mean poses of several headings at its place; what is predicted and the present
        modes stay in the race.
        """
        poses = None
        if observation.keypoints is not None:
            seen = np.isfinite(observation.keypoints.pixels).all(1)
            if seen.sum() >= FEWEST_KEYPOINTS:
                poses = poses_from_keypoints(self.body, self.camera, observation.keypoints)
        if poses is None and observation.outline is not None:
            poses = poses_from_outline(self.body, self.camera, observation.outline)
        if poses is None and prediction is None:
            return False
        found = [poses] if poses is not None else []
        if prediction is not None:
            found.append(prediction.both_ways(self.body).means)
        poses = np.concatenate([self._filter.modes.poses, *found])
        solved = self._filter.begin_anew(poses, observation)
        self._other_way = None
        if observation.keypoints is None:
            self._follow_both_ways(solved, np.zeros(len(poses)), observation, stamp)
        return True

    # Which way the person faces.

    def _follow_both_ways(
        self, solved: Minimum, log_weights: Array, observation: Observation, stamp: int
    ) -> None:
        """Follows those that face like the best, and beside them those that face otherwise."""
        s = self.settings
        if s.facing_trial == 0:
            return
        usable = np.flatnonzero(np.isfinite(solved.value))
        best = usable[np.argmax(log_weights[usable] - s.temperature * solved.value[usable])]
        alike = faces_like(self.body, solved.x, solved.x[best])[usable]
        if alike.all():
            return
        self._other_way = self._filter.twin()
        for one, rows in zip(self._filters, (usable[alike], usable[~alike]), strict=True):
            one.keep_still(some_minima(solved, rows), log_weights[rows], observation)
        self._undecided_until = stamp + round(s.facing_trial * 1e9)

    def _decide_facing(self, other: MixtureFilter, observation: Observation, stamp: int) -> None:
        """Gives one way to face up where the images speak against it.

        When time is over and they do not, both become one mixture.
        """
        mine = self._filter
        ahead = mine.log_evidence - other.log_evidence
        decided = abs(ahead) >= DECIDED or mine.lost != other.lost
        if not decided and stamp < self._undecided_until:
            return
        better, worse = mine, other
        if mine.lost > other.lost or (mine.lost == other.lost and ahead < 0):
            better, worse = other, mine
        if not decided:
            better.join(worse, _shares(better, worse), observation)
        self._filter, self._other_way = better, None

    # One image after another.

    def _follow(
        self, observation: Observation, stamp: int, prediction: PosePrediction | None
    ) -> None:
        """Takes the next image of a track."""
        assert self._last_stamp is not None
        dt = (stamp - self._last_stamp) * 1e-9
        if self._filter.lost and self._recover(observation, prediction, stamp):
            return
        for one in self._filters:
            expected = None if prediction is None else prediction.seen_as(one.body)
            if prediction is not None and self._other_way is not None:
                # Neither is offered the way that the other faces.
                both = prediction.both_ways(one.body)
                own = both[faces_like(one.body, both.means, one.modes.poses[0])]
                expected = own.normalised() if len(own) else None
            one.propagate(observation, dt, expected)

    def _observe(self, image: Image, keypoints: Keypoints | None) -> Observation:
        t = self.settings.likelihood
        shape = t.containment.weight > 0 or t.coverage.weight > 0
        textured = t.intensity.weight > 0 or t.motion.weight > 0
        wanted = [
            name
            for name, needed in (
                ('edges', t.edges.weight > 0),
                ('intensity', textured),
                ('flow', t.motion.weight > 0),
            )
            if needed
        ]
        silhouette = None
        if shape and self.background.frames:
            silhouette = self.background.silhouette(image, self._region())
        return observe(
            image, silhouette, keypoints, self.settings.observation,
            last_image=self._last_image, wanted=wanted,
        )  # fmt: skip

    def _region(self) -> tuple[int, int, int, int] | None:
        """Where the person can be in the next image; None: anywhere."""
        if not self._filter.begun or self._filter.lost:
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


def _shares(a: MixtureFilter, b: MixtureFilter) -> Array:
    """Log probabilities (2,) of the two, as far as images tell."""
    return log_shares([a.log_evidence, b.log_evidence])
