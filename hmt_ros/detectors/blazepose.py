"""BlazePose, the detector of MediaPipe Pose: 33 landmarks of one person, in pixels and in metres.

Two networks find the landmarks. The first one searches the whole image for a person, and outputs a
circle around the body: its centre, which is the middle of the hips, and a point on it. The second
one receives the square around this circle, turned upright, and outputs landmarks, positions and a
mask. It also outputs the circle for the next image, which therefore needs only the second network.
One-euro filters smooth landmarks and circle:

    y_t = y_(t-1) + a(f) (x_t - y_(t-1)),    f = f_0 + b |v_t|,    a(f) = 1 / (1 + 1 / (2 pi f dt))

with the smoothed velocity v_t of x_t (Casiez, Roussel, Vogel, CHI 2012). Constants are from
MediaPipe 0.10.21. The networks run in this process, in one thread, without holding Python's global
lock.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from hmt_ros.core import elementary
from hmt_ros.detectors import blazepose_models
from hmt_ros.detectors.detector import DetectorKind
from hmt_ros.detectors.square import Square, sigmoid
from hmt_ros.image.keypoint_schemes import schemes
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference.arrays import Array, Image, Mask
from hmt_ros.inference.linear_algebra import product

if TYPE_CHECKING:
    from ai_edge_litert.interpreter import Interpreter

SCHEME = 'mediapipe33'
LANDMARKS = 33
# Gap between images after which the whole image is searched again, ns.
_MAX_INTERVAL = 1_000_000_000
# Side lengths of the two networks' inputs, and of the heat maps of landmarks, px.
_PERSON_SIZE, _LANDMARK_SIZE, _HEAT_SIZE = 224, 256, 64
# Cell sizes of the first network, px, predictions per cell, and overlap (intersection over union)
# above which two predictions are merged.
_STRIDES, _PREDICTIONS_PER_CELL, _SAME_OVERLAP = (8, 16, 32), (2, 2, 6), 0.3
# Minimum probability of a person, and minimum probability that a pixel belongs to the person.
_MIN_PROBABILITY = 0.5
# Factor on the quality of a person who is lying or upside down.
_LYING_QUALITY = 0.6
# Half side of the window around a landmark in its heat map, cells, and minimum peak in this window.
_HEAT_REACH, _MIN_HEAT_PEAK = 4, 0.5
# Cutoffs f_0 of the one-euro filters, Hz, and factors b by which velocities raise the cutoffs.
_VELOCITY_CUTOFF = 1.0
_LANDMARK_CUTOFF, _CIRCLE_CUTOFF, _POSITION_CUTOFF = (0.05, 80.0), (0.01, 10.0), (0.1, 40.0)
# Weight of a new image in the smoothed visibility.
_VISIBILITY_GAIN = 0.1

_Tensor = NDArray[np.float32]


class BlazePose:
    """Follows one person from image to image.

    Args:
        with_mask: whether to compute `mask` as well.

    Attributes:
        mask: (H, W) pixels of the person in the last image; None without `with_mask`.

    Raises:
        DetectorError: the detector is not installed.
    """

    def __init__(self, *, with_mask: bool = False) -> None:
        self.mask: Mask | None = None
        self._with_mask = with_mask
        self._networks = Networks()
        self._size = (0, 0)
        self._newest = 0
        self._followed: Followed | None = None

    def detect(self, image: Image, stamp_ns: int) -> Keypoints | None:
        """The landmarks of the person in an image, named as in the scheme 'mediapipe33'.

        An image starts a new sequence if it is not newer than the previous image, is newer by more
        than 1 s, or differs in size.

        Args:
            image: (H, W, 3) BGR.
            stamp_ns: stamp of the image.

        Returns:
            The keypoints, with unknown covariances, visibilities as confidences, and positions in m
            relative to the middle of the hips, along the axes of the camera. None if nobody was
            seen.
        """
        interval = stamp_ns - self._newest
        if not 0 < interval <= _MAX_INTERVAL or image.shape[:2] != self._size:
            self._followed = None
        self._newest, self._size = stamp_ns, image.shape[:2]
        circle = self._circle(image) if self._followed is None else self._followed.circle
        found = None if circle is None else self._networks.landmarks(image, Square.about(circle))
        if found is None:
            self._followed = None
            if self._with_mask:
                self.mask = np.zeros(self._size, dtype=np.bool_)
            return None
        if self._followed is None:
            self._followed = Followed()
        if self._with_mask:
            self.mask = found.square.spread(sigmoid(found.mask), self._size) >= _MIN_PROBABILITY
        return self._followed.smooth(found, interval * 1e-9)

    def _circle(self, image: Image) -> Array | None:
        """Circle (centre and a point, (2, 2), px) around the person of highest score, or None."""
        height, width = image.shape[:2]
        whole = Square((width / 2, height / 2), max(height, width), 0.0)
        return next((circle for _, circle in self._networks.circles(image, whole)), None)


class Networks:
    """The two networks: one finds people in a square of an image, the other a person's landmarks.

    Raises:
        DetectorError: the networks are not installed.
    """

    def __init__(self) -> None:
        self._person = _Network(blazepose_models.PERSON)
        self._landmark = _Network(blazepose_models.LANDMARKS)
        self._anchors = _anchors()

    def circles(self, image: Image, square: Square) -> Iterator[tuple[float, Array]]:
        """Yields score and circle (centre and a point, (2, 2), px) of people, highest score first.

        Each prediction is averaged with the predictions of lower score that overlap with it.
        """
        seen = square.seen(image, _PERSON_SIZE, cv2.BORDER_CONSTANT)
        boxes, logits = self._person(seen * np.float32(2 / 255) - np.float32(1))
        scores = sigmoid(logits[:, 0].astype(np.float64))
        chosen = np.flatnonzero(scores >= _MIN_PROBABILITY)
        scores = scores[chosen]
        # Centre and size of the face, then points on the body, as fractions of the square.
        points = boxes[chosen].astype(np.float64).reshape(-1, 6, 2) / _PERSON_SIZE
        points[:, [0, 2, 3]] += self._anchors[chosen, None]
        while len(scores):
            lower, upper = points[:, 0] - points[:, 1] / 2, points[:, 0] + points[:, 1] / 2
            best = int(scores.argmax())
            common = np.minimum(upper, upper[best]) - np.maximum(lower, lower[best])
            area = np.prod(common.clip(0.0), axis=1)
            areas = np.prod(upper - lower, axis=1)
            same = area > _SAME_OVERLAP * (areas + areas[best] - area)
            same[best] = True
            middle = np.average(points[same, 2:4], axis=0, weights=scores[same])
            yield float(scores[best]), square.corner + middle * square.side
            points, scores = points[~same], scores[~same]

    def landmarks(self, image: Image, square: Square) -> Found | None:
        """The landmarks of the person in a square; None if the square shows nobody."""
        if square.side < 1.0:
            return None
        seen = square.seen(image, _LANDMARK_SIZE, cv2.BORDER_REPLICATE)
        flat, presence, mask, heat, world = self._landmark(seen * np.float32(1 / 255))
        if not presence[0] > _MIN_PROBABILITY:
            return None
        rows = flat.astype(np.float64).reshape(-1, 5)
        points = _refined(rows[:, :2] / _LANDMARK_SIZE, heat)[: LANDMARKS + 2]
        positions = world.astype(np.float64).reshape(-1, 3)[:LANDMARKS]
        positions[:, :2] = product(positions[:, :2], square.axes)
        return Found(
            square,
            square.corner + product(square.side * points, square.axes),
            sigmoid(rows[:LANDMARKS, 3]),
            positions,
            mask[..., 0],
            float(presence[0]),
        )


MEDIAPIPE = DetectorKind(
    'MediaPipe Pose', BlazePose, blazepose_models.is_installed, blazepose_models.install
)


@dataclass(frozen=True, eq=False)
class Found:
    """The output of the second network for one image.

    Attributes:
        square: square of the image that was the network's input.
        points: (35, 2) landmarks, then centre and point of the circle, px.
        visibilities: (33,) visibilities of the landmarks, 0 to 1.
        positions: (33, 3) 3D positions of the landmarks, m.
        mask: (256, 256) logits that a pixel of the square belongs to the person.
        presence: probability that the square shows a person.
    """

    square: Square
    points: Array
    visibilities: Array
    positions: Array
    mask: _Tensor
    presence: float

    @property
    def quality(self) -> float:
        """Presence times mean visibility, 0 to 1; lower for a person who is not upright."""
        upright = max(float(elementary.cos(self.square.angle)), 0.0)
        share = _LYING_QUALITY + (1.0 - _LYING_QUALITY) * upright
        return self.presence * float(self.visibilities.mean()) * share


class Followed:
    """Smooths the landmarks and the circle of a person over successive images.

    Attributes:
        circle: (2, 2) centre and point of the circle to search in the next image, px.
    """

    def __init__(self) -> None:
        self.circle = np.zeros((2, 2))
        self._visibilities: Array | None = None
        self._of_landmarks = _OneEuroFilter(*_LANDMARK_CUTOFF)
        self._of_circle = _OneEuroFilter(*_CIRCLE_CUTOFF)
        self._of_positions = _OneEuroFilter(*_POSITION_CUTOFF)

    def smooth(self, found: Found, interval: float) -> Keypoints:
        """Smooths the output for an image `interval` s after the previous image."""
        landmarks, circle = found.points[:LANDMARKS], found.points[LANDMARKS:]
        diameter = max(2 * math.hypot(*(circle[1] - circle[0])), 1.0)
        self.circle = self._of_circle(circle, interval, diameter)
        if self._visibilities is None:
            self._visibilities = found.visibilities
        change = found.visibilities - self._visibilities
        self._visibilities = self._visibilities + _VISIBILITY_GAIN * change
        pixels = self._of_landmarks(landmarks, interval, diameter)
        positions = self._of_positions(found.positions, interval, 1.0)
        unknown = np.full((LANDMARKS, 2, 2), np.nan)
        # The network's origin is the edge of the first pixel.
        return Keypoints(
            schemes()[SCHEME].names, pixels - 0.5, unknown, self._visibilities, positions
        )


class _OneEuroFilter:
    """One-euro filter of an array, which smooths fast changes less; see the module's docstring."""

    def __init__(self, cutoff: float, gain: float) -> None:
        self._cutoff, self._gain = cutoff, gain
        self._last: Array | None = None

    def __call__(self, values: Array, interval: float, scale: float) -> Array:
        """Smooths the next values; `scale` is the length unit in which velocities are measured."""
        if self._last is None:
            self._smoothed, self._velocity = values, np.zeros_like(values)
        else:
            velocity = (values - self._last) / (scale * interval)
            self._velocity += _weight(_VELOCITY_CUTOFF, interval) * (velocity - self._velocity)
            cutoff = self._cutoff + self._gain * np.abs(self._velocity)
            change = _weight(cutoff, interval) * (values - self._smoothed)
            self._smoothed = self._smoothed + change
        self._last = values
        return self._smoothed


