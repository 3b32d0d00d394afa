"""Pictures of a body: image, silhouette, part labels and depth of its flesh at given poses.

Triangles of the flesh's mesh are cut into spans of pixels and the spans meet in a depth buffer, all
in numpy over whole arrays. A pixel belongs to a triangle when its centre lies inside; neighbouring
triangles share no pixel and leave none out. Colours are taken at a finer raster and averaged.

Depth cameras have noise, steps of disparity and holes. Sensors with structured light or two cameras
measure disparity, so that their error grows with the square of the depth [Khoshelham and Elberink,
Sensors 2012]:

    d = 1 / z + noise_d,   noise_d of standard deviation NOISE, smooth over a few pixels

Nothing is measured in the shadow that something near casts between the two eyes of the sensor, at
edges, where its window sees two depths, on patches that reflect badly, and out of range.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.flesh import Mesh
from hmt_ros.body.kinematics import Frames, forward
from hmt_ros.inference.arrays import Array, Index, Mask
from hmt_ros.rendering.scene import Clothes, Scene

Picture = NDArray[np.float32]

STACKS, SLICES = 13, 18  # of the mesh of a part: its outline is right to 2 % of its radius
SUPERSAMPLING = 2
SMALLEST_AREA = 1e-6  # px^2, of twice a triangle: a smaller one covers the centre of no pixel
SHADOW_BLUR = 0.004  # standard deviation of the shadow's edge as a share of the image's width
CHUNK = 16  # poses whose silhouettes are drawn together


@dataclass(frozen=True, eq=False)
class Rendered:
    """A picture of a person in a scene.

    Attributes:
        image: (H, W, 3) uint8, BGR.
        mask: (H, W) true where the person is seen.
        parts: (H, W) int8, index into `body.flesh.parts`; -1 in the background.
        depth: (H, W) float32, z of the surface in the camera frame, m; inf in the background.
    """

    image: NDArray[np.uint8]
    mask: Mask
    parts: NDArray[np.int8]
    depth: Picture


def render(body: Body, pose: ArrayLike, camera: Camera, scene: Scene, frame: int = 0) -> Rendered:
    """Picture of a body at a pose (d,) in a scene.

    Args:
        pose: (d,).
        frame: number of the picture, which seeds its noise.

    Raises:
        ValueError: the body has no flesh, or the pose has a wrong shape.
    """
    return _renderer(body, camera, scene).render(pose, frame)


def render_frames(body: Body, poses: ArrayLike, camera: Camera, scene: Scene) -> Iterator[Rendered]:
    """Pictures of a body at poses (T, d), one after the other, numbered from 0."""
    renderer = _renderer(body, camera, scene)
    for frame, pose in enumerate(np.asarray(poses, dtype=np.float64)):
        yield renderer.render(pose, frame)


def render_people(
    bodies: Sequence[Body], poses: Sequence[ArrayLike], camera: Camera, scene: Scene, frame: int = 0
) -> tuple[NDArray[np.uint8], NDArray[np.int8]]:
    """Picture of several people in a scene; of two the nearer one hides the other as a whole.

    Args:
        bodies: with flesh; each person has clothes of its own.
        poses: (d,) of each.

    Returns:
        (H, W, 3) uint8, BGR, and (H, W) the number of the person who is seen there; -1: nobody.
    """
    shape = (camera.height, camera.width)
    image, owners = scene.background(camera).copy(), np.full(shape, -1, dtype=np.int8)
    drawn = []
    for number, (body, pose) in enumerate(zip(bodies, poses, strict=True)):
        renderer = _renderer(body, camera, scene, number)
        frames = forward(body.skeleton, np.asarray(pose, dtype=np.float64)[None])
        points = frames.points(renderer.mesh.segments, renderer.mesh.vertices)
        if scene.shadow > 0:
            renderer.darken(image, points)
        drawn.append((float(points[:, 2].mean()), number, renderer, frames, points))
    for _, number, renderer, frames, points in sorted(drawn, key=lambda x: -x[0]):
        triangles = _project(renderer.mesh, points, camera)
        owners.reshape(-1)[_fill(triangles, *shape).pixels] = number
        if (owners == number).any():
            renderer.draw(image, triangles, frames)
    return scene.add_noise(image, frame), owners


def render_silhouettes(body: Body, poses: ArrayLike, camera: Camera) -> Mask:
    """Silhouettes (N, H, W) of a body at poses (N, d), the same as the masks of `render`.

    Raises:
        ValueError: the body has no flesh, or the poses have a wrong shape.
    """
    poses = np.asarray(poses, dtype=np.float64)
    mesh = _mesh(body)
    result = np.zeros((len(poses), camera.height, camera.width), dtype=bool)
    for start in range(0, len(poses), CHUNK):
        frames = forward(body.skeleton, poses[start : start + CHUNK])
        points = frames.points(mesh.segments, mesh.vertices)
        pixels = _fill(_project(mesh, points, camera), camera.height, camera.width).pixels
        result[start : start + CHUNK].reshape(-1)[pixels] = True
    return result


@dataclass(frozen=True, eq=False)
class _Renderer:
    """Common data of pictures of the same body, camera and scene."""

    body: Body
    camera: Camera
    scene: Scene
    mesh: Mesh
    places: Array  # (V, 4) of the vertices, for the clothes
    clothes: Clothes

    def render(self, pose: ArrayLike, frame: int = 0) -> Rendered:
        """Picture number `frame`, of a pose (d,)."""
        camera, scene = self.camera, self.scene
        shape = (camera.height, camera.width)
        frames = forward(self.body.skeleton, np.asarray(pose, dtype=np.float64)[None])
        points = frames.points(self.mesh.segments, self.mesh.vertices)
        triangles = _project(self.mesh, points, camera)
        image = scene.background(camera).copy()
        if scene.shadow > 0:
            self.darken(image, points)
        front = _front(triangles, _fill(triangles, *shape), shape)
        parts = np.full(shape, -1, dtype=np.int8)
        parts.reshape(-1)[front.pixels] = self.mesh.parts[triangles.corners[0, front.triangles]]
        depth = np.full(shape, np.inf, dtype=np.float32)
        depth.reshape(-1)[front.pixels] = 1.0 / front.inverse_depth
        if len(front.pixels):
            self.draw(image, triangles, frames)
        return Rendered(scene.add_noise(image, frame), parts >= 0, parts, depth)

    def draw(self, image: Picture, triangles: _Triangles, frames: Frames) -> None:
        """The person into the image."""
        k = SUPERSAMPLING
        height, width = image.shape[:2]
        left, right = _extent(triangles.u, width)
        top, bottom = _extent(triangles.v, height)
        fine = triangles.magnified(k, left, top)
        shape = (k * (bottom - top), k * (right - left))
        front = _front(fine, _fill(fine, *shape), shape)
        normals = frames.directions(self.mesh.segments, self.mesh.normals)[:, :, 0]
        values = np.concatenate([self.places, normals], axis=1).astype(np.float32)
        surface = fine.interpolated(values, front)
        normal = surface[:, 4:]
        cosine = normal @ self.scene.light_direction.astype(np.float32)
        cosine /= np.sqrt(np.einsum('mx,mx->m', normal, normal))
        parts = self.mesh.parts[fine.corners[0, front.triangles]]
        layer = np.zeros((shape[0] * shape[1], 4), dtype=np.float32)
        colour = self.clothes.colours(parts, surface[:, :4])
        colour *= (255.0 * self.scene.lambert(cosine))[:, None]
        layer[front.pixels, :3] = np.minimum(colour, 255.0)
        layer[front.pixels, 3] = 1.0
        size = (right - left, bottom - top)
        seen = cv2.resize(layer.reshape(*shape, 4), size, interpolation=cv2.INTER_AREA)
        window = image[top:bottom, left:right]
        window *= 1.0 - seen[:, :, 3:]
        window += seen[:, :, :3]

    def darken(self, image: Picture, points: Array) -> None:
        """The shadow of the person's vertices (V, 3, 1) into the image."""
        camera, scene = self.camera, self.scene
        fallen = scene.shadow_points(points[:, :, 0])[:, :, None]
        triangles = _project(self.mesh, fallen, camera)
        dark = np.zeros((camera.height, camera.width), dtype=np.float32)
        dark.reshape(-1)[_fill(triangles, camera.height, camera.width).pixels] = 1.0
        if not dark.any():
            return
        sigma = max(SHADOW_BLUR * camera.width, 0.5)
        margin = int(3 * sigma) + 1
        left, right = _extent(triangles.u, camera.width, margin)
        top, bottom = _extent(triangles.v, camera.height, margin)
        soft = cv2.GaussianBlur(dark[top:bottom, left:right], (0, 0), sigma)
        cosine = scene.light[2] / float(np.linalg.norm(scene.light))
        lit, shaded = scene.lambert(np.array([1.0, 1.0 - scene.shadow]) * cosine)
        soft *= (1.0 - shaded / lit) * scene.floor(camera)[top:bottom, left:right]
        image[top:bottom, left:right] *= 1.0 - soft[:, :, None]


