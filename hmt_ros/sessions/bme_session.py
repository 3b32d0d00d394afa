"""Session of the pose predictor: images or keypoints in, mixtures over poses out.

The rules, in addition to those of `CameraSession`:

- Every usable image gets one prediction. A prediction without components means that nobody was
  seen (the silhouette is not tall enough) or, if `reason` is set, that the background is
  unknown because the scene has not been seen empty.
- With `use_mask` the mask of an image is used as silhouette; the background is not learned from an
  image whose mask shows somebody.
- With `tracked_interval` the session subscribes to the track of the filter (`pose_mixture`). While
  the person is tracked, images within `tracked_interval` after the last prediction are not
  evaluated. Instead, messages with the state of the track and without components are published,
  so that subscribers do not wait. Such a message does not mean that nobody was seen.
- The result of background subtraction is published as the silhouette of every image, evaluated or
  not, if somebody subscribes. It is empty while the background is being learned. With `use_mask`
  no silhouette is published.
- With `propagation` a prediction depends on the previous one, unless the latter is older than
  `MAX_INTERVAL`, belongs to another calibration, or precedes a jump in time.
- With `predict_from` 'keypoints' every message of keypoints gets one prediction, from the keypoints
  of the last second (`experts.lifter`); images are not used. It has no components if fewer than
  five landmarks are seen. With 'both' an image waits for the keypoints of exactly its stamp, for
  keypoints of a later stamp, or for an image that is `input_timeout` younger; its silhouette is
  used if the keypoints show nobody. (The product of both predictions is no more accurate than the
  one from keypoints.)
"""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body import Camera
from hmt_ros.body.camera import roll
from hmt_ros.experts.descriptor.contour import NoSilhouetteError
from hmt_ros.experts.lifted_fit import KeypointPredictor
from hmt_ros.experts.pose_predictor import (
    BY_EXPERTS,
    SHIPPED,
    STEP,
    WITHOUT_PROPAGATION,
    PosePredictor,
    Prediction,
    load_predictor,
)
from hmt_ros.experts.root_placement import SIZE_SPREAD
from hmt_ros.image.background import BackgroundModel, BackgroundSettings, one_person
from hmt_ros.image.empty_scene import EmptyScene
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.arrays import Mask
from hmt_ros.sessions.bme_parameters import (
    FROM_BOTH,
    FROM_KEYPOINTS,
    FROM_SILHOUETTES,
    BmeParameters,
)
from hmt_ros.sessions.camera_frames import unit_vector
from hmt_ros.sessions.camera_session import (
    CAMERA_INFO,
    FRAME_ID,
    CameraSession,
    CameraState,
    WaitingImage,
    check_size,
    read_picture,
)
from hmt_ros.sessions.image_inputs import KEYPOINTS, MASK_INPUT, PREDICTION, ImageInput
from hmt_ros.sessions.keypoint_inputs import KeypointReader, keypoints_input, known_lifter
from hmt_ros.sessions.named_file import named_file
from hmt_ros.sessions.session import (
    NeededInput,
    PublishedTopic,
)
from msg_tools.files.error_line import error_line
from msg_tools.messages.headers import SECOND_NS, time_ns
from msg_tools.messages.images import image_message
from msg_tools.messages.pose_mixtures import (
    MixtureKind,
    PoseMixture,
    TrackState,
    pose_mixture_message,
)

TRACK, SILHOUETTE = 'pose_mixture', 'silhouette'
TOPICS = {PREDICTION: PublishedTopic('hmt_msgs/msg/PoseMixture')}
# Silhouettes are too large for bags.
_TOPICS_OF_NODE = {**TOPICS, SILHOUETTE: PublishedTopic('sensor_msgs/msg/Image')}


# Minimum height of the silhouette of a person, px.
MIN_HEIGHT = 40
# Maximum age of the previous prediction for propagation, s.
MAX_INTERVAL = 0.5
# Maximum time between an image and the track message that is applied to it, ns.
_TRACKED_TIME_NS = SECOND_NS
# Relative standard deviation of the size of a person whose stature is known.
_MEASURED_SPREAD = 0.02


@dataclass(frozen=True)
class BmeState(CameraState):
    """State of the predictor: its status is 'no camera', 'learning', 'nobody' or 'predicting'.

    Keys of `counts`: 'predicted' (evaluated images), 'empty' (evaluated images without a person),
    'left' (images that were not evaluated because the person was tracked).

    Attributes:
        modes: number of components of the last prediction.
        height: height of the last silhouette, px.
        support: similarity of the silhouette to the training silhouettes, 0 to 1.
    """

    modes: int = 0
    height: int = 0
    support: float = math.nan

    def summary(self) -> str:
        """The present estimate in a few words."""
        return f'{self.modes} modes'

    def values(self) -> list[tuple[str, str]]:
        """Keys and values of the diagnostics."""
        return [
            ('images without a person', str(self.counts['empty'])),
            ('images left to the track', str(self.counts['left'])),
            ('modes', str(self.modes)),
            ('entropy of the weights, nats', f'{self.entropy:.3f}'),
            ('height of the silhouette, px', str(self.height)),
            ('support', f'{self.support:.3f}'),
        ]


