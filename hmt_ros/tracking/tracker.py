"""Follows one person through images: starts a track, moves it on, notices when it is lost.

    WAITING or NOBODY  -> (a start)                        ->  TRACKING
    TRACKING           -> (no image says where)            ->  LOST
    LOST               -> (found again)                    ->  TRACKING
    TRACKING or LOST   -> (an image says: nobody is there) ->  NOBODY
    TRACKING or LOST   -> (not seen for an hour)           ->  WAITING, for anybody

The tracker knows images, background, starts and existence; a `MixtureFilter` knows the person and
carries the mixture.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.mirror import relevelled
from hmt_ros.body.pose_terms import FrameTerm
from hmt_ros.experts.lifter import KeypointHistory, lifted_positions, load_lifter
from hmt_ros.image.background import BackgroundModel
from hmt_ros.image.lifted_poses import pooled
from hmt_ros.image.observation import Box, Observation
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference.arrays import Array, Image, Mask
from hmt_ros.inference.error_model import ERRORS, TOGETHER, seconds
from hmt_ros.inference.mixture import GaussianMixture
from hmt_ros.tracking.beginning import (
    FROM_JOINTS,
    FROM_SILHOUETTES,
    Beginning,
    Shown,
    Source,
    first_start,
    poses_to_search,
)
from hmt_ros.tracking.camera_motion import CameraPath, CameraPose
from hmt_ros.tracking.existence import GIVEN, SAME_PERSON, Existence, Status
from hmt_ros.tracking.filter import MixtureFilter
from hmt_ros.tracking.ground import (
    GIVEN_UP_SIGMA,
    Gravity,
    Ground,
    GroundEstimator,
    KnownGround,
    unit_vector,
)
from hmt_ros.tracking.hypotheses import LIKELY, Modes
from hmt_ros.tracking.initialisation import check_box
from hmt_ros.tracking.misfit import KEYPOINTS, SILHOUETTE
from hmt_ros.tracking.observer import Observer
from hmt_ros.tracking.point_estimate import PointEstimate
from hmt_ros.tracking.prediction import Forecaster
from hmt_ros.tracking.proposals import PosePrediction
from hmt_ros.tracking.settings import TrackerSettings
from hmt_ros.tracking.silhouettes import Silhouettes
from hmt_ros.tracking.start_depth import depths_of
from hmt_ros.tracking.subject import Subject
from hmt_ros.tracking.validity import DEPTH, Validity
from hmt_ros.tracking.view import View

# Share of the time for which somebody stands on both feet, where contact is unknown.
RESTING = 0.3


class Tracker:
    """Follows one person through images; the posterior over poses is a mixture.

    Args:
        body: model of the person; a subject's lengths replace the model's when a track starts.
        camera: calibrated.
        settings: of the tracking.
        background: the empty scene; None, or a model that has learned nothing: learned from images
            before the track starts, and if there are none the silhouette is not used.
        seed: of all randomness. The same images, settings and seed give the same numbers.
        extra: further energy terms of the posterior.
        known_ground: gravity and floor, as far as they are known; the rest is estimated.
        shared_background: whether the background is that of several trackers; none learns it.

    Attributes:
        silhouettes: source of the silhouettes of the images.
        ground: the present estimate of gravity and of the floor.
        contacts: probabilities that the feet stand on the floor, by name.
        evaluations: of the likelihood in the last image.
        log_likelihoods: (K,) of the last tracked image at the means of its likelihood mixture, nats
            up to a constant of the image.
        likelihood_errors: how the errors of that likelihood last, which is undiscounted.
        shape_covariance: (d, d) of the errors that poses of all images share, because the lengths
            and the flesh of the person are not known exactly; that likelihood does not hold them.
        track_id: number of the present track, or of the last one; 0 before the first.
        started_from: the input that this track began from; None before the first.
    """

    def __init__(
        self,
        body: Body,
        camera: Camera,
        settings: TrackerSettings | None = None,
        background: BackgroundModel | None = None,
        seed: int = 0,
        extra: Sequence[FrameTerm] = (),
        known_ground: KnownGround | None = None,
        *,
        shared_background: bool = False,
    ) -> None:
        self.settings = settings or TrackerSettings()
        self.model = body
        self.camera = camera
        self.silhouettes = Silhouettes(background or BackgroundModel(), shared=shared_background)
        self._observer = Observer(camera, self.settings, self.silhouettes)
        self.evaluations = 0
        self.log_likelihoods: Array = np.empty(0)
        self.likelihood_errors = ERRORS['image']
        self.shape_covariance: Array = np.zeros((body.dimension, body.dimension))
        self.track_id = 0
        self.started_from: Source | None = None
        self._seed = seed
        # What the track starts from, and where the person is in the next image.
        self._given: Subject | GaussianMixture | None = None
        self._box: Box | None = None
        self._extra = tuple(extra)
        self._ground = GroundEstimator(known_ground)
        self._track = self._new_track(body)
        self._point = PointEstimate()
        self._existence = Existence()
        self._nobody = False
        # Whether the last posterior is no more than a prediction.
        self._foreseen = False
        self._last_stamp: int | None = None
        self._followed: int | None = None
        self._camera_path = CameraPath()
        self._camera_pose: CameraPose | None = None
        self._newer_gravity: KnownGround | None = None
        chosen = self.settings.lifter
        self._lifter = load_lifter(chosen) if chosen else None
        self._seen = KeypointHistory(camera)

    def reset(
        self, start: Subject | GaussianMixture | None = None, *, box: Box | None = None
    ) -> None:
        """Drops the track; a new one starts.

        Args:
            start: a subject, whose track starts at the first image at or after its stamp, or a
                mixture over poses of the present body, or None: the start that was given last. If
                none was given, keypoints, a mask or a prediction start it, whichever comes first.
            box: (left, top, right, bottom) in which the person is in the next image, px; the track
                starts there.

        Raises:
            ValueError: a mixture of another dimension, or a box that is not in the image.
        """
        if isinstance(start, GaussianMixture) and start.dimension != self.body.dimension:
            raise ValueError(
                f'a start for {self.body.name} has {self.body.dimension} dimensions, '
                f'saw {start.dimension}'
            )
        if box is not None:
            check_box(box, self.camera)
        if start is not None:
            self._given = start
        self._box = box
        self._drop_track()
        self._existence, self._nobody = Existence(), False
        self._last_stamp = None
        self._camera_path = CameraPath()
        self._seen = KeypointHistory(self.camera)
        self._ground.forget_scene()

    def step(
        self,
        image: Image,
        stamp: int,
        keypoints: Keypoints | None = None,
        prediction: PosePrediction | None = None,
        mask: Mask | None = None,
        *,
        nobody_predicted: bool = False,
        others: Mask | None = None,
        depth: NDArray[np.floating] | None = None,
    ) -> tuple[GaussianMixture, GaussianMixture] | tuple[None, None]:
        """Takes the next image.

        Args:
            image: (H, W, 3) BGR uint8, of the camera's size.
            stamp: of the image, ns; later than the one before.
            keypoints: joints seen in this image; without any that was seen: the detector saw
                nobody. None: there is no detector, or it has not answered.
            prediction: poses that a regression expects by this image, if any. They start a track
                that has no other start, and no keypoints that suffice, with the lengths that they
                assume, are among the hypotheses of every image, and of a lost track; they are no
                evidence, which would count the image twice.
            mask: (H, W) where a segmenter sees the person, which replaces background subtraction;
                all false: it sees nobody; None: unknown.
            nobody_predicted: whether that regression saw nobody in this image.
            others: (H, W) pixels that somebody else covers or may cover: no evidence for a
                pose or against it; None: there are none.
            depth: (H, W) depth at each pixel, along the axis of the camera, m; 0, NaN and values
                out of range are no evidence. None: unknown.

        Returns:
            The posterior p(x_t | R_t) and the likelihood p(r_t | x_t), undiscounted (see
            `likelihood_errors`), as mixtures over poses, heaviest first with weights that sum to 1;
            (None, None) while there is no track, before the first or because nobody is in view.

        Raises:
            ValueError: an image, mask or depth of another size, a stamp that does not increase, or
                a prediction of a body with other degrees of freedom.
        """
        if prediction is not None:
            prediction.seen_as(self.body)
        self._observer.check_sizes(image, mask, others, depth)
        if self._last_stamp is not None and stamp <= self._last_stamp:
            raise ValueError(f'stamps must increase, saw {stamp} after {self._last_stamp} ns')
        self.evaluations = 0
        self._move_camera(stamp)
        if self.settings.ground.on:
            self._ground.look(image, self.camera, stamp)
            before = self._ground.reversed
            if keypoints is not None:
                self._ground.see(keypoints)
            if before != self._ground.reversed and self._track.begun:
                self._drop_track()
        if not self._track.begun:
            self._stand_upright()
        known = self.silhouettes.scene.known and not self.silhouettes.doubted
        self._ground.still = self._camera_path.known or (known and not self._ground.turning)
        keypoints = self._lifted(keypoints, stamp)
        near, dt = None, 0.0
        if self._followed is not None and not self._track.lost:
            near, dt = self.modes.poses, seconds(stamp - self._followed)
        doubted = self.silhouettes.doubted
        view = self._observer.view(
            image,
            stamp,
            keypoints,
            mask,
            self.body,
            near,
            dt,
            predicted=False if nobody_predicted else True if prediction is not None else None,
            others=others,
            depth=depth,
        )
        if self.silhouettes.doubted > doubted and (
            not self._track.begun or self.started_from in FROM_SILHOUETTES
        ):
            # What was seen was a ghost, as far as anybody knows.
            self._drop_track()
            self._existence, self._nobody = Existence(), False
        found = self._take(view, stamp, prediction, mask)
        self._last_stamp = stamp
        return found

    @property
    def background(self) -> BackgroundModel:
        """The empty scene, as far as it is known."""
        return self.silhouettes.background

    @property
    def status(self) -> Status:
        """State of the tracker."""
        if self._nobody and (self._existence.nobody or self._existence.met is not None):
            return Status.NOBODY
        if not self._track.begun:
            return Status.WAITING
        found = self._existence.somebody and not self._track.lost
        return Status.TRACKING if found else Status.LOST

    @property
    def existence_probability(self) -> float:
        """Probability that a person is in view, given all images so far; see `Existence`.

        NaN: nothing has said anything of that.
        """
        existence = self._existence
        return existence.probability if existence.told or self._track.begun else math.nan

    @property
    def body(self) -> Body:
        """The person, with the present estimate of lengths and flesh."""
        return self._track.limbs.told(self._track.body)

    @property
    def ground(self) -> Ground:
        """Gravity and floor, as far as they are known or estimated."""
        return self._ground.estimate

    @property
    def vertical(self) -> Array | None:
        """(3,) unit vector against gravity, camera frame, as given or as the scene shows it.

        None: it is unknown, at most guessed from the track.
        """
        return self._ground.estimate.up if self._ground.vertical_known else None

    @property
    def gravity_contradicted(self) -> bool:
        """Whether scene or person contradict the gravity that is given; it is used all the same."""
        return self._ground.contradicted

    @property
    def gravity_reversed(self) -> bool:
        """Whether the gravity that is given is the opposite, as an accelerometer measures it."""
        return self._ground.reversed

    def set_gravity(
        self, up: ArrayLike, camera_height: float | None = None, up_sigma: float = GIVEN_UP_SIGMA
    ) -> None:
        """Takes a newer direction against gravity, before the image that it belongs to.

        Args:
            up: (3,) unit vector in the camera frame.
            camera_height: height of the camera above the floor, m; None: as it was known before.
            up_sigma: standard deviation of the direction about each horizontal axis, rad.

        Raises:
            ValueError: it is no unit vector, or the height is not positive.
        """
        self._newer_gravity = KnownGround(unit_vector(up), camera_height, up_sigma)

    def set_camera(self, position: ArrayLike, rotation: ArrayLike) -> None:
        """Takes the pose of the camera, before the image that it belongs to.

        Motion, gravity, floor and contacts are then those of the fixed frame, while the mixture
        stays in the camera frame. An image without a pose is taken to go on with the last motion
        of the camera, for half a second at most.

        Args:
            position: (3,) of the camera in a frame that stands still, m; its axes may be any.
            rotation: (3, 3) from the camera optical frame to that frame.

        Raises:
            ValueError: numbers that are not finite, or no rotation.
        """
        self._camera_pose = CameraPose.of(position, rotation)

    @property
    def contacts(self) -> dict[str, float]:
        """Probability by foot, 'left_foot' and 'right_foot', that the heaviest mode rests on it.

        Empty while it is unknown: there is no track, the body has no feet, the terms of the ground
        are off, or the motion of the camera is unknown. The camera stands still where there is a
        background image, and moves as `set_camera` says.
        """
        return self._track.contacts.by_foot() if self._ground.still else {}

    @property
    def misfit(self) -> float:
        """Share of the last image that no mode explains."""
        return self._track.misfit

    @property
    def validity(self) -> Validity:
        """How far each cue of the images is believed to show the person, and the track."""
        return self._track.validity

    @property
    def modes(self) -> Modes:
        """The present modes, heaviest first.

        Raises:
            ValueError: there is no track.
        """
        return self._track.modes

    @property
    def published(self) -> Modes:
        """The modes of the posterior: limbs that no image shows are as people hold them.

        Raises:
            ValueError: there is no track.
        """
        return self._track.published

    @property
    def point_estimate(self) -> Array:
        """The pose (d,) of the likeliest motion; see `PointEstimate`.

        Raises:
            ValueError: there is no track.
        """
        if self._point.pose is None:
            raise ValueError('there is no track yet')
        return self._point.pose

    @property
    def foreseen(self) -> bool:
        """Whether the last image showed nothing of the person: the posterior is a prediction."""
        return self._foreseen

    @property
    def nobody_shown(self) -> bool:
        """Whether the last image itself has said that nobody is there; a covered lens does not."""
        return self._nobody and self._existence.nobody

    @property
    def reason(self) -> str:
        """What is missing where the state is neither tracking nor nobody; '' where nothing is."""
        status, existence = self.status, self._existence
        if status is Status.WAITING:
            return 'nobody has been seen so far' if existence.told else self.silhouettes.scene.wants
        if status is Status.NOBODY and not self.nobody_shown:
            return 'the image shows neither somebody nor that nobody is there'
        if status is not Status.LOST:
            return ''
        if not existence.somebody:
            return (
                'no image says where the person is, who is in view with a probability of '
                f'{existence.probability:.0%}'
            )
        return f'no mode explains {self.misfit:.0%} of what is seen'

    @property
    def forecaster(self) -> Forecaster:
        """Predicts the track from the last image that it followed.

        Raises:
            ValueError: there is no track.
        """
        assert self._followed is not None
        weights = self.posterior.weights
        return Forecaster(self.published, weights, self.body, self.settings.motion, self._followed)

    @property
    def origins(self) -> Array:
        """Probabilities (K, M) that component k of the posterior continues component m before.

        M is the number of components of the image before, 0 where a track begins or is found again;
        see `LaggedWeights`.

        Raises:
            ValueError: there is no track.
        """
        modes = self.published
        return np.eye(len(modes)) if self._foreseen else modes.origins

    @property
    def velocities(self) -> Array | None:
        """Velocities (K, d) of the present modes, per second; None: unknown.

        They are unknown in the first image of a track, and where poses walk randomly.
        """
        velocities = self.published.velocities
        return velocities if velocities.any() else None

    @property
    def posterior(self) -> GaussianMixture:
        """The present posterior."""
        return self.published.mixture

    def _move_camera(self, stamp: int) -> None:
        """Carries the estimates into the camera frame of the next image; takes newer gravity."""
        pose, self._camera_pose = self._camera_pose, None
        motion = self._camera_path.advance(stamp, pose)
        if motion is not None:
            self._ground.carry(motion)
            self._seen.carry(motion.rotation)
            self._point.carry(self.body, motion)
            if self._track.begun:
                self._track.carry(motion)
        newer, self._newer_gravity = self._newer_gravity, None
        if newer is not None and newer.up is not None:
            self._ground.set_gravity(newer.up, newer.camera_height, newer.up_sigma)
        if pose is not None:
            self.silhouettes.see_from(pose, self.camera)

    def _lifted(self, keypoints: Keypoints | None, stamp: int) -> Keypoints | None:
        """Keypoints with the mixture over whole poses by experts, or by a detector that lifts."""
        if keypoints is None or not keypoints.seen.any():
            return keypoints
        opinions = []
        if self._lifter is not None:
            self._seen.add(keypoints, seconds(stamp))
            person = self._lifter.proportions(self.body) if self._track.begun else None
            opinions.append(self._seen.lift(self._lifter, self.vertical, person))
        if keypoints.positions is not None:
            opinions.append(lifted_positions(self.camera, keypoints))
        said = [one for one in opinions if one is not None]
        return replace(keypoints, lifted=pooled(said)) if said else keypoints

    @property
    def _gravity(self) -> Gravity | None:
        """Gravity for a start; None: it is unknown, or not used."""
        weight, known = self.settings.ground.upright_weight, self._ground.vertical_known
        return Gravity(self._ground.plane, weight) if known and weight > 0 else None

    def _stand_upright(self) -> None:
        """Levels the body by what is known of gravity, before a track starts."""
        before = self._track.body
        body = before.levelled(self._ground.level)
        if body is not before:
            self._track = self._new_track(body)
            if isinstance(self._given, GaussianMixture):
                self._given = relevelled(before, self._given, body)

    def _new_track(self, body: Body) -> MixtureFilter:
        return MixtureFilter(
            body, self.camera, self.settings, self._seed, self._extra, self._ground
        )

    def _drop_track(self, body: Body | None = None) -> None:
        """Keeps nothing but the body, or takes another one."""
        self._track = self._new_track(body or self._track.body)
        self._point = PointEstimate()
        self._ground.reset()
        self._observer.last_image, self._followed = None, None
        self._existence.meet()

    def _take(
        self, view: View, stamp: int, prediction: PosePrediction | None, mask: Mask | None
    ) -> tuple[GaussianMixture, GaussianMixture] | tuple[None, None]:
        """See `step`."""
        masked, existence, self._foreseen = mask is not None, self._existence, False
        if (
            existence.met is not None
            and SAME_PERSON.transition(seconds(stamp - existence.met))[1, 1] < 0.5
        ):
            # Whoever comes now is somebody else, of whom nothing is known.
            self._drop_track(self.model)
            self._nobody, existence.met = True, None
        if self._track.begun:
            existence.look(view, stamp, self.body)
            if existence.nobody:
                self._nobody = True
                self._drop_track()
                return None, None
            if not existence.seen and (existence.hidden or view.silhouette is not None):
                # Nothing is there to fit modes to.
                self._foreseen = True
                return self._expected(stamp), self._likelihood(Observation())
            if existence.elsewhere:
                view = self._observer.seen_anywhere(view, stamp, mask)
            observation = self._observe(view, self.modes.poses[0])
            self._follow(observation, stamp, prediction)
        else:
            begun = self._start_track(view, stamp, prediction, masked=masked)
            if begun is None:
                return None, None
            observation = begun
        if not masked and self._is_told_by_others(view):
            likely = self.modes.log_weights > -LIKELY
            poses = self.modes.poses[likely]
            self.silhouettes.complete(view.image, self.body, self.camera, poses)
        dt = 0.0 if self._followed is None else seconds(stamp - self._followed)
        if self.settings.ground.on:
            resting = min(self.contacts.values(), default=RESTING)
            self._ground.update(self.body, self.modes, resting, dt)
        follows = self.modes.origins.shape[1] > 0
        # The motion takes in one image after another, so each with its own covariance alone.
        found = self.modes.mixture
        found = replace(found, covariances=found.covariances / TOGETHER)
        self._point.update(self.body, self._track.dynamics, found, dt if follows else None)
        self._observer.last_image, self._followed = view.image, stamp
        if self._existence.seen:
            self._existence.learn(view, stamp, self.body, self.camera, self.modes.poses[0])
        self.evaluations = self._track.evaluations
        return self.posterior, self._likelihood(observation)

    def _is_told_by_others(self, view: View) -> bool:
        """Whether something else than silhouettes says where the person of the track is."""
        shown = {KEYPOINTS: view.keypoints is not None, DEPTH: view.depth is not None}
        believed = (shown[cue] and self.validity.believes(cue) for cue in shown)
        return not self._track.lost and any(believed)

    def _likelihood(self, observation: Observation) -> GaussianMixture:
        found = self._track.likelihood(observation)
        self.log_likelihoods, self.likelihood_errors = found.values, found.errors
        self.shape_covariance = found.shape_covariance
        return found.mixture

    def _start_track(
        self, view: View, stamp: int, prediction: PosePrediction | None, *, masked: bool
    ) -> Observation | None:
        """Starts a track, if it starts at this image; returns the observation it started with."""
        # Before the first track a background may still be learned: its silhouettes are no start.
        known = masked or self._nobody
        self._existence.look(
            view if known else view._replace(anywhere=None, silhouette=None),
            stamp,
            self.body,
            waiting=True,
        )
        somebody = self._existence.somebody and self._existence.llr > 0.0
        if self._nobody and self._box is None:
            observation = self._observe(view, None)
            poses = self._poses_to_search(observation, prediction) if somebody else None
            if poses is None:
                return None
            near = replace(
                observation, magnification=self.camera.magnification(float(np.median(poses[:, 2])))
            )
            arrived = Beginning(Source.ARRIVAL, self._track.body, poses)
            self._begin(near, arrived, stamp)
        else:
            shown = Shown(
                view,
                stamp,
                self.model.levelled(self.body.level),
                self._track.body,
                self.camera,
                self._gravity,
                self._given,
                self._box,
                prediction,
                masked,
                lambda: self._observe(view, None),
            )
            beginning = first_start(shown, self._existence)
            if beginning is None:
                if self._given is not None or self._existence.llr <= 0.0:
                    said = self._existence.said.get('detector', 0.0)
                    if masked and view.silhouette is not None:
                        said = 1.0 if view.silhouette.any() else -1.0
                    self.silhouettes.learn(view.image, stamp, said > 0.0 if said else None)
                return None
            if beginning.source in FROM_JOINTS:
                if not masked:
                    self.silhouettes.check(view.image, beginning.body, self.camera, beginning.best)
                if self.silhouettes.doubted:
                    view = view._replace(silhouette=None, anywhere=None, unsure=None)
                pose, depths = beginning.best[0], depths_of(view.depth)
                self._track.check_depths(beginning.body, pose, depths, np.inf)
            observation = self._observe(view, beginning.best[0])
            self._begin(observation, beginning, stamp)
            if not self.validity.believes(SILHOUETTE):
                # The start is where the person is; the silhouette is not.
                observation = self._observe(view, beginning.best[0])
                self._begin(observation, beginning, stamp)
            if not somebody:
                # The start itself says that somebody is there.
                self._existence = Existence(GIVEN)
                pose = self.modes.poses[0]
                self._existence.learn(view, stamp, self.body, self.camera, pose)
                self._existence.look(view, stamp, self.body)
        self.track_id += 1
        self._box, self._nobody = None, False
        return observation

    def _expected(self, stamp: int) -> GaussianMixture:
        """The posterior of a time at which nothing is seen."""
        assert self._followed is not None
        self._point.expect(self.body, self._track.dynamics, seconds(stamp - self._followed))
        return self.forecaster.at(stamp)

    def _begin(self, observation: Observation, beginning: Beginning, stamp: int) -> None:
        """Starts the track."""
        self.started_from = beginning.source
        self._track.begin(beginning.body, beginning.start, observation, beginning.clicked)

    def _follow(
        self, observation: Observation, stamp: int, prediction: PosePrediction | None
    ) -> None:
        """Takes the next image of a track."""
        assert self._followed is not None
        search = self._track.lost or self._existence.elsewhere
        poses = self._poses_to_search(observation, prediction) if search else None
        dt = seconds(stamp - self._followed)
        if poses is None:
            self._track.propagate(observation, dt, prediction)
        else:
            self._track.begin_anew(poses, observation, dt)

    def _poses_to_search(
        self, observation: Observation, prediction: PosePrediction | None
    ) -> Array | None:
        """See `poses_to_search`."""
        return poses_to_search(self.body, self.camera, observation, prediction, self._gravity)

    def _observe(self, view: View, pose: Array | None) -> Observation:
        """The evidence of an image about a person near a pose (d,), if the pose is known."""
        return self._observer.observation(view, pose, self.validity)
