"""The table of inputs defines everything about an input in session, node and replay."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from hmt_ros.app.replay import inputs
from hmt_ros.app.replay.inputs import recorded_input
from hmt_ros.sessions import image_inputs, tracking_session
from hmt_ros.sessions.camera_session import CAMERA_INFO, IMAGE
from hmt_ros.sessions.declared_parameters import AT_ONCE, parameter_field
from hmt_ros.sessions.handled import HandlingLog
from hmt_ros.sessions.image_inputs import (
    DEPTH_INPUT,
    DETECTIONS_INPUT,
    INPUTS,
    MASK_INPUT,
    ImageInput,
    ImageInputs,
)
from hmt_ros.sessions.tracking_parameters import FilterParameters
from hmt_ros.sessions.tracking_session import TrackingSession
from msg_tools import BagReader, BagWriter

RANGE = 'sensor_msgs/msg/Range'


def _read_distance(message, stamp):
    if not np.isfinite(message.range):
        raise ValueError(f'uwb of {stamp} ns is {message.range} m, wanted a distance')
    return float(message.range)


# A radio that measures the person's distance. A new input needs this row ...
UWB = ImageInput(
    'uwb', {'uwb': RANGE}, 'use_uwb', _read_distance,
)  # fmt: skip


# ... its parameter ...
@dataclass(frozen=True)
class Parameters(FilterParameters):
    """With a radio.

    Attributes:
        use_uwb: If true, distances of a radio are a measurement.
    """

    use_uwb: bool = parameter_field(False, AT_ONCE)


# ... and where it is used.
class Session(TrackingSession):
    def _people_in(self, waiting, camera):
        self.heard = [*getattr(self, 'heard', []), waiting.content('uwb')]
        return super()._people_in(waiting, camera)


@pytest.fixture
def with_a_radio(monkeypatch):
    for module in (image_inputs, tracking_session):
        monkeypatch.setattr(module, 'INPUTS', (*INPUTS, UWB))
    monkeypatch.setattr(inputs, 'RECORDED_INPUTS', (*inputs.RECORDED_INPUTS, UWB))


def distance(camera, index, metres=2.5):
    return camera.messages.create(RANGE, header=camera.image(index).header, range=metres)


@pytest.mark.usefixtures('with_a_radio')
def test_an_input_is_a_row_and_its_parameter(
    stub_tracker, subject_file, outputs, small_camera, tmp_path
):
    p = Parameters(subject_file=str(subject_file), use_uwb=True, input_timeout=60.0)
    one = Session(p, outputs.append)
    # Images wait for it, and diagnostics know of it.
    assert ('uwb',) in [each.sources for each in one.needed_inputs()]
    one.take(CAMERA_INFO, small_camera.info())
    one.take(IMAGE, small_camera.image(0))
    assert outputs == []
    one.take('uwb', distance(small_camera, 0))
    assert one.heard == [2.5]
    # An invalid message counts as missing, and is reported.
    (fault,) = one.take('uwb', distance(small_camera, 1, np.nan)).faults
    assert fault == f'uwb of {small_camera.stamp(1)} ns is nan m, wanted a distance'
    one.take(IMAGE, small_camera.image(1))
    assert one.heard == [2.5, None]
    # Without its parameter images do not wait.
    one.parameters = replace(p, use_uwb=False)
    one.take(IMAGE, small_camera.image(2))
    assert one.heard == [2.5, None, None]
    # Bags contain it under its name.
    with BagWriter(tmp_path / 'bag') as bag:
        for topic, message in (
            ('/image', small_camera.image(0)), ('/camera_info', small_camera.info()),
            ('/uwb', distance(small_camera, 0)),
        ):  # fmt: skip
            bag.write(topic, small_camera.stamp(0), message)
    with BagReader(tmp_path / 'bag') as bag:
        found = recorded_input(bag)
        assert found.of('uwb').name == '/uwb'
        assert [source for source, _ in found.messages(bag)] == ['image', 'camera_info', 'uwb']


@pytest.mark.ros
@pytest.mark.usefixtures('with_a_radio')
def test_a_node_listens_to_every_row():
    from hmt_ros.nodes.subscribed_topic import input_topics

    topics = {one.topic: one for one in input_topics(TrackingSession.inputs_of(FilterParameters()))}
    assert topics['uwb'].msgtype == RANGE
    assert list(topics) == [source for row in (*INPUTS, UWB) for source in row.types]
    assert topics['depth'].largest == DEPTH_INPUT.largest > topics['uwb'].largest
    assert topics['depth'].waiting < topics['uwb'].waiting
    assert topics['pose_prediction'].qos != topics['uwb'].qos


def test_an_input_of_no_image_is_told(small_camera):
    log = HandlingLog()
    given = ImageInputs((MASK_INPUT, DETECTIONS_INPUT), log)
    image = np.zeros((48, 64, 3), np.uint8)
    for stamp in (1, 2, 3):
        given.put('mask', small_camera.mask(0), stamp, MASK_INPUT.read)
        given.put('detections', None, stamp, lambda message, stamp: ['somebody'])
    assert given.take(MASK_INPUT, 3, image, dropped={2}) is not None
    assert log.faults == {'mask without an image': 1}
    assert log.last_fault.startswith('mask of 1 ns: no image with this stamp waits')
    given.take(DETECTIONS_INPUT, 2, image, dropped=())
    assert log.last_fault.startswith('detections of 1 ns: no image with this stamp waits')
    assert given.take(DETECTIONS_INPUT, 5, image, dropped={3}) is None
    assert log.last_fault == 'no detections came for the image of 5 ns'
    with pytest.raises(KeyError):
        given.put('tail', None, 1, MASK_INPUT.read)
