"""Converts sensor_msgs/Image and sensor_msgs/CompressedImage to arrays and back.

A decoded picture is always BGR, uint8, (H, W, 3), contiguous and writable. Messages of `rosbags`
and of ROS are both accepted: the data can be any buffer of bytes.

A depth image is registered to a colour image of the same size: each value is the depth of the
surface at that pixel, along the axis of the camera (REP 118). `16UC1` is in mm, 0 without
measurement; `32FC1` is in m, NaN without measurement.
"""

from __future__ import annotations

import re
import struct
import zlib
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from msg_tools.messages.headers import header_message
from msg_tools.messages.message_types import MessageFactory

Picture = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Depth = NDArray[np.float32]

# Maximum number of pixels; larger pictures are refused before memory is allocated.
MAX_PIXELS = 2**26

_PNG_SIGNATURE = b'\x89PNG\r\n\x1a\n'
# Byte offsets of the size and of the bit depth in a PNG; the next byte is the colour type, 0 for
# grey.
_PNG_SIZE_OFFSET, _PNG_DEPTH_OFFSET = 16, 24
# Chunks of a PNG that are kept; texts, profiles and animations could unpack to any size.
_PNG_CHUNKS = b'IHDR', b'PLTE', b'tRNS', b'IDAT', b'IEND'

# Start of a JPEG, and maximum number of segments before its frame header.
_JPEG_START, _MAX_JPEG_SEGMENTS = b'\xff\xd8', 1000
_JPEG_SEGMENT = re.compile(rb'\xff+([\xc0-\xcf\xdb-\xfe])(..)', re.DOTALL)
_JPEG_FRAMES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}
_JPEG_SCAN, _JPEG_END = b'\xff\xda', b'\xff\xd9'
# Maximum number of scans; a progressive JPEG has a dozen, each one pass over the whole picture.
MAX_JPEG_SCANS = 100
_MAX_SCANNED = 16 * MAX_PIXELS  # maximum number of pixels of all scans

# Limits of compression: JPEG needs at least one bit per block of 8x8 pixels. Deflate needs at least
# one byte per 1032 bytes, and one byte of a PNG is at most 8 pixels.
_JPEG_PIXELS_PER_BYTE = 512
_PNG_PIXELS_PER_BYTE = 8 * 1032
# Number of pixels allowed in every file, and additional pixels per byte of the file. Otherwise
# small files of one colour could occupy a reader for minutes.
FREE_PIXELS, _PIXELS_PER_BYTE = 2**24, 16
# Maximum size of a PNG, bytes: a part per pixel (four incompressible channels of 16 bits), plus a
# constant. Surplus data would be inflated, too.
_PNG_BYTES_PER_PIXEL, _PNG_BYTES = 9, 10_000


class ImageError(ValueError):
    """A picture can not be decoded; the message is one line with actual and required values."""