@dataclass(frozen=True, eq=False)
class _Triangles:
    """F triangles that face the camera."""

    images: Index  # (F,) index of the image
    corners: Index  # (3, F) vertices
    u: Array  # (3, F) px
    v: Array  # (3, F) px
    inverse_depth: Array  # (3, F) 1 / z of the corners, 1/m

    def magnified(self, factor: int, left: int, top: int) -> _Triangles:
        """The triangles in a finer raster over a window of the image."""
        u = (self.u + (0.5 - left)) * factor - 0.5
        v = (self.v + (0.5 - top)) * factor - 0.5
        return _Triangles(self.images, self.corners, u, v, self.inverse_depth)

    def planes(self, values: NDArray[np.floating]) -> tuple[Array, Array, Array]:
        """Value at the first corner, and slopes along u and v, of values (3, F, ...)."""
        tail = (slice(None),) + (None,) * (values.ndim - 2)
        u, v = self.u[1:] - self.u[0], self.v[1:] - self.v[0]
        area = u[0] * v[1] - v[0] * u[1]
        one, two = values[1] - values[0], values[2] - values[0]
        along_u = one * (v[1] / area)[tail] - two * (v[0] / area)[tail]
        along_v = two * (u[0] / area)[tail] - one * (u[1] / area)[tail]
        return values[0], along_u, along_v

    def interpolated(self, values: Picture, front: _Front) -> Picture:
        """Values (M, k) at the pixels, from values (V, k) at the vertices; right in perspective."""
        # Divided by the depth they are linear over the image.
        weighted = values[self.corners] * self.inverse_depth[:, :, None].astype(np.float32)
        which = front.triangles
        base, along_u, along_v = (x.astype(np.float32)[which] for x in self.planes(weighted))
        along_u *= (front.columns - self.u[0][which]).astype(np.float32)[:, None]
        along_v *= (front.rows - self.v[0][which]).astype(np.float32)[:, None]
        base += along_u
        base += along_v
        base *= (1.0 / front.inverse_depth).astype(np.float32)[:, None]
        return base


