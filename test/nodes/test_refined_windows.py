"""Windows refined on images, with filter and smoother in the same or different processes."""

import pytest

from hmt_ros.image.image_sequence import SeenImage
from hmt_ros.image.likelihood import ImageLikelihood
from hmt_ros.image.observation import Observation
from msg_tools.messages.cdr import serialise
from test.nodes.test_person_node import (  # noqa: F401
    camera_of,
    spin_until,
    state_of,
    together,
)
from test.sessions.conftest import StubTracker

pytestmark = pytest.mark.ros


def seen(tracker):
    """An image without evidence: only the prior of the body."""
    return SeenImage(ImageLikelihood(tracker.body, tracker.camera), Observation())


@pytest.mark.parametrize('refine', ['asked', 'never'])
def test_a_window_is_refined_in_the_process_of_the_filter(
    refine,
    together,  # noqa: F811
    small_camera,
    monkeypatch,
):
    from hmt_msgs.srv import SmoothWindow

    monkeypatch.setattr(StubTracker, 'shown', property(seen))
    nodes, other, executor = together(refine_on_images=refine)
    smoother, told = nodes['smoother_node'], []
    monkeypatch.setattr(smoother.get_logger(), 'info', told.append)
    publishers = camera_of(other, executor)
    publishers['camera_info'].publish(serialise(small_camera.info()))
    for index in range(3):
        publishers['image'].publish(serialise(small_camera.image(index)))
        spin_until(
            executor, lambda n=index: state_of(smoother).counts['smoothed'] == n + 1, 'smoothing'
        )
    client = other.create_client(SmoothWindow, 'smoother_node/smooth_window')
    spin_until(executor, client.service_is_ready, 'the service')
    answer = client.call_async(SmoothWindow.Request())
    spin_until(executor, answer.done, 'an answer')
    trajectories = answer.result().trajectories
    assert answer.result().success
    assert len(trajectories.stamps) == 3
    if refine == 'asked':
        assert told[-1] == 'motions are refined on 3 images'
        assert len(trajectories.free_energy) >= 1
    else:
        assert told[-1] == 'smoothed without images, as refine_on_images says'
        assert len(trajectories.free_energy) == 0
