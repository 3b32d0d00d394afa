"""Images in messages: every encoding compared with OpenCV, one error line for every defect."""

import struct
import zlib
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from msg_tools.messages.images import (
    ImageError,
    compressed_image_message,
    decode_image,
    decode_mask,
    decode_picture,
    encode_jpeg,
    image_message,
)

HEIGHT, WIDTH = 30, 44
RNG = np.random.default_rng(2)


def scene():
    """A smooth coloured image, BGR."""
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH]
    planes = [128 + 100 * np.sin(u / 7), 128 + 100 * np.cos(v / 9), 255 * u / WIDTH]
    return np.stack(planes, axis=-1).round().astype(np.uint8)


def raw(pixels, encoding, /, *, padding=0, big=False, **changes):
    """An Image message of rows of pixels."""
    kind = pixels.dtype.newbyteorder('>' if big else '<')
    rows = np.ascontiguousarray(pixels.astype(kind)).view(np.uint8).reshape(len(pixels), -1)
    padded = np.hstack([rows, np.full((len(rows), padding), 171, dtype=np.uint8)])
    fields = {
        'height': HEIGHT,
        'width': WIDTH,
        'encoding': encoding,
        'is_bigendian': int(big),
        'step': padded.shape[1],
        'data': padded.tobytes(),
    }
    return SimpleNamespace(**{**fields, **changes})


