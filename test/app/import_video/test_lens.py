"""The focal length in the metadata of videos."""

import math
import struct

import pytest

from hmt_ros.app.import_video.lens import KEY, metadata_fov

MAKE = b'com.apple.quicktime.make'


def box(kind, *contents):
    content = b''.join(contents)
    return struct.pack('>I4s', 8 + len(content), kind) + content


def metadata(values, *, version=b''):
    """A box of values, (type, bytes) by name, in QuickTime's form or with MP4's version."""
    names = [box(b'mdta', name) for name in values]
    keys = box(b'keys', struct.pack('>II', 0, len(names)), *names)
    items = [
        box(struct.pack('>I', i), box(b'data', struct.pack('>II', kind, 0), content))
        for i, (kind, content) in enumerate(values.values(), 1)
    ]
    return box(b'meta', version, box(b'hdlr', bytes(24)), keys, box(b'ilst', *items))


def fov_of(focal):
    return pytest.approx(math.degrees(2 * math.atan(18 / focal)))


@pytest.fixture
def told(tmp_path):
    def write(*boxes):
        path = tmp_path / 'video.mov'
        path.write_bytes(b''.join([box(b'ftyp', b'qt  '), *boxes]))
        return metadata_fov(path)

    return write


@pytest.mark.parametrize(
    'value', [(21, struct.pack('>i', 26)), (23, struct.pack('>f', 26.0)), (1, b'26')]
)
def test_a_focal_length_of_the_movie_or_of_its_track(told, value):
    values = {MAKE: (1, b'Apple'), KEY: value}
    assert told(box(b'mdat', bytes(99)), box(b'moov', metadata(values))) == fov_of(26)
    track = box(b'moov', box(b'mvhd', bytes(8)), box(b'trak', metadata(values)))
    assert told(track) == fov_of(26)
    assert told(box(b'moov', metadata(values, version=bytes(4)))) == fov_of(26)


def test_boxes_with_long_sizes_are_passed(told):
    long = struct.pack('>I4sQ', 1, b'mdat', 16 + 99) + bytes(99)
    assert told(long, box(b'moov', metadata({KEY: (23, struct.pack('>d', 13)[:4])}))) != fov_of(13)
    assert told(long, box(b'moov', metadata({KEY: (24, struct.pack('>d', 13))}))) == fov_of(13)


@pytest.mark.parametrize(
    'boxes',
    [
        [],
        [box(b'moov', metadata({MAKE: (1, b'Apple')}))],
        [box(b'moov', metadata({KEY: (1, b'wide')}))],
        [box(b'moov', metadata({KEY: (23, b'\0')}))],
        [box(b'moov', metadata({KEY: (21, bytes(4))}))],
        [box(b'moov', metadata({KEY: (21, b'\xff' * 200)}))],
        [box(b'moov', box(b'meta'))],
        [b'\0\0\0\0moov' * 5000],
        [b'\0\0\0\4moov', bytes(40)],
        [box(b'moov', metadata({KEY: (21, struct.pack('>i', 26))}))[:-6]],
    ],
)
def test_files_that_do_not_tell(told, boxes):
    assert told(*boxes) is None
