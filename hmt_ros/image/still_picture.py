"""Detects images without change around keypoints, which then do not belong to a person.

If a detector takes the foot of a table for a person, it does so in every image of the scene.
People, however, always move a little.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference.arrays import Image

# Blur of compared images, px; minimum change of a pixel that is not noise, grey levels; minimum
# fraction of changed pixels around keypoints, because a person breathes or sways within tenths of a
# second (at least 0.003 on ten clips of people, 0 on a table); minimum contrast, grey levels.
BLUR_SIGMA, MIN_LEVEL_CHANGE, MIN_MOVING_FRACTION, MIN_CONTRAST = 1.5, 10.0, 0.002, 4.0


class StillPicture:
    """Compares images around keypoints with the last image in which this region had changed."""

    def __init__(self) -> None:
        self._last: NDArray[np.float32] | None = None

    def shows_again(self, image: Image, keypoints: Keypoints) -> bool:
        """Whether an image equals the stored image around keypoints; if not, stores the new image.

        Args:
            image: (H, W, 3) BGR.
            keypoints: keypoints in the image, at least one of them seen.
        """
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        picture = cv2.GaussianBlur(grey, (0, 0), BLUR_SIGMA).astype(np.float32)
        before, (height, width) = self._last, grey.shape[:2]
        if before is not None and before.shape == picture.shape:
            pixels = keypoints.pixels[keypoints.seen]
            left, top = np.clip(np.floor(pixels.min(0)), 0, [width - 1, height - 1]).astype(int)
            right, bottom = np.clip(np.ceil(pixels.max(0)) + 1, 1, [width, height]).astype(int)
            here = (slice(top, max(bottom, top + 1)), slice(left, max(right, left + 1)))
            changed = np.abs(picture[here] - before[here]) > MIN_LEVEL_CHANGE
            if picture[here].std() > MIN_CONTRAST and changed.mean() < MIN_MOVING_FRACTION:
                return True
        self._last = picture
        return False