BGR = scene()
GREY = cv2.cvtColor(BGR, cv2.COLOR_BGR2GRAY)
WORDS = RNG.integers(0, 65536, (HEIGHT, WIDTH), dtype=np.uint16)
MOSAIC = RNG.integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8)
PAIRS = RNG.integers(0, 256, (HEIGHT, WIDTH, 2), dtype=np.uint8)
PLANES = RNG.integers(0, 256, (HEIGHT * 3 // 2, WIDTH), dtype=np.uint8)
ALPHA = np.dstack([BGR, MOSAIC])


def eight_bits(words):
    return np.rint(words.astype(np.float64) / 257.0).astype(np.uint8)


# Encoding, pixels as sent, expected image.
CASES: list[tuple[str, Any, Any]] = [
    ('mono8', GREY, cv2.cvtColor(GREY, cv2.COLOR_GRAY2BGR)),
    ('8UC1', GREY, cv2.cvtColor(GREY, cv2.COLOR_GRAY2BGR)),
    ('mono16', WORDS, np.dstack([eight_bits(WORDS)] * 3)),
    ('16UC1', WORDS, np.dstack([eight_bits(WORDS)] * 3)),
    ('bgr8', BGR, BGR),
    ('8UC3', BGR, BGR),
    ('rgb8', BGR[..., ::-1], BGR),
    ('bgra8', ALPHA, BGR),
    ('8UC4', ALPHA, BGR),
    ('rgba8', ALPHA[..., [2, 1, 0, 3]], BGR),
    ('bgr16', BGR.astype(np.uint16) * 257, BGR),
    ('rgb16', BGR[..., ::-1].astype(np.uint16) * 257, BGR),
    ('bgra16', ALPHA.astype(np.uint16) * 257, BGR),
    ('rgba16', ALPHA[..., [2, 1, 0, 3]].astype(np.uint16) * 257, BGR),
    ('bayer_rggb8', MOSAIC, cv2.cvtColor(MOSAIC, cv2.COLOR_BayerRGGB2BGR)),
    ('bayer_bggr8', MOSAIC, cv2.cvtColor(MOSAIC, cv2.COLOR_BayerBGGR2BGR)),
    ('bayer_gbrg8', MOSAIC, cv2.cvtColor(MOSAIC, cv2.COLOR_BayerGBRG2BGR)),
    ('bayer_grbg8', MOSAIC, cv2.cvtColor(MOSAIC, cv2.COLOR_BayerGRBG2BGR)),
    ('bayer_rggb16', WORDS, eight_bits(cv2.cvtColor(WORDS, cv2.COLOR_BayerRGGB2BGR))),
    ('bayer_bggr16', WORDS, eight_bits(cv2.cvtColor(WORDS, cv2.COLOR_BayerBGGR2BGR))),
    ('bayer_gbrg16', WORDS, eight_bits(cv2.cvtColor(WORDS, cv2.COLOR_BayerGBRG2BGR))),
    ('bayer_grbg16', WORDS, eight_bits(cv2.cvtColor(WORDS, cv2.COLOR_BayerGRBG2BGR))),
    ('yuv422', PAIRS, cv2.cvtColor(PAIRS, cv2.COLOR_YUV2BGR_UYVY)),
    ('uyvy', PAIRS, cv2.cvtColor(PAIRS, cv2.COLOR_YUV2BGR_UYVY)),
    ('yuv422_yuy2', PAIRS, cv2.cvtColor(PAIRS, cv2.COLOR_YUV2BGR_YUY2)),
    ('yuyv', PAIRS, cv2.cvtColor(PAIRS, cv2.COLOR_YUV2BGR_YUY2)),
    ('yvyu', PAIRS, cv2.cvtColor(PAIRS, cv2.COLOR_YUV2BGR_YVYU)),
    ('nv12', PLANES, cv2.cvtColor(PLANES, cv2.COLOR_YUV2BGR_NV12)),
    ('nv21', PLANES, cv2.cvtColor(PLANES, cv2.COLOR_YUV2BGR_NV21)),
]


@pytest.mark.parametrize('padding', [0, 1, 6])
@pytest.mark.parametrize(('encoding', 'pixels', 'wanted'), CASES, ids=[case[0] for case in CASES])
def test_every_encoding(encoding, pixels, wanted, padding):
    for big in (False, True) if pixels.dtype == np.uint16 else (False,):
        picture = decode_image(raw(pixels, encoding, padding=padding, big=big))
        np.testing.assert_array_equal(picture, wanted)
        assert picture.dtype == np.uint8
        assert picture.flags.c_contiguous
        assert picture.flags.writeable


@pytest.mark.parametrize('padding', [0, 2, 6])
@pytest.mark.parametrize('encoding', ['yuv420', 'i420', 'yv12'])
def test_three_planes(encoding, padding):
    """Chroma rows have half the length and half the padding, as in libcamera."""
    wanted = cv2.cvtColor(PLANES, cv2.COLOR_YUV2BGR_I420)
    luma, chroma = PLANES[:HEIGHT], PLANES[HEIGHT:].reshape(2, HEIGHT // 2, WIDTH // 2)
    halves = chroma[::-1] if encoding == 'yv12' else chroma
    data = np.pad(luma, ((0, 0), (0, padding))).tobytes()
    data += np.pad(halves, ((0, 0), (0, 0), (0, padding // 2))).tobytes()
    step = WIDTH + padding
    message = raw(BGR, encoding, data=data, step=step)
    np.testing.assert_array_equal(decode_image(message), wanted)
    message = raw(BGR, encoding, data=data, step=step + 1)
    with pytest.raises(ImageError, match=f'step is {step + 1}, wanted an even one'):
        decode_image(message)
    message = raw(BGR, encoding, data=data[:-2], step=step)
    with pytest.raises(ImageError, match=f'image has {len(data) - 2} bytes, wanted {len(data)}'):
        decode_image(message)


@pytest.mark.parametrize(
    ('changes', 'error'),
    [
        ({'encoding': 'rgb9'}, r"image encoding 'rgb9' is not known, wanted one of mono8, "),
        ({'width': 0}, r'image has size 0x30, wanted at least one pixel'),
        ({'height': 0}, r'image has size 44x0'),
        ({'step': 131}, r'image step is 131, wanted at least 132 for 44 bgr8'),
        ({'step': 0}, r'image step is 0'),
        ({'height': 31}, r'image has 3960 bytes, wanted 4092: 31 rows with a step of 132'),
        ({'height': 29}, r'image has 3960 bytes, wanted 3828'),
        ({'data': b''}, r'image has 0 bytes'),
        ({'data': None}, r'image data is a NoneType, wanted bytes'),
        ({'width': 2**31, 'height': 2**31, 'step': 2**33}, r'the limit is 67108864 pixels'),
        (
            {'encoding': 'yuv422', 'width': 43},
            r'image of 43x30 can not be yuv422, wanted even sizes',
        ),
        ({'encoding': 'nv12', 'height': 31}, r'image of 44x31 can not be nv12, wanted even sizes'),
    ],
)
def test_defects_of_raw_images(changes, error):
    with pytest.raises(ImageError, match=error):
        decode_image(raw(BGR, 'bgr8', **changes))


# Compressed


def compressed(data, form='jpeg'):
    return SimpleNamespace(format=form, data=data)


def encoded(suffix, image):
    done, data = cv2.imencode(suffix, image)
    assert done
    return bytes(data)


@pytest.mark.parametrize(
    ('form', 'suffix'),
    [
        ('jpeg', '.jpg'),
        ('jpg', '.jpg'),
        ('', '.jpg'),
        ('bgr8; jpeg compressed bgr8', '.jpg'),
        ('rgb8; jpeg compressed bgr8', '.jpg'),
        ('png', '.png'),
        ('rgb8; png compressed bgr8', '.png'),
    ],
)
def test_compressed_formats(form, suffix):
    data = encoded(suffix, BGR)
    wanted = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    picture = decode_image(compressed(data, form))
    np.testing.assert_array_equal(picture, wanted)
    assert picture.flags.writeable
    if suffix == '.png':
        np.testing.assert_array_equal(picture, BGR)


def test_compressed_grey_alpha_and_16_bits():
    for image, wanted in (
        (GREY, np.dstack([GREY] * 3)),
        (ALPHA, BGR),
        (BGR.astype(np.uint16) * 257, BGR),
    ):
        np.testing.assert_array_equal(
            decode_image(compressed(encoded('.png', image), 'png')), wanted
        )
    grey = decode_image(compressed(encoded('.jpg', GREY)))
    assert grey.shape == (HEIGHT, WIDTH, 3)
    assert np.abs(grey[..., 1].astype(int) - GREY).mean() < 3


def test_jpeg_that_was_cut_anywhere_is_no_picture():
    data = encoded('.jpg', BGR)
    for length in range(len(data) - 1):
        with pytest.raises(ImageError):
            decode_image(compressed(data[:length]))
    # Cameras pad their images.
    assert decode_image(compressed(data + bytes(7))).shape == BGR.shape


def test_damaged_pictures_never_crash():
    for suffix in ('.jpg', '.png'):
        data = encoded(suffix, BGR)
        for seed in range(300):
            rng = np.random.default_rng(seed)
            damaged = bytearray(data)
            for offset in rng.integers(0, len(data), 4):
                damaged[offset] = rng.integers(256)
            try:
                picture = decode_image(compressed(bytes(damaged)))
            except ImageError:
                continue
            assert picture.size <= 3 * 2**26


def with_size(png, width, height):
    header = b'IHDR' + struct.pack('>II', width, height) + png[24:29]
    return png[:12] + header + struct.pack('>I', zlib.crc32(header)) + png[33:]


def test_a_small_file_of_one_colour_is_not_a_huge_picture():
    png = encoded('.png', np.zeros((4096, 4096), np.uint8))
    assert decode_picture(png, colours=cv2.IMREAD_GRAYSCALE).shape == (4096, 4096)
    png = encoded('.png', np.zeros((4096, 8192), np.uint8))
    with pytest.raises(ImageError, match='can not have a size of 8192x4096'):
        decode_picture(png)


def test_defects_of_compressed_images():
    jpeg = encoded('.jpg', BGR)
    frame = jpeg.index(b'\xff\xc0')
    huge = jpeg[: frame + 5] + b'\xff\xff\xff\xff' + jpeg[frame + 9 :]
    large = jpeg[: frame + 5] + b'\x10\x00\x10\x00' + jpeg[frame + 9 :]
    png = encoded('.png', BGR)
    for message, error in (
        (compressed(b''), r"of format 'jpeg' starts with b'', wanted jpeg or png"),
        (compressed(b'\x00\x00\x00\x01h264', 'h264'), r"of format 'h264' starts with"),
        (compressed(jpeg[:2] + b'\xff\xfe\x00\x03c' * 1000 + jpeg[2:]), 'its size is missing'),
        (compressed(jpeg[:2] + b'\xff\xd0\x00\x02' + jpeg[2:]), 'its size is missing'),
        (compressed(jpeg[:2] + b'\xff\xc0\x00\x02'), 'its size is missing'),
        (compressed(png, '16UC1; compressedDepth png'), r'depth, wanted a picture'),
        (compressed(huge), r'has size \d+x\d+, the limit is'),
        (compressed(large), rf'of {len(large)} bytes can not have a size of 4096x4096'),
        (compressed(with_size(png, 8192, 8200), 'png'), r'8192x8200, the limit is'),
        (compressed(with_size(png, 0, 0), 'png'), r'has size 0x0, wanted at least one pixel'),
        (compressed(with_size(png, 8000, 8000), 'png'), r'can not have a size of 8000x8000'),
        (
            compressed(png[:33] + chunk(b'IDAT', zlib.compress(bytes(10**8), 9)) + png[33:], 'png'),
            'has more data than 44x30',
        ),
        (compressed(png[:40] + b'?' + png[41:], 'png'), r'breaks off or is damaged$'),
        (compressed(png[:33] + b'\x7f' + png[34:], 'png'), r'breaks off or is damaged'),
    ):
        with pytest.raises(ImageError, match=error):
            decode_image(message)


def chunk(kind, content):
    return (
        struct.pack('>I', len(content))
        + kind
        + content
        + struct.pack('>I', zlib.crc32(kind + content))
    )


@pytest.mark.parametrize('place', [33, -12])
def test_chunks_of_a_png_that_its_picture_does_not_need_are_never_unpacked(place):
    """Texts and profiles of 8 MB each, which the decoder would store, and animation frames."""
    png = encoded('.png', BGR)
    text = chunk(b'zTXt', b'a\0\0' + zlib.compress(bytes(7_900_000), 9)) * 20
    profile = chunk(b'iCCP', b'a\0\0' + zlib.compress(bytes(7_900_000), 9))
    frames = chunk(b'acTL', struct.pack('>II', 1000, 0)) + chunk(b'fdAT', bytes(8)) * 1000
    for more in (text, profile, frames):
        content = png[:place] + more + png[place:]
        np.testing.assert_array_equal(decode_image(compressed(content, 'png')), BGR)
    for bad in (png[:-12], png[:8] + text + png[8:], png[:8], png[:33] + chunk(b'IEND', b'')):
        with pytest.raises(ImageError, match='is damaged'):
            decode_image(compressed(bad, 'png'))


def test_many_scans_of_a_large_jpeg_are_refused():
    """Each scan costs a pass over all pixels: 67 of them cost too much in a large image."""
    done, file = cv2.imencode(
        '.jpg', np.zeros((4000, 4000), np.uint8), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]
    )
    assert done
    plain = file.tobytes()
    assert decode_image(compressed(plain)).shape == (4000, 4000, 3)
    last = plain[plain.rfind(b'\xff\xda') : -2]
    with pytest.raises(ImageError, match=r'jpeg has \d\d scans, the limit is 67'):
        decode_image(compressed(plain[:-2] + last * 66 + plain[-2:]))


# Encoding


def test_jpeg_with_scans_without_end_is_refused_undecoded():
    done, file = cv2.imencode('.jpg', scene(), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])
    assert done
    plain = file.tobytes()
    assert plain.count(b'\xff\xda') > 3
    wanted = cv2.imdecode(file, cv2.IMREAD_COLOR)
    np.testing.assert_array_equal(decode_image(compressed(plain)), wanted)
    last = plain[plain.rfind(b'\xff\xda') : -2]
    bomb = plain[:-2] + last * 500 + plain[-2:]
    with pytest.raises(ImageError, match=r'jpeg has 5\d\d scans, the limit is 100'):
        decode_image(compressed(bomb))


# Masks

SHAPE = np.where(MOSAIC > 99, MOSAIC - np.uint8(99), np.uint8(0))


@pytest.mark.parametrize('padding', [0, 3])
@pytest.mark.parametrize('encoding', ['mono8', '8UC1'])
def test_masks_are_true_where_they_are_not_zero(encoding, padding):
    mask = decode_mask(raw(SHAPE, encoding, padding=padding))
    assert mask.dtype == np.bool_
    np.testing.assert_array_equal(mask, SHAPE > 0)


@pytest.mark.parametrize('values', [SHAPE, SHAPE // 100])
def test_masks_as_png(values):
    np.testing.assert_array_equal(
        decode_mask(compressed(encoded('.png', values), 'mono8; png compressed ')), values > 0
    )
    done, packed = cv2.imencode('.png', SHAPE // 100, [cv2.IMWRITE_PNG_BILEVEL, 1])
    assert done
    np.testing.assert_array_equal(decode_mask(compressed(bytes(packed), 'png')), SHAPE >= 100)


@pytest.mark.parametrize(
    ('message', 'error'),
    [
        (raw(BGR, 'bgr8'), r"mask has encoding 'bgr8', wanted mono8 or 8UC1"),
        (raw(WORDS, 'mono16'), r"mask has encoding 'mono16', wanted mono8 or 8UC1"),
        (raw(SHAPE, 'mono8', width=45), r'image step is 44, wanted at least 45 for 45 mono8'),
        (raw(SHAPE, 'mono8', height=31), r'image has 1320 bytes, wanted 1364'),
        (raw(SHAPE, 'mono8', width=0), r'image has size 0x30'),
        (raw(SHAPE, 'mono8', data=b''), r'image has 0 bytes'),
        (compressed(encoded('.jpg', GREY)), r"of format 'jpeg' starts with .*, wanted png"),
        (compressed(b''), r"starts with b'', wanted png"),
        (compressed(encoded('.png', BGR), 'png'), r'a png of 8 bits and colour type 2, wanted'),
        (compressed(encoded('.png', WORDS), 'png'), r'a png of 16 bits and colour type 0, wanted'),
        (compressed(encoded('.png', GREY)[:-20], 'png'), r'breaks off or is damaged'),
    ],
)
def test_defects_of_masks(message, error):
    with pytest.raises(ImageError, match=error):
        decode_mask(message)


def test_pictures_of_files():
    png = encoded('.png', scene())
    np.testing.assert_array_equal(decode_picture(png), scene())
    with pytest.raises(ImageError, match=r"unknown format starts with b'BM"):
        decode_picture(encoded('.bmp', scene()))


def test_encoding_is_repeatable_and_near(messages):
    assert encode_jpeg(BGR, 90) == encode_jpeg(BGR.copy(), 90)
    assert len(encode_jpeg(BGR, 95)) > len(encode_jpeg(BGR, 50))
    message = compressed_image_message(messages, BGR, 1_500_000_000, 'camera', quality=95)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1, 500_000_000)
    assert message.format == 'jpeg'
    assert np.abs(decode_image(message).astype(int) - BGR).mean() < 3


def test_image_message_round_trip(messages):
    view = np.dstack([BGR, BGR])[:, ::2, 1:4]
    message = image_message(messages, view, 5, 'camera')
    assert (message.encoding, message.step) == ('bgr8', WIDTH // 2 * 3)
    np.testing.assert_array_equal(decode_image(message), view)
    message = image_message(messages, GREY, 5, 'camera')
    assert message.encoding == 'mono8'
    np.testing.assert_array_equal(decode_image(message)[..., 0], GREY)


@pytest.mark.parametrize('image', [BGR.astype(float), BGR[..., :2], BGR[0, 0], BGR[:0]])
def test_what_is_no_picture_is_not_encoded(messages, image):
    with pytest.raises(ImageError):
        encode_jpeg(image)
    with pytest.raises(ImageError):
        image_message(messages, image, 0, 'camera')
