"""Follows one person through images: starts a track, updates it, and detects its loss.

    observe      the image, in the present camera frame                    `View`
    believe      existence of a person, and validity of the cues           `TrackState`
    propagate    the modes to the image, or start or end a track           `MixtureFilter`
    publish      the present estimate                                      `Estimate`

The tracker handles images, background, starts and existence; a `MixtureFilter` stores the body and
the mixture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.camera_pose import CameraPose
from hmt_ros.body.mirror import relevelled
from hmt_ros.body.pose_terms import FrameTerm
from hmt_ros.experts.lifter import KeypointHistory, lifted_positions, load_lifter
from hmt_ros.image.background import BackgroundModel
from hmt_ros.image.image_sequence import SeenImage
from hmt_ros.image.lifted_poses import pooled
from hmt_ros.image.observation import Box, Observation
from hmt_ros.image.sampling import ImageMap
from hmt_ros.image.silhouettes import Silhouettes
from hmt_ros.image.subject import Subject
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference.arrays import Array, Image, Mask
from hmt_ros.inference.error_model import seconds
from hmt_ros.inference.mixture import GaussianMixture
from hmt_ros.tracking.appearance import Appearance
from hmt_ros.tracking.beginning import (
    JOINT_SOURCES,
    SILHOUETTE_SOURCES,
    Shown,
    Source,
    first_start,
    poses_to_search,
)
from hmt_ros.tracking.camera_motion import CameraPath
from hmt_ros.tracking.existence import GIVEN_PROBABILITY, Existence
from hmt_ros.tracking.filter import CueMisfits, MixtureFilter
from hmt_ros.tracking.ground import (
    GroundEstimator,
    KnownGround,
    unit_vector,
)
from hmt_ros.tracking.hypotheses import PosePrediction
from hmt_ros.tracking.initialisation import Start, check_box
from hmt_ros.tracking.landmark_offsets import LandmarkOffsets
from hmt_ros.tracking.laplace_approximation import likelihood_modes
from hmt_ros.tracking.misfit import KEYPOINTS, SILHOUETTE, of_depth_at_best
from hmt_ros.tracking.observer import Observer, View
from hmt_ros.tracking.point_estimate import point_estimate
from hmt_ros.tracking.prediction import Forecaster
from hmt_ros.tracking.settings import GIVEN_UP_SIGMA, LIKELY_NATS, RESTING_SHARE, TrackerSettings
from hmt_ros.tracking.track_state import Estimate, TrackState, no_likelihood
from hmt_ros.tracking.validity import DEPTH, Validity


class Tracker:
    """Follows one person through images; the posterior over poses is a mixture.

    Args:
        body: model of the person; a subject's lengths replace the model's when a track starts.
        camera: the calibrated camera.
        settings: settings of the tracker.
        background: model of the empty scene. If it is None or empty, it is learned from images
            before the track starts; without such images, silhouettes are not used.
        seed: random seed. The same images, settings and seed give the same numbers.
        extra: further energy terms of the posterior.
        known_ground: known values of gravity and floor; unknown values are estimated.
        shared_background: whether several trackers share the background; if so, no tracker learns
            it.

    Attributes:
        model, camera, settings: the arguments; the model does not include a subject's lengths.
        silhouettes: source of the silhouettes of the images.
        track_id: number of the present or last track; 0 before the first track.
        estimate: estimate after the last image.
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
        self.track_id = 0
        self._observer = Observer(camera, self.settings, self.silhouettes)
        self._seed = seed
        self._extra = tuple(extra)
        # Start given by the user, and box of the person in the next image.
        self._given: Subject | GaussianMixture | None = None
        self._box: Box | None = None
        self._started_from: Source | None = None
        self._ground = GroundEstimator(known_ground)
        self._newer_gravity: KnownGround | None = None
        self._camera_path = CameraPath()
        self._camera_pose: CameraPose | None = None
        chosen = self.settings.lifter
        self._lifter = load_lifter(chosen) if chosen else None
        self._seen = KeypointHistory(camera)
        self._landmarks = LandmarkOffsets()
        self._likelihood = no_likelihood(body.dimension)
        self._state = TrackState()
        self._track = self._new_track(body)
        self.estimate = self._estimate()

    def reset(
        self, start: Subject | GaussianMixture | None = None, *, box: Box | None = None
    ) -> None:
        """Drops the track, so that a new track starts.

        Args:
            start: subject, or mixture over poses of the present body. A subject starts the track at
                the first image at or after its timestamp. None repeats the last given start; if
                none was given, the first sufficient keypoints, mask or prediction start a track.
            box: bounding box (left, top, right, bottom) of the person in the next image, px, which
                starts the track.

        Raises:
            ValueError: the mixture does not have the dimension of the body, or the box is outside
                the image.
        """
        body = self._track.body
        if isinstance(start, GaussianMixture) and start.dimension != body.dimension:
            raise ValueError(
                f'a start for {body.name} has {body.dimension} dimensions, saw {start.dimension}'
            )
        if box is not None:
            check_box(box, self.camera)
        if start is not None:
            self._given = start
        self._box = box
        self._drop_track(TrackState())
        self._camera_path = CameraPath()
        self._seen = KeypointHistory(self.camera)
        self._landmarks = LandmarkOffsets()
        self._ground.forget_scene()
        self.estimate = self._estimate()

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
        """Processes the next image.

        Args:
            image: (H, W, 3) BGR uint8, of the camera's size.
            stamp: timestamp of the image, ns; later than the previous timestamp.
            keypoints: joints detected in this image. If none of them is seen, the detector found
                nobody. None: no detector, or no result.
            prediction: poses that a regression predicts from this image, if any. They are
                hypotheses in every image and in the search for a lost track. They also start a
                track, with the lengths that they assume, if there is no other start and the
                keypoints do not suffice. They are not evidence, because the image would then be
                counted twice.
            mask: (H, W) pixels of the person from a segmenter; replaces background subtraction. All
                False if the segmenter found nobody; None: unknown.
            nobody_predicted: whether the regression found nobody in this image.
            others: (H, W) pixels that other people cover or may cover; they are no evidence about
                the pose. None: no such pixels.
            depth: (H, W) depth at each pixel, along the axis of the camera, m; 0, NaN and values
                out of range are ignored. None: unknown.

        Returns:
            The posterior p(x_t | R_t) and the likelihood p(r_t | x_t), undiscounted (see
            `Likelihood.errors`), as mixtures over poses, heaviest component first, with weights
            that sum to 1; (None, None) without a track, that is before the first track or while
            nobody is in view.

        Raises:
            ValueError: an image, mask or depth does not have the camera's size, the timestamp does
                not increase, the keypoints have names of a detector (see `Keypoints.named_for`), or
                the body of the prediction has other degrees of freedom.
        """
        predicted = False if nobody_predicted else True if prediction is not None else None
        given = View(image, stamp, keypoints, prediction, mask, predicted, others, depth)
        self._observer.check(given, self._track.body, self._state.stamp)
        view, observation = self._observe(given), None
        self._update_existence(view)
        if not self._state.begun:
            observation = self._start(view)
        elif self._state.existence.nobody:
            self._drop_track(replace(self._state, ended=True))
        elif not self._state.existence.last.blank:
            observation = self._propagate(view)
        if observation is not None:
            self._learn(view, image_counts=bool(observation.evidence))
        return self._publish(stamp, observation)

    def set_gravity(
        self, up: ArrayLike, camera_height: float | None = None, up_sigma: float = GIVEN_UP_SIGMA
    ) -> None:
        """Sets the direction against gravity for the next image.

        Args:
            up: (3,) unit vector in the camera frame.
            camera_height: height of the camera above the floor, m; None: unchanged.
            up_sigma: standard deviation of the direction about each horizontal axis, rad.

        Raises:
            ValueError: `up` is not a unit vector, or the height is not positive.
        """
        self._newer_gravity = KnownGround(unit_vector(up), camera_height, up_sigma)

    def set_camera(self, position: ArrayLike, rotation: ArrayLike) -> None:
        """Sets the pose of the camera for the next image.

        Motion, gravity, floor and contacts then refer to the fixed frame, while the mixture stays
        in the camera frame. If an image has no pose, the last motion of the camera is extrapolated
        for at most half a second.

        Args:
            position: (3,) position of the camera in a fixed frame with arbitrary axes, m.
            rotation: (3, 3) rotation from the camera optical frame to the fixed frame.

        Raises:
            ValueError: a number is not finite, or `rotation` is not a rotation matrix.
        """
        self._camera_pose = CameraPose.of(position, rotation)

    # Observe.

    def _move_camera(self, stamp: int) -> None:
        """Transforms the estimates to the camera frame of the next image; applies newer gravity."""
        pose, self._camera_pose = self._camera_pose, None
        motion = self._camera_path.advance(stamp, pose)
        if motion is not None:
            self._ground.carry(motion)
            self._seen.carry(motion.rotation)
            if self._state.begun:
                self._track.carry(motion)
        newer, self._newer_gravity = self._newer_gravity, None
        if newer is not None and newer.up is not None:
            self._ground.set_gravity(newer.up, newer.camera_height, newer.up_sigma)
        if pose is not None:
            self.silhouettes.set_camera_pose(pose, self.camera)

    def _observe(self, given: View) -> View:
        """Updates ground and scene from an image, and returns the view of a person in it."""
        ground, silhouettes = self._ground, self.silhouettes
        self._track.spent.clear()
        self._move_camera(given.stamp)
        if self.settings.ground.on:
            ground.update_by_lines(given.image, self.camera, given.stamp)
            upside_down = ground.reversed
            if given.keypoints is not None:
                ground.update_sign_by_keypoints(given.keypoints)
            if upside_down != ground.reversed and self._state.begun:
                self._drop_track(self._state)
        before = self._track.body
        body = before if self._state.begun else before.levelled(ground.level)
        if body is not before:
            # Before a track starts, the body is levelled by the estimated gravity.
            self._track = self._new_track(body)
            if isinstance(self._given, GaussianMixture):
                self._given = relevelled(before, self._given, body)
        known = silhouettes.scene.known and not silhouettes.doubted
        ground.still = self._camera_path.known or (known and not ground.turning)
        limbs = self._track.limbs
        keypoints = limbs.without_guesses(self._track.body, given.keypoints, given.stamp)
        keypoints = self._lifted(self._landmarks.applied(keypoints), given.stamp)
        given = given._replace(keypoints=keypoints, hidden=limbs.hidden)
        found = self._state.begun and not self._state.validity.lost
        near = self._track.modes.poses if found else None
        doubted = silhouettes.doubted
        dt = self._state.age(given.stamp)
        view = self._observer.view(given, self._track.person, near, dt)
        ghost = not self._state.begun or self._started_from in SILHOUETTE_SOURCES
        if silhouettes.doubted > doubted and ghost:
            # The track may have followed a ghost: an error of the background.
            self._drop_track(TrackState(stamp=self._state.stamp))
        return view

    def _lifted(self, keypoints: Keypoints | None, stamp: int) -> Keypoints | None:
        """Returns keypoints with a mixture over whole poses, from experts and a 3D detector."""
        if keypoints is None or not keypoints.seen.any():
            return keypoints
        opinions = []
        if self._lifter is not None:
            self._seen.add(keypoints, seconds(stamp))
            begun = self._state.begun
            person = self._lifter.proportions(self._track.person) if begun else None
            opinions.append(self._seen.lift(self._lifter, self._ground.vertical, person))
        if keypoints.positions is not None:
            opinions.append(lifted_positions(self.camera, keypoints))
        said = [one for one in opinions if one is not None]
        return replace(keypoints, lifted=pooled(said)) if said else keypoints

    # Believe.

    def _update_existence(self, view: View) -> None:
        """Updates the existence of a person; drops the track if the person has probably changed."""
        if self._state.is_somebody_else(view.stamp):
            # Nothing is known about a new person.
            self._landmarks = LandmarkOffsets()
            self._drop_track(replace(self._state, ended=True, last_seen_stamp=None), self.model)
        state = self._state
        if not (state.begun or state.ended or view.mask is not None):
            # The background may still be learning, so its silhouettes cannot start a track.
            view = view._replace(anywhere=None, silhouette=None)
        state.existence.update(view, self._track.person, waiting=not state.begun)

    def _update_validity(self, misfits: CueMisfits, depths: ImageMap | None, dt: float) -> None:
        """Updates the validity of modes and cues from an image, dt s after the previous one."""
        validity, track = self._state.validity, self._track
        validity.update(misfits.by_cue, dt, misfits.alone)
        if depths is not None:
            pose = track.modes.poses[0]
            validity.update_depths(of_depth_at_best(track.body, self.camera, pose, depths), dt)

    # Propagate, start or end.

    def _propagate(self, view: View) -> Observation:
        """Propagates the track; returns the observation, with each cue weighted by its validity."""
        state, track = self._state, self._track
        if state.existence.last.elsewhere:
            view = self._observer.view(view, track.person, None, 0.0)
        observation = self._observer.observation(view, track.modes.poses[0], state.validity)
        poses = None
        if state.validity.lost or state.existence.last.elsewhere:
            poses = self._search(observation, view.prediction)
        dt = state.age(view.stamp)
        state.validity.predict(dt)
        believed = replace(observation, beliefs=state.validity.beliefs)
        if poses is None:
            misfits = track.propagate(believed, dt, view.prediction)
        else:
            state.validity.search()
            misfits, dt = track.restart(poses, observation), np.inf
        self._update_validity(misfits, observation.depths, dt)
        return believed

    def _search(self, observation: Observation, prediction: PosePrediction | None) -> Array | None:
        """Starting poses for a search in the image, or None; see `poses_to_search`."""
        gravity = self._ground.gravity(self.settings.ground.upright_weight)
        return poses_to_search(self._track.person, self.camera, observation, prediction, gravity)

    def _start(self, view: View) -> Observation | None:
        """Starts a track if this image allows it; returns the observation of the start."""
        state, existence = self._state, self._state.existence
        somebody = existence.somebody and existence.last.llr > 0.0
        if state.ended and self._box is None:
            # A person enters the view after another track has ended.
            observation = self._observer.observation(view, None, state.validity)
            poses = self._search(observation, view.prediction) if somebody else None
            if poses is None:
                return None
            magnification = self.camera.magnification(float(np.median(poses[:, 2])))
            near = replace(observation, magnification=magnification)
            self._begin(near, Source.ARRIVAL, Start(self._track.body, poses))
        else:
            begun = self._given_start(view, somebody=somebody)
            if begun is None:
                return None
            observation = begun
        self.track_id += 1
        self._box, state.ended = None, False
        return replace(observation, beliefs=state.validity.beliefs)

    def _given_start(self, view: View, *, somebody: bool) -> Observation | None:
        """Starts a track from the user's start, or from an image with sufficient inputs.

        Args:
            view: view of the image.
            somebody: whether the existence filter reports a person; if not, the start resets it to
                `GIVEN_PROBABILITY`.
        """
        masked, existence, silhouettes = (
            view.mask is not None,
            self._state.existence,
            self.silhouettes,
        )
        shown = Shown(
            view,
            self.model.levelled(self._track.body.level),
            self._track.body,
            self.camera,
            self._ground.gravity(self.settings.ground.upright_weight),
            self._given,
            self._box,
        )
        found = first_start(shown, existence)
        if found is None:
            if self._given is not None or existence.last.llr <= 0.0:
                said = existence.last.log_ratios.get('detector', 0.0)
                if masked and view.silhouette is not None:
                    said = 1.0 if view.silhouette.any() else -1.0
                silhouettes.learn(view.image, view.stamp, said > 0.0 if said else None)
            return None
        source, start = found
        if source in JOINT_SOURCES:
            if not masked:
                silhouettes.check(view.image, start.body, self.camera, start.best)
            if silhouettes.doubted:
                view = view._replace(silhouette=None, anywhere=None, unsure=None)
            if shown.depths is not None:
                share = of_depth_at_best(start.body, self.camera, start.best[0], shown.depths)
                self._state.validity.update_depths(share, np.inf)
        for _ in range(2):
            observation = self._observer.observation(view, start.best[0], self._state.validity)
            self._begin(observation, source, start)
            if self._state.validity.is_trusted(SILHOUETTE):
                break
            # The silhouette contradicts the start. The start is trusted: repeat without silhouette.
        if not somebody:
            self._state.existence = Existence(GIVEN_PROBABILITY)
            self._learn_appearance(view)
            self._state.existence.update(view, self._track.person)
        return observation

    def _begin(self, observation: Observation, source: Source, start: Start) -> None:
        """Starts the modes of a track."""
        self._started_from = source
        self._update_validity(self._track.begin(start, observation), observation.depths, np.inf)

    def _new_track(self, body: Body) -> MixtureFilter:
        return MixtureFilter(
            body, self.camera, self.settings, self._seed, self._extra, self._ground
        )

    def _drop_track(self, state: TrackState, body: Body | None = None) -> None:
        """Drops the track; continues with a given state, and with a new body if given."""
        state.existence.appearance = Appearance()
        self._state = replace(state, validity=Validity(), followed=None)
        self._track = self._new_track(body or self._track.body)
        self._ground.reset()
        self._observer.last_image = None

    # Learn and publish.

    def _learn_appearance(self, view: View) -> None:
        """Learns the appearance of the person from an image."""
        self._state.last_seen_stamp = view.stamp
        self._state.existence.appearance.learn(
            view, view.stamp, self._track.person, self.camera, self._track.modes.poses[0]
        )

    def _learn(self, view: View, *, image_counts: bool) -> None:
        """Updates background, ground, appearance and landmarks from the modes of an image."""
        state, track, modes = self._state, self._track, self._track.modes
        shown = {KEYPOINTS: view.keypoints is not None, DEPTH: view.depth is not None}
        told = any(shown[cue] and state.validity.is_trusted(cue) for cue in shown)
        if view.mask is None and told and not state.validity.lost:
            # A cue other than the silhouette locates the person.
            likely = modes.poses[modes.log_weights > -LIKELY_NATS]
            self.silhouettes.complete(view.image, track.person, self.camera, likely)
        if self.settings.ground.on:
            resting = min(self._ground.by_foot(modes).values(), default=RESTING_SHARE)
            self._ground.update(track.person, modes, resting, state.age(view.stamp))
        age = state.age(view.stamp)
        self._observer.last_image, state.followed = view.image, view.stamp
        if state.existence.last.seen:
            self._learn_appearance(view)
        if view.keypoints is not None and image_counts and not state.validity.lost:
            self._landmarks = self._landmarks.after(
                view.keypoints, track.person, self.camera, modes.poses[0], age
            )

    def _publish(
        self, stamp: int, observation: Observation | None
    ) -> tuple[GaussianMixture, GaussianMixture] | tuple[None, None]:
        """Updates the estimate; returns the result of `step`.

        Args:
            stamp: timestamp of the image, ns.
            observation: observation to which the modes were fitted; None: no fit.
        """
        state, track = self._state, self._track
        before, modes, posterior = state.stamp, track.modes, track.posterior
        state.stamp, foreseen = stamp, state.begun and observation is None
        shown = None
        if observation is not None:
            shown = SeenImage(posterior.likelihood, observation, posterior.known(observation))
        if foreseen:
            observation = Observation()
            # The modes are unchanged.
            modes = replace(modes, origins=np.eye(len(modes)))
        if observation is not None:
            self._likelihood = likelihood_modes(
                modes, posterior, observation, track.shape, (before, self._likelihood)
            )
        self.estimate = self._estimate(shown, foreseen=foreseen)
        if observation is None:
            return None, None
        expected = self.estimate.forecaster.at(stamp) if foreseen else self.estimate.posterior
        return expected, self._likelihood.mixture

    def _estimate(self, shown: SeenImage | None = None, *, foreseen: bool = False) -> Estimate:
        state, track, ground = self._state, self._track, self._ground
        poses = track.modes.mixture
        if foreseen and state.stamp is not None and state.followed is not None:
            forecaster = Forecaster(track.modes, track.person, self.settings.motion, state.followed)
            poses = forecaster.at(state.stamp)
        return Estimate(
            status=state.status,
            reason=state.reason(self.silhouettes.scene.wants, track.misfit),
            existence_probability=state.probability,
            nobody_shown=state.nobody_shown,
            started_from=self._started_from,
            body=track.person,
            modes=track.modes,
            published=track.published,
            point_estimate=point_estimate(track.person, poses),
            likelihood=self._likelihood,
            shown=shown,
            foreseen=foreseen,
            misfit=track.misfit,
            evaluations=sum(track.spent),
            validity=state.validity,
            contacts=ground.by_foot(track.modes),
            ground=ground.estimate,
            vertical=ground.vertical,
            gravity_contradicted=ground.contradicted,
            gravity_reversed=ground.reversed,
            motion=self.settings.motion,
            stamp_ns=state.followed,
        )