class _Network:
    """A neural network, read from a file, that runs in one thread."""

    def __init__(self, name: str) -> None:
        content = blazepose_models.require_network(name)
        from ai_edge_litert.interpreter import Interpreter

        self._interpreter: Interpreter = Interpreter(model_content=content, num_threads=1)
        self._interpreter.allocate_tensors()
        self._input = self._interpreter.get_input_details()[0]['index']
        self._outputs = [each['index'] for each in self._interpreter.get_output_details()]

    def __call__(self, image: _Tensor) -> list[_Tensor]:
        self._interpreter.set_tensor(self._input, np.ascontiguousarray(image)[None])
        self._interpreter.invoke()
        return [self._interpreter.get_tensor(index)[0] for index in self._outputs]


def _anchors() -> Array:
    """Cell centres (2254, 2) of the first network's predictions, as fractions of its input."""
    result = []
    for stride, predictions in zip(_STRIDES, _PREDICTIONS_PER_CELL):
        middles = (np.arange(_PERSON_SIZE // stride) + 0.5) * stride / _PERSON_SIZE
        cells = np.stack(np.meshgrid(middles, middles), axis=-1).reshape(-1, 2)
        result.append(np.repeat(cells, predictions, axis=0))
    return np.concatenate(result)


def _refined(points: Array, heat: _Tensor) -> Array:
    """Moves points (n, 2), fractions of the image, to the mean of the heat map around each point.

    Args:
        heat: (64, 64, n) logits of heat maps.
    """
    cells = np.trunc(points * _HEAT_SIZE).astype(int)
    about = cells[..., None] + np.arange(-_HEAT_REACH, _HEAT_REACH + 1)
    inside = (about >= 0) & (about < _HEAT_SIZE)
    column, row = about.clip(0, _HEAT_SIZE - 1).swapaxes(0, 1)
    window = sigmoid(heat[row[:, :, None], column[:, None], np.arange(len(points))[:, None, None]])
    window = window * (inside[:, 1, :, None] & inside[:, 0, None])
    profiles = np.stack([window.sum(axis=1), window.sum(axis=2)], axis=1)
    mass = np.maximum(profiles.sum(axis=2), np.finfo(np.float32).tiny)
    hot = (window.max(axis=(1, 2)) >= _MIN_HEAT_PEAK) & inside[..., _HEAT_REACH].all(axis=1)
    return np.where(hot[:, None], (profiles * about).sum(axis=2) / mass / _HEAT_SIZE, points)


def _weight(cutoff: Array | float, interval: float) -> Array | float:
    return 1 / (1 + 1 / (2 * math.pi * interval * cutoff))
