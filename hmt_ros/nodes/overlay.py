"""The modes of a mixture, drawn as skeletons on the image that they explain.

Colours are those of the markers: the heaviest mode orange, the others blue, the lighter the
fainter. The same modes on the same image give the same picture.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from hmt_ros.body import Body, Camera

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

_FIRST, _OTHERS = (13, 115, 230), (204, 115, 26)  # BGR
_FAINTEST = 0.2
_SHIFT = 4  # fractional bits of coordinates
_FAR = 2.0**14  # px; OpenCV draws nothing that begins further away


def draw_modes(
    image: Image, body: Body, camera: Camera, poses: Array, weights: Array, count: int
) -> Image:
    """A copy of an image with the heaviest modes on it.

    Args:
        image: (H, W, 3) BGR.
        body, camera: whose poses they are, and what they are seen with.
        poses: (K, d).
        weights: (K,).
        count: how many are drawn at most.
    """
    result = image.copy()
    order = np.argsort(-weights, kind='stable')[:count]
    if len(order) == 0:
        return result
    thickness = max(round(min(image.shape[:2]) / 240), 1)
    pixels = camera.project(body.joint_positions(poses[order]))
    usable = np.logical_and.reduce(np.abs(np.nan_to_num(pixels, nan=np.inf)) < _FAR, axis=2)
    # The heaviest last, on top.
    for rank in reversed(range(len(order))):
        share = float(weights[order[rank]] / weights[order[0]]) if weights[order[0]] > 0 else 1.0
        layer = result.copy() if rank else result
        fixed = np.rint(np.where(usable[rank][:, None], pixels[rank], 0.0) * 2**_SHIFT).astype(int)
        for start, end in body.skeleton.bones:
            if usable[rank, start] and usable[rank, end]:
                cv2.line(
                    layer,
                    fixed[start].tolist(),
                    fixed[end].tolist(),
                    _OTHERS if rank else _FIRST,
                    thickness + (rank == 0),
                    cv2.LINE_AA,
                    _SHIFT,
                )
        if rank:
            strength = _FAINTEST + (1 - _FAINTEST) * share
            result = cv2.addWeighted(layer, strength, result, 1 - strength, 0.0).astype(
                np.uint8, copy=False
            )
    return result
