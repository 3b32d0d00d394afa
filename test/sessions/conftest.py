"""Stub tracker and stub predictor, messages of a camera and of a filter."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from hmt_ros.body import Body, Camera, load_body
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.error_model import CueErrors
from hmt_ros.inference.linear_gaussian_dynamics import LinearGaussianDynamics
from hmt_ros.sessions import bme_session, camera_session, smoother_session, track_start
from hmt_ros.tracking import PosePrediction, Status, Subject, TrackerSettings
from hmt_ros.tracking.beginning import Source
from hmt_ros.tracking.ground import Ground
from hmt_ros.tracking.validity import Validity
from msg_tools import RosbagsMessages
from msg_tools.messages.camera_info import camera_info_message
from msg_tools.messages.headers import header_message
from msg_tools.messages.images import compressed_image_message, depth_message, image_message
from msg_tools.messages.message_types import register_definitions
from msg_tools.messages.pose_mixtures import MixtureKind, PoseMixture, pose_mixture_message

FRAME_NS = 100_000_000
START_NS = 1_700_000_000_000_000_000
INDEPENDENT, UNKNOWN = CueErrors(1.0, 0.0), CueErrors(np.nan, np.nan)
JOINTS = ('left_hip', 'right_hip', 'left_shoulder', 'right_shoulder', 'head')


class StubTracker:
    """Stub with the interface of `hmt_ros.tracking.Tracker` and two given modes."""

    made: list[StubTracker] = []  # noqa: RUF012
    empty: set[int] = set()  # noqa: RUF012  # stamps of images without a person
    fault: Exception | None = None
    shown: Any = None

    def __init__(
        self, body, camera, settings=None, background=None, seed=0, known_ground=None,
        shared_background=False,
    ):  # fmt: skip
        self.body, self.camera, self.seed = body, camera, seed
        self.settings = settings or TrackerSettings()
        self.silhouettes = SimpleNamespace(
            background=background,
            doubted=False,
            share=0.9,
            known='known',
            watch=SimpleNamespace(moved=False, shift=0.0),
        )
        self.validity = Validity()
        self.status, self.misfit, self.evaluations = Status.WAITING, 0.0, 0
        self.foreseen, self.nobody_shown, self.reason = False, True, ''
        self.track_id, self.started_from = 0, None
        self.existence_probability = 0.875
        self.likelihood = SimpleNamespace(
            values=np.array([-1.5, -2.5]),
            errors=CueErrors(0.25, 0.125),
            shape_covariance=np.zeros((body.dimension, body.dimension)),
            identities=np.array([77, 1]),
            posterior_weights=np.array([0.6, 0.4]),
            origins=np.empty((2, 0)),
            ancestors=np.empty(0, dtype=int),
            ancestry_stamp=None,
        )
        self.known_ground = known_ground
        up = np.array([0.0, -1.0, 0.0]) if known_ground.up is None else known_ground.up
        self.ground = Ground(up, 0.1, known_ground.camera_height, 0.02)
        self.vertical, self.gravity_contradicted = known_ground.up, False
        self.gravity_reversed = False
        self.contacts = {'left_foot': 0.75, 'right_foot': 0.0}
        self.gravities: list[Any] = []
        self.poses: list[Any] = []
        self.seen: list[tuple[int, Any]] = []
        self.predictions: list[PosePrediction | None] = []
        self.masks: list[Any] = []
        self.depths: list[Any] = []
        self.nobody_predicted: list[bool] = []
        self.start = None
        StubTracker.made.append(self)

    def reset(self, start=None, *, box=None):
        self.start, self.box = start, box

    def set_gravity(self, up, camera_height=None, up_sigma=None):
        self.gravities.append(up)
        height = self.ground.height if camera_height is None else camera_height
        self.ground, self.vertical = replace(self.ground, up=up, height=height), up

    def set_camera(self, position, rotation):
        self.poses.append((position, rotation))

    @property
    def estimate(self):
        """The tracker itself, which stands for its estimate."""
        return self

    @property
    def modes(self):
        identities = np.array([len(self.seen), 77])
        return SimpleNamespace(log_likelihoods=np.array([-1.0, -2.0]), identities=identities)

    @property
    def published(self):
        return self.modes

    @property
    def forecaster(self):
        """Moves the person to the right at 1 m/s."""
        stamp, before = self.seen[-1][0], self.posterior

        def at(later):
            means = before.means.copy()
            means[:, 0] += 1e-9 * (later - stamp)
            return replace(before, means=means)

        return SimpleNamespace(at=at, modes=self.modes)

    @property
    def velocities(self):
        """To the right, from the second image."""
        moving = np.zeros((2, self.body.dimension))
        moving[:, 0] = [1.5, 0.0]
        return moving if len(self.seen) > 1 else None

    @property
    def point_estimate(self):
        start = self.start
        return self.body.prior_mean if isinstance(start, Subject) else start.means[0]

    def step(
        self, image, stamp, keypoints=None, prediction=None, mask=None, *, nobody_predicted=False,
        others=None, depth=None,
    ):  # fmt: skip
        assert image.shape == (self.camera.height, self.camera.width, 3)
        if self.fault is not None:
            raise self.fault
        if self.start is None and prediction is not None:
            self.start = prediction.mixture
            self.started_from = Source.PREDICTION
        if self.start is None or (isinstance(self.start, Subject) and stamp < self.start.stamp_ns):
            return None, None
        self.seen.append((stamp, keypoints))
        self.predictions.append(prediction)
        self.masks.append(mask)
        self.depths.append(depth)
        self.nobody_predicted.append(nobody_predicted)
        if stamp in self.empty:
            self.status = Status.NOBODY
            return None, None
        self.track_id += self.status is not Status.TRACKING
        self.status, self.misfit, self.evaluations = Status.TRACKING, 0.125, 7
        means = np.tile(self.body.prior_mean, (2, 1))
        means[:, 2] = 4.0
        means[:, 0] = [0.1 * len(self.seen), -0.1]
        covariances = np.tile(1e-3 * np.eye(self.body.dimension), (2, 1, 1))
        found = tuple(
            GaussianMixture(np.array([share, 1 - share]), means, covariances)
            for share in (0.75, 0.5)
        )
        self.posterior = found[0]
        return found


@pytest.fixture
def stub_tracker(monkeypatch):
    monkeypatch.setattr(track_start, 'Tracker', StubTracker)
    monkeypatch.setattr(StubTracker, 'made', [])
    monkeypatch.setattr(StubTracker, 'fault', None)
    monkeypatch.setattr(StubTracker, 'empty', set())
    return StubTracker


@dataclass
class SmallCamera:
    """Messages of a camera of 64x48 pixels; images are counted from 0, ten per second."""

    camera: Camera = field(default_factory=lambda: Camera(60.0, 60.0, 31.5, 23.5, 64, 48))
    messages: RosbagsMessages = field(default_factory=RosbagsMessages)

    def stamp(self, index):
        return START_NS + round(index * FRAME_NS)

    def picture(self, index, size=(64, 48)):
        rng = np.random.default_rng(self.stamp(index))
        return rng.integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)

    def image(self, index, size=(64, 48), frame_id='lens'):
        picture = self.picture(index, size)
        return image_message(self.messages, picture, self.stamp(index), frame_id)

    def compressed(self, index):
        picture = self.picture(index)
        return compressed_image_message(self.messages, picture, self.stamp(index), 'lens')

    def mask(self, index, size=(64, 48), fill=0, encoding='mono8'):
        """A mask of one value, except for a person of 10x24 pixels."""
        pixels = np.full((size[1], size[0]), fill, np.uint8)
        pixels[12:36, 20:30] = 1
        message = image_message(self.messages, pixels, self.stamp(index), 'lens')
        message.encoding = encoding
        return message

    def depth(self, index, size=(64, 48), metres=3.0):
        """A depth image, 16UC1, of a wall with a hole."""
        depth = np.full((size[1], size[0]), 1000 * metres, np.uint16)
        depth[:4, :4] = 0
        return depth_message(self.messages, depth, self.stamp(index), 'lens')

    def nobody(self, index):
        message = self.mask(index)
        message.data[:] = 0
        return message

    def compressed_mask(self, index):
        message = self.mask(index)
        done, data = cv2.imencode('.png', message.data.reshape(48, 64))
        assert done
        return self.messages.create(
            'sensor_msgs/msg/CompressedImage',
            header=message.header,
            format='mono8; png compressed ',
            data=data.ravel(),
        )

    def info(self, index=0, camera=None, frame_id='lens'):
        return camera_info_message(
            self.messages, camera or self.camera, self.stamp(index), frame_id
        )

    def uncalibrated(self, index=0):
        info = self.info(index)
        return self.messages.create(
            'sensor_msgs/msg/CameraInfo',
            header=info.header,
            width=64,
            height=48,
            distortion_model='plumb_bob',
        )

    def keypoints(self, index, names=JOINTS, **fields):
        # At (0, 0) keypoints count as missing.
        fields.setdefault('u', np.arange(1.0, 1 + len(names)))
        fields.setdefault('v', np.arange(1.0, 1 + len(names)))
        return self.messages.create(
            'hmt_msgs/msg/Keypoints2D',
            header=header_message(self.messages, self.stamp(index), 'lens'),
            names=list(names),
            **fields,
        )

    def keypoints_3d(self, index, names=JOINTS, **fields):
        """3D landmarks; landmark i is i m to the right."""
        fields.setdefault('x', np.arange(len(names), dtype=float))
        return self.messages.create(
            'hmt_msgs/msg/Keypoints3D',
            header=header_message(self.messages, self.stamp(index), 'lens'),
            names=list(names),
            **{axis: fields.get(axis, np.zeros(len(names))) for axis in 'xyz'},
        )


@pytest.fixture
def small_camera():
    return SmallCamera()


@dataclass
class Somebody(SmallCamera):
    """A camera that sees a white pillar of 10x24 pixels, which moves, before a grey wall."""

    def picture(self, index, size=(64, 48)):
        picture = np.full((size[1], size[0], 3), 90, np.uint8)
        left = 20 + round(index) % 20
        picture[12:36, left : left + 10] = 250
        return picture

    def empty(self, index):
        wall = np.full((48, 64, 3), 90, np.uint8)
        return image_message(self.messages, wall, self.stamp(index), 'lens')


@pytest.fixture
def somebody():
    return Somebody()


class StubPredictor:
    """Stub of `hmt_ros.experts.PosePredictor`, whose poses do not depend on the silhouette."""

    body = load_body('human37')
    asked: list[tuple[Any, GaussianMixture | None, float]] = []  # noqa: RUF012
    intervals: list[float] = []  # noqa: RUF012
    dynamics = None
    fault: Exception | None = None

    def with_body(self, body):
        assert body is not self.body
        return self

    def observe(
        self, mask, camera, previous=None, interval=1 / 30, *, propagation='none',
        max_components=8, size_spread=0.06, image=None,
    ):  # fmt: skip
        if self.fault is not None:
            raise self.fault
        assert image.shape == (*mask.shape, 3)
        StubPredictor.asked.append((mask, previous, size_spread))
        StubPredictor.intervals.append(interval)
        means = np.tile(self.body.prior_mean, (2, 1))
        means[:, 2] = [4.0, 4.5]
        covariances = np.tile(1e-2 * np.eye(self.body.dimension), (2, 1, 1))
        return SimpleNamespace(
            mixture=GaussianMixture([0.7, 0.3], means, covariances)[:max_components].normalised(),
            place=SimpleNamespace(remarks=('cut at the left',) if mask[:, 0].any() else ()),
            support=0.5,
        )


@pytest.fixture
def stub_predictor(monkeypatch):
    monkeypatch.setattr(bme_session, 'load_predictor', lambda path: StubPredictor())
    monkeypatch.setattr(bme_session, 'MIN_HEIGHT', 10)  # images are small
    monkeypatch.setattr(StubPredictor, 'asked', [])
    monkeypatch.setattr(StubPredictor, 'intervals', [])
    monkeypatch.setattr(StubPredictor, 'fault', None)
    return StubPredictor


@pytest.fixture
def outputs():
    """List of the messages that a session publishes."""
    return []


@pytest.fixture(scope='session')
def body():
    return load_body('human37')


@pytest.fixture
def subject_file(tmp_path):
    lines = [f'stamp_ns: {START_NS}', 'sigma_px: 2.0', 'keypoints:']
    lines += [f'  {name}: [{10 * i}.0, 20.0]' for i, name in enumerate(JOINTS)]
    path = tmp_path / 'subject.yaml'
    path.write_text('\n'.join(lines) + '\n')
    return path


@pytest.fixture
def background_file(tmp_path):
    path = tmp_path / 'background.png'
    cv2.imwrite(str(path), np.full((48, 64, 3), 90, np.uint8))
    return path


@dataclass
class Likelihoods:
    """Messages of a filter whose person raises an arm; ten mixtures of two modes per second."""

    body: Body = field(default_factory=lambda: load_body('human37'))
    messages: RosbagsMessages = field(default_factory=RosbagsMessages)
    leans: bool = False
    hops: float = 0.002  # probability that a mode descends from the other one

    def stamp(self, index):
        return START_NS + round(index * FRAME_NS)

    def mixture(self, index):
        """A mixture over poses; the second mode bends the elbow more, and may lean back."""
        means = np.tile(self.body.prior_mean, (2, 1))
        means[:, 2] = 4.0
        moving = self.body.dof_names.index('left_elbow')
        means[:, moving] = 0.5 + 0.05 * index
        means[1, moving] += 0.8
        if self.leans:
            means[1, self.body.dof_names.index('trunk_x')] -= 0.6
        covariances = np.tile(1e-3 * np.eye(self.body.dimension), (2, 1, 1))
        return GaussianMixture(np.array([0.6, 0.4]), means, covariances)

    def nobody(self, index):
        """A prediction from an image without a person."""
        return self.messages.create(
            'hmt_msgs/msg/PoseMixture',
            header=header_message(self.messages, self.stamp(index), 'lens'),
            kind=int(MixtureKind.PREDICTION),
        )

    def chain(self, weights, before):
        """Ancestry of modes that continue those of image `before`; None for first modes."""
        count, known = len(weights), before is not None
        own = self.hops + (1.0 - count * self.hops) * np.eye(count)
        ids = np.arange(5, 5 + count)
        return {
            'identities': ids,
            'posterior_weights': np.array(weights),
            # Columns have no fixed order.
            'ancestry': own[:, ::-1] if known else np.empty((count, 0)),
            'ancestry_ids': ids[::-1] if known else ids[:0],
            'ancestry_stamp_ns': self.stamp(before) if known else 0,
        }

    def message(
        self,
        index,
        body=None,
        kind=MixtureKind.LIKELIHOOD,
        errors=INDEPENDENT,
        mixture=None,
        weights=None,
        before=...,
        chain=True,
    ):
        """A mixture as a message.

        Args:
            weights: posterior weights of the modes; None means 0.7 and 0.3, or those of `mixture`.
            before: image whose modes they continue, by default the last one; None for a start.
            chain: whether the message contains both, as those of the filter do.
        """
        body, found = body or self.body, mixture or self.mixture(index)
        if weights is None:
            weights = found.weights if len(found) != 2 else [0.7, 0.3]
        before = index - 1 if before is ... else before
        told = self.chain(weights, before) if chain and kind is MixtureKind.LIKELIHOOD else {}
        content = PoseMixture.of_body(
            body,
            found,
            kind,
            self.stamp(index),
            'lens',
            error_share=errors.independent,
            error_time=errors.time,
            **told,
        )
        return pose_mixture_message(self.messages, content)


@pytest.fixture(scope='session')
def random_walk():
    """Makes the smoother use random walks at the bodies' rates as motion priors."""
    return lambda body: LinearGaussianDynamics.random_walk(
        body.rates / smoother_session.DIFFUSION_FACTOR
    )


@pytest.fixture(scope='session')
def likelihoods():
    return Likelihoods()


# The part of hri_msgs 2.0 used for REP 155.
HRI_MSGS = {
    'IdsList': 'std_msgs/Header header\nstring[] ids\n',
    'NormalizedPointOfInterest2D': 'float32 x\nfloat32 y\nfloat32 c\n',
    'NormalizedRegionOfInterest2D': (
        'std_msgs/Header header\n'
        'float32 xmin\nfloat32 ymin\nfloat32 xmax\nfloat32 ymax\nfloat32 c\n'
    ),
    'Skeleton2D': 'std_msgs/Header header\nNormalizedPointOfInterest2D[18] skeleton\n',
}


@pytest.fixture(scope='session')
def hri_msgs(tmp_path_factory):
    """Registers the messages of hri_msgs, which need not be installed."""
    folder = tmp_path_factory.mktemp('hri_msgs')
    for name, text in HRI_MSGS.items():
        (folder / f'{name}.msg').write_text(text)
    register_definitions('hri_msgs', folder)


@pytest.fixture
def few_wait(monkeypatch):
    """Limits the number of waiting images to `queue_size`."""
    monkeypatch.setattr(camera_session, 'MAX_INCOMPLETE_IMAGES', 1)
