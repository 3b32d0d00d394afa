"""Data and small bags that the tests of msg_tools share."""

from __future__ import annotations

import os
import resource
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from msg_tools import BagError, BagReader, BagWriter, RosbagsMessages
from msg_tools.messages.headers import header_message
from msg_tools.messages.pose_mixtures import MixtureKind, PoseMixture, TrackState

Read = Callable[[Path], tuple[list[tuple[int, str, bytes]], str | None]]


@contextmanager
def limited_file_size(count: int) -> Iterator[None]:
    """Within the context, files longer than `count` bytes raise an error, like a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (count, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)


@pytest.fixture(scope='session')
def shared() -> Path:
    """Folder of the development data."""
    default = Path(__file__).resolve().parents[2] / '..' / 'shared'
    folder = Path(os.environ.get('HMT_SHARED', default))
    if not folder.is_dir():
        pytest.skip(f'the development data is not there: {folder} (HMT_SHARED names another place)')
    return folder


@pytest.fixture(scope='session')
def messages() -> RosbagsMessages:
    return RosbagsMessages()


@pytest.fixture(scope='session')
def read() -> Read:
    """Reads a bag: (time, topic, bytes) of its messages, and the error or cut that ended it."""

    def read_bag(path: Path) -> tuple[list[tuple[int, str, bytes]], str | None]:
        found = []
        try:
            with BagReader(path) as bag:
                for stored in bag.messages():
                    found.append((stored.log_time_ns, stored.topic, bytes(stored.data)))
                    assert stored.message is not None
        except BagError as error:
            return found, str(error)
        return found, 'breaks off' if bag.cut_off else None

    return read_bag


@pytest.fixture(scope='session')
def small_bag(tmp_path_factory: pytest.TempPathFactory, messages: RosbagsMessages) -> Path:
    """A bag of 40 messages in several chunks: images of noise, strings, a latched string."""
    path = tmp_path_factory.mktemp('bags') / 'small'
    rng = np.random.default_rng(0)
    with BagWriter(path) as bag:
        bag.add_topic('note', 'std_msgs/msg/String', latched=True)
        bag.write('note', 10**18, messages.create('std_msgs/msg/String', data='latched'))
        for i in range(39):
            stamp = 10**18 + i * 10**8
            if i % 3:
                bag.write('text', stamp, messages.create('std_msgs/msg/String', data=f'text {i}'))
                continue
            image: Any = messages.create(
                'sensor_msgs/msg/CompressedImage',
                header=header_message(messages, stamp, 'camera'),
                format='jpeg',
                data=rng.integers(0, 256, 200_000, dtype=np.uint8),
            )
            bag.write('image/compressed', stamp, image)
    return path


@pytest.fixture
def pose_mixture() -> PoseMixture:
    """A mixture of three components over four degrees of freedom, heaviest last."""
    rng = np.random.default_rng(3)
    root = rng.normal(size=(3, 4, 4))
    covariances = root @ root.transpose(0, 2, 1) + np.eye(4)
    return PoseMixture(
        weights=np.array([0.2, 0.3, 0.5]),
        means=rng.normal(size=(3, 4)),
        covariances=(covariances + covariances.transpose(0, 2, 1)) / 2,
        body_model='human37',
        dof_names=('root_x', 'root_yy', 'root_zzz', 'bend'),
        joint_names=('pelvis', 'head'),
        joint_positions=rng.normal(size=(3, 2, 3)),
        kind=MixtureKind.SMOOTHED,
        stamp_ns=1_700_000_000_123_456_789,
        frame_id='camera',
        segment_lengths={'trunk': 0.5, 'thigh': 0.41},
        log_likelihoods=np.array([-3.0, -2.0, -1.0]),
        degrees_of_freedom=np.array([0.0, 5.0, 0.0]),
        state=TrackState.TRACKING,
        track_id=2,
        identities=np.array([4, 1, 9]),
        joint_covariances=np.eye(3)
        * np.array([[1e-4, 2e-4], [3e-4, 4e-4], [5e-4, 6e-4]])[..., None, None],
        joint_velocities=rng.normal(size=(3, 2, 3)),
    )
