"""Pictures of a body: image, silhouette, part labels and depth of its flesh at given poses.

A depth buffer combines the pixel spans of `hmt_ros.body.rasterisation`. Colours are computed on a
finer raster and averaged.

Simulated depth has noise, disparity steps and holes. Sensors with structured light or two cameras
measure disparity, so that their error grows with the square of the depth [Khoshelham and Elberink,
Sensors 2012]:

    d = 1 / z + noise_d,   noise_d of standard deviation NOISE, smooth over a few pixels

Depth is missing where a near surface hides a point from one of the sensor's two eyes, at depth
edges, on patches that reflect badly, and out of range.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hmt_learning.rendering.scene import Clothes, Scene
from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.flesh import Mesh
from hmt_ros.body.kinematics import Frames, forward
from hmt_ros.body.rasterisation import Filled, Triangles, fill, mesh_of, project
from hmt_ros.inference.arrays import Array, Mask

Picture = NDArray[np.float32]

SUPERSAMPLING = 2
SHADOW_BLUR = 0.004  # standard deviation of the blur of the shadow, as a share of the image width


@dataclass(frozen=True, eq=False)
class Rendered:
    """A picture of a person in a scene.

    Attributes:
        image: (H, W, 3) uint8, BGR.
        mask: (H, W) true where the person is visible.
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
        frame: number of the picture, used as a seed of its noise.

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
    """Picture of several people in a scene; a nearer person is drawn over those behind.

    Args:
        bodies: bodies with flesh; the clothes of each differ.
        poses: pose (d,) of each.

    Returns:
        Image (H, W, 3) uint8, BGR, and the index (H, W) of the visible person; -1 if none.
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
        triangles = project(renderer.mesh, points, camera)
        owners.reshape(-1)[fill(triangles, *shape).pixels] = number
        if (owners == number).any():
            renderer.draw(image, triangles, frames)
    return scene.add_noise(image, frame), owners


@dataclass(frozen=True, eq=False)
class _Renderer:
    """Data shared by all pictures of one body, camera and scene."""

    body: Body
    camera: Camera
    scene: Scene
    mesh: Mesh
    places: Array  # (V, 4) texture coordinates of the vertices
    clothes: Clothes

    def render(self, pose: ArrayLike, frame: int = 0) -> Rendered:
        """Picture number `frame`, of a pose (d,)."""
        camera, scene = self.camera, self.scene
        shape = (camera.height, camera.width)
        frames = forward(self.body.skeleton, np.asarray(pose, dtype=np.float64)[None])
        points = frames.points(self.mesh.segments, self.mesh.vertices)
        triangles = project(self.mesh, points, camera)
        image = scene.background(camera).copy()
        if scene.shadow > 0:
            self.darken(image, points)
        front = _front(triangles, fill(triangles, *shape), shape)
        parts = np.full(shape, -1, dtype=np.int8)
        parts.reshape(-1)[front.pixels] = self.mesh.parts[triangles.corners[0, front.triangles]]
        depth = np.full(shape, np.inf, dtype=np.float32)
        depth.reshape(-1)[front.pixels] = 1.0 / front.inverse_depth
        if len(front.pixels):
            self.draw(image, triangles, frames)
        return Rendered(scene.add_noise(image, frame), parts >= 0, parts, depth)

    def draw(self, image: Picture, triangles: Triangles, frames: Frames) -> None:
        """Draws the person into the image."""
        k = SUPERSAMPLING
        height, width = image.shape[:2]
        left, right = _extent(triangles.u, width)
        top, bottom = _extent(triangles.v, height)
        fine = _magnified(triangles, k, left, top)
        shape = (k * (bottom - top), k * (right - left))
        front = _front(fine, fill(fine, *shape), shape)
        normals = frames.directions(self.mesh.segments, self.mesh.normals)[:, :, 0]
        values = np.concatenate([self.places, normals], axis=1).astype(np.float32)
        surface = _interpolated(fine, values, front)
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
        """Draws the shadow of the person's vertices (V, 3, 1) into the image."""
        camera, scene = self.camera, self.scene
        fallen = scene.shadow_points(points[:, :, 0])[:, :, None]
        triangles = project(self.mesh, fallen, camera)
        dark = np.zeros((camera.height, camera.width), dtype=np.float32)
        dark.reshape(-1)[fill(triangles, camera.height, camera.width).pixels] = 1.0
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
class _Front(Filled):
    """Pixels covered by triangles, each with the nearest triangle."""

    inverse_depth: Array  # (M,) 1 / z, 1/m


def _magnified(triangles: Triangles, factor: int, left: int, top: int) -> Triangles:
    """The triangles in a finer raster over a window of the image."""
    u = (triangles.u + (0.5 - left)) * factor - 0.5
    v = (triangles.v + (0.5 - top)) * factor - 0.5
    return Triangles(triangles.images, triangles.corners, u, v, triangles.inverse_depth)


