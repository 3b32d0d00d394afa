"""The empty scene of a camera that stands still, and checks whether it contained a person.

A given background is the empty scene. A background that is learned from images contains any person
who stood still in these images. Silhouettes then lack this person, and contain a ghost where the
person stood. Both faults give silhouettes of plausible shape, so they are detected by other cues:

    still      log odds -= dt / STILL_TIME       people move; a scene without motion is empty
    moved      log odds = 0, scene relearned     a piece as large as a part of a person has changed
    outline    log odds -= a(dt) N (u - m)       u: fraction of a silhouette's outline where edges
                                                 of the image exceed edges of the background

The log odds are for the presence of a person in the learned scene. The outline of a person has
edges in the image; the outline of a ghost has edges in the background. If a detector finds nobody,
less time is needed, and moving objects are not taken for a person.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from hmt_ros.core import elementary
from hmt_ros.image.background import WIDTH, BackgroundModel, edges_of
from hmt_ros.inference.arrays import Array, Image
from hmt_ros.inference.error_model import seconds, share_of_time

UNSEEN = (
    'the scene has not been seen empty and still for two seconds; wanted that, or background_file, '
    'or a detector (use_keypoints, or "install-detector")'
)
# Time constants of a person who keeps still, and of a still person whom a detector misses, s;
# maximum change of the log odds in one image, nats.
STILL_TIME, UNDETECTED_TIME, MAX_NATS = 0.4, 0.1, 3.5
# Log odds of a person in the scene, nats: maximum at which silhouettes are used; minimum that
# stillness can give, because a person may sleep; value below which silhouettes are no longer
# checked.
USABLE_LOG_ODDS, MIN_STILL_LOG_ODDS, SURE_LOG_ODDS = -3.5, -5.0, -14.0
# Blur of compared images, px; time constant of their mean, s; minimum change of a pixel that is not
# noise, grey levels; minimum size of a changed piece that is part of a person, as a fraction of the
# image (measured: up to 6e-5 in empty scenes, 2e-4 to 3e-3 within 0.5 s for people who stand).
BLUR_SIGMA, MEMORY_TIME, MIN_LEVEL_CHANGE, MIN_PIECE_FRACTION = 1.5, 1.0, 10.0, 2e-4
# N, m, time constant of errors of the outline, s, and minimum length of the outline, px. On nine
# rendered clips u is 0.85 to 1 if the background is the empty scene, and 0.25 to 0.66 if it is the
# first image, until the person has left the place of the ghost.
OUTLINE_NATS, UNDECIDED_MISFIT, OUTLINE_TIME, MIN_OUTLINE_LENGTH = 16.0, 0.75, 0.2, 40


class EmptyScene:
    """Learns the empty scene, and checks whether it contains a person.

    Args:
        background: a given background, or a new model without images.
        trusted: whether other code learns and checks the background.

    Attributes:
        background: the learned scene.
        seen: whether the scene was observed for long enough for silhouettes to be used and checked.
        log_odds: log odds of a person in the learned scene, nats.
    """

    def __init__(self, background: BackgroundModel, *, trusted: bool = False) -> None:
        self.background = background
        self.seen = bool(background.frames or trusted)
        self.log_odds = -math.inf if self.seen else 0.0
        self._recent: Array | None = None
        self._learned = 0
        self._judged: int | None = None
        self._edges: NDArray[np.float32] | None = None

    @property
    def known(self) -> bool:
        """Whether the scene was observed for long enough and contains nobody."""
        return self.background.frames > 0 and self.seen and self.log_odds < USABLE_LOG_ODDS

    @property
    def wants(self) -> str:
        """Message about input that silhouettes still need; '' if nothing is missing."""
        return '' if self.known else UNSEEN

    @property
    def is_of_somebody(self) -> bool:
        """Whether the scene was observed for long enough and probably contains a person."""
        return self.seen and self.log_odds > 0.0

    def learn(self, image: Image, stamp: int, detected: bool | None = None) -> None:
        """Learns from an image (H, W, 3), unless a detector finds a person in the image.

        Args:
            image: image of the scene.
            stamp: stamp of the image, ns, later than the previous one.
            detected: whether a detector or a segmenter finds a person; None if unknown.
        """
        if self.log_odds == -math.inf or detected:
            return
        dt = seconds(stamp - self._learned) if self._recent is not None else 0.0
        if self._has_moved(image, dt) and detected is None:
            if self.seen:
                return
            self.background, self.log_odds = BackgroundModel(self.background.settings), 0.0
        elif self.log_odds > MIN_STILL_LOG_ODDS:
            still = min(dt / (STILL_TIME if detected is None else UNDETECTED_TIME), MAX_NATS)
            self.log_odds = max(self.log_odds - still, MIN_STILL_LOG_ODDS)
            self.seen |= self.log_odds < USABLE_LOG_ODDS
        self._learned, self._edges = stamp, None
        self.background.learn(image)

    def update(self, image: Image, stamp: int) -> None:
        """Updates the log odds from the outline of the silhouette in an image (H, W, 3)."""
        if not self.seen or self.log_odds <= SURE_LOG_ODDS:
            return
        now, size = edges_of(image), image.shape[1::-1]
        if self._edges is None:
            empty = cv2.resize(self.background.empty, size)
            self._edges = edges_of(np.asarray(empty, dtype=np.uint8))
        silhouette = self.background.silhouette(image)
        pixels = cv2.resize(silhouette.view(np.uint8), now.shape[::-1])
        square = np.ones((3, 3), np.uint8)
        outline = cv2.morphologyEx(pixels, cv2.MORPH_GRADIENT, square) > 0
        if np.count_nonzero(outline) < MIN_OUTLINE_LENGTH * now.shape[1] / WIDTH:
            return
        stronger = cv2.dilate(now, square) > cv2.dilate(self._edges, square)
        since = math.inf if self._judged is None else seconds(stamp - self._judged)
        evidence = (
            share_of_time(since, OUTLINE_TIME)
            * OUTLINE_NATS
            * (float(stronger[outline].mean()) - UNDECIDED_MISFIT)
        )
        self.log_odds -= float(np.clip(evidence, -MAX_NATS, MAX_NATS))
        self._judged = stamp

    def _has_moved(self, image: Image, dt: float) -> bool:
        """Whether a piece as large as a part of a person has changed since earlier images."""
        width = min(WIDTH, image.shape[1])
        height = max(round(image.shape[0] * width / image.shape[1]), 1)
        resized = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        small = np.asarray(cv2.GaussianBlur(resized, (0, 0), BLUR_SIGMA), dtype=np.float64)
        before = self._recent
        if before is None or before.shape != small.shape:
            self._recent = small
            return False
        changed = (np.abs(small - before).max(axis=2) > MIN_LEVEL_CHANGE).view(np.uint8)
        _, _, pieces, _ = cv2.connectedComponentsWithStats(changed, connectivity=8)
        moved = pieces[1:, cv2.CC_STAT_AREA].max(initial=0) > MIN_PIECE_FRACTION * changed.size
        gain = 1.0 if moved else -float(elementary.expm1(-dt / MEMORY_TIME))
        self._recent = before + gain * (small - before)
        return bool(moved)