@dataclass(frozen=True, eq=False)
class _Filled:
    """M pairs of a pixel and a triangle that contains its centre."""

    pixels: Index  # (M,) index into all images, row by row
    rows: Index
    columns: Index
    triangles: Index


@dataclass(frozen=True, eq=False)
class _Front(_Filled):
    """Each pixel that shows a triangle, with the nearest one."""

    inverse_depth: Array  # (M,) 1 / z, 1/m


@lru_cache(maxsize=8)
def _mesh(body: Body) -> Mesh:
    """Triangles of the flesh, the normals of which point outwards."""
    if not body.shapes:
        raise ValueError(f'body {body.name} has no flesh: it can not be drawn')
    mesh = body.flesh.mesh(STACKS, SLICES)
    # The order of the corners decides which triangles face the camera: make it fit the normals.
    a, b, c = mesh.vertices[mesh.triangles.T]
    inwards = np.einsum('fx,fx->f', np.cross(b - a, c - a), mesh.normals[mesh.triangles[:, 0]]) < 0
    triangles = np.where(inwards[:, None], mesh.triangles[:, ::-1], mesh.triangles)
    return replace(mesh, triangles=triangles)


@lru_cache(maxsize=4)
def _renderer(body: Body, camera: Camera, scene: Scene, wearer: int = 0) -> _Renderer:
    mesh, clothes = _mesh(body), Clothes.of_seed(body, scene.seed + wearer)
    places = clothes.places(mesh.segments, mesh.vertices)
    return _Renderer(body, camera, scene, mesh, places, clothes)


