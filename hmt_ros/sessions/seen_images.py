"""What the newest images show, kept for a smoother in the process of the filter."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np

from hmt_ros.image.image_sequence import SeenImage

# Memory that the images of a window take at most, MB; 47 images of a person who fills a picture of
# 640 x 480 take 80.
MOST_MB = 256


class SeenImages:
    """Images by stamp; any thread may call the methods.

    Args:
        most_mb: memory that they take at most, MB; the oldest go first.

    Attributes:
        wanted: number of the newest that are kept.
    """

    def __init__(self, most_mb: float = MOST_MB) -> None:
        self.most_mb, self.wanted = most_mb, 0
        self._kept: dict[int, tuple[SeenImage, int]] = {}
        self._lock = threading.Lock()

    def add(self, stamp_ns: int, image: SeenImage | None) -> None:
        """Keeps the evidence of an image, None: it shows nobody.

        Those that are not older are of another time, and go.
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
        """The images of these stamps; None: it is not kept."""
        kept = self._kept
        return [kept[stamp][0] if stamp in kept else None for stamp in stamps_ns]


def size_of(value: Any) -> int:
    """Bytes of the arrays in a value."""
    if isinstance(value, np.ndarray):
        return int(value.nbytes)
    if is_dataclass(value):
        return sum(size_of(getattr(value, one.name)) for one in fields(value))
    if isinstance(value, Mapping):
        return sum(size_of(one) for one in value.values())
    return sum(size_of(one) for one in value) if isinstance(value, tuple) else 0