class BmeSession(CameraSession[BmeParameters, BmeState]):
    """Predicts the poses in the images of one camera; see `Session` for arguments and attributes.

    `predict_once` is thread-safe.
    """

    TOPICS = _TOPICS_OF_NODE
    DONE = 'predicted'
    ESTIMATE = 'the sequence'
    CHECKED = ('model_file', 'background_file', 'stature', 'lifter')

    def _set_up(self) -> None:
        super()._set_up()
        p = self.parameters
        self._predictor, self._size_spread = _predictor_of(p)
        file = p.background_file
        self._scene = EmptyScene(
            BackgroundModel.from_image(read_picture(file)) if file else BackgroundModel()
        )
        # OpenCV's background model has an internal buffer, so only one thread may use it at a time.
        self._background_in_use = threading.Lock()
        self._height, self._support, self._reason = 0, math.nan, ''
        # Whether the last prediction was made without a background.
        self._without_background = p.predict_from == FROM_KEYPOINTS
        self._lifter = None if p.predict_from == FROM_SILHOUETTES else known_lifter(p.lifter)
        self._cue = p.predict_from
        self._keypoints = KeypointReader(p.source, self._log)
        self.restart()

    def restart(self) -> None:
        """See `Session`."""
        # Last prediction and its stamp, ns. A restart keeps the background.
        self._previous: tuple[GaussianMixture, int] | None = None
        # Stamps of the last evaluated image, and of the last message with a tracked person, ns.
        self._looked: int | None = None
        self._tracked: int | None = None
        self._by_keypoints: KeypointPredictor | None = None
        self._weights = np.empty(0)
        super().restart()

    @classmethod
    def inputs_of(cls, parameters: BmeParameters) -> tuple[ImageInput, ...]:
        """See `CameraSession`."""
        cue, own = parameters.predict_from, keypoints_input(parameters.source)
        own = replace(own, parameter='', together=True)
        if cue == FROM_KEYPOINTS:
            return (own,)
        return (MASK_INPUT,) if cue == FROM_SILHOUETTES else (own, MASK_INPUT)

    def needed_inputs(self) -> list[NeededInput]:
        """See `Session`."""
        needed = super().needed_inputs()
        if self._cue != FROM_KEYPOINTS:
            return needed
        own = NeededInput(tuple(self.rows[0].types))
        return [own, *(x for x in needed if x.sources == (CAMERA_INFO,))]

    def _is_counted(self, source: str) -> bool:
        if self._cue != FROM_KEYPOINTS:
            return super()._is_counted(source)
        return source in self.rows[0].types

    def _jump_back(self, first: int, last: int) -> None:
        super()._jump_back(first, last)
        self._keypoints.chosen.forget()

    def _read_input(self, row: ImageInput, message: Any, stamp: int) -> Any:
        if row.name != KEYPOINTS:
            return super()._read_input(row, message, stamp)
        return self._keypoints.read(
            message, stamp, self.parameters, self._predictor.body, self._camera
        )

    def _take(self, source: str, message: Any, stamp: int) -> None:
        row = self._inputs.row(source)
        if row is not None and self._cue == FROM_KEYPOINTS:
            self._take_keypoints(row, message, stamp)
        elif source != TRACK:
            super()._take(source, message, stamp)
        elif self._tracked is None or not 0 <= self._tracked - stamp <= _TRACKED_TIME_NS:
            tracked = message.state == TrackState.TRACKING and len(message.components)
            self._tracked = stamp if tracked else None

    def _take_keypoints(self, row: ImageInput, message: Any, stamp: int) -> None:
        """Predicts from the keypoints of the last second, without an image."""
        camera = self._camera
        if camera is None:
            self._log.skip(
                'camera_info',
                f'keypoints of {stamp} ns are not used: no calibrated camera_info has come',
            )
            return
        self._newest = stamp
        try:
            self._inputs[KEYPOINTS].put(stamp, self._read_input(row, message, stamp))
            mixture = self._lifted(stamp, camera)
        except (ValueError, ArithmeticError) as error:
            text = f'no prediction from the keypoints of {stamp} ns: {error_line(error)}'
            self._log.skip('keypoints', text)
            return
        self._report_handled(mixture, stamp, self._frame_id or self._frame or FRAME_ID)

    def _lifted(self, stamp: int, camera: Camera) -> GaussianMixture | None:
        """Return the prediction from keypoints; None if they show nobody at the stamp."""
        assert self._lifter is not None
        made = self._by_keypoints
        if made is None:
            made = self._by_keypoints = KeypointPredictor(
                self._lifter,
                self._predictor.body,
                camera,
                size_known=self.parameters.stature > 0,
            )
        taken = self._inputs[KEYPOINTS].take_all(stamp)
        for each, keypoints in taken.items():
            # Keypoints may arrive out of order.
            if keypoints is not None and each / SECOND_NS > made.newest:
                known, _ = keypoints.named_for(
                    self._predictor.body, self.parameters.keypoint_scheme
                )
                made.add(known, each / SECOND_NS)
        gravity = self.parameters.gravity
        up = -unit_vector(gravity, 'gravity') if gravity else None
        found = made.predict(up) if taken.get(stamp) is not None else None
        return None if found is None else found[: self.parameters.max_hypotheses].normalised()

    def _take_image(self, message: Any, stamp: int) -> None:
        if self._cue == FROM_KEYPOINTS:
            return
        in_turn = not self._waiting and self._newest is not None and stamp > self._newest
        if not in_turn or not self._is_tracked(stamp) or self._wanted(SILHOUETTE):
            super()._take_image(message, stamp)
            return
        # The image of a tracked person is neither decoded nor evaluated.
        self._newest = stamp
        self._skip_prediction(stamp, str(message.header.frame_id) or self._frame or FRAME_ID)

    def _is_tracked(self, stamp: int) -> bool:
        """Whether an image needs no prediction because the person is tracked."""
        interval = self.parameters.tracked_interval * SECOND_NS
        if self._looked is None or self._tracked is None:
            return False
        return stamp < self._looked + interval and abs(stamp - self._tracked) <= _TRACKED_TIME_NS

    def _skip_prediction(self, stamp: int, frame_id: str) -> None:
        self._log.counts['left'] += 1
        if self._wanted(PREDICTION):
            made = self._message(None, stamp, frame_id, TrackState.TRACKING)
            self._publish(PREDICTION, stamp, made)

    def _estimate(self, waiting: WaitingImage, camera: Camera) -> None:
        if self._is_tracked(waiting.stamp_ns):
            self._publish_silhouette(waiting)
            self._skip_prediction(waiting.stamp_ns, waiting.frame_id)
            return
        self._looked, self._reason = waiting.stamp_ns, ''
        try:
            mixture = self._mixture_of(waiting, camera)
        except (ValueError, ArithmeticError) as error:
            text = f'no prediction from the image of {waiting.stamp_ns} ns: {error_line(error)}'
            self._log.skip('estimate', text)
            self._previous = None
            return
        if mixture is not None:
            self._previous = mixture, waiting.stamp_ns
        self._report_handled(mixture, waiting.stamp_ns, waiting.frame_id)

    def _report_handled(self, mixture: GaussianMixture | None, stamp: int, frame_id: str) -> None:
        """Counts and publishes a prediction; None means that nobody is seen."""
        self._log.counts['predicted'] += 1
        if mixture is None:
            self._log.counts['empty'] += 1
        self._weights = np.empty(0) if mixture is None else mixture.weights
        if self._wanted(PREDICTION):
            self._publish(PREDICTION, stamp, self._message(mixture, stamp, frame_id))

    def _mixture_of(self, waiting: WaitingImage, camera: Camera) -> GaussianMixture | None:
        """Return the prediction; None if nobody is seen or the background is unknown."""
        given = waiting.mask
        if self._cue == FROM_BOTH:
            lifted = self._lifted(waiting.stamp_ns, camera)
            if lifted is not None:
                self._without_background = True
                self._publish_silhouette(waiting)
                return lifted
        self._without_background = given is not None
        if given is None:
            mask = self._usable_silhouette(waiting)
            self._publish_silhouette(waiting, mask)
            if not self._scene.known:
                self._reason = self._scene.wants
                return None
        else:
            mask = one_person(given, BackgroundSettings())
            with self._background_in_use:
                self._scene.learn(waiting.image, waiting.stamp_ns, bool(given.any()))
        self._height = _height(mask)
        if self._height < MIN_HEIGHT:
            return None
        try:
            before = self._known_before(waiting.stamp_ns)
            found = self._seen(mask, waiting.image, camera, *before)
        except NoSilhouetteError:
            return None
        self._support = found.support
        for text in found.place.remarks:
            self._log.note('silhouette', f'image of {waiting.stamp_ns} ns: {text}')
        return found.mixture

    def _usable_silhouette(self, waiting: WaitingImage) -> Mask:
        """Return the silhouette of an image; it has no pixels until the background is known."""
        scene, stamp = self._scene, waiting.stamp_ns
        with self._background_in_use:
            if scene.seen:
                self._look_at_scene(waiting, scene.background, 'configure the node again')
                scene.update(waiting.image, stamp)
                if scene.known:
                    return scene.background.silhouette(waiting.image)
            if scene.is_of_somebody:
                self._scene = scene = EmptyScene(BackgroundModel())
            scene.learn(waiting.image, stamp)
        return np.zeros(waiting.image.shape[:2], np.bool_)

    def _known_before(self, stamp_ns: int) -> tuple[GaussianMixture | None, float]:
        """Return the previous prediction and its age, s; None and `STEP` if it is too old."""
        previous = self._previous
        if self.parameters.propagation == WITHOUT_PROPAGATION or previous is None:
            return None, STEP
        interval = (stamp_ns - previous[1]) / SECOND_NS
        return (None, STEP) if interval > MAX_INTERVAL else (previous[0], interval)

    def _seen(
        self,
        mask: Mask,
        image: NDArray[np.uint8],
        camera: Camera,
        previous: GaussianMixture | None = None,
        interval: float = STEP,
    ) -> Prediction:
        return self._predictor.observe(
            mask,
            camera,
            previous,
            interval,
            propagation=self.parameters.propagation,
            max_components=self.parameters.max_hypotheses,
            size_spread=self._size_spread,
            image=image,
        )

    def _publish_silhouette(self, of: WaitingImage, mask: Mask | None = None) -> None:
        """Publishes the silhouette of an image, which is computed if it is not given."""
        known = mask is not None or (of.mask is None and self._scene.known)
        if not known or not self._wanted(SILHOUETTE):
            return
        shown = self._silhouette(of.image) if mask is None else mask
        picture = np.where(shown, np.uint8(255), np.uint8(0))
        made = image_message(self._messages, picture, of.stamp_ns, of.frame_id)
        self._publish(SILHOUETTE, of.stamp_ns, made)

    def _silhouette(self, image: NDArray[np.uint8]) -> Mask:
        with self._background_in_use:
            return self._scene.background.silhouette(image)

    def _message(
        self,
        mixture: GaussianMixture | None,
        stamp: int,
        frame_id: str,
        state: TrackState = TrackState.UNKNOWN,
    ) -> Any:
        content = PoseMixture.of_body(
            self._predictor.body,
            mixture,
            MixtureKind.PREDICTION,
            stamp,
            frame_id,
            state=state,
            reason=self._reason if mixture is None else '',
        )
        return pose_mixture_message(self._messages, content)

    def predict_once(self, message: Any) -> Any:
        """Predicts the pose in a single image, with the present background.

        Thread-safe.

        Args:
            message: sensor_msgs/Image or CompressedImage.

        Returns:
            hmt_msgs/PoseMixture.

        Raises:
            ValueError: the image can not be used, camera or background is unknown, or nobody is
                seen.
        """
        camera = self._camera
        if camera is None:
            raise ValueError('no calibrated camera_info has come yet')
        if not self._scene.known:
            raise ValueError(f'no silhouette: {self._scene.wants}')
        image = self.decode_image(message)
        check_size(image, camera)
        mask = self._silhouette(image)
        if _height(mask) < MIN_HEIGHT:
            raise ValueError(
                f'nobody is seen: the silhouette is {_height(mask)} px high, wanted at least '
                f'{MIN_HEIGHT}'
            )
        mixture = self._seen(mask, image, camera).mixture
        return self._message(mixture, time_ns(message.header.stamp), str(message.header.frame_id))

    def _present_state(self) -> BmeState:
        return BmeState(
            *self._status_and_wants(),
            **self._totals(self._weights),
            modes=len(self._weights),
            height=self._height,
            support=self._support,
            moved=self._watch.moved,
        )

    def _status(self) -> tuple[str, str]:
        if not self._scene.known and not self._without_background:
            return 'learning', self._scene.wants
        return 'predicting' if len(self._weights) else 'nobody', ''


def _predictor_of(parameters: BmeParameters) -> tuple[PosePredictor, float]:
    """Return the predictor for the person, and the relative standard deviation of body size."""
    with named_file('model_file', parameters.model_file, 'model of poses'):
        predictor = load_predictor(parameters.model_file or SHIPPED)
    if parameters.propagation == BY_EXPERTS and predictor.dynamics is None:
        raise ValueError(
            f"propagation 'experts' needs a model that was trained with --dynamics, which "
            f'{parameters.model_file or SHIPPED} was not'
        )
    spread = SIZE_SPREAD
    if parameters.stature:
        predictor = predictor.with_body(predictor.body.with_stature(parameters.stature))
        spread = _MEASURED_SPREAD
    if parameters.gravity:
        level = roll(-unit_vector(parameters.gravity, 'gravity'))
        predictor = predictor.with_body(predictor.body.levelled(level))
    return predictor, spread


def _height(mask: Mask) -> int:
    rows = np.flatnonzero(mask.any(1))
    return int(rows[-1] - rows[0] + 1) if len(rows) else 0
