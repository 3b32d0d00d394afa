import struct
import subprocess
import sys

import cv2
import numpy as np
import pytest

from hmt_ros.app.import_video.frames import Selection, natural_order, open_source
from msg_tools.files.display_matrix import display_matrix


def boxes(content, start, end):
    """(kind, begin, end) of the boxes of an MP4 file between two offsets."""
    while start < end:
        size, kind = struct.unpack_from('>I4s', content, start)
        yield kind.decode(), start, start + size
        start += size


def find(content, *path):
    """Offsets of the boxes on a path through an MP4 file, and the end of the last box."""
    begin, end, found = 0, len(content), []
    for kind in path:
        begin, end = next((b, e) for k, b, e in boxes(content, begin, end) if k == kind)
        found.append(begin)
        begin += 8
    return found, end


def with_durations(content, durations):
    """An MP4 file with changed durations of the frames, in units of its time scale."""
    above, end = find(content, 'moov', 'trak', 'mdia', 'minf', 'stbl', 'stts')
    entries = b''.join(struct.pack('>II', 1, d) for d in durations)
    table = struct.pack('>I4sII', 16 + len(entries), b'stts', 0, len(durations)) + entries
    grown = len(table) - (end - above[-1])
    assert content.index(b'mdat') < above[0], 'places in the data would change'
    changed = bytearray(content)
    for begin in above[:-1]:
        struct.pack_into('>I', changed, begin, struct.unpack_from('>I', content, begin)[0] + grown)
    changed[above[-1] : end] = table
    return bytes(changed)


def turned(content, a, b, c, d, x, y):
    """An MP4 file shown transformed: its pixel (u, v) at (a u + c v + x, b u + d v + y)."""
    (*_, begin), _ = find(content, 'moov', 'trak', 'tkhd')
    changed = bytearray(content)
    matrix = [x << 16 for x in (a, b, 0, c, d, 0, x, y)]
    struct.pack_into('>9i', changed, begin + 48, *matrix, 1 << 30)
    return bytes(changed)


def read(path, fps=None, **selection):
    source = open_source(path, fps)
    return [*source.frames(Selection(**selection))], source


def test_video_is_read_frame_by_frame(video, number_in):
    frames, source = read(video)
    assert [x.number for x in frames] == [*range(10)]
    assert [number_in(x.image) for x in frames] == [*range(10)]
    assert [x.time_ns for x in frames] == [40_000_000 * i for i in range(10)]
    assert {x.jpeg for x in frames} == {None}
    assert (source.count, source.ended, source.claimed) == (10, True, 10)


def test_range_and_every(video, number_in):
    frames, source = read(video, start=0.1, end=0.3, every=2)
    assert [x.number for x in frames] == [3, 5, 7]
    assert [number_in(x.image) for x in frames] == [3, 5, 7]
    assert not source.ended
    with pytest.raises(ValueError, match=r'--start 2 is not before --end 1'):
        Selection(2.0, 1.0)