# Encoding: (dtype, channels, conversion to BGR or None). OpenCV names Bayer patterns after the
# second row and column: BG in OpenCV is rggb in ROS.
_ENCODINGS: dict[str, tuple[str, int, int | None]] = {
    'mono8': ('u1', 1, cv2.COLOR_GRAY2BGR),
    '8UC1': ('u1', 1, cv2.COLOR_GRAY2BGR),
    'mono16': ('u2', 1, cv2.COLOR_GRAY2BGR),
    '16UC1': ('u2', 1, cv2.COLOR_GRAY2BGR),
    'bgr8': ('u1', 3, None),
    '8UC3': ('u1', 3, None),
    'rgb8': ('u1', 3, cv2.COLOR_RGB2BGR),
    'bgra8': ('u1', 4, cv2.COLOR_BGRA2BGR),
    '8UC4': ('u1', 4, cv2.COLOR_BGRA2BGR),
    'rgba8': ('u1', 4, cv2.COLOR_RGBA2BGR),
    'bgr16': ('u2', 3, None),
    'rgb16': ('u2', 3, cv2.COLOR_RGB2BGR),
    'bgra16': ('u2', 4, cv2.COLOR_BGRA2BGR),
    'rgba16': ('u2', 4, cv2.COLOR_RGBA2BGR),
    'bayer_rggb8': ('u1', 1, cv2.COLOR_BayerBG2BGR),
    'bayer_bggr8': ('u1', 1, cv2.COLOR_BayerRG2BGR),
    'bayer_gbrg8': ('u1', 1, cv2.COLOR_BayerGR2BGR),
    'bayer_grbg8': ('u1', 1, cv2.COLOR_BayerGB2BGR),
    'bayer_rggb16': ('u2', 1, cv2.COLOR_BayerBG2BGR),
    'bayer_bggr16': ('u2', 1, cv2.COLOR_BayerRG2BGR),
    'bayer_gbrg16': ('u2', 1, cv2.COLOR_BayerGR2BGR),
    'bayer_grbg16': ('u2', 1, cv2.COLOR_BayerGB2BGR),
    'yuv422': ('u1', 2, cv2.COLOR_YUV2BGR_UYVY),
    'uyvy': ('u1', 2, cv2.COLOR_YUV2BGR_UYVY),
    'yuv422_yuy2': ('u1', 2, cv2.COLOR_YUV2BGR_YUY2),
    'yuyv': ('u1', 2, cv2.COLOR_YUV2BGR_YUY2),
    'yvyu': ('u1', 2, cv2.COLOR_YUV2BGR_YVYU),
    'yuv420': ('u1', 1, cv2.COLOR_YUV2BGR_I420),
    'i420': ('u1', 1, cv2.COLOR_YUV2BGR_I420),
    'yv12': ('u1', 1, cv2.COLOR_YUV2BGR_YV12),
    'nv12': ('u1', 1, cv2.COLOR_YUV2BGR_NV12),
    'nv21': ('u1', 1, cv2.COLOR_YUV2BGR_NV21),
}
_MASKS = ('mono8', '8UC1')
# Encodings in which chroma follows luma, in half as many rows.
_PLANAR = ('nv12', 'nv21', 'yuv420', 'i420', 'yv12')
# Encodings with two separate chroma planes, in rows of half the width.
_THREE_PLANES = ('yuv420', 'i420', 'yv12')
# Encodings in which two neighbouring pixels share their chroma.
_EVEN_WIDTH = ('yuv422', 'uyvy', 'yuv422_yuy2', 'yuyv', 'yvyu', *_PLANAR)
# Encoding: (dtype, units per metre). Some drivers write mono16 for 16UC1.
_DEPTH_ENCODINGS = {'16UC1': ('u2', 1000), 'mono16': ('u2', 1000), '32FC1': ('f4', 1)}


def decode_image(message: Any) -> Picture:
    """The picture of an Image or a CompressedImage, BGR (H, W, 3).

    16-bit pictures are scaled to 8 bits, grey pictures get three equal channels, alpha is dropped.
    The orientation in a JPEG is ignored, because the calibration is for the stored picture.

    Raises:
        ImageError: unsupported encoding, inconsistent size, or bytes that are not a picture.
    """
    if hasattr(message, 'encoding'):
        return _decode_raw(message)
    form = str(message.format)
    if 'compressedDepth' in form:
        raise ImageError(f'compressed image has format {form!r}: depth, wanted a picture')
    return decode_picture(_bytes_of(message.data).tobytes(), f'format {form!r}')


