"""A tracker that costs nothing, and the messages of a small camera."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from hmt_ros.body import Camera, load_body
from hmt_ros.inference import GaussianMixture
from hmt_ros.nodes import track_start
from hmt_ros.tracking import Status, Subject, TrackerSettings
from msg_tools import RosbagsMessages
from msg_tools.camera_info import camera_info_message
from msg_tools.headers import header_message
from msg_tools.images import compressed_image_message, image_message

FRAME_NS = 100_000_000
START_NS = 1_700_000_000_000_000_000
JOINTS = ('left_hip', 'right_hip', 'left_shoulder', 'right_shoulder', 'head')


class StubTracker:
    """What `hmt_ros.tracking.Tracker` shows to the outside; its two modes are where it was told."""

    made: list[StubTracker] = []  # noqa: RUF012
    fault: Exception | None = None

    def __init__(self, body, camera, settings=None, background=None, seed=0):
        self.body, self.camera, self.seed = body, camera, seed
        self.settings = settings or TrackerSettings()
        self.background = background
        self.status, self.misfit, self.evaluations = Status.WAITING, 0.0, 0
        self.seen: list[tuple[int, Any]] = []
        self._start = None
        StubTracker.made.append(self)

    def reset(self, start=None):
        self._start = start

    @property
    def modes(self):
        return SimpleNamespace(log_likelihoods=np.array([-1.0, -2.0]))

    def step(self, image, stamp, keypoints=None):
        assert image.shape == (self.camera.height, self.camera.width, 3)
        if self.fault is not None:
            raise self.fault
        if self._start is None or (
            isinstance(self._start, Subject) and stamp < self._start.stamp_ns
        ):
            return None, None
        self.seen.append((stamp, keypoints))
        self.status, self.misfit, self.evaluations = Status.TRACKING, 0.125, 7
        means = np.tile(self.body.prior_mean, (2, 1))
        means[:, 2] = 4.0
        means[:, 0] = [0.1 * len(self.seen), -0.1]
        covariances = np.tile(1e-3 * np.eye(self.body.dimension), (2, 1, 1))
        return tuple(
            GaussianMixture(np.array([share, 1 - share]), means, covariances)
            for share in (0.75, 0.5)
        )


@pytest.fixture
def stub_tracker(monkeypatch):
    monkeypatch.setattr(track_start, 'Tracker', StubTracker)
    monkeypatch.setattr(StubTracker, 'made', [])
    monkeypatch.setattr(StubTracker, 'fault', None)
    return StubTracker


@dataclass
class SmallCamera:
    """Messages of a camera of 64x48 pixels; images are counted from 0, ten a second."""

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
        fields.setdefault('u', np.arange(len(names), dtype=float))
        fields.setdefault('v', np.arange(len(names), dtype=float))
        return self.messages.create(
            'hmt_msgs/msg/Keypoints2D',
            header=header_message(self.messages, self.stamp(index), 'lens'),
            names=list(names),
            **fields,
        )


@pytest.fixture
def small_camera():
    return SmallCamera()


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
