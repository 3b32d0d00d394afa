"""The colours of a person's clothes, on torso and legs, which distinguish people.

The torso is the quadrangle between shoulders and hips. The legs are lines through the landmarks of
hips, knees and ankles; their width is a fraction of the trunk's length. The colours of a part are a
histogram; the distance between two histograms is the squared Hellinger distance 1 - sum sqrt(p q),
from 0 to 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from hmt_ros.core import count_colours
from hmt_ros.image.person_colours import BINS, binned
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference.arrays import Array, Image

TORSO = ('left_shoulder', 'right_shoulder', 'right_hip', 'left_hip')
LEGS = (('left_hip', 'left_knee', 'left_ankle'), ('right_hip', 'right_knee', 'right_ankle'))
# Minimum number of pixels of a part, and width of a leg as a fraction of the length of the trunk.
MIN_PIXELS, LEG_WIDTH_RATIO = 40, 0.22
# Minimum visibility of landmarks, and side length, px, to which larger crops of a person are
# reduced.
MIN_VISIBILITY, MAX_IMAGE_SIDE = 0.5, 96


@dataclass(frozen=True, eq=False)
class Clothes:
    """Colour histograms (2, BINS^3) of torso and legs, with sum 1; NaN if a part is not seen."""

    shares: Array

    @classmethod
    def of(cls, image: Image, keypoints: Keypoints) -> Clothes:
        """The clothes of a person in an image (H, W, 3) BGR."""
        at = dict(zip(keypoints.names, keypoints.pixels, strict=True))
        seen = dict(zip(keypoints.names, keypoints.confidences >= MIN_VISIBILITY, strict=True))
        counts = np.zeros((3, BINS**3), np.int64)
        low, high = (f(list(at.values()), axis=0) for f in (np.min, np.max))
        height, width = image.shape[:2]
        (left, top), (right, bottom) = (
            np.clip(np.rint(x), 0, (width, height)).astype(int) for x in (low, high)
        )
        if right - left >= 2 and bottom - top >= 2:
            part = image[top:bottom, left:right]
            scale = min(MAX_IMAGE_SIDE / max(part.shape[:2]), 1.0)
            small = cv2.resize(part, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
            labels = np.zeros(small.shape[:2], np.uint8)

            def places(names: tuple[str, ...]) -> NDArray[np.int32]:
                off = np.array([at[x] for x in names]) - (left, top)
                return np.asarray(np.rint(scale * off), dtype=np.int32)

            trunk = places(TORSO)
            length = np.linalg.norm(trunk[:2].mean(0) - trunk[2:].mean(0))
            for leg in LEGS:
                if all(seen[x] for x in leg):
                    wide = max(round(LEG_WIDTH_RATIO * length), 1)
                    cv2.polylines(labels, [places(leg)], False, 2, wide)
            if all(seen[x] for x in TORSO):
                cv2.fillConvexPoly(labels, cv2.convexHull(trunk), 1)
            count_colours(binned(np.asarray(small, np.uint8)), labels, counts)
        sizes = counts[1:].sum(1, keepdims=True)
        return cls(np.where(sizes >= MIN_PIXELS, counts[1:] / np.maximum(sizes, 1), np.nan))

    def distance(self, other: Clothes) -> float:
        """Mean distance over the parts seen on both people, 0 to 1; NaN without such parts."""
        each = 1.0 - np.sqrt(self.shares * other.shares).sum(1)
        return float(np.nanmean(each)) if np.isfinite(each).any() else np.nan

    def mixed(self, other: Clothes, share: float) -> Clothes:
        """Mixes in a share of other clothes; a part seen on only one of the two is copied."""
        mixed = self.shares + share * (other.shares - self.shares)
        known = np.where(np.isnan(self.shares), other.shares, self.shares)
        return Clothes(np.where(np.isnan(mixed), known, mixed))