def _decode_raw(message: Any) -> Picture:
    height, width = int(message.height), int(message.width)
    encoding = str(message.encoding)
    if encoding not in _ENCODINGS:
        raise ImageError(
            f'image encoding {encoding!r} is not known, wanted one of {", ".join(_ENCODINGS)}'
        )
    dtype, channels, conversion = _ENCODINGS[encoding]
    if (encoding in _EVEN_WIDTH and width % 2) or (encoding in _PLANAR and height % 2):
        raise ImageError(f'image of {width}x{height} can not be {encoding}, wanted even sizes')
    rows = height * 3 // 2 if encoding in _PLANAR else height
    row_bytes = width * channels * np.dtype(dtype).itemsize
    image: NDArray[Any]
    if encoding in _THREE_PLANES:
        if message.step % 2:
            raise ImageError(f'image step is {message.step}, wanted an even one for {encoding}')
        whole = _rows_of(message, rows, max(row_bytes, int(message.step)))
        chroma = whole[height:].reshape(height, -1)[:, : width // 2]
        image = pixels = np.concatenate([whole[:height, :width], chroma.reshape(-1, width)])
    else:
        image = pixels = _rows_of(message, rows, row_bytes)
    if dtype == 'u2':
        image = pixels.view('>u2' if message.is_bigendian else '<u2').astype(np.uint16)
    image = image.reshape((rows, width, channels) if channels > 1 else (rows, width))
    try:
        if conversion is not None:
            image = cv2.cvtColor(image, conversion)
    except cv2.error as error:
        raise ImageError(f'image of {width}x{height} can not be {encoding}: {error.err}') from error
    if image.dtype == np.uint16:
        image = cv2.convertScaleAbs(image, alpha=255.0 / 65535.0)
    return np.array(image, dtype=np.uint8, order='C')


def _rows_of(message: Any, rows: int, row_bytes: int, what: str = 'image') -> Picture:
    """The bytes (rows, row_bytes) of an Image, without the padding of its rows."""
    width, height, step = int(message.width), int(message.height), int(message.step)
    _check_size(width, height, what)
    if step < row_bytes:
        raise ImageError(
            f'{what} step is {step}, wanted at least {row_bytes} for {width} {message.encoding}'
        )
    data = _bytes_of(message.data)
    if len(data) != rows * step:
        raise ImageError(
            f'{what} has {len(data)} bytes, wanted {rows * step}: {rows} rows with a step of {step}'
        )
    return np.ascontiguousarray(data.reshape(rows, step)[:, :row_bytes])


def decode_mask(message: Any) -> Mask:
    """Decodes the mask (H, W) in an Image (`mono8` or `8UC1`) or a CompressedImage (grey PNG).

    True where the value is not zero. A JPEG is refused, because it blurs the outline of the mask
    and changes zeros.

    Raises:
        ImageError: unsupported encoding, inconsistent size, or bytes that are not a picture.
    """
    if hasattr(message, 'encoding'):
        encoding = str(message.encoding)
        if encoding not in _MASKS:
            raise ImageError(f'mask has encoding {encoding!r}, wanted {" or ".join(_MASKS)}')
        return _rows_of(message, int(message.height), int(message.width)) > 0
    content = _bytes_of(message.data).tobytes()
    if not content.startswith(_PNG_SIGNATURE):
        raise ImageError(
            f'compressed mask of format {str(message.format)!r} starts with {content[:4]!r}, '
            'wanted png'
        )
    picture = decode_picture(content, f'format {str(message.format)!r}', cv2.IMREAD_GRAYSCALE)
    depth, colours = content[_PNG_DEPTH_OFFSET : _PNG_DEPTH_OFFSET + 2]
    if depth > 8 or colours != 0:
        raise ImageError(
            f'compressed mask is a png of {depth} bits and colour type {colours}, wanted grey of '
            'at most 8 bits'
        )
    return picture > 0


def decode_picture(
    content: bytes, form: str = 'unknown format', colours: int = cv2.IMREAD_COLOR
) -> Picture:
    """Decodes a PNG or JPEG file to a picture, BGR (H, W, 3) unless `colours` is given.

    The size in the header of the file is checked before decoding.

    Args:
        form: declared format, for error messages.
        colours: flag of OpenCV for the channels of the picture.

    Raises:
        ImageError: unsupported format, damaged file, more pixels than `MAX_PIXELS`, or too many
            pixels for the size of the file.
    """
    if content.startswith(b'\xff\xd8\xff'):
        width, height = _jpeg_size(content)
        densest = _JPEG_PIXELS_PER_BYTE
    elif content.startswith(_PNG_SIGNATURE):
        content = _plain_png(content)
        width, height = struct.unpack_from('>II', content, _PNG_SIZE_OFFSET)
        if len(content) > _PNG_BYTES_PER_PIXEL * (width + 1) * (height + 1) + _PNG_BYTES:
            raise ImageError(f'png of {len(content)} bytes has more data than {width}x{height}')
        densest = _PNG_PIXELS_PER_BYTE
    else:
        raise ImageError(
            f'compressed image of {form} starts with {content[:4]!r}, wanted jpeg or png'
        )
    _check_size(width, height)
    if width * height > min(densest, _PIXELS_PER_BYTE + FREE_PIXELS / len(content)) * len(content):
        raise ImageError(
            f'compressed image of {len(content)} bytes can not have a size of {width}x{height}'
        )
    image = decoded(content, colours | cv2.IMREAD_IGNORE_ORIENTATION)
    if image.shape[:2] != (height, width):
        raise ImageError(f'compressed image of {len(content)} bytes and {form} is damaged')
    return image


def decoded(content: bytes, flags: int = cv2.IMREAD_COLOR) -> Picture:
    """Decodes a picture in any format of OpenCV.

    Raises:
        ImageError: unsupported format, or a damaged file.
    """
    try:
        image = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), flags)
    except cv2.error as error:
        raise ImageError(f'the image can not be decoded: {error.err}') from error
    if image is None:
        raise ImageError('not an image that OpenCV can read, or it is damaged')
    _check_size(image.shape[1], image.shape[0])
    return np.array(image, dtype=np.uint8, order='C')


