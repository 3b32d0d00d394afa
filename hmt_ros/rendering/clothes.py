"""What a rendered person wears: colours and patterns that are fixed to the surface of the flesh.

A shirt with short sleeves, shorts, socks, shoes, hair and a face, each with a pattern, so that
matching of intensities along the surface has something to hold on to.
"""

from __future__ import annotations

import colorsys
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.kinematics import forward

Array = NDArray[np.float64]
Values = NDArray[np.float32]
Index = NDArray[np.intp]

OF_CLOTHES = 4  # stream of random numbers of a seed
WAVE_LENGTHS = (0.30, 0.16, 0.10, 0.07)  # m, of what a pattern is the sum of
# Where cloth ends, as shares of the segment from its start.
SLEEVE, SHORTS, SOCK = 0.80, 0.15, 0.85
# What covers a segment whose name contains the word; everything else is skin.
KIND_OF_SEGMENT = {
    'head': 'head', 'neck': 'head', 'trunk': 'shirt', 'pelvis': 'shorts', 'upper_arm': 'sleeve',
    'thigh': 'shorts', 'shin': 'shin', 'foot': 'shoe',
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Clothes:
    """Colours of the surface of a body's P parts, BGR from 0 to 1.

    Attributes:
        body: who wears them.
        kinds: (P,) 'head', 'shirt', 'sleeve', 'shorts', 'shin', 'shoe' or 'skin'.
        skin, hair, shirt, logo, shorts, shoe: colours (3,).
        stripes: of the shirt, per metre.
        waves: (3, 4) of the patterns, rad/m.
        phases: (P, 4) of the pattern of each part.
    """

    body: Body
    kinds: tuple[str, ...]
    skin: Values
    hair: Values
    shirt: Values
    logo: Values
    shorts: Values
    shoe: Values
    stripes: float
    waves: Values
    phases: Values

    @classmethod
    def of_seed(cls, body: Body, seed: int) -> Clothes:
        """Random clothes for a body."""
        rng = np.random.default_rng([seed, OF_CLOTHES])

        def colour(saturation: tuple[float, float], value: tuple[float, float]) -> Values:
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
        """Places (V, 4) on the surface, of points (V, 3) given in the frames of segments (V,), m.

        A place is how far it lies right, ahead and up of the start of its segment when the person
        stands at rest, in m of a body of the default size, and the share of the segment, from its
        start.
        """
        rest = forward(self.body.skeleton, np.zeros((1, self.body.dimension)))
        at = rest.directions(segments, points)[:, :, 0] @ rest.columns[0, :, :, 0].T
        spans = np.ones(len(self.body.skeleton.segment_names))
        for shape in self.body.shapes:
            if shape.length is not None:
                spans[shape.segment] = max(float(self.body.skeleton.lengths[shape.length]), 1e-3)
        share = -points[:, 2:] / spans[segments, None]
        return np.concatenate([at / self.body.scale, share], axis=1)

    def colours(self, parts: Index, places: Values) -> Values:
        """Colours (M, 3) of places (M, 4) on parts (M,)."""
        result = np.empty((len(parts), 3), dtype=np.float32)
        for part, kind in enumerate(self.kinds):
            here = np.flatnonzero(parts == part)
            if len(here):
                at = places[here]
                wave = np.sin(at[:, :3] @ self.waves + self.phases[part]).mean(1)
                result[here] = self._colours(kind, at, wave[:, None])
        return result

    def _colours(self, kind: str, places: Values, wave: Values) -> Values:
        x, y, z, share = places.T
        skin = self.skin * (1.0 + 0.12 * wave)
        if kind == 'head':
            return self._head(places, skin, wave)
        if kind in ('shirt', 'sleeve'):
            cloth = self.shirt * (1.0 + 0.35 * wave)
            cloth[np.sin(z * (2 * np.pi * self.stripes)) > 0.35] *= 0.55
            if kind == 'sleeve':
                return _choose(share < SLEEVE, cloth, skin)
            # A cross on the chest, its four corners on the back.
            across, up = np.abs(x), np.abs(z - 0.30)
            bar = (across < 0.035) | (up < 0.030)
            mark = (across < 0.075) & (up < 0.085) & (bar == (y > 0))
            return _choose(mark, self.logo * (1.0 + 0.1 * wave), cloth)
        if kind in ('shorts', 'shin'):
            bold: Values = np.copysign(np.sqrt(np.abs(wave)), wave)
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

    def _head(self, places: Values, skin: Values, wave: Values) -> Values:
        x, y, z = np.abs(places[:, 0]), places[:, 1], places[:, 2] - 0.185
        front = y > 0
        eyes = front & (np.abs(x - 0.030) < 0.013) & (np.abs(z - 0.010) < 0.010)
        mouth = front & (x < 0.028) & (np.abs(z + 0.055) < 0.008)
        face = _choose(eyes, np.float32(0.13), skin)
        face = _choose(mouth, self.skin * np.array([0.6, 0.55, 0.8], dtype=np.float32), face)
        return _choose((z > 0.9 * y + 0.015) & (z > -0.085), self.hair * (1.0 + 0.6 * wave), face)


def _choose(where: NDArray[np.bool_], one: Values | np.float32, other: Values) -> Values:
    result: Values = np.where(where[:, None], one, other)
    return result


def _kind(segment: str) -> str:
    return next((kind for word, kind in KIND_OF_SEGMENT.items() if word in segment), 'skin')
