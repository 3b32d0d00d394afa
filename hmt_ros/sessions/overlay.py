"""Overlay on an image: the modes of a mixture as skeletons, and notes for a user.

Colours match the markers: the heaviest mode is orange, the others are blue, and modes of
less weight are fainter. The same modes on the same image give the same picture.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from hmt_ros.body import Camera
from hmt_ros.inference.arrays import Array, Image

_FIRST_COLOUR, _OTHER_COLOUR = (13, 115, 230), (204, 115, 26)  # BGR
_MIN_OPACITY = 0.2
_FRACTIONAL_BITS = 4  # fractional bits of coordinates
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_MAX_COORDINATE = 2.0**14  # maximum coordinate, px; OpenCV draws no line that begins further away


def draw_modes(
    image: Image,
    camera: Camera,
    joints: Array,
    bones: Sequence[tuple[int, int]],
    weights: Array,
    count: int,
) -> Image:
    """Draw the heaviest modes on a copy of an image.

    Args:
        image: (H, W, 3) BGR.
        joints: (K, J, 3) joint positions of the modes, camera frame, m.
        bones: pairs of joints that are connected.
        weights: (K,) weights of the modes.
        count: maximum number of modes that are drawn.
    """
    result = image.copy()
    order = np.argsort(-weights, kind='stable')[:count]
    if len(order) == 0:
        return result
    thickness = max(round(min(image.shape[:2]) / 240), 1)
    pixels = camera.project(joints[order])
    usable = np.logical_and.reduce(
        np.abs(np.nan_to_num(pixels, nan=np.inf)) < _MAX_COORDINATE, axis=2
    )
    # The heaviest mode is drawn last, on top.
    for rank in reversed(range(len(order))):
        lines = [(a, b) for a, b in bones if usable[rank, a] and usable[rank, b]]
        ends = pixels[rank, sorted({joint for line in lines for joint in line})]
        left, top, right, bottom = _box(ends, 4 * thickness, image.shape)
        if left >= right or top >= bottom:
            continue
        part = result[top:bottom, left:right]
        layer = part.copy()
        fixed = np.zeros(pixels[rank].shape, dtype=int)
        fixed[usable[rank]] = np.rint(
            (pixels[rank][usable[rank]] - [left, top]) * 2**_FRACTIONAL_BITS
        )
        for start, end in lines:
            cv2.line(
                layer,
                fixed[start].tolist(),
                fixed[end].tolist(),
                _OTHER_COLOUR if rank else _FIRST_COLOUR,
                thickness + (rank == 0),
                cv2.LINE_AA,
                _FRACTIONAL_BITS,
            )
        share = float(weights[order[rank]] / weights[order[0]]) if weights[order[0]] > 0 else 1.0
        strength = _MIN_OPACITY + (1 - _MIN_OPACITY) * share
        cv2.addWeighted(layer, strength, part, 1 - strength, 0.0, dst=part)
    return result


def draw_notes(image: Image, notes: Sequence[str]) -> Image:
    """Draw lines of text at the lower left of a copy of an image (H, W, 3), light on dark."""
    result = image.copy()
    height, width = image.shape[:2]
    bottom = height
    for note in reversed(notes):
        # The text is at most as wide as the image.
        (wide, _), _ = cv2.getTextSize(note, _FONT, 1.0, 1)
        scale = min(max(height / 700.0, 0.35), 0.95 * width / max(wide, 1))
        top = bottom - round(36 * scale)
        right = min(round(scale * (wide + 24)), width)
        cv2.rectangle(result, (0, max(top, 0)), (right, bottom), (0, 0, 0), cv2.FILLED)
        place = round(12 * scale), bottom - round(10 * scale)
        cv2.putText(result, note, place, _FONT, scale, (255, 255, 255), 1, cv2.LINE_AA)
        bottom = top
    return result


def _box(pixels: Array, margin: int, shape: tuple[int, ...]) -> tuple[int, int, int, int]:
    """Return left, top, right and bottom of the part of an image that contains some points."""
    if len(pixels) == 0:
        return 0, 0, 0, 0
    low = np.floor(pixels.min(0)).astype(int) - margin
    high = np.ceil(pixels.max(0)).astype(int) + margin + 1
    return max(low[0], 0), max(low[1], 0), min(high[0], shape[1]), min(high[1], shape[0])
