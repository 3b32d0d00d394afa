"""Shared parts of tests: their own ROS domain, reproducible hypothesis runs, poses, clips."""

import json
import os
import shutil
import socket
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import settings

from hmt_learning.app import make_bag
from hmt_ros.app import progress
from hmt_ros.body import Body, load_body
from hmt_ros.detectors.blazepose_models import has_networks, has_runtime
from hmt_ros.image.keypoint_schemes import schemes
from msg_tools import BagReader
from msg_tools.messages.images import decode_image

ROOT = Path(__file__).resolve().parents[1]

# Tests must not fail on a slow machine.
settings.register_profile('hmt_ros', deadline=None, derandomize=True)
settings.load_profile('hmt_ros')
# Progress lines must not appear among the expected lines of a command.
progress.INTERVAL = 3600.0

# The slowest test files, slowest first. They are run first, so that at the end no process waits for
# another that has just begun a slow one.
LONGEST = (
    'test_workspace.py',
    'app/replay/test_live_node.py',
    'test_benchmarks.py',
    'tracking/test_bad_input.py',
    'app/report/test_command.py',
    'learning/app/test_train.py',
    'test_docs.py',
    'test_launch.py',
    'app/replay/test_many_bags.py',
    'app/report/test_page.py',
    'tracking/test_absence.py',
    'experts/test_expert_mixture.py',
    'tracking/test_memory.py',
    'image/test_scene_watch.py',
    'nodes/test_filter_node.py',
    'app/replay/test_transforms.py',
    'nodes/test_usage.py',
)

_domain_reservation = pytest.StashKey[socket.socket]()


def _reserve_ros_domain():
    """Number of a ROS domain unused by other test runs on this machine, and its reservation.

    A domain is reserved by binding port 32768 + domain, as in ament's domain_coordinator. The
    search starts at a number derived from the path of the checkout.
    """
    start = zlib.crc32(str(Path(__file__).resolve()).encode())
    for offset in range(100):
        domain = 1 + (start + offset) % 100
        reservation = socket.socket()
        try:
            reservation.bind(('', 32768 + domain))
        except OSError:
            reservation.close()
        else:
            return domain, reservation
    raise RuntimeError('all ROS domains from 1 to 100 are in use by other test runs')


def pytest_configure(config):
    # Each process has its own domain, also with pytest-xdist, because nodes of a domain connect.
    domain, config.stash[_domain_reservation] = _reserve_ros_domain()
    os.environ['ROS_DOMAIN_ID'] = str(domain)
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'


def pytest_unconfigure(config):
    reservation = config.stash.get(_domain_reservation, None)
    if reservation is not None:
        reservation.close()


def pytest_itemcollected(item):
    if item.get_closest_marker('ros') is not None and 'AMENT_PREFIX_PATH' not in os.environ:
        reason = 'no ROS environment: "make test" or "source tools/environment.bash" first'
        item.add_marker(pytest.mark.skip(reason=reason))


def pytest_collection_modifyitems(items):
    folder = Path(__file__).resolve().parent
    places = {folder / name: place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: places.get(item.path, len(places)))


def copy_objects_of_core(build: Path) -> None:
    """Copies the objects compiled by "make core", for the build of a copy of the sources.

    A build reuses the objects of unchanged files.
    """
    for folder in (ROOT / 'build' / 'hmt_ros' / 'build').glob('temp.*'):
        shutil.copytree(folder, build / folder.name)


@pytest.fixture(scope='session')
def mediapipe_pose():
    """Skips tests that need MediaPipe Pose if it is not installed."""
    if not (has_runtime() and has_networks()):
        pytest.skip('MediaPipe Pose is not installed: run "make detector"')


@pytest.fixture(scope='session')
def mocap():
    """Folder of the development motions; skips tests that need it if it is missing."""
    root = Path(__file__).resolve().parents[1]
    folder = Path(os.environ.get('HMT_SHARED', root / '..' / 'shared')) / 'mocap'
    if not (folder / 'index.csv').is_file():
        pytest.skip(f'no development motions in {folder} (set HMT_SHARED)')
    return folder


@pytest.fixture(scope='session')
def human32():
    return load_body('human32')


@pytest.fixture(scope='session')
def human37():
    return load_body('human37')


RandomPoses = Callable[[Body, int, int], np.ndarray]


@pytest.fixture(scope='session')
def random_poses():
    """Function (body, n, seed) -> poses (n, d) inside the limits, root 2 to 5 m from the camera."""

    def draw(body, n, seed):
        rng = np.random.default_rng(seed)
        lower = np.maximum(body.lower, -np.pi)
        upper = np.minimum(body.upper, np.pi)
        poses = rng.uniform(lower, upper, size=(n, body.dimension))
        shifts = np.flatnonzero(~body.skeleton.dof_is_rotation)
        poses[:, shifts] = rng.uniform(-0.5, 0.5, size=(n, len(shifts)))
        poses[:, shifts[-1]] += 3.5
        return poses

    return draw


@pytest.fixture(scope='session')
def walk_video(tmp_path_factory):
    """Folder with walk.mp4, seen at 60 degrees, the results walk.json of a perfect detector of COCO
    keypoints, and the rendered bag `rendered` that both come from, with truth.npz.
    """
    folder = tmp_path_factory.mktemp('video')
    rendered = folder / 'rendered'
    options = ['--duration', '0.8', '--fps', '10', '--size', '320x240', '--fov', '60']
    options += ['--distance', '3.2', '--quiet', '-o', str(rendered)]
    assert make_bag.main(['walk', *options]) == 0
    kind = cv2.VideoWriter_fourcc(*'mp4v')
    writer = cv2.VideoWriter(str(folder / 'walk.mp4'), kind, 10.0, (320, 240))
    assert writer.isOpened()
    with BagReader(rendered) as bag:
        for stored in bag.messages(['image/compressed']):
            writer.write(decode_image(stored.message))
    writer.release()
    truth = np.load(rendered / 'truth.npz')
    joints = {name: i for i, name in enumerate(truth['joint_names'])}
    results = []
    for number, pixels in enumerate(truth['pixels']):
        flat: list[float] = []
        for name in schemes()['coco17'].names:
            # The body has no joints for eyes, ears and nose, so the detector misses them.
            seen = name in joints
            flat += [*map(float, pixels[joints[name]]), 0.9] if seen else [0.0, 0.0, 0.0]
        results.append({'image_id': number, 'category_id': 1, 'keypoints': flat, 'score': 0.9})
    (folder / 'walk.json').write_text(json.dumps(results), 'utf-8')
    return folder