@lru_cache(maxsize=8)
def _field_of_view(camera: Camera) -> Array:
    """Bounds [[low, high], [low, high]] of x / z and of y / z of points in the image."""
    u, v = np.linspace(-0.5, camera.width - 0.5, 33), np.linspace(-0.5, camera.height - 0.5, 33)
    rays = camera.rays(np.stack(np.meshgrid(u, v), axis=-1))
    slopes = (rays[..., :2] / rays[..., 2:]).reshape(-1, 2)
    low, high = slopes.min(0), slopes.max(0)
    margin = 0.05 * (high - low)
    return np.stack([low - margin, high + margin], axis=1)


def _project(mesh: Mesh, points: Array, camera: Camera) -> _Triangles:
    """Triangles that face the camera and may be seen, of vertices (V, 3, N) of N images."""
    p = np.ascontiguousarray(points.transpose(1, 0, 2))
    (u, v), _ = camera.project_with_derivative(p, derivative=False)
    a, b, c = mesh.triangles.T
    # Counter-clockwise from outside is clockwise where the v axis points down. A corner behind the
    # camera is NaN, and the triangle is left out.
    area = (u[b] - u[a]) * (v[c] - v[a]) - (v[b] - v[a]) * (u[c] - u[a])
    visible = area < -SMALLEST_AREA
    # Far outside the image a distortion model may fold back into it.
    (left, right), (top, bottom) = _field_of_view(camera)
    x, y, z = p
    sides = (x < left * z, x > right * z, y < top * z, y > bottom * z)
    for side in sides:
        if side.any():
            visible &= ~(side[a] & side[b] & side[c])
    triangle, image = np.nonzero(visible)
    corners = np.ascontiguousarray(mesh.triangles[triangle].T)
    return _Triangles(image, corners, u[corners, image], v[corners, image], 1.0 / z[corners, image])


def _fill(triangles: _Triangles, height: int, width: int) -> _Filled:
    """All pixels whose centres lie in triangles, whether or not another triangle hides them."""
    # Corners from top to bottom. Both triangles at an edge then compute its places alike, and every
    # pixel goes to one of them.
    order = np.argsort(triangles.v, axis=0, kind='stable')
    u0, u1, u2 = np.take_along_axis(triangles.u, order, axis=0)
    v0, v1, v2 = np.take_along_axis(triangles.v, order, axis=0)
    rows, which = _ranges(_first(v0, height), _first(v2, height))
    with np.errstate(divide='ignore', invalid='ignore'):  # an edge along a row is never asked
        upper, lower, long = (u1 - u0) / (v1 - v0), (u2 - u1) / (v2 - v1), (u2 - u0) / (v2 - v0)
    below = rows >= v1[which]
    one = u0[which] + long[which] * (rows - v0[which])
    two = np.where(below, u1[which], u0[which])
    two += np.where(below, lower[which], upper[which]) * (
        rows - np.where(below, v1[which], v0[which])
    )
    start, stop = _first(np.minimum(one, two), width), _first(np.maximum(one, two), width)
    columns, span = _ranges(start, stop)
    first = (triangles.images[which] * height + rows) * width
    return _Filled(first[span] + columns, rows[span], columns, which[span])


def _front(triangles: _Triangles, filled: _Filled, shape: tuple[int, int]) -> _Front:
    """The triangle nearest to the camera at each pixel of one image."""
    base, along_u, along_v = triangles.planes(triangles.inverse_depth)
    base = base - along_u * triangles.u[0] - along_v * triangles.v[0]
    which = filled.triangles
    inverse = base[which] + along_u[which] * filled.columns + along_v[which] * filled.rows
    buffer = np.zeros(shape[0] * shape[1])
    np.maximum.at(buffer, filled.pixels, inverse)
    nearest = np.flatnonzero(inverse == buffer[filled.pixels])
    winner = np.full(len(buffer), -1, dtype=np.intp)
    winner[filled.pixels[nearest]] = nearest  # of equals the last
    seen = winner[winner >= 0]
    return _Front(
        filled.pixels[seen], filled.rows[seen], filled.columns[seen], which[seen], inverse[seen]
    )


