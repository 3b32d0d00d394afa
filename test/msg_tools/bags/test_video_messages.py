"""Videos in bags become images, with PyAV or with a compatible stand-in."""

import sys
from fractions import Fraction
from types import SimpleNamespace

import numpy as np
import pytest

from msg_tools import BagError, BagReader, BagWriter, RosbagsMessages
from msg_tools.bags.video_messages import VIDEO_TYPE, image_stamp, is_video, with_pictures
from msg_tools.messages.headers import header_message, time_message, time_ns
from msg_tools.messages.images import decode_image
from msg_tools.messages.message_types import register_definitions

MESSAGES = RosbagsMessages()
TOPIC = '/camera/image/compressed'
START_NS, STEP_NS = 1_700_000_000_000_000_000, 40_000_000
DEFINITION = """\
builtin_interfaces/Time timestamp
string frame_id
uint8[] data
string format
"""


def scene(number):
    """An image whose grey level encodes the number."""
    return np.full((48, 64, 3), 30 + 16 * number, np.uint8)


def number_in(picture):
    return round((float(np.median(picture)) - 30) / 16)


class Decoder:
    """Decodes packets b'K<number>' (key frame), b'P<number>', b'H' (parameters), b'!' (damaged).

    Pictures are returned one packet late.
    """

    def __init__(self):
        self.waiting = []

    def decode(self, packet):
        done, self.waiting = self.waiting, []
        if packet is None or packet.data == b'H':
            return done
        if packet.data == b'!':
            self.waiting = done
            raise FakeError
        number = int(packet.data[1:])
        frame = SimpleNamespace(pts=packet.pts, key_frame=packet.data[:1] == b'K')
        frame.to_ndarray = lambda format: scene(number)  # noqa: A006
        self.waiting = [frame]
        return done


class FakeError(Exception):
    pass


@pytest.fixture
def stand_in(monkeypatch):
    made = SimpleNamespace(
        CodecContext=SimpleNamespace(create=lambda codec, mode: Decoder()),
        Packet=lambda data: SimpleNamespace(data=data, pts=None),
        error=SimpleNamespace(FFmpegError=FakeError),
    )
    monkeypatch.setitem(sys.modules, 'av', made)


def write(path, packets, kind='h264'):
    with BagWriter(path) as bag:
        for i, data in enumerate(packets):
            stamp = START_NS + i * STEP_NS
            bag.write(
                TOPIC,
                stamp,
                MESSAGES.create(
                    'sensor_msgs/msg/CompressedImage',
                    header=header_message(MESSAGES, stamp, 'lens'),
                    format=kind,
                    data=np.frombuffer(data, np.uint8),
                ),
            )
    return path


def pictures(path):
    """(message index, number in the picture) of the images."""
    with BagReader(path) as bag:
        assert is_video(bag, bag.topics[TOPIC])
        found = []
        for stored in with_pictures(bag.messages(), TOPIC):
            assert stored.msgtype == 'sensor_msgs/msg/Image'
            stamp = time_ns(stored.message.header.stamp)
            assert stored.log_time_ns == stamp == image_stamp(stored.message)
            assert stored.message.header.frame_id == 'lens'
            number = number_in(decode_image(stored.message))
            found.append(((stamp - START_NS) // STEP_NS, number))
        return found


@pytest.mark.usefixtures('stand_in')
def test_pictures_have_the_stamps_of_their_packets(tmp_path):
    packets = [b'P9', b'P9', b'H', b'K1', b'P2', b'!', b'P3', b'P4']
    # Packets before the key frame and damaged ones are skipped.
    assert pictures(write(tmp_path / 'bag', packets)) == [(3, 1), (4, 2), (6, 3), (7, 4)]


@pytest.mark.usefixtures('stand_in')
def test_without_a_key_frame_there_is_no_picture(tmp_path):
    with pytest.raises(BagError, match='none of its 2 packets of video is a complete key frame'):
        pictures(write(tmp_path / 'bag', [b'P1', b'P2']))


def test_one_line_without_the_library(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, 'av', None)
    path = write(tmp_path / 'bag', [b'K1'])
    with BagReader(path) as bag, pytest.raises(BagError, match=r'needs PyAV .*: pip install av$'):
        is_video(bag, bag.topics[TOPIC])
    with BagReader(path) as bag, pytest.raises(BagError, match='h264 video, which needs PyAV'):
        next(with_pictures(bag.messages(), TOPIC))


def test_other_images_stay(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, 'av', None)
    path = write(tmp_path / 'bag', [b'jpeg'], kind='jpeg')
    with BagReader(path) as bag:
        assert not is_video(bag, bag.topics[TOPIC])
        (stored,) = with_pictures(bag.messages(), TOPIC)
        assert stored.msgtype == 'sensor_msgs/msg/CompressedImage'


def encoded(av, codec='libx264'):
    """Packets of twelve pictures, a key frame first."""
    try:
        context = av.CodecContext.create(codec, 'w')
    except Exception:  # noqa: BLE001 - a build without the encoder
        pytest.skip(f'this PyAV has no {codec}')
    context.width, context.height, context.pix_fmt = 64, 48, 'yuv420p'
    context.time_base, context.options = Fraction(1, 25), {'bf': '0', 'crf': '10'}
    packets = []
    for i in range(12):
        frame = av.VideoFrame.from_ndarray(scene(i), format='bgr24').reformat(format='yuv420p')
        frame.pts = i
        packets += context.encode(frame)
    return [bytes(x) for x in (*packets, *context.encode(None))]


def test_h264_itself(tmp_path):
    av = pytest.importorskip('av', reason='PyAV is not installed')
    packets = encoded(av)
    assert pictures(write(tmp_path / 'bag', packets)) == [(i, i) for i in range(12)]
    # A recording that begins between two key frames.
    late = [*packets[5:], *packets]
    assert pictures(write(tmp_path / 'late', late)) == [(7 + i, i) for i in range(12)]


def test_video_of_foxglove(tmp_path, stand_in):
    folder = tmp_path / 'msg'
    folder.mkdir()
    (folder / 'CompressedVideo.msg').write_text(DEFINITION, 'utf-8')
    register_definitions('foxglove_msgs', folder)
    with BagWriter(tmp_path / 'bag') as bag:
        for i, data in enumerate((b'K0', b'P1', b'P2')):
            stamp = START_NS + i * STEP_NS
            message = MESSAGES.create(
                VIDEO_TYPE,
                timestamp=time_message(MESSAGES, stamp),
                frame_id='lens',
                data=np.frombuffer(data, np.uint8),
                format='h264',
            )
            bag.write(TOPIC, stamp, message)
            assert image_stamp(message) == stamp
    assert pictures(tmp_path / 'bag') == [(0, 0), (1, 1), (2, 2)]
