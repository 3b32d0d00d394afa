"""The view of a person in an image, before a pose is known, and what was given with the image."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference.arrays import Image, Mask
from hmt_ros.tracking.pose_prediction import PosePrediction


class View(NamedTuple):
    """The view of a person in an image.

    Attributes:
        image: (H, W, 3) BGR.
        stamp: of the image, ns.
        keypoints: of a detector; without any that was seen: it saw nobody. None: it has not
            answered, or there is none.
        prediction: pose hypotheses from an external predictor, if any.
        mask: (H, W) of a segmenter; None: unknown.
        predicted: whether a predictor expects somebody by this image; None: it has not answered, or
            there is none.
        others: (H, W) pixels that somebody else covers; None: none.
        depth: (H, W) depth along the axis of the camera, m; None: unknown.
        silhouette: (H, W) foreground near the person, all false where there is none; None: there is
            no background.
        anywhere: (h, w) all of the foreground of the image, on a coarser raster; None: there is no
            background.
        changed: share of the pixels that differ from the background.
        unsure: (H, W) pixels of the person or of a shadow; None: none.
    """

    image: Image
    stamp: int = 0
    keypoints: Keypoints | None = None
    prediction: PosePrediction | None = None
    mask: Mask | None = None
    predicted: bool | None = None
    others: Mask | None = None
    depth: NDArray[np.floating] | None = None
    silhouette: Mask | None = None
    anywhere: Mask | None = None
    changed: float = 0.0
    unsure: Mask | None = None