def _extent(places: Array, size: int, margin: int = 0) -> tuple[int, int]:
    """First pixel and the one after the last that places (px) touch, within an image."""
    low, high = np.floor(places.min() + 0.5) - margin, np.floor(places.max() + 0.5) + 1 + margin
    return int(np.clip(low, 0, size)), int(np.clip(high, 0, size))


def _first(places: Array, size: int) -> Index:
    """First whole number from each place on, within an image."""
    return np.clip(np.ceil(places), 0, size).astype(np.intp)


def _ranges(start: Index, stop: Index) -> tuple[Index, Index]:
    """All whole numbers of the ranges [start, stop), and the range that each belongs to."""
    count = np.maximum(stop - start, 0)
    which = np.repeat(np.arange(len(start)), count)
    first = start - (np.cumsum(count) - count)
    return np.arange(len(which)) + first[which], which


Depth = NDArray[np.floating]

# Standard deviation and step of the disparity, divided by focal length and distance of the eyes:
# factors on the square of a depth, 1/m.
NOISE, STEP = 0.0020, 0.0008
# Standard deviation of the blur that makes neighbouring errors alike, px.
BLUR = 1.5
# Distance of the eyes of the sensor, m.
BASELINE = 0.05
# Depths that differ by more than this share over a pixel are an edge.
EDGE = 0.05
# Share of the pixels that reflect badly, and standard deviation of the patches' blur, px.
DARK, PATCH = 0.02, 5.0
NEAREST, FURTHEST = 0.3, 10.0
# Stream of random numbers of a seed; a scene uses others.
OF_DEPTH = 6


def sensed_depth(depth: Depth, camera: Camera, seed: int, frame: int = 0) -> NDArray[np.uint16]:
    """Depths measured by a sensor, from true depths.

    Args:
        depth: (H, W) along the axis of the camera, m; inf where nothing is.

    Returns:
        (H, W) mm, 0 where nothing was measured.
    """
    rng = np.random.default_rng([seed, OF_DEPTH, frame])
    z = np.asarray(depth, dtype=np.float64)
    inverse = 1.0 / z
    smooth = _smooth_noise(rng, z.shape, BLUR)
    measured = np.round((inverse + NOISE * smooth) / STEP) * STEP
    bad = (z < NEAREST) | (z > FURTHEST) | (measured <= 0.0)
    bad |= _shadowed(inverse, camera.fx * BASELINE)
    least, most = cv2.erode(z, np.ones((3, 3))), cv2.dilate(np.where(bad, 0.0, z), np.ones((3, 3)))
    with np.errstate(invalid='ignore'):
        bad |= (most - least > EDGE * least) & (rng.random(z.shape) < 0.5)
    patches = _smooth_noise(rng, z.shape, PATCH)
    bad |= patches > np.quantile(patches, 1.0 - DARK)
    with np.errstate(divide='ignore'):
        mm = np.where(bad, 0.0, np.rint(1000.0 / np.where(bad, 1.0, measured)))
    return np.clip(mm, 0, 65535).astype(np.uint16)


def _smooth_noise(rng: np.random.Generator, shape: tuple[int, ...], blur: float) -> Depth:
    """Noise of unit variance that is alike over some pixels."""
    noise = cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), blur)
    result: Depth = noise / noise.std()
    return result


def _shadowed(inverse: Depth, shift: float) -> NDArray[np.bool_]:
    """Pixels hidden from the second eye, to the right, by disparities in units of 1/m."""
    column = np.arange(inverse.shape[1])
    # A pixel is seen there at this column; a nearer surface, further right, covers it.
    there = column - shift * inverse
    nearest_right = np.minimum.accumulate(there[:, ::-1], axis=1)[:, ::-1]
    result: NDArray[np.bool_] = there > nearest_right + 0.5
    return result
