"""Pictures of bodies for the pages: solid bodies in a camera's image and from above."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.patches import Polygon
from numpy.typing import NDArray

from hmt_ros.app.report.skeletons import LEFT_COLOUR, RIGHT_COLOUR, STYLE, bones_of
from hmt_ros.body import Body, Camera
from hmt_ros.body.kinematics import forward

Array = NDArray[np.float64]

TRUNK = '#9a9a9a'
# Style of figures 8.4 inches wide, which pages show smaller.
PAGE_STYLE: Any = {**STYLE, 'font.size': 10.0, 'axes.titlesize': 10.0}
# Half the width of a picture from above, m.
REACH = 0.85


def add_body(
    axes: Axes, body: Body, pose: Array, camera: Camera | None, alpha: float = 1.0
) -> None:
    """Draws a solid body (left limbs orange, right limbs blue) into the axes.

    Args:
        axes: axes of the picture.
        body: body with flesh.
        pose: pose (d,).
        camera: camera whose image is drawn, px; None draws from above, m to the right of the
            pelvis and away from the camera.
        alpha: opacity.
    """
    mesh = body.flesh.mesh()
    frames = forward(body.skeleton, pose[None])
    points = frames.points(mesh.segments, mesh.vertices)[:, :, 0]
    if camera is None:
        flat, depth = from_above(points, body.joint_positions(pose[None])[0, 0]), points[:, 1]
    else:
        flat, depth = camera.project(points), points[:, 2]
    order = sorted(
        range(len(body.shapes)), key=lambda part: -float(depth[mesh.parts == part].mean())
    )
    for rank, part in enumerate(order):
        name = body.skeleton.segment_names[body.shapes[part].segment]
        hull = cv2.convexHull(flat[mesh.parts == part].astype(np.float32))[:, 0]
        colour = (
            LEFT_COLOUR
            if name.startswith('left')
            else RIGHT_COLOUR
            if name.startswith('right')
            else TRUNK
        )
        axes.add_patch(
            Polygon(
                hull,
                facecolor=colour,
                edgecolor='white',
                lw=0.4,
                alpha=alpha,
                zorder=2 + rank / 100,
            )
        )


def add_skeleton(
    axes: Axes, points: Array, names: Sequence[str], colour: str | None = None, width: float = 1.4
) -> None:
    """Draws bones between points (J, 2); unknown ones are left out."""
    bones = [(points[[a, b]], own) for a, b, own in bones_of(names)]
    bones = [(line, own) for line, own in bones if np.isfinite(line).all()]
    axes.add_collection(
        LineCollection(
            [line for line, _ in bones], colors=[colour or own for _, own in bones],
            linewidths=width, capstyle='round', zorder=4,
        )
    )  # fmt: skip


def from_above(points: Array, pelvis: Array) -> Array:
    """Points (..., 3) of the camera frame as (..., 2): to the right of the pelvis, and away, m."""
    return np.asarray((points - pelvis)[..., [0, 2]])


def frame_above(axes: Axes) -> None:
    """Sets the axes for a view from above, with the camera at the bottom."""
    axes.set(xlim=(-REACH, REACH), ylim=(-REACH, REACH), aspect='equal', xticks=[], yticks=[])
    _without_frame(axes)


def frame_image(
    axes: Axes, image: NDArray[np.uint8] | None, box: tuple[float, float, float, float]
) -> None:
    """Shows part of an image (H, W, 3), BGR, or of an empty one; for the box see `box_of`."""
    if image is not None:
        axes.imshow(image[..., ::-1])
    axes.set(xlim=box[:2], ylim=box[2:], aspect='equal', xticks=[], yticks=[])
    _without_frame(axes)


def box_of(pixels: Array, margin: float = 0.1) -> tuple[float, float, float, float]:
    """Left, right, bottom, top of a part of an image around points (..., 2), px.

    Args:
        pixels: image points, px; unknown ones are NaN.
        margin: margin on every side, relative to the height.
    """
    flat = pixels.reshape(-1, 2)
    flat = flat[np.isfinite(flat).all(1)]
    (left, top), (right, bottom) = flat.min(0), flat.max(0)
    more = margin * (bottom - top)
    return left - more, right + more, bottom + more, top - 1.5 * more


def _without_frame(axes: Axes) -> None:
    for spine in axes.spines.values():
        spine.set_visible(False)
