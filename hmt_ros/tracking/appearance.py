"""Usual silhouette and colours of a person, and their evidence in an image.

    place    share of the model that is foreground / usual share
    area     area of the largest piece of the foreground that has the shape of one person / usual

If the clothes have the colours of the room, only a part of the model is foreground, so the share is
compared with the share in earlier images of the track. A person who was not seen for a time t may
be RUNNING_SPEED t further away, so the usual area is reduced accordingly. For colours see
`image.person_colours`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.body.camera import MIN_DEPTH, Camera
from hmt_ros.body.keep_out import RUNNING_SPEED
from hmt_ros.core import elementary
from hmt_ros.image.person_colours import LEARNING_INTERVAL, MEMORY_TIME, Colours, Motion
from hmt_ros.image.person_shape import (
    Piece,
    counted,
    covered,
    largest_person,
    on_raster,
    raster_step,
)
from hmt_ros.inference.arrays import Array, Image, Mask
from hmt_ros.inference.error_model import seconds
from hmt_ros.tracking.observer import View
from hmt_ros.tracking.settings import MAJORITY_FRACTION, UNDECIDED_FRACTION


class Silhouetted(NamedTuple):
    """Evidence of a silhouette for a person in view: -1 is nobody, 1 is a person.

    Attributes:
        by_place: evidence from the share of the model that is foreground.
        by_area: evidence from the largest piece anywhere that has the shape of a person.
        cut: whether the image border may cut the largest piece.
    """

    by_place: float
    by_area: float
    cut: bool

    @property
    def evidence(self) -> float:
        """Larger of the two, because a model in a wrong pose does not mean that nobody is there."""
        return max(self.by_place, self.by_area)


class Appearance:
    """Usual appearance of one person.

    Attributes:
        colours: colours of the person.
    """

    def __init__(self) -> None:
        self.colours = Colours()
        self._model: Mask | None = None
        self._depth = self._magnification = math.nan
        self._share, self._area = MAJORITY_FRACTION, math.nan
        self._stamp = 0
        self._coloured: int | None = None
        # Foreground of the last image on the raster, and its largest piece shaped like a person.
        self._foreground: Mask | None = None
        self._piece: Piece | None = None

    def uncovered_share(self, others: Mask | None) -> float:
        """Share of the model's last image area outside the pixels (H, W) of other people."""
        if self._model is None or others is None:
            return 1.0
        hidden = counted(self._model & on_raster(others, self._model))
        return 1.0 - hidden / max(counted(self._model), 1)

    def unseen(self, stamp: int) -> float:
        """Time from the last sighting to a timestamp, ns, in seconds; 0 if never seen."""
        return 0.0 if self._model is None else seconds(stamp - self._stamp)

    def silhouetted(self, view: View, stamp: int) -> Silhouetted | None:
        """Evidence of the silhouette; None without silhouette, or if most of the image has changed.

        Args:
            view: view of the image.
            stamp: timestamp of the image, ns.
        """
        self._foreground, self._piece = None, None
        if view.anywhere is None:
            return None
        model = np.zeros_like(view.anywhere) if self._model is None else self._model
        if view.changed > MAJORITY_FRACTION + counted(model) / model.size:
            return None
        foreground, others = view.anywhere, view.others
        if others is not None and view.silhouette is not None:
            # Other people may be in view, so only foreground near the person is used.
            foreground = on_raster(view.silhouette, foreground)
            model = model & ~on_raster(others, model)
        self._foreground = foreground
        self._piece = piece = largest_person(foreground, raster_step(len(view.image)))
        place = counted(foreground & model) / max(counted(model), 1)
        area = 0.0
        if piece is not None:
            shrunk = (self._depth / (self._depth + RUNNING_SPEED * self.unseen(stamp))) ** 2
            least = self._area * shrunk * self.uncovered_share(others)
            area = 1.0 if math.isnan(least) else piece.area / least
        return Silhouetted(
            _evidence(place / self._share), _evidence(area), piece is not None and piece.cut
        )

    def colour_evidence(self, view: View) -> tuple[bool, float] | None:
        """Whether colours support a person in view, and their weight, 0 to 1; None if unknown.

        Evidence against a person has weight 0 if the scene has changed since the colours were
        learned.
        """
        image = _coarse(view)
        score = self.colours.score(image)
        if score is None:
            return None
        if score > 0.5:
            return True, min(2.0 * score - 1.0, 1.0)
        most = self.colours.score(image, unseen=1.0)
        if most is None:
            return None
        against = min(max(1.0 - 2.0 * most, 0.0), 1.0)
        return False, against * self.colours.stillness(image)

    def motion(self, view: View) -> Motion:
        """Motion since the image that was learned last; see `Colours.motion`."""
        return self.colours.motion(_coarse(view))

    def is_apart(self, view: View, stamp: int) -> bool:
        """Whether most keypoints are outside the model's box, but within the person's reach.

        Keypoints beyond that reach are a detection error, or belong to another person.
        """
        keypoints = view.keypoints
        if keypoints is None or self._model is None or not keypoints.seen.any():
            return False
        x, y, width, height = cv2.boundingRect(self._model.view(np.uint8))
        pixels = keypoints.pixels[keypoints.seen] / raster_step(len(view.image))
        low, high = np.array([x, y]), np.array([x + width, y + height])
        away = np.maximum(low - pixels, pixels - high).max(axis=1)
        way = RUNNING_SPEED * self.unseen(stamp) * self._magnification
        return bool(0.25 * max(width, height) < np.median(away) < way)

    def learn(self, view: View, stamp: int, body: Body, camera: Camera, pose: Array) -> None:
        """Learns the appearance from an image and a pose (d,); call `silhouetted` first."""
        dt = 0.0 if self._model is None else seconds(stamp - self._stamp)
        gain = -float(elementary.expm1(-dt / MEMORY_TIME))
        self._model = model = covered(body, camera, pose, raster_step(camera.height))
        self._depth, self._stamp = max(float(pose[2]), MIN_DEPTH), stamp
        self._magnification = camera.magnification(self._depth) / raster_step(camera.height)
        free = self.uncovered_share(view.others)
        if free < MAJORITY_FRACTION:
            return
        if view.others is not None:
            model = model & ~on_raster(view.others, model)
        if self._foreground is not None and model.any():
            share = counted(self._foreground & model) / counted(model)
            if share > UNDECIDED_FRACTION * self._share:
                self._share += gain * (share - self._share)
        if self._piece is not None:
            area = self._piece.area / free
            known = not math.isnan(self._area)
            self._area = self._area + gain * (area - self._area) if known else area
        since = math.inf if self._coloured is None else seconds(stamp - self._coloured)
        if since >= LEARNING_INTERVAL:
            self.colours.learn(_coarse(view), model, since)
            self._coloured = stamp


def _coarse(view: View) -> Image:
    """Image on the coarse raster."""
    step = raster_step(len(view.image))
    height, width = (-(-x // step) for x in view.image.shape[:2])
    return on_raster(view.image, np.empty((height, width), np.bool_))


def _evidence(value: float) -> float:
    """Evidence, from -1 to 1, given the ratio of a value to its usual value."""
    return min(max(value / UNDECIDED_FRACTION - 1.0, -1.0), 1.0)
