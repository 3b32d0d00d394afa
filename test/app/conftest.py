"""A bag of synthetic mixtures, the bag of its images, and the report of both."""

import json
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from hmt_learning.app.rendered_bag import ground_truth
from hmt_ros.app.report import command as report
from hmt_ros.body import Camera, load_body
from hmt_ros.inference import GaussianMixture
from msg_tools import BagWriter, RosbagsMessages
from msg_tools.messages.bodies import message_of_body
from msg_tools.messages.camera_info import camera_info_message
from msg_tools.messages.headers import FRAME_ID, START_NS
from msg_tools.messages.images import compressed_image_message, encode_jpeg, jpeg_message
from msg_tools.messages.pose_mixtures import MixtureKind, PoseMixture, pose_mixture_message
from msg_tools.messages.trajectory_mixtures import TrajectoryMixture, trajectory_mixture_message

MESSAGES = RosbagsMessages()
FRAMES, WINDOW, TRAJECTORIES = 7, 3, 10
STAMPS = [START_NS + i * 100_000_000 for i in range(FRAMES)]
CAMERA = Camera(300.0, 300.0, 159.5, 119.5, 320, 240)


@dataclass(frozen=True)
class Made:
    """A bag of synthetic mixtures, the bag of its images, and the truth."""

    out: Path
    images: Path
    truth: Path


@pytest.fixture(scope='session')
def body():
    return load_body('human37').with_stature(1.75)


@pytest.fixture(scope='session')
def poses(body):
    """True poses (T, d) of a person who raises an arm."""
    poses = np.tile(np.clip(np.zeros(body.dimension), body.lower, body.upper), (FRAMES, 1))
    poses[:, 2] = 4.0
    bends = [i for i, name in enumerate(body.dof_names) if 'left_shoulder' in name]
    poses[:, bends] += 0.1 * np.arange(FRAMES)[:, None]
    return np.clip(poses, body.lower, body.upper)


def mixture_of(body, pose, modes, rng):
    weights = np.sort(rng.dirichlet(np.ones(modes)))[::-1]
    means = pose + 0.1 * rng.normal(size=(modes, body.dimension))
    return GaussianMixture(weights, means, np.tile(0.003 * np.eye(body.dimension), (modes, 1, 1)))


def pose_message(body, mixture, stamp, kind, **fields):
    content = PoseMixture.of_body(body, mixture, kind, stamp, FRAME_ID)
    message = pose_mixture_message(MESSAGES, content)
    for name, value in fields.items():
        setattr(message, name, value)
    return message


def window_message(body, poses, last, rng):
    first = max(0, last - WINDOW + 1)
    means = poses[first : last + 1] + 0.1 * rng.normal(
        size=(TRAJECTORIES, last + 1 - first, body.dimension)
    )
    content = TrajectoryMixture(
        weights=rng.dirichlet(np.ones(TRAJECTORIES)),
        means=means,
        marginal_covariances=None,
        log_joint=np.zeros(TRAJECTORIES),
        inflation=np.ones(TRAJECTORIES),
        stamps_ns=tuple(STAMPS[first : last + 1]),
        final_until_ns=STAMPS[0],
        free_energy=np.linspace(9.0 + last, 3.0, 5),
        body_model=body.name,
        dof_names=body.dof_names,
        frame_id=FRAME_ID,
        segment_lengths=body.segment_lengths,
    )
    return trajectory_mixture_message(MESSAGES, content)


def write_out(path, body, poses, *, truth=True, overlay=False, change=None, namespace=''):
    rng = np.random.default_rng(0)
    with BagWriter(path, namespace=namespace) as bag:
        bag.write('body', START_NS, message_of_body(MESSAGES, body, START_NS, FRAME_ID))
        for i, stamp in enumerate(STAMPS):
            for topic, kind, modes in (
                ('pose_mixture', MixtureKind.POSTERIOR, 3 + i % 2),
                ('smoothed_pose_mixture', MixtureKind.SMOOTHED, 2),
            ):
                message = pose_message(body, mixture_of(body, poses[i], modes, rng), stamp, kind)
                bag.write(topic, stamp, message if change is None else change(message))
            bag.write('trajectory_mixture', stamp, window_message(body, poses, i, rng))
            if overlay:
                picture = np.full((240, 320, 3), 90, np.uint8)
                message = compressed_image_message(MESSAGES, picture, stamp, FRAME_ID)
                bag.write('overlay/compressed', stamp, message)
            if truth:
                joints = body.joint_positions(poses[i : i + 1])[0]
                message = ground_truth(MESSAGES, body, poses[i], joints, stamp)
                bag.write('ground_truth', stamp, message)
    return path


def write_images(path, stamps=STAMPS, picture=None):
    if picture is None:
        picture = np.full((240, 320, 3), 120, np.uint8)
        picture[:, ::16] = 60
    with BagWriter(path) as bag:
        large = Camera(600.0, 600.0, 319.5, 239.5, 640, 480)
        camera = CAMERA if picture.shape[1] == CAMERA.width else large
        message = camera_info_message(MESSAGES, camera, stamps[0], FRAME_ID)
        bag.write('camera_info', stamps[0], message)
        jpeg = encode_jpeg(picture)
        for stamp in stamps:
            bag.write('image/compressed', stamp, jpeg_message(MESSAGES, jpeg, stamp, FRAME_ID))
    return path


@pytest.fixture(scope='session')
def made(tmp_path_factory, body, poses):
    folder = tmp_path_factory.mktemp('bags')
    np.savez(
        folder / 'truth.npz',
        stamps=np.array(STAMPS),
        joint_names=np.array(body.joint_names),
        joints=body.joint_positions(poses),
    )
    return Made(
        write_out(folder / 'out', body, poses, truth=False),
        write_images(folder / 'in'),
        folder / 'truth.npz',
    )


def make(out, folder, *options):
    """The report's page, as text."""
    assert report.main([str(out), '-o', str(folder), '--quiet', *map(str, options)]) == 0
    return (folder / 'report.html').read_text('utf-8')


@pytest.fixture
def no_pictures(monkeypatch):
    """Reports without pictures, for tests that do not need them."""
    monkeypatch.setattr(report, 'draw_pictures', lambda *_: [])


def data_of(page):
    (text,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', page, re.S)
    return json.loads(text)


@pytest.fixture(scope='session')
def folder(made, tmp_path_factory):
    folder = tmp_path_factory.mktemp('report') / 'new' / 'report'
    make(made.out, folder, '--images', made.images, '--truth', made.truth)
    return folder


@pytest.fixture(scope='session')
def page(folder):
    return (folder / 'report.html').read_text('utf-8')


@pytest.fixture(scope='session')
def data(page):
    return data_of(page)
