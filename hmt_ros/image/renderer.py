"""Pictures of a body: image, silhouette, part labels and depth of its flesh at given poses.

Triangles of the flesh's mesh are cut into spans of pixels and the spans meet in a depth buffer, all in
numpy over whole arrays. A pixel belongs to a triangle when its centre lies inside; neighbouring triangles
share no pixel and leave none out. Colours are taken at a finer raster and averaged.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.flesh import Mesh
from hmt_ros.body.kinematics import Frames, forward
from hmt_ros.image.clothes import Clothes
from hmt_ros.image.scene import Scene

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

STACKS, SLICES = 13, 18  # of the mesh of a part: its outline is right to 2 % of its radius
SUPERSAMPLING = 2
SHADOW_BLUR = 0.004  # standard deviation of the shadow's edge as a share of the image's width
CHUNK = 16  # poses whose silhouettes are drawn together


@dataclass(frozen=True, eq=False)
class Rendered:
    """A person in a scene.

    Attributes:
        image: (H, W, 3) uint8, BGR.
        mask: (H, W) where the person is seen.
        parts: (H, W) int8, index into `body.flesh.parts`; -1: background.
        depth: (H, W) float32, z of the surface in the camera frame, m; inf: background.
    """

    image: NDArray[np.uint8]
    mask: Mask
    parts: NDArray[np.int8]
    depth: NDArray[np.float32]


def render(body: Body, pose: ArrayLike, camera: Camera, scene: Scene, frame: int = 0) -> Rendered:
    """Picture of a body at a pose (d,) in a scene.

    Args:
        body: with flesh.
        pose: (d,).
        camera: with its distortion; the scene's viewpoint says where it stands.
        scene: place, light, clothes and noise.
        frame: number of the picture; pictures of different numbers have different noise.

    Raises:
        ValueError: a body without flesh, or a pose of wrong shape.
    """
    return _renderer(body, camera, scene).render(pose, frame)


def render_frames(
    body: Body, poses: ArrayLike, camera: Camera, scene: Scene
) -> Iterator[Rendered]:
    """Pictures of a body at poses (T, d), one after the other; picture t has the noise of frame t."""
    renderer = _renderer(body, camera, scene)
    for frame, pose in enumerate(np.asarray(poses, dtype=np.float64)):
        yield renderer.render(pose, frame)


def render_silhouettes(body: Body, poses: ArrayLike, camera: Camera) -> Mask:
    """Silhouettes (N, H, W) of a body at poses (N, d): the masks that `render` gives, and no more.

    Raises:
        ValueError: a body without flesh, or poses of wrong shape.
    """
    poses = np.asarray(poses, dtype=np.float64)
    mesh = _mesh(body)
    result = np.zeros((len(poses), camera.height, camera.width), dtype=bool)
    for start in range(0, len(poses), CHUNK):
        points = _vertices(mesh, forward(body.skeleton, poses[start : start + CHUNK]))
        triangles, _ = _project(mesh, points, camera)
        pixels = _fill(triangles, camera.width, camera.height).pixels
        result[start : start + CHUNK].reshape(-1)[pixels] = True
    return result


@dataclass(frozen=True, eq=False)
class Renderer:
    """What pictures of the same body, camera and scene share.

    Attributes:
        body, camera, scene: of the pictures.
        mesh: of the flesh.
        places: (V, 4) of the vertices, for the clothes.
        clothes: of the person.
    """

    body: Body
    camera: Camera
    scene: Scene
    mesh: Mesh
    places: Array
    clothes: Clothes

    @classmethod
    def of(cls, body: Body, camera: Camera, scene: Scene) -> Renderer:
        """The renderer of a body in a scene."""
        mesh = _mesh(body)
        clothes = Clothes.of_seed(body, scene.seed)
        return cls(body, camera, scene, mesh, clothes.places(mesh.segments, mesh.vertices), clothes)

    def render(self, pose: ArrayLike, frame: int = 0) -> Rendered:
        """Picture number `frame`, of a pose (d,)."""
        camera = self.camera
        shape = (camera.height, camera.width)
        frames = forward(self.body.skeleton, np.asarray(pose, dtype=np.float64)[None])
        points = _vertices(self.mesh, frames)
        triangles, corners = _project(self.mesh, points, camera)
        image = self.scene.background(camera)
        if self.scene.shadow > 0:
            image = self._with_shadow(image, points)

        front = _front(_fill(triangles, *shape[::-1]), shape[0] * shape[1])
        parts = np.full(shape, -1, dtype=np.int8)
        parts.reshape(-1)[front.pixels] = self.mesh.parts[corners[front.triangles, 0]]
        depth = np.full(shape, np.inf, dtype=np.float32)
        depth.reshape(-1)[front.pixels] = 1.0 / front.inverse_depth
        if len(front.pixels):
            image = self._with_person(image, triangles, corners, frames)
        return Rendered(self.scene.add_noise(image, frame), parts >= 0, parts, depth)

    def _with_person(
        self, image: NDArray[np.float32], triangles: _Triangles, corners: Index, frames: Frames
    ) -> NDArray[np.float32]:
        camera, k = self.camera, SUPERSAMPLING
        # The part of the image with the person, and a margin.
        low = np.floor(triangles.pixels.min((0, 1))).astype(int)
        high = np.ceil(triangles.pixels.max((0, 1))).astype(int) + 1
        left, top = np.clip(low, 0, [camera.width, camera.height])
        right, bottom = np.clip(high, 0, [camera.width, camera.height])
        if right <= left or bottom <= top:
            return image
        width, height = k * (right - left), k * (bottom - top)
        fine = triangles.scaled(k, left, top)
        front = _front(_fill(fine, width, height), width * height)
        share = fine.shares(front)
        of = corners[front.triangles]
        places = np.einsum('mc,mcx->mx', share, self.places[of])
        normals = frames.directions(self.mesh.segments, self.mesh.normals)[:, :, 0]
        normal = np.einsum('mc,mcx->mx', share, normals[of])
        cosine = normal @ self.scene.light_direction
        cosine /= np.sqrt(np.einsum('mx,mx->m', normal, normal))
        colour = self.clothes.colours(self.mesh.parts[of[:, 0]], places)
        colour *= 255.0 * self.scene.lambert(cosine)[:, None]
        layer = np.zeros((height * width, 4), dtype=np.float32)
        layer[front.pixels, :3] = np.minimum(colour, 255.0)
        layer[front.pixels, 3] = 1.0
        size = (right - left, bottom - top)
        layer = cv2.resize(layer.reshape(height, width, 4), size, interpolation=cv2.INTER_AREA)
        result = image.copy()
        window = result[top:bottom, left:right]
        window *= 1.0 - layer[:, :, 3:]
        window += layer[:, :, :3]
        return result

    def _with_shadow(self, image: NDArray[np.float32], points: Array) -> NDArray[np.float32]:
        camera, scene = self.camera, self.scene
        fallen = scene.shadow_points(points[:, :, 0])
        triangles, _ = _project(self.mesh, fallen[:, :, None], camera)
        dark = np.zeros((camera.height, camera.width), dtype=np.float32)
        dark.reshape(-1)[_fill(triangles, camera.width, camera.height).pixels] = 1.0
        rows, columns = np.flatnonzero(dark.any(1)), np.flatnonzero(dark.any(0))
        if not len(rows):
            return image
        sigma = max(SHADOW_BLUR * camera.width, 0.5)
        margin = int(3 * sigma) + 1
        window = (
            slice(max(rows[0] - margin, 0), rows[-1] + margin + 1),
            slice(max(columns[0] - margin, 0), columns[-1] + margin + 1),
        )
        soft = cv2.GaussianBlur(dark[window], (0, 0), sigma)
        light = np.array(scene.light)
        cosine = light[2] / np.linalg.norm(light)
        lit, shaded = scene.lambert(np.array([1.0, 1.0 - scene.shadow]) * cosine)
        result = image.copy()
        weakened = 1.0 - (1.0 - shaded / lit) * soft * scene.floor(camera)[window]
        result[window] *= weakened[:, :, None].astype(np.float32)
        return result


@dataclass(frozen=True, eq=False)
class _Triangles:
    """F triangles that face the camera.

    Attributes:
        images: (F,) index of the image.
        pixels: (F, 3, 2) corners, px.
        inverse_depth: (F, 3) 1 / z of the corners, 1/m: linear over an image without distortion.
    """

    images: Index
    pixels: Array
    inverse_depth: Array

    def scaled(self, factor: int, left: int, top: int) -> _Triangles:
        """The triangles in a finer raster of a window of the image."""
        pixels = (self.pixels + 0.5 - [left, top]) * factor - 0.5
        return _Triangles(self.images, pixels, self.inverse_depth)

    def shares(self, front: _Front) -> Array:
        """Shares (M, 3) of the corners in what is seen at M pixels, right in perspective."""
        p = self.pixels[front.triangles]
        edges = p[:, 1:] - p[:, :1]
        offset = np.stack([front.columns, front.rows], axis=1) - p[:, 0]
        area = edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]
        b = (offset[:, 0] * edges[:, 1, 1] - offset[:, 1] * edges[:, 1, 0]) / area
        c = (edges[:, 0, 0] * offset[:, 1] - edges[:, 0, 1] * offset[:, 0]) / area
        share = np.stack([1.0 - b - c, b, c], axis=1) * self.inverse_depth[front.triangles]
        result: Array = share / share.sum(1, keepdims=True)
        return result


@dataclass(frozen=True, eq=False)
class _Front:
    """M pixels and the triangle that each shows (or, before the depth buffer, may show).

    Attributes:
        pixels: (M,) index into all images, row by row.
        rows, columns: (M,).
        triangles: (M,).
        inverse_depth: (M,) 1/m.
    """

    pixels: Index
    rows: Index
    columns: Index
    triangles: Index
    inverse_depth: Array


def _mesh(body: Body) -> Mesh:
    if not body.shapes:
        raise ValueError(f'body {body.name} has no flesh: it can not be drawn')
    return _mesh_of_flesh(body)


@lru_cache(maxsize=8)
def _mesh_of_flesh(body: Body) -> Mesh:
    return body.flesh.mesh(STACKS, SLICES)


@lru_cache(maxsize=4)
def _renderer(body: Body, camera: Camera, scene: Scene) -> Renderer:
    return Renderer.of(body, camera, scene)


def _vertices(mesh: Mesh, frames: Frames) -> Array:
    """Vertices (V, 3, N) of the mesh, camera frame, m."""
    return frames.points(mesh.segments, mesh.vertices)


@lru_cache(maxsize=8)
def _field_of_view(camera: Camera) -> tuple[float, float, float, float]:
    """Bounds of x / z and y / z of what the image may show: lower, lower, upper, upper."""
    u, v = np.linspace(-0.5, camera.width - 0.5, 33), np.linspace(-0.5, camera.height - 0.5, 33)
    grid = np.stack(np.meshgrid(u, v), axis=-1)
    rays = camera.rays(grid)
    slopes = (rays[..., :2] / rays[..., 2:]).reshape(-1, 2)
    low, high = slopes.min(0), slopes.max(0)
    margin = 0.05 * (high - low)
    return (*(low - margin), *(high + margin))


def _project(mesh: Mesh, points: Array, camera: Camera) -> tuple[_Triangles, Index]:
    """Triangles of N images that face the camera and may be seen; corners (F, 3) as vertices."""
    n = points.shape[2]
    p = points.transpose(2, 0, 1)
    z = p[..., 2]
    pixels = camera.project(p)
    # Far outside the image a distortion model may fold back into it.
    low_x, low_y, high_x, high_y = _field_of_view(camera)
    x, y = p[..., 0], p[..., 1]
    outside = np.stack([x < low_x * z, x > high_x * z, y < low_y * z, y > high_y * z], axis=-1)
    ahead = np.isfinite(pixels).all(-1)
    corners = mesh.triangles
    visible = ahead[:, corners].all(2) & ~outside[:, corners].all(2).any(2)
    t = pixels[:, corners]
    one, two = t[:, :, 1] - t[:, :, 0], t[:, :, 2] - t[:, :, 0]
    with np.errstate(invalid='ignore'):
        # Counter-clockwise from outside is clockwise for a v axis that points down.
        visible &= one[..., 0] * two[..., 1] - one[..., 1] * two[..., 0] < 0.0
    image, triangle = np.nonzero(visible)
    chosen = corners[triangle]
    del n
    return (
        _Triangles(image, pixels[image[:, None], chosen], 1.0 / z[image[:, None], chosen]),
        chosen,
    )


def _fill(triangles: _Triangles, width: int, height: int) -> _Front:
    """All pixels whose centres lie in triangles, without regard to what hides what."""
    # Corners from top to bottom, so that both triangles at an edge compute it alike.
    order = np.argsort(triangles.pixels[:, :, 1], axis=1, kind='stable')
    p = np.take_along_axis(triangles.pixels, order[:, :, None], axis=1)
    first = np.clip(np.ceil(p[:, 0, 1]), 0, height).astype(np.intp)
    last = np.clip(np.ceil(p[:, 2, 1]), 0, height).astype(np.intp)
    rows, which = _ranges(first, last)
    q = p[which]
    lower = rows >= q[:, 1, 1]
    a = np.where(lower[:, None], q[:, 1], q[:, 0])
    b = np.where(lower[:, None], q[:, 2], q[:, 1])
    long = _crossing(q[:, 0], q[:, 2], rows)
    short = _crossing(a, b, rows)
    start = np.clip(np.ceil(np.minimum(long, short)), 0, width).astype(np.intp)
    stop = np.clip(np.ceil(np.maximum(long, short)), 0, width).astype(np.intp)
    columns, span = _ranges(start, stop)
    which, rows = which[span], rows[span]

    w, p = triangles.inverse_depth, triangles.pixels
    one, two = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    dw, ew = w[:, 1] - w[:, 0], w[:, 2] - w[:, 0]
    area = one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]
    along_u = (dw * two[:, 1] - ew * one[:, 1]) / area
    along_v = (ew * one[:, 0] - dw * two[:, 0]) / area
    base = w[:, 0] - along_u * p[:, 0, 0] - along_v * p[:, 0, 1]
    depth = base[which] + along_u[which] * columns + along_v[which] * rows
    # The plane of a triangle seen from its edge is not known well: never beyond its corners.
    depth = np.clip(depth, w.min(1)[which], w.max(1)[which])
    pixels = (triangles.images[which] * height + rows) * width + columns
    return _Front(pixels, rows, columns, which, depth)


def _front(filled: _Front, count: int) -> _Front:
    """Of all that pixels may show, what is nearest to the camera; each pixel once."""
    buffer = np.zeros(count)
    np.maximum.at(buffer, filled.pixels, filled.inverse_depth)
    nearest = np.flatnonzero(filled.inverse_depth == buffer[filled.pixels])
    winner = np.full(count, -1, dtype=np.intp)
    winner[filled.pixels[nearest]] = nearest  # of equals the last
    seen = winner[winner >= 0]
    return _Front(
        filled.pixels[seen],
        filled.rows[seen],
        filled.columns[seen],
        filled.triangles[seen],
        filled.inverse_depth[seen],
    )


def _crossing(a: Array, b: Array, rows: Index) -> Array:
    """Column where the line from a to b (M, 2) crosses a row (M,); within the two ends."""
    height = b[:, 1] - a[:, 1]
    share = (rows - a[:, 1]) / np.where(height > 0, height, 1.0)
    result: Array = a[:, 0] + np.clip(share, 0.0, 1.0) * (b[:, 0] - a[:, 0])
    return result


def _ranges(start: Index, stop: Index) -> tuple[Index, Index]:
    """All whole numbers of the ranges [start, stop), and the range that each belongs to."""
    count = np.maximum(stop - start, 0)
    which = np.repeat(np.arange(len(start)), count)
    first = np.cumsum(count) - count
    return np.arange(len(which)) - first[which] + start[which], which
