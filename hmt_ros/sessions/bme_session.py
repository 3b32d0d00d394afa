"""The prediction of poses from images behind its topics: messages in, messages out, without ROS.

The node and offline replay give their messages to a `BmeSession`, one after the other; the same
messages in the same order give the same bytes. The rules:

- Every image that can be used gets one prediction. One without components says that nobody was
  seen: the background is still being learned, or there is no silhouette of the height of a person.
- Images are taken in the order of their stamps. One that is not younger than the one before is
  skipped, or is the first of a new sequence where `reset_on_time_jump` says so.
- Images wait until a calibrated camera_info has come; at most `queue_size`, the oldest are dropped.
- With `propagate` a prediction takes those before into account, unless they are older than
  `longest_interval`, come from another calibration, or from after a jump in time.
- What can not be used is skipped. Of each kind of fault the first is told, all are counted.
"""

from __future__ import annotations

import math
import threading
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body import Camera
from hmt_ros.experts.descriptor.contour import NoSilhouetteError
from hmt_ros.experts.pose_predictor import SHIPPED, PosePredictor, Prediction, load_predictor
from hmt_ros.experts.root_placement import SIZE_SPREAD
from hmt_ros.experts.training_set import RATE
from hmt_ros.image.background import BackgroundModel
from hmt_ros.inference import GaussianMixture
from hmt_ros.sessions.bme_parameters import BmeParameters
from hmt_ros.sessions.camera_input import CAMERA_INFO, IMAGE, CameraInput, InTime, WaitingImage
from hmt_ros.sessions.handled import Handled, Output
from hmt_ros.sessions.picture_file import read_picture
from hmt_ros.sessions.published_topic import PublishedTopic
from hmt_ros.sessions.session import Session, entropy, everything
from hmt_ros.tracking.dynamics import PoseRates
from msg_tools.files.error_line import error_line
from msg_tools.messages.headers import SECOND_NS, header_message, time_ns
from msg_tools.messages.images import decode_image
from msg_tools.messages.pose_mixtures import MixtureKind, PoseMixture, pose_mixture_message

__all__ = ['CAMERA_INFO', 'IMAGE', 'PREDICTION', 'TOPICS', 'BmeSession', 'BmeState']

PREDICTION = 'pose_prediction'
TOPICS = {PREDICTION: PublishedTopic('hmt_msgs/msg/PoseMixture')}

Mask = NDArray[np.bool_]

# Relative standard deviation of the size of a person whose stature is known.
_MEASURED_SPREAD = 0.02
# How fast poses change where the step that dynamics were learned for is exceeded.
_RATES = PoseRates()


@dataclass(frozen=True)
class BmeState:
    """What is going on, for diagnostics.

    Attributes:
        status: 'no camera', 'learning', 'nobody' or 'predicting'.
        wants: what the next step waits for, '' while images are used.
        modes: components of the last prediction.
        entropy: of their weights, nats; NaN: there is none.
        height: of the last silhouette, px.
        support: 0 to 1, how far it is like those that the model has learned from.
        images: number of images: 'received', and of these 'predicted' (with or without somebody),
            'empty' (without), 'skipped', 'dropped'.
        faults: number of faults by kind.
        last_fault: the newest; '' before the first.
    """

    status: str
    wants: str
    modes: int = 0
    entropy: float = math.nan
    height: int = 0
    support: float = math.nan
    images: Counter[str] = field(default_factory=Counter)
    faults: Counter[str] = field(default_factory=Counter)
    last_fault: str = ''


class _Previous(NamedTuple):
    mixture: GaussianMixture
    stamp_ns: int


