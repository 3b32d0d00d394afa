"""Depth images of sensor_msgs/Image as arrays in metres, and back (REP 118).

A depth image is registered to a colour image of the same size: each value is the depth of what that
pixel shows, along the axis of the camera. `16UC1` counts millimetres, 0 where nothing was measured;
`32FC1` counts metres, NaN where nothing was measured.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from msg_tools.messages.headers import header_message
from msg_tools.messages.images import MAX_PIXELS, ImageError
from msg_tools.messages.message_types import MessageFactory

Depth = NDArray[np.float32]

# Encoding: dtype and how many of its units are a metre. Some drivers say mono16 for 16UC1.
_ENCODINGS = {'16UC1': ('u2', 1000), 'mono16': ('u2', 1000), '32FC1': ('f4', 1)}


def decode_depth(message: Any) -> Depth:
    """The depths (H, W) of a sensor_msgs/Image, m, float32; 0 or NaN where nothing was measured.

    Raises:
        ImageError: another encoding, or sizes that contradict each other.
    """
    encoding = str(message.encoding)
    if encoding not in _ENCODINGS:
        raise ImageError(f'depth has encoding {encoding!r}, wanted 16UC1 in mm or 32FC1 in m')
    kind, units = _ENCODINGS[encoding]
    height, width, step = int(message.height), int(message.width), int(message.step)
    dtype = np.dtype(kind).newbyteorder('>' if message.is_bigendian else '<')
    row_bytes = width * dtype.itemsize
    if width < 1 or height < 1 or width * height > MAX_PIXELS:
        raise ImageError(f'depth has size {width}x{height}, wanted 1 to {MAX_PIXELS} pixels')
    data = np.frombuffer(message.data, dtype=np.uint8) if len(message.data) else np.zeros(0, 'u1')
    if step < row_bytes or len(data) != height * step:
        raise ImageError(
            f'depth has {len(data)} bytes and a step of {step}, wanted {height} rows of at least '
            f'{row_bytes} for {width} {encoding}'
        )
    rows = np.ascontiguousarray(data.reshape(height, step)[:, :row_bytes])
    result: Depth = rows.view(dtype).astype(np.float32) / np.float32(units)
    return result


def depth_message(
    messages: MessageFactory, depth: NDArray[np.uint16] | Depth, stamp_ns: int, frame_id: str
) -> Any:
    """sensor_msgs/Image of depths (H, W): uint16 in mm becomes 16UC1, float32 in m 32FC1.

    Raises:
        ImageError: an array of another shape or type.
    """
    encoding = {'uint16': '16UC1', 'float32': '32FC1'}.get(depth.dtype.name)
    if encoding is None or depth.ndim != 2 or not depth.size:
        raise ImageError(
            f'depth is {depth.dtype} {depth.shape}, wanted uint16 in mm or float32 in m, (H, W)'
        )
    little = np.ascontiguousarray(depth).astype(depth.dtype.newbyteorder('<'), copy=False)
    return messages.create(
        'sensor_msgs/msg/Image',
        header=header_message(messages, stamp_ns, frame_id),
        height=depth.shape[0],
        width=depth.shape[1],
        encoding=encoding,
        is_bigendian=0,
        step=depth.shape[1] * depth.dtype.itemsize,
        data=little.view(np.uint8).reshape(-1),
    )