def test_times_of_a_variable_frame_rate(video):
    content = video.read_bytes()
    (*_, begin), _ = find(content, 'moov', 'trak', 'mdia', 'mdhd')
    (scale,) = struct.unpack_from('>I', content, begin + 20)
    # The total duration is unchanged, because an edit list cuts off the rest.
    units = [scale // 50 * x for x in (1, 1, 4, 1, 2, 1, 1, 6, 1, 2)]
    video.write_bytes(with_durations(content, units))
    frames, _ = read(video)
    wanted = np.concatenate([[0], np.cumsum(units)[:-1]]) / scale
    assert np.allclose([x.time_ns / 1e9 for x in frames], wanted, atol=1e-6)


@pytest.mark.parametrize(
    ('matrix', 'turn'),
    [
        ((0, 1, -1, 0, 48, 0), cv2.ROTATE_90_CLOCKWISE),
        ((0, -1, 1, 0, 0, 64), cv2.ROTATE_90_COUNTERCLOCKWISE),
        ((-1, 0, 0, -1, 64, 48), cv2.ROTATE_180),
    ],
)
def test_video_of_a_phone_is_upright(matrix, turn, video):
    stored, _ = read(video)
    video.write_bytes(turned(video.read_bytes(), *matrix))
    frames, _ = read(video)
    assert len(frames) == 10
    assert np.array_equal(frames[0].image, cv2.rotate(stored[0].image, turn))


@pytest.mark.parametrize(
    ('matrix', 'mirrored'),
    [
        ((-1, 0, 0, 1, 64, 0), lambda x: x[:, ::-1]),
        ((1, 0, 0, -1, 0, 48), lambda x: x[::-1]),
        ((0, 1, 1, 0, 0, 0), lambda x: x.swapaxes(0, 1)),
        ((0, -1, -1, 0, 48, 64), lambda x: x.swapaxes(0, 1)[::-1, ::-1]),
    ],
)
def test_mirrored_video_is_shown_as_players_do(matrix, mirrored, video):
    stored, plain = read(video)
    video.write_bytes(turned(video.read_bytes(), *matrix))
    frames, source = read(video)
    assert np.array_equal(frames[3].image, mirrored(stored[3].image))
    assert frames[3].image.flags.c_contiguous
    assert plain.notes == []
    assert [x for x in source.notes if 'mirror the frames' in x] == source.notes != []


def test_display_matrix_of_damaged_and_other_files(video, tmp_path):
    content = video.read_bytes()
    assert display_matrix(video) == (1 << 16, 0, 0, 1 << 16)
    for damaged in (content[: content.index(b'tkhd') + 30], b'', b'RIFF' + bytes(40), bytes(64)):
        path = tmp_path / 'damaged.mp4'
        path.write_bytes(damaged)
        assert display_matrix(path) is None
    # 64-bit lengths, and a sound track before the image track.
    (moov, *_), end = find(content, 'moov', 'trak')
    (_, trak), _ = find(content, 'moov', 'trak')
    sound = content[trak:end].replace(b'vide', b'soun')
    inside = content[moov + 8 : trak] + sound + turned(content, -1, 0, 0, 1, 64, 0)[trak:]
    path.write_bytes(content[:moov] + struct.pack('>I4sQ', 1, b'moov', 16 + len(inside)) + inside)
    assert display_matrix(path) == (-1 << 16, 0, 0, 1 << 16)


def test_pixels_that_are_not_square(video, with_pixel_aspect):
    stored, _ = read(video)
    assert stored[0].aspect == 1.0
    content = with_pixel_aspect(video.read_bytes(), 64, 45)
    video.write_bytes(content)
    frames, source = read(video)
    assert np.array_equal(frames[0].image, stored[0].image)
    assert frames[0].aspect == pytest.approx(64 / 45)
    assert len(source.notes) == 1
    assert 'pixels are 1.42 times as wide as high' in source.notes[0]
    video.write_bytes(turned(content, 0, 1, -1, 0, 48, 0))
    frames, _ = read(video)
    assert frames[0].aspect == pytest.approx(45 / 64)


def test_folder_is_read_in_the_order_of_numbers(folder, number_in):
    frames, source = read(folder, fps=10.0)
    assert [x.name for x in frames] == [f'img_{i}.jpg' for i in range(1, 11)]
    assert [number_in(x.image) for x in frames] == [*range(10)]
    assert [x.time_ns for x in frames] == [100_000_000 * i for i in range(10)]
    assert frames[3].jpeg == (folder / 'img_4.jpg').read_bytes()
    assert source.ended
    assert natural_order('a_9.png') < natural_order('a_10.png')


def test_jpeg_that_was_taken_turned_is_made_upright(folder):
    content = (folder / 'img_1.jpg').read_bytes()
    # Exif orientation 6: rotate by 90 degrees clockwise.
    entry = struct.pack('<HHIHH', 0x0112, 3, 1, 6, 0)
    exif = b'Exif\0\0' + struct.pack('<2sHIH', b'II', 42, 8, 1) + entry + bytes(4)
    segment = b'\xff\xe1' + struct.pack('>H', 2 + len(exif)) + exif
    (folder / 'img_1.jpg').write_bytes(content[:2] + segment + content[2:])
    frame = open_source(folder, 1.0).frame(0)
    assert frame.jpeg is None
    assert frame.image.shape == (64, 48, 3)
    assert frame.image[:16, 40:].min() > 200  # the bright corner is at the right


def test_labels_of_frames(folder, video):
    images, film = open_source(folder, 1.0), open_source(video, None, first_number=1)
    assert images.number_of('img_10') == 9
    assert images.number_of('elsewhere/img_10.jpg') == 9
    assert images.number_of('mask_0003.png') == 3
    assert film.number_of('walk_000000000012') == 11
    assert film.number_of(12) == 11
    with pytest.raises(ValueError, match='0 is before the first frame, which has the number 1'):
        film.number_of(0)
    with pytest.raises(ValueError, match=r'mask\.png is not the name of a frame and has no number'):
        film.number_of('mask.png')


def test_bad_sources(tmp_path, folder):
    (tmp_path / 'broken.mp4').write_bytes(b'no video' * 100)
    (tmp_path / 'empty').mkdir()
    for name, message in (
        ('nothing.mp4', 'no such file'),
        ('broken.mp4', 'is not a video that OpenCV can read'),
        ('empty', 'has no images, wanted files .jpg'),
        ('images/img_1.jpg', 'is one image; wanted a video file or a folder'),
    ):
        with pytest.raises(ValueError, match=message):
            open_source(tmp_path / name, 1.0)
    with pytest.raises(ValueError, match='give their rate with --fps'):
        read(folder)
    (folder / 'img_3.jpg').write_bytes((folder / 'img_3.jpg').read_bytes()[:200])
    with pytest.raises(ValueError, match=r'img_3\.jpg: jpeg of 200 bytes breaks off'):
        read(folder, fps=1.0)
    (folder / 'img_3.jpg').unlink()
    (folder / 'img_3.png').write_bytes(b'no image')
    with pytest.raises(ValueError, match=r'img_3\.png: not an image that OpenCV can read'):
        read(folder, fps=1.0)


BOMBS = {
    # Run lengths: a few bytes for 900 million pixels.
    'a.bmp': struct.pack('<2sIHHI', b'BM', 0, 0, 0, 1078)
    + struct.pack('<IiiHHIIiiII', 40, 30000, 30000, 1, 8, 1, 0, 0, 0, 0, 0)
    + bytes(1024)
    + b'\0\1',
    'a.ppm': b'P6 30000 30000 255\n',
    'a.webp': b'RIFF\x1a\0\0\0WEBPVP8L\x0d\0\0\0\x2f\xff\xff\xff\x0f' + bytes(9),
}


@pytest.mark.parametrize('name', BOMBS)
def test_sizes_of_images_are_checked_before_memory_is_made(name, tmp_path):
    """OpenCV reads its limit on import, so a new process imports the package first."""
    path = tmp_path / name
    path.write_bytes(BOMBS[name])
    program = f"""\
from pathlib import Path
import resource
from hmt_ros.app.import_video.frames import ImageFolder, Selection
resource.setrlimit(resource.RLIMIT_AS, (3 * 2**30, 3 * 2**30))
try:
    next(ImageFolder(Path({str(tmp_path)!r}), 25.0).frames(Selection()))
except ValueError as error:
    print(error, end='')
"""
    done = subprocess.run(
        [sys.executable, '-c', program], capture_output=True, text=True, check=True, timeout=60
    )
    assert f'{path}: ' in done.stdout
    assert '\n' not in done.stdout
    assert done.stderr == ''
