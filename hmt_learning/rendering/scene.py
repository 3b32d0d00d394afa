"""Surroundings of a rendered person (light, floor, wall, boxes, noise), and clothes.

A scene is a seed and a few numbers. The picture of the empty place follows from them by casting
rays through every pixel, so that it is correct under any lens distortion.

Clothes are colours and patterns that are fixed to the surface of the flesh: a shirt with short
sleeves, shorts, socks, shoes, hair and a face, each with a pattern, so that matching of intensities
along the surface finds texture.
"""

from __future__ import annotations

import colorsys
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from hmt_learning.motion.viewpoint import Viewpoint
from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.kinematics import forward
from hmt_ros.inference.arrays import Array, Index

Picture = NDArray[np.float32]
Real = TypeVar('Real', np.float32, np.float64)

SUPERSAMPLING = 2
NOISE_LEVELS = 256
# Identifiers of the random streams of a seed.
OF_THINGS, OF_SURFACES, OF_NOISE, OF_CLOTHES = 1, 2, 3, 4
WAVE_LENGTHS = (0.30, 0.16, 0.10, 0.07)  # wavelengths of a pattern, m
# Boundaries of the cloth, as fractions of the segment from its start.
SLEEVE, SHORTS, SOCK = 0.80, 0.15, 0.85
# Clothing of a segment by a word in its name; other segments show skin.
KIND_OF_SEGMENT = {
    'head': 'head',
    'neck': 'head',
    'trunk': 'shirt',
    'pelvis': 'shorts',
    'upper_arm': 'sleeve',
    'thigh': 'shorts',
    'shin': 'shin',
    'foot': 'shoe',
}