def _check_size(width: int, height: int, what: str = 'image') -> None:
    if width < 1 or height < 1:
        raise ImageError(f'{what} has size {width}x{height}, wanted at least one pixel')
    if width * height > MAX_PIXELS:
        raise ImageError(f'{what} has size {width}x{height}, the limit is {MAX_PIXELS} pixels')


def _check_picture(image: NDArray[np.uint8]) -> None:
    if image.dtype != np.uint8 or image.ndim not in (2, 3) or image.shape[2:] not in ((), (3,)):
        raise ImageError(f'image is {image.dtype} {image.shape}, wanted uint8 (H, W, 3) or (H, W)')
    _check_size(image.shape[1], image.shape[0])


def _bytes_of(data: Any) -> Picture:
    try:
        # numpy rejects an empty buffer.
        return np.frombuffer(data, dtype=np.uint8) if len(data) else np.zeros(0, dtype=np.uint8)
    except (TypeError, ValueError) as error:
        raise ImageError(f'image data is a {type(data).__name__}, wanted bytes') from error


def _plain_png(content: bytes) -> bytes:
    """Returns a PNG file without unneeded chunks; raises ImageError if it is incomplete."""
    parts, at, kind = [_PNG_SIGNATURE], len(_PNG_SIGNATURE), b''
    while kind != b'IEND':
        size = int.from_bytes(content[at : at + 4], 'big')
        chunk = content[at + 4 : at + 12 + size]  # kind, data and checksum
        right = chunk[-4:] == zlib.crc32(chunk[:-4]).to_bytes(4, 'big')
        first = kind or content[12:16] == b'IHDR'
        if not first or not right or len(chunk) != size + 8:
            raise ImageError(f'png of {len(content)} bytes breaks off or is damaged')
        kind, at = chunk[:4], at + 12 + size
        if kind in _PNG_CHUNKS:
            parts += size.to_bytes(4, 'big'), chunk
    return b''.join(parts)