class BmeSession(Session):
    """One camera, from the first message on.

    All methods but `predict_once` are to be called by one thread; `state` and `parameters` may be
    read and replaced by others.

    Args:
        parameters: of the node.
        publish: takes what is to be published, as soon as it is there.
        wanted: whether a topic needs to be published; predictions are made all the same.

    Raises:
        ValueError: the parameters name a file that can not be used.

    Attributes:
        parameters: a new value takes effect when `declared_parameters` says.
        start: None, there is but one way to start.
        state: see `BmeState`.
    """

    def __init__(
        self,
        parameters: BmeParameters,
        publish: Callable[[Output], None],
        wanted: Callable[[str], bool] = everything,
    ) -> None:
        super().__init__(parameters, publish, wanted)
        self._predictor, self._size_spread = _predictor_of(parameters)
        self._background = BackgroundModel(parameters.background)
        self._given: NDArray[np.uint8] | None = None
        if parameters.background_file:
            self._given = read_picture(parameters.background_file)
            self._background = BackgroundModel.from_image(self._given, parameters.background)
        # OpenCV's model computes in memory of its own.
        self._background_in_use = threading.Lock()
        self._input = CameraInput(self._log, 'the sequence')
        self._previous: _Previous | None = None
        self._weights = np.empty(0)
        self._height, self._support = 0, math.nan
        self.state = self._present_state()

    # What comes in.

    def take(self, source: str, message: Any) -> Handled:
        """Handles a message.

        Args:
            source: `CAMERA_INFO` or `IMAGE`.
            message: sensor_msgs/CameraInfo, Image or CompressedImage.
        """
        self._log.begin()
        stamp = time_ns(message.header.stamp)
        if source == CAMERA_INFO:
            if self._input.take_camera_info(message):
                self.restart()
        else:
            in_time = self._input.judge_stamp(stamp, self.parameters.reset_on_time_jump)
            if in_time is InTime.JUMP:
                self._input.forget_images()
                self.restart()
            if in_time is not InTime.SKIPPED:
                self._input.take_image(message, stamp)
        while self._input.waiting and self._input.camera is not None:
            self._predict(self._input.waiting.popleft(), self._input.camera)
        self._input.drop_excess(self.parameters.queue_size)
        self.state = self._present_state()
        return self._log.handled(source, stamp)

    def restart(self, start: None = None) -> None:
        """Forgets the images before; what is known of the background stays."""
        self._previous = None
        self._weights = np.empty(0)
        self.state = self._present_state()

    # What comes out.

    def _predict(self, waiting: WaitingImage, camera: Camera) -> None:
        if not self._input.fits(waiting):
            return
        try:
            mixture = self._mixture_of(waiting, camera)
        except (ValueError, ArithmeticError) as error:
            text = error_line(error)
            self._log.skip(
                'estimate', f'no prediction from the image of {waiting.stamp_ns} ns: {text}'
            )
            self._previous = None
            return
        self._log.counts['predicted'] += 1
        if mixture is None:
            self._log.counts['empty'] += 1
            self._weights = np.empty(0)
        else:
            self._previous = _Previous(mixture, waiting.stamp_ns)
            self._weights = mixture.weights
        if self._wanted(PREDICTION):
            message = self._message(mixture, waiting.stamp_ns, self._input.frame_of(waiting))
            self._publish(PREDICTION, waiting.stamp_ns, message)

    def _mixture_of(self, waiting: WaitingImage, camera: Camera) -> GaussianMixture | None:
        """What the image says; None: nobody is seen."""
        p = self.parameters
        if self._given is None and self._background.frames < p.background_images:
            with self._background_in_use:
                self._background.learn(waiting.image)
            return None
        mask = self._silhouette(waiting.image)
        self._height = _height(mask)
        if self._height < p.least_height:
            return None
        try:
            found = self._seen(mask, camera, self._one_step_before(waiting.stamp_ns))
        except NoSilhouetteError:
            return None
        self._support = found.support
        for text in found.place.remarks:
            self._log.note('silhouette', f'image of {waiting.stamp_ns} ns: {text}')
        return found.mixture

    def _one_step_before(self, stamp_ns: int) -> GaussianMixture | None:
        """The poses one step of the dynamics before an image, as far as they are known."""
        p, previous = self.parameters, self._previous
        if not p.propagate or previous is None:
            return None
        interval = (stamp_ns - previous.stamp_ns) / SECOND_NS
        if interval > p.longest_interval:
            return None
        gained = _RATES.rates(self._predictor.body.skeleton) * max(interval - 1.0 / RATE, 0.0)
        m = previous.mixture
        return GaussianMixture(m.weights, m.means, m.covariances + np.diag(gained))

    def _seen(self, mask: Mask, camera: Camera, previous: GaussianMixture | None) -> Prediction:
        return self._predictor.observe(
            mask,
            camera,
            previous,
            max_components=self.parameters.max_hypotheses,
            size_spread=self._size_spread,
        )

    def _silhouette(self, image: NDArray[np.uint8]) -> Mask:
        with self._background_in_use:
            return self._background.silhouette(image)

    def _message(self, mixture: GaussianMixture | None, stamp: int, frame_id: str) -> Any:
        body = self._predictor.body
        if mixture is None:
            return self._messages.create(
                'hmt_msgs/msg/PoseMixture',
                header=header_message(self._messages, stamp, frame_id),
                body_model=body.name,
                dof_names=list(body.dof_names),
                joint_names=list(body.joint_names),
                kind=int(MixtureKind.PREDICTION),
            )
        content = PoseMixture(
            mixture=mixture,
            body_model=body.name,
            dof_names=body.dof_names,
            joint_names=body.joint_names,
            joint_positions=body.joint_positions(mixture.means),
            kind=MixtureKind.PREDICTION,
            stamp_ns=stamp,
            frame_id=frame_id,
        )
        return pose_mixture_message(self._messages, content)

    def predict_once(self, message: Any) -> Any:
        """The prediction from one image alone, before the present background.

        May be called by any thread, at any time.

        Args:
            message: sensor_msgs/Image or CompressedImage.

        Returns:
            hmt_msgs/PoseMixture.

        Raises:
            ValueError: the image can not be used, nothing is known of camera or background, or
                nobody is seen.
        """
        camera = self._input.camera
        if camera is None:
            raise ValueError('no calibrated camera_info has come yet')
        p = self.parameters
        if self._given is None and self._background.frames < p.background_images:
            raise ValueError(
                f'the background is being learned, from {self._background.frames} of '
                f'{p.background_images} images so far: set background_file, or wait'
            )
        image = decode_image(message)
        height, width = image.shape[:2]
        if (width, height) != (camera.width, camera.height):
            raise ValueError(
                f'image has {width}x{height} pixels, wanted the {camera.width}x{camera.height} of '
                'camera_info'
            )
        mask = self._silhouette(image)
        if _height(mask) < p.least_height:
            raise ValueError(
                f'nobody is seen: the silhouette is {_height(mask)} px high, wanted at least '
                f'{p.least_height}'
            )
        mixture = self._seen(mask, camera, None).mixture
        return self._message(mixture, time_ns(message.header.stamp), str(message.header.frame_id))

    # What is told.

    def _present_state(self) -> BmeState:
        status, wants = 'no camera', 'a calibrated camera_info'
        if self._input.camera is not None:
            learned, needed = self._background.frames, self.parameters.background_images
            if self._given is None and learned < needed:
                status = 'learning'
                wants = f'{needed - learned} more images of the empty scene'
            else:
                status, wants = 'predicting' if len(self._weights) else 'nobody', ''
        return BmeState(
            status,
            wants,
            modes=len(self._weights),
            entropy=entropy(self._weights),
            height=self._height,
            support=self._support,
            images=Counter(self._log.counts),
            faults=Counter(self._log.faults),
            last_fault=self._log.last_fault,
        )


def _predictor_of(parameters: BmeParameters) -> tuple[PosePredictor, float]:
    """The model for the person, and how much persons of known stature differ from its size."""
    try:
        predictor = load_predictor(parameters.model_file or SHIPPED)
    except OSError as error:
        raise ValueError(error_line(error)) from error
    if not parameters.stature:
        return predictor, SIZE_SPREAD
    body = predictor.body.with_stature(parameters.stature)
    return predictor.with_body(body), _MEASURED_SPREAD


def _height(mask: Mask) -> int:
    rows = np.flatnonzero(mask.any(1))
    return int(rows[-1] - rows[0] + 1) if len(rows) else 0
