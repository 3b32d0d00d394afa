"""tools/camera.sh: from a video file to tracked people, without launch files."""

import os
import signal
import subprocess
from contextlib import suppress
from itertools import islice
from pathlib import Path

import cv2
import pytest

from hmt_ros.detectors.registry import DETECTORS, USUAL_DETECTOR
from msg_tools import BagReader
from msg_tools.messages.images import decode_image

ROOT = Path(__file__).parent.parent
DETECTOR = DETECTORS[USUAL_DETECTOR]


@pytest.fixture(scope='module')
def video(tmp_path_factory):
    """Three seconds of the demonstration."""
    path = tmp_path_factory.mktemp('camera') / 'room.avi'
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*'MJPG'), 10, (480, 360))
    with BagReader(ROOT / 'bags' / 'living_room') as bag:
        for stored in islice(bag.messages(['image/compressed']), 30):
            writer.write(decode_image(stored.message))
    writer.release()
    return path


def camera(*arguments):
    command = [ROOT / 'tools' / 'camera.sh', *arguments]
    process = subprocess.Popen(
        command,
        env=os.environ | {'ROS_FROM_APT': '/nowhere'},
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        told = process.communicate(timeout=120)[1]
    finally:
        # Its nodes are killed, too, because they hold the pipe.
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    return subprocess.CompletedProcess(command, process.returncode, stderr=told)


@pytest.mark.skipif(not DETECTOR.is_installed(), reason=f'{DETECTOR.title} is not installed')
@pytest.mark.skipif(not (ROOT / 'install').is_dir(), reason='the packages are not built')
@pytest.mark.parametrize(
    ('options', 'node'), [(['51'], 'humans.bodies.p1.filter_node'), (['', '2'], 'people_node')]
)
def test_people_in_a_video_are_tracked_until_it_ends(video, options, node):
    done = camera(video, *options)
    assert done.returncode == 0, done.stderr
    assert '30 images shown; the file is over' in done.stderr
    assert any(f'[{node}]' in x and 'track 1 starts' in x for x in done.stderr.splitlines())
    assert 'RViz is not in /nowhere (sudo apt install ros-jazzy-rviz2)' in done.stderr
    assert 'unknown parameter' not in done.stderr
    assert 'Traceback' not in done.stderr


@pytest.mark.skipif(not (ROOT / 'install').is_dir(), reason='the packages are not built')
def test_a_camera_that_fails_ends_all():
    done = camera(__file__)
    assert done.returncode == 1
    assert 'camera_node: ' in done.stderr
    assert 'is not a video' in done.stderr
    assert 'Traceback' not in done.stderr


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        (['nothing.mp4'], 'camera: nothing.mp4 is not there: wanted a webcam such as /dev/video0'),
        ([__file__, '60', 'all'], 'camera: PEOPLE: wanted a number from 1 to 20, saw all'),
        ([], 'usage: tools/camera.sh VIDEO [FOV [PEOPLE]]'),
    ],
)
def test_wrong_arguments_are_told_in_one_line(arguments, message):
    done = camera(*arguments)
    assert done.returncode == 1
    assert message in done.stderr
    assert len(done.stderr.splitlines()) == 1
