"""Evidence of the newest images, kept for a smoother in the same process as the filter."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np

from hmt_ros.image.image_sequence import SeenImage

# Maximum memory of the images of a window, MB; 47 images of 640 x 480 pixels take 80 MB if the
# person fills them.
MAX_MEGABYTES = 256


class SeenImages:
    """Thread-safe store of images by stamp.

    Args:
        most_mb: maximum memory of the images, MB; the oldest are dropped first.

    Attributes:
        wanted: maximum number of images; the newest are kept.
    """

    def __init__(self, most_mb: float = MAX_MEGABYTES) -> None:
        self.most_mb, self.wanted = most_mb, 0
        self._kept: dict[int, tuple[SeenImage, int]] = {}
        self._lock = threading.Lock()

    def add(self, stamp_ns: int, image: SeenImage | None) -> None:
        """Keeps the evidence of an image; ignores None, which stands for an image of nobody.

        Drops kept images that are not older, because they precede a jump in time.
        """
        if image is None:
            return
        observation = replace(
            image.observation,
            silhouette=None,
            foreground=None,
            depths=None,
            flow=None,
            others=None,
        )
        slim, size = replace(image, observation=observation), size_of(observation)
        with self._lock:
            kept = {stamp: one for stamp, one in self._kept.items() if stamp < stamp_ns}
            kept[stamp_ns] = slim, size
            total = sum(one[1] for one in kept.values())
            while len(kept) > self.wanted or total > 1e6 * self.most_mb:
                total -= kept.pop(next(iter(kept)))[1]
            self._kept = kept

    def of(self, stamps_ns: Sequence[int]) -> list[SeenImage | None]:
        """Return the image of each stamp, or None if the image is not kept."""
        kept = self._kept
        return [kept[stamp][0] if stamp in kept else None for stamp in stamps_ns]


def size_of(value: Any) -> int:
    """Return the size of the arrays in a value, bytes."""
    if isinstance(value, np.ndarray):
        return int(value.nbytes)
    if is_dataclass(value):
        return sum(size_of(getattr(value, one.name)) for one in fields(value))
    if isinstance(value, Mapping):
        return sum(size_of(one) for one in value.values())
    return sum(size_of(one) for one in value) if isinstance(value, tuple) else 0
