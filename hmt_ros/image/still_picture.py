"""Whether an image shows the same picture as another one around keypoints.

A detector that takes the foot of a table for a person does so in every image that shows the same.
People move, if only a little.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference.arrays import Image

# Blur of images that are compared, px; least change of a pixel that noise does not make, grey
# levels; share of the pixels around keypoints that change when a person breathes or sways within
# tenths of a second (0.003 and more on ten clips of people, 0 on a table); least contrast.
BLUR, CHANGED, MOVING, CONTRAST = 1.5, 10.0, 0.002, 4.0


class StillPicture:
    """The last image that showed something else around keypoints than the one before."""

    def __init__(self) -> None:
        self._last: NDArray[np.float32] | None = None

    def shows_again(self, image: Image, keypoints: Keypoints) -> bool:
        """Whether keypoints lie on the last such picture; else the image becomes the last.

        Args:
            image: (H, W, 3) BGR.
            keypoints: some of which were seen.
        """
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        picture = cv2.GaussianBlur(grey, (0, 0), BLUR).astype(np.float32)
        before, (height, width) = self._last, grey.shape[:2]
        if before is not None and before.shape == picture.shape:
            pixels = keypoints.pixels[keypoints.seen]
            left, top = np.clip(np.floor(pixels.min(0)), 0, [width - 1, height - 1]).astype(int)
            right, bottom = np.clip(np.ceil(pixels.max(0)) + 1, 1, [width, height]).astype(int)
            here = (slice(top, max(bottom, top + 1)), slice(left, max(right, left + 1)))
            changed = np.abs(picture[here] - before[here]) > CHANGED
            if picture[here].std() > CONTRAST and changed.mean() < MOVING:
                return True
        self._last = picture
        return False