@dataclass(frozen=True)
class Scene:
    """A still, cluttered place with a floor, seen by a still camera.

    Attributes:
        viewpoint: place of the camera.
        seed: seed of the clutter, the clothes of the person, and the noise.
        light: direction towards the light in the world of the viewpoint, of any length.
        ambient: share of the light that comes from everywhere.
        shadow: share of the other light that a shadow removes, 0 (no shadow) to 1.
        noise: standard deviation of the noise of a pixel, grey levels of 255.
        clear: minimum distance of the boxes behind the origin of the world, m.
        clutter: number of boxes.

    Raises:
        ValueError: a number is outside its range.
    """

    viewpoint: Viewpoint = field(default_factory=Viewpoint)
    seed: int = 0
    light: tuple[float, float, float] = (-0.5, 0.75, 1.0)
    ambient: float = 0.5
    shadow: float = 0.8
    noise: float = 2.5
    clear: float = 1.5
    clutter: int = 14

    def __post_init__(self) -> None:
        for name, low, high in (
            ('seed', 0, 2**63),
            ('ambient', 0.0, 1.0),
            ('shadow', 0.0, 1.0),
            ('noise', 0.0, 100.0),
            ('clear', 0.0, 1000.0),
            ('clutter', 0, 1000),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise ValueError(f'{name} of a scene must lie in [{low}, {high}], saw {value}')
        if not (np.isfinite(self.light).all() and self.light[2] > 0):
            raise ValueError(f'the light of a scene must come from above, saw {self.light}')

    @property
    def light_direction(self) -> Array:
        """Unit vector (3,) towards the light, camera frame."""
        return self.viewpoint.rotation @ _unit(np.array(self.light))

    def lambert(self, cosine: NDArray[Real]) -> NDArray[Real]:
        """Reflected share of the light, from the cosine between normal and light; at most 1."""
        lit = self.ambient + (1.0 - self.ambient) * np.maximum(cosine, 0.0)
        return lit.astype(cosine.dtype, copy=False)

    def background(self, camera: Camera) -> Picture:
        """Image of the empty place, BGR (H, W, 3) in grey levels 0 to 255, without noise."""
        return _empty_place(self, camera)[0]

    def depth(self, camera: Camera) -> Array:
        """Depth (H, W) of the empty place along the optical axis, m; inf where nothing is hit."""
        return _empty_depth(self, camera)

    def floor(self, camera: Camera) -> Picture:
        """Fraction (H, W) of each pixel in which the floor is visible."""
        return _empty_place(self, camera)[1]

    def shadow_points(self, points: Array) -> Array:
        """Shadows on the floor (..., 3) of points (..., 3); camera frame, m."""
        world = self.viewpoint.to_world(points)
        light = np.array(self.light)
        return self.viewpoint.to_camera(world - world[..., 2:] / light[2] * light)

    def add_noise(self, image: Picture, frame: int) -> NDArray[np.uint8]:
        """The image (H, W, 3) with the noise of a frame, rounded."""
        if self.noise > 0:
            rng = np.random.default_rng([self.seed, OF_NOISE, frame])
            index = rng.integers(0, NOISE_LEVELS, image.shape, dtype=np.uint8)
            # Half a grey level more, so that truncation rounds to the nearest level.
            table = np.float32(self.noise) * _normal_quantiles() + np.float32(0.5)
            image = image + cv2.LUT(index, table)
        else:
            image = image + np.float32(0.5)
        return np.clip(image, 0.0, 255.0, out=image).astype(np.uint8)


@lru_cache(maxsize=1)
def _normal_quantiles() -> Picture:
    """NOISE_LEVELS equally likely values, with mean and variance of a standard normal variable."""
    grid = np.linspace(-4.0, 4.0, 8001)
    cumulative = np.cumsum(np.exp(-0.5 * grid * grid))
    p = (np.arange(NOISE_LEVELS) + 0.5) / NOISE_LEVELS
    values = np.interp(p, cumulative / cumulative[-1], grid)
    values -= values.mean()
    return np.asarray((values / values.std()).astype(np.float32))


def smooth_noise(points: Array, rng: np.random.Generator) -> Array:
    """Smooth random values in [-1, 1] at points (N, 2): random at integers, cubic in between."""
    table = rng.uniform(-1.0, 1.0, (64, 64))
    cell = np.floor(points).astype(np.intp)
    f = points - cell
    f = f * f * (3.0 - 2.0 * f)
    i, j = cell[:, 0] % 64, cell[:, 1] % 64
    k, m = (i + 1) % 64, (j + 1) % 64
    low = table[i, j] * (1 - f[:, 0]) + table[k, j] * f[:, 0]
    high = table[i, m] * (1 - f[:, 0]) + table[k, m] * f[:, 0]
    return low * (1 - f[:, 1]) + high * f[:, 1]


@dataclass(frozen=True, eq=False)
class _Things:
    """B boxes on the floor, in the world frame of the viewpoint, m."""

    centre: Array  # (B, 3)
    half: Array  # (B, 3)
    yaw: Array  # (B,)
    colour: Array  # (B, 3)
    stripes: Array  # (B,) per metre, 0 if plain

    def hit(self, origins: Array, rays: Array) -> tuple[Array, NDArray[np.intp], Array, Array]:
        """First box hit by each ray (N, 3): distance (inf if none), index, normal, local point."""
        best = np.full(len(rays), np.inf)
        which = np.zeros(len(rays), dtype=np.intp)
        normal, place = np.zeros((len(rays), 3)), np.zeros((len(rays), 3))
        for b in range(len(self.yaw)):
            # Rays that miss the bounding sphere of the box are skipped.
            offset = self.centre[b] - origins
            along = np.einsum('ni,ni->n', offset, rays)
            miss = np.einsum('ni,ni->n', offset, offset) - along * along
            near = np.flatnonzero((miss < self.half[b] @ self.half[b]) & (along > 0))
            c, s = np.cos(self.yaw[b]), np.sin(self.yaw[b])
            turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
            o, r = -offset[near] @ turn.T, rays[near] @ turn.T
            r = np.where(np.abs(r) > 1e-12, r, 1e-12)
            enter = (-np.sign(r) * self.half[b] - o) / r
            leave = (np.sign(r) * self.half[b] - o) / r
            t, axis = enter.max(1), enter.argmax(1)
            new = np.flatnonzero((t > 1e-6) & (t < leave.min(1)) & (t < best[near]))
            here = near[new]
            best[here], which[here] = t[new], b
            place[here] = o[new] + t[new, None] * r[new]
            face = np.zeros((len(new), 3))
            face[np.arange(len(new)), axis[new]] = -np.sign(r[new, axis[new]])
            normal[here] = face @ turn
        return best, which, normal, place


def _things(scene: Scene) -> _Things:
    rng = np.random.default_rng([scene.seed, OF_THINGS])
    n = scene.clutter
    half = rng.uniform([0.2, 0.15, 0.25], [0.7, 0.5, 1.1], (n, 3))
    depth = scene.clear + rng.uniform(0.8, 4.0, n)
    # One box in each slot across the view, so that some stand behind the person.
    slots = (rng.permutation(n) + rng.uniform(0.1, 0.9, n)) / max(n, 1)
    side = (slots - 0.5) * 1.3 * (scene.viewpoint.distance + depth)
    hsv = rng.uniform([0, 60, 90], [180, 170, 210], (n, 3)).astype(np.uint8)
    colour = cv2.cvtColor(hsv[None], cv2.COLOR_HSV2BGR)[0] if n else hsv
    stripes = np.where(rng.random(n) < 0.5, rng.uniform(2.0, 6.0, n), 0.0)
    centre = np.stack([side, -depth, half[:, 2]], axis=1)
    return _Things(centre, half, rng.uniform(-0.7, 0.7, n), colour / 255.0, stripes)


@lru_cache(maxsize=8)
def _empty_place(scene: Scene, camera: Camera) -> tuple[Picture, Picture]:
    shape = (SUPERSAMPLING * camera.height, SUPERSAMPLING * camera.width)
    v, u = np.mgrid[: shape[0], : shape[1]]
    pixels = (np.stack([u, v], axis=-1).reshape(-1, 2) + 0.5) / SUPERSAMPLING - 0.5
    rays = camera.rays(pixels) @ scene.viewpoint.rotation
    eye = np.array([0.0, scene.viewpoint.distance, scene.viewpoint.height])
    light = _unit(np.array(scene.light))
    rng = np.random.default_rng([scene.seed, OF_SURFACES])
    base = np.array([[0.62, 0.66, 0.68], [0.30, 0.34, 0.40], [0.36, 0.42, 0.50]])
    base = np.clip(base + rng.uniform(-0.08, 0.08, base.shape), 0.05, 0.95)

    t_wall, t_floor = _wall_and_floor(scene, eye, rays)
    things = _things(scene)
    t_box, box, normal, place = things.hit(np.broadcast_to(eye, rays.shape), rays)
    on_box = t_box < np.minimum(t_wall, t_floor)
    on_floor = (t_floor < t_wall) & ~on_box

    # The wall has stains and a skirting. Rays that hit nothing get its plain colour.
    colour = np.tile(base[0] * scene.lambert(light[1:2]), (len(rays), 1))
    on_wall = np.flatnonzero(np.isfinite(t_wall) & ~on_floor & ~on_box)
    at = eye + rays[on_wall] * t_wall[on_wall, None]
    stains = 1.0 + 0.25 * smooth_noise(at[:, [0, 2]] * 0.6, rng)
    stains *= 1.0 + 0.10 * smooth_noise(at[:, [0, 2]] * 3.0, rng)
    colour[on_wall] *= (stains * np.where(at[:, 2] < 0.18, 0.45, 1.0))[:, None]

    # The floor has tiles, stains and the shadows of the things; its colours fade with distance.
    points = eye + rays[on_floor] * t_floor[on_floor, None]
    tile = np.floor(points[:, 0] / 0.9 + 0.3) + np.floor(points[:, 1] / 0.9)
    ground = np.where((tile % 2 == 0)[:, None], base[1], base[2])
    ground *= 1.0 + 0.20 * smooth_noise(points[:, :2] * 1.3, rng)[:, None]
    ground *= 1.0 + 0.12 * smooth_noise(points[:, :2] * 9.0, rng)[:, None]
    dark = np.isfinite(things.hit(points, np.broadcast_to(light, points.shape))[0])
    ground *= scene.lambert(light[2] * np.where(dark, 1.0 - scene.shadow, 1.0))[:, None]
    fade = np.clip((t_floor[on_floor, None] - 6.0) / 20.0, 0.0, 0.6)
    colour[on_floor] = ground + fade * (base[1:].mean() - ground)

    which = box[on_box]
    face = things.colour[which] * scene.lambert(normal[on_box] @ light)[:, None]
    wave = np.sin(2 * np.pi * things.stripes[which] * (place[on_box] @ [0.8, 0.8, 1.0]))
    face[(wave > 0.3) & (things.stripes[which] > 0)] *= 0.6
    skew = np.array([[6.0, 1.2], [0.6, 6.0], [5.4, 1.8]])
    colour[on_box] = face * (1.0 + 0.08 * smooth_noise(place[on_box] @ skew, rng))[:, None]

    image = (255.0 * np.clip(colour, 0.0, 1.0)).astype(np.float32).reshape(*shape, 3)
    floor = on_floor.astype(np.float32).reshape(shape)
    size = (camera.width, camera.height)
    result = [
        np.asarray(cv2.resize(x, size, interpolation=cv2.INTER_AREA), dtype=np.float32)
        for x in (image, floor)
    ]
    for picture in result:
        picture.setflags(write=False)
    return result[0], result[1]


def _wall_and_floor(scene: Scene, eye: Array, rays: Array) -> tuple[Array, Array]:
    """Distances (N,) along rays (N, 3) to the wall and to the floor, world frame; inf if missed."""
    wall = -scene.clear - 5.0
    t_wall = np.where(rays[:, 1] < -1e-6, (wall - eye[1]) / np.minimum(rays[:, 1], -1e-6), np.inf)
    t_floor = np.where(rays[:, 2] < -1e-6, -eye[2] / np.minimum(rays[:, 2], -1e-6), np.inf)
    return t_wall, t_floor


@lru_cache(maxsize=8)
def _empty_depth(scene: Scene, camera: Camera) -> Array:
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = camera.rays(np.stack([u, v], axis=-1).reshape(-1, 2))
    world = rays @ scene.viewpoint.rotation
    eye = np.array([0.0, scene.viewpoint.distance, scene.viewpoint.height])
    t_wall, t_floor = _wall_and_floor(scene, eye, world)
    t_box, *_ = _things(scene).hit(np.broadcast_to(eye, world.shape), world)
    nearest = np.minimum(np.minimum(t_wall, t_floor), t_box)
    result: Array = (nearest * rays[:, 2]).reshape(camera.height, camera.width)
    result.setflags(write=False)
    return result


def _unit(vector: Array) -> Array:
    return vector / np.linalg.norm(vector)


@dataclass(frozen=True, eq=False)
class Clothes:
    """Colours of the surface of a body's P parts, BGR from 0 to 1.

    Attributes:
        body: the body of the person.
        kinds: (P,) 'head', 'shirt', 'sleeve', 'shorts', 'shin', 'shoe' or 'skin'.
        skin, hair, shirt, logo, shorts, shoe: colours (3,).
        stripes: stripes of the shirt per metre.
        waves: (3, 4) wave vectors of the patterns, rad/m.
        phases: (P, 4) phases of the pattern of each part.
    """

    body: Body
    kinds: tuple[str, ...]
    skin: Picture
    hair: Picture
    shirt: Picture
    logo: Picture
    shorts: Picture
    shoe: Picture
    stripes: float
    waves: Picture
    phases: Picture

    @classmethod
    def of_seed(cls, body: Body, seed: int) -> Clothes:
        """Random clothes for a body."""
        rng = np.random.default_rng([seed, OF_CLOTHES])

        def colour(saturation: tuple[float, float], value: tuple[float, float]) -> Picture:
            hsv = (rng.random(), rng.uniform(*saturation), rng.uniform(*value))
            return np.array(colorsys.hsv_to_rgb(*hsv)[::-1], dtype=np.float32)

        light, dark = np.array([0.66, 0.76, 0.95]), np.array([0.28, 0.40, 0.58])
        directions = rng.normal(size=(3, len(WAVE_LENGTHS)))
        directions /= np.linalg.norm(directions, axis=0)
        return cls(
            body=body,
            kinds=tuple(_kind(body.skeleton.segment_names[s.segment]) for s in body.shapes),
            skin=(light + rng.random() * (dark - light)).astype(np.float32),
            hair=np.array([0.10, 0.14, 0.22], dtype=np.float32) * np.float32(rng.uniform(0.5, 2.2)),
            shirt=colour((0.55, 0.9), (0.7, 1.0)),
            logo=colour((0.0, 0.5), (0.8, 1.0)),
            shorts=colour((0.3, 0.8), (0.2, 0.5)),
            shoe=colour((0.0, 0.5), (0.15, 0.9)),
            stripes=float(rng.uniform(9.0, 14.0)),
            waves=(directions * (2 * np.pi / np.array(WAVE_LENGTHS))).astype(np.float32),
            phases=rng.uniform(0, 2 * np.pi, (len(body.shapes), len(WAVE_LENGTHS))).astype(
                np.float32
            ),
        )

    def places(self, segments: Index, points: Array) -> Array:
        """Texture coordinates (V, 4) of points (V, 3) in the frames of segments (V,), m.

        The first three are the offsets to the right, ahead and up from the start of the segment
        in the zero pose, scaled to a body of the default size, m. The fourth is the fraction of
        the segment's length.
        """
        rest = forward(self.body.skeleton, np.zeros((1, self.body.dimension)))
        at = rest.directions(segments, points)[:, :, 0] @ rest.columns[0, :, :, 0].T
        spans = np.ones(len(self.body.skeleton.segment_names))
        for shape in self.body.shapes:
            if shape.length is not None:
                spans[shape.segment] = max(float(self.body.skeleton.lengths[shape.length]), 1e-3)
        share = -points[:, 2:] / spans[segments, None]
        return np.concatenate([at / self.body.scale, share], axis=1)

    def colours(self, parts: Index, places: Picture) -> Picture:
        """Colours (M, 3) at texture coordinates (M, 4) of parts (M,)."""
        result = np.empty((len(parts), 3), dtype=np.float32)
        for part, kind in enumerate(self.kinds):
            here = np.flatnonzero(parts == part)
            if len(here):
                at = places[here]
                wave = np.sin(at[:, :3] @ self.waves + self.phases[part]).mean(1)
                result[here] = self._colours(kind, at, wave[:, None])
        return result

    def _colours(self, kind: str, places: Picture, wave: Picture) -> Picture:
        x, y, z, share = places.T
        skin = self.skin * (1.0 + 0.12 * wave)
        if kind == 'head':
            return self._head(places, skin, wave)
        if kind in ('shirt', 'sleeve'):
            cloth = self.shirt * (1.0 + 0.35 * wave)
            cloth[np.sin(z * (2 * np.pi * self.stripes)) > 0.35] *= 0.55
            if kind == 'sleeve':
                return _choose(share < SLEEVE, cloth, skin)
            # A cross on the chest; on the back, the four corners around it.
            across, up = np.abs(x), np.abs(z - 0.30)
            bar = (across < 0.035) | (up < 0.030)
            mark = (across < 0.075) & (up < 0.085) & (bar == (y > 0))
            return _choose(mark, self.logo * (1.0 + 0.1 * wave), cloth)
        if kind in ('shorts', 'shin'):
            bold: Picture = np.copysign(np.sqrt(np.abs(wave)), wave)
            cloth = self.shorts * (1.0 + 0.8 * bold)
            if kind == 'shorts':
                return cloth
            sock = np.float32(0.85) + 0.1 * wave
            return _choose(share < SHORTS, cloth, _choose(share > SOCK, sock, skin))
        if kind == 'shoe':
            shoe = self.shoe * (1.0 + 0.3 * wave)
            shoe[np.sin(90.0 * x) > 0.6] *= 0.5
            return shoe
        return skin

    def _head(self, places: Picture, skin: Picture, wave: Picture) -> Picture:
        x, y, z = np.abs(places[:, 0]), places[:, 1], places[:, 2] - 0.185
        front = y > 0
        eyes = front & (np.abs(x - 0.030) < 0.013) & (np.abs(z - 0.010) < 0.010)
        mouth = front & (x < 0.028) & (np.abs(z + 0.055) < 0.008)
        face = _choose(eyes, np.float32(0.13), skin)
        face = _choose(mouth, self.skin * np.array([0.6, 0.55, 0.8], dtype=np.float32), face)
        return _choose((z > 0.9 * y + 0.015) & (z > -0.085), self.hair * (1.0 + 0.6 * wave), face)


def _choose(where: NDArray[np.bool_], one: Picture | np.float32, other: Picture) -> Picture:
    return np.where(where[:, None], one, other)


def _kind(segment: str) -> str:
    return next((kind for word, kind in KIND_OF_SEGMENT.items() if word in segment), 'skin')