def _jpeg_size(content: bytes) -> tuple[int, int]:
    """Width and height of a JPEG file; raises ImageError if the file is incomplete."""
    what = f'jpeg of {len(content)} bytes'
    found = _JPEG_SEGMENT.match(content, len(_JPEG_START))
    for _ in range(_MAX_JPEG_SEGMENTS):
        if found is None or found[1][0] in _JPEG_FRAMES:
            break
        end = found.end() - 2 + int.from_bytes(found[2], 'big')
        found = _JPEG_SEGMENT.match(content, end)
    if found is None or found[1][0] not in _JPEG_FRAMES or len(content) < found.end() + 5:
        raise ImageError(f'{what} breaks off or is damaged: its size is missing')
    height, width = struct.unpack_from('>HH', content, found.end() + 1)
    _check_size(width, height)
    # Scan data never contain these two markers: a byte ff is never followed by their codes.
    scans = content.count(_JPEG_SCAN)
    most = min(MAX_JPEG_SCANS, _MAX_SCANNED // (width * height + 1))
    if scans > most:
        raise ImageError(f'jpeg has {scans} scans, the limit is {most}')
    if content.rfind(_JPEG_END) <= content.rfind(_JPEG_SCAN):
        raise ImageError(f'{what} breaks off or is damaged: its end is missing')
    return width, height


def encode_jpeg(image: NDArray[np.uint8], quality: int = 90) -> bytes:
    """Encodes a picture, BGR (H, W, 3) or grey (H, W), as JPEG; equal pictures give equal bytes.

    Raises:
        ImageError: the array is not a picture.
    """
    _check_picture(image)
    done, encoded = cv2.imencode('.jpg', image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise ImageError(f'image of {image.shape[1]}x{image.shape[0]} can not be encoded as jpeg')
    return bytes(encoded)


def compressed_image_message(
    messages: MessageFactory,
    image: NDArray[np.uint8],
    stamp_ns: int,
    frame_id: str,
    quality: int = 90,
) -> Any:
    """sensor_msgs/CompressedImage with a JPEG of a picture, BGR (H, W, 3) or grey (H, W)."""
    return jpeg_message(messages, encode_jpeg(image, quality), stamp_ns, frame_id)


def jpeg_message(messages: MessageFactory, jpeg: bytes, stamp_ns: int, frame_id: str) -> Any:
    """sensor_msgs/CompressedImage with the content of a JPEG file."""
    return messages.create(
        'sensor_msgs/msg/CompressedImage',
        header=header_message(messages, stamp_ns, frame_id),
        format='jpeg',
        data=np.frombuffer(jpeg, dtype=np.uint8),
    )


def image_message(
    messages: MessageFactory, image: NDArray[np.uint8], stamp_ns: int, frame_id: str
) -> Any:
    """sensor_msgs/Image of a picture, bgr8 for (H, W, 3) or mono8 for (H, W)."""
    _check_picture(image)
    encoding = 'bgr8' if image.ndim == 3 else 'mono8'
    return _raw_message(messages, image, encoding, stamp_ns, frame_id)


def decode_depth(message: Any) -> Depth:
    """Depths (H, W) in a sensor_msgs/Image, m, float32; 0 or NaN where no depth was measured.

    Raises:
        ImageError: unsupported encoding, or inconsistent size.
    """
    encoding = str(message.encoding)
    if encoding not in _DEPTH_ENCODINGS:
        raise ImageError(f'depth has encoding {encoding!r}, wanted 16UC1 in mm or 32FC1 in m')
    kind, units = _DEPTH_ENCODINGS[encoding]
    dtype = np.dtype(kind).newbyteorder('>' if message.is_bigendian else '<')
    rows = _rows_of(message, int(message.height), int(message.width) * dtype.itemsize, 'depth')
    result: Depth = rows.view(dtype).astype(np.float32) / np.float32(units)
    return result


def depth_message(
    messages: MessageFactory, depth: NDArray[np.uint16] | Depth, stamp_ns: int, frame_id: str
) -> Any:
    """sensor_msgs/Image of depths (H, W): 16UC1 for uint16 in mm, 32FC1 for float32 in m.

    Raises:
        ImageError: unsupported shape or type of the array.
    """
    encoding = {'uint16': '16UC1', 'float32': '32FC1'}.get(depth.dtype.name)
    if encoding is None or depth.ndim != 2 or not depth.size:
        raise ImageError(
            f'depth is {depth.dtype} {depth.shape}, wanted uint16 in mm or float32 in m, (H, W)'
        )
    little = np.ascontiguousarray(depth).astype(depth.dtype.newbyteorder('<'), copy=False)
    return _raw_message(messages, little, encoding, stamp_ns, frame_id)


def _raw_message(
    messages: MessageFactory, values: NDArray[Any], encoding: str, stamp_ns: int, frame_id: str
) -> Any:
    """sensor_msgs/Image of little-endian values (H, W) or (H, W, C)."""
    rows = np.ascontiguousarray(values)
    height, width = rows.shape[:2]
    return messages.create(
        'sensor_msgs/msg/Image',
        header=header_message(messages, stamp_ns, frame_id),
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=0,
        step=rows.nbytes // height,
        data=rows.view(np.uint8).reshape(-1),
    )
