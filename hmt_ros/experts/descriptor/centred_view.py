"""The silhouette seen by a camera without distortion that looks straight at the person.

Towards the border of an image, most of all with a wide lens, a person is stretched and leans. Seen
along the optical axis, one posture looks the same wherever it is, as its target does
(`hmt_ros.experts.pose_encoding`).
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.camera import Camera
from hmt_ros.experts.descriptor.contour import PersonBlob
from hmt_ros.experts.pose_encoding import ray_rotations

Bytes = NDArray[np.uint8]

SIDE = 192  # px, of the view
FILLED = 0.8  # share of the view that the longer side of the person fills, roughly
STRAIGHT = np.radians(2.0)  # angle to the axis below which a rotation moves nothing by a pixel


def centred_view(blob: PersonBlob, camera: Camera) -> Bytes:
    """The person (h, w), 1 inside, seen by the camera turned to the middle of the box.

    Args:
        blob: Person in the camera's image.
        camera: Camera of the image.
    """
    left, top, right, bottom = blob.box
    middle = np.array([0.5 * (left + right), 0.5 * (top + bottom)])
    axis = camera.rays(middle)
    if not camera.distortion and axis[2] > np.cos(STRAIGHT):
        return blob.mask
    corners = np.array([[x, y] for x in (left, middle[0], right) for y in (top, middle[1], bottom)])
    turn = ray_rotations(axis[None])[0]  # from the view to the camera
    seen = camera.rays(corners) @ turn
    reach = float(np.abs(seen[:, :2] / np.maximum(seen[:, 2:], 0.1)).max())
    focal = 0.5 * FILLED * SIDE / reach
    centre = 0.5 * (SIDE - 1)
    if not camera.distortion:
        view = np.array([[focal, 0.0, centre], [0.0, focal, centre], [0.0, 0.0, 1.0]])
        shift = np.array([[1.0, 0.0, -blob.left], [0.0, 1.0, -blob.top], [0.0, 0.0, 1.0]])
        to_blob = shift @ camera.matrix @ turn @ np.linalg.inv(view)
        how = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        drawn = cv2.warpPerspective(blob.mask * np.uint8(255), to_blob, (SIDE, SIDE), flags=how)
    else:
        u, v = np.meshgrid(np.arange(SIDE), np.arange(SIDE))
        rays = np.stack([(u - centre) / focal, (v - centre) / focal, np.ones_like(u, float)], -1)
        pixels = camera.project(rays @ turn.T).astype(np.float32)
        pixels -= np.array([blob.left, blob.top], dtype=np.float32)
        columns, rows = np.where(np.isfinite(pixels), pixels, -1e4).transpose(2, 0, 1)
        drawn = cv2.remap(
            blob.mask * np.uint8(255),
            np.ascontiguousarray(columns, dtype=np.float32),
            np.ascontiguousarray(rows, dtype=np.float32),
            cv2.INTER_LINEAR,
        )
    result: Bytes = (drawn > 127).astype(np.uint8)
    return result if result.any() else blob.mask