def _planes(triangles: Triangles, values: NDArray[np.floating]) -> tuple[Array, Array, Array]:
    """Value at the first corner, and slopes along u and v, of values (3, F, ...)."""
    tail = (slice(None),) + (None,) * (values.ndim - 2)
    u, v = triangles.u[1:] - triangles.u[0], triangles.v[1:] - triangles.v[0]
    area = u[0] * v[1] - v[0] * u[1]
    one, two = values[1] - values[0], values[2] - values[0]
    along_u = one * (v[1] / area)[tail] - two * (v[0] / area)[tail]
    along_v = two * (u[0] / area)[tail] - one * (u[1] / area)[tail]
    return values[0], along_u, along_v


def _interpolated(triangles: Triangles, values: Picture, front: _Front) -> Picture:
    """Values (M, k) at the pixels, from values (V, k) at the vertices; perspective-correct."""
    # Values divided by the depth are linear over the image.
    weighted = values[triangles.corners] * triangles.inverse_depth[:, :, None].astype(np.float32)
    which = front.triangles
    base, along_u, along_v = (x.astype(np.float32)[which] for x in _planes(triangles, weighted))
    along_u *= (front.columns - triangles.u[0][which]).astype(np.float32)[:, None]
    along_v *= (front.rows - triangles.v[0][which]).astype(np.float32)[:, None]
    base += along_u
    base += along_v
    base *= (1.0 / front.inverse_depth).astype(np.float32)[:, None]
    return base


@lru_cache(maxsize=4)
def _renderer(body: Body, camera: Camera, scene: Scene, wearer: int = 0) -> _Renderer:
    mesh, clothes = mesh_of(body), Clothes.of_seed(body, scene.seed + wearer)
    places = clothes.places(mesh.segments, mesh.vertices)
    return _Renderer(body, camera, scene, mesh, places, clothes)


def _front(triangles: Triangles, filled: Filled, shape: tuple[int, int]) -> _Front:
    """The triangle nearest to the camera at each pixel of one image."""
    base, along_u, along_v = _planes(triangles, triangles.inverse_depth)
    base = base - along_u * triangles.u[0] - along_v * triangles.v[0]
    which = filled.triangles
    inverse = base[which] + along_u[which] * filled.columns + along_v[which] * filled.rows
    buffer = np.zeros(shape[0] * shape[1])
    np.maximum.at(buffer, filled.pixels, inverse)
    nearest = np.flatnonzero(inverse == buffer[filled.pixels])
    winner = np.full(len(buffer), -1, dtype=np.intp)
    winner[filled.pixels[nearest]] = nearest  # the last one of a tie
    seen = winner[winner >= 0]
    return _Front(
        filled.pixels[seen], filled.rows[seen], filled.columns[seen], which[seen], inverse[seen]
    )


def _extent(places: Array, size: int, margin: int = 0) -> tuple[int, int]:
    """First pixel that positions (px) cover, and the one after the last, within an image."""
    low, high = np.floor(places.min() + 0.5) - margin, np.floor(places.max() + 0.5) + 1 + margin
    return int(np.clip(low, 0, size)), int(np.clip(high, 0, size))


Depth = NDArray[np.floating]

# Standard deviation and step of the disparity, divided by focal length and BASELINE: factors on the
# square of a depth, 1/m.
NOISE, STEP = 0.0020, 0.0008
# Standard deviation of the blur that correlates neighbouring errors, px.
BLUR = 1.5
# Distance between the two eyes of the sensor, m.
BASELINE = 0.05
# Relative difference of depth between neighbouring pixels that counts as an edge.
EDGE = 0.05
# Share of the pixels that reflect badly, and standard deviation of the patches' blur, px.
DARK, PATCH = 0.02, 5.0
NEAREST, FURTHEST = 0.3, 10.0
# Identifier of a random stream; a scene uses others.
OF_DEPTH = 6


def sensed_depth(depth: Depth, camera: Camera, seed: int, frame: int = 0) -> NDArray[np.uint16]:
    """Depths measured by a sensor, from true depths.

    Args:
        depth: (H, W) true depth along the optical axis, m; inf if nothing is there.

    Returns:
        Depth (H, W), mm; 0 if not measured.
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
    """Noise of unit variance, correlated over some pixels."""
    noise = cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), blur)
    return np.asarray(noise / noise.std())


def _shadowed(inverse: Depth, shift: float) -> NDArray[np.bool_]:
    """Pixels hidden from the sensor's second eye, on the right, from inverse depths, 1/m."""
    column = np.arange(inverse.shape[1])
    # Column in the second eye's image; a nearer surface from further right covers it.
    there = column - shift * inverse
    nearest_right = np.minimum.accumulate(there[:, ::-1], axis=1)[:, ::-1]
    return there > nearest_right + 0.5
