"""Videos from outside: only their own images, and no more images than bytes."""

import struct

import cv2
import numpy as np
import pytest

from msg_tools.files.video_file import open_video

SIZE = (64, 48)
ABOVE = (b'moov', b'trak', b'mdia', b'minf', b'stbl')


def write_video(path, code='mp4v', size=SIZE, count=3):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*code), 25, size)
    for i in range(count):
        writer.write(np.full((size[1], size[0], 3), 50 * i, np.uint8))
    writer.release()
    return path


def images_in(path):
    capture, count = open_video(path), 0
    while capture.grab():
        count += 1
    return count


@pytest.mark.parametrize(
    ('name', 'code'), [('a.mp4', 'mp4v'), ('a.avi', 'MJPG'), ('a.mkv', 'MJPG')]
)
def test_videos_are_opened(name, code, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = write_video(tmp_path / name, code)
    assert images_in(path) == 3
    assert images_in(path.rename(tmp_path / f'http:{name}').relative_to(tmp_path)) == 3


@pytest.mark.parametrize(
    ('name', 'text'),
    [
        ('list.mp4', 'ffconcat version 1.0\nfile secret.mp4\n'),
        ('list.txt', 'ffconcat version 1.0\nfile secret.mp4\n'),
        ('list.m3u8', '#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\nsecret.mp4\n#EXT-X-ENDLIST\n'),
        ('call.sdp', 'v=0\no=- 0 0 IN IP4 127.0.0.1\ns=x\nt=0 0\nm=video 5004 RTP/AVP 96\n'),
        ('list.mpd', '<?xml version="1.0"?><MPD><BaseURL>secret.mp4</BaseURL></MPD>'),
        ('secret_%01d.png', '\x00\x00\x01\xba'),
        ('secret_%01d.tga', '\x00\x00\x01\xba'),
        ('empty.mp4', ''),
    ],
)
def test_no_other_file_is_read(name, text, tmp_path):
    write_video(tmp_path / 'secret.mp4')
    for i in range(3):
        cv2.imwrite(str(tmp_path / f'secret_{i}.png'), np.zeros((8, 8, 3), np.uint8))
    (tmp_path / name).write_bytes(text.encode('latin-1'))
    with pytest.raises(ValueError, match='is not a video that OpenCV can read') as caught:
        open_video(tmp_path / name)
    assert '\n' not in str(caught.value)


def test_more_images_than_bytes_are_not_announced(tmp_path):
    """FFmpeg needs 24 bytes for each image that a table or fragment announces in four bytes."""
    whole = write_video(tmp_path / 'a.mp4').read_bytes()
    at = whole.index(b'stsz') + 8
    path = tmp_path / 'many.mp4'
    path.write_bytes(whole[:at] + struct.pack('>II', 1, 80_000_000) + whole[at + 8 :])
    with pytest.raises(ValueError, match='is not a video'):
        open_video(path)
    run = struct.pack('>I4sII', 16, b'trun', 0, 80_000_000)
    for kind in (b'traf', b'moof'):
        run = struct.pack('>I4s', len(run) + 8, kind) + run
    path.write_bytes(whole + run)
    with pytest.raises(ValueError, match='is not a video'):
        open_video(path)


def test_size_is_checked_before_an_image_is_made(tmp_path):
    path = write_video(tmp_path / 'a.avi', 'MJPG', (8200, 8200), 1)
    with pytest.raises(ValueError, match='images of 8200x8200 pixels, the limit is 67108864'):
        open_video(path)
