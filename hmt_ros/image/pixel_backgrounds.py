"""Per-pixel models of the empty scene: the interface, and OpenCV's two models.

A new model needs a file in this folder with a class that has the interface, and a line in
`background.BACKGROUNDS`.
"""

from __future__ import annotations

from typing import Protocol

import cv2
import numpy as np

from hmt_ros.inference.arrays import Image

# Label of a pixel that differs from the background, and of a darker pixel of the same colour. All
# other pixels have the label 0.
FOREGROUND_LABEL, SHADOW_LABEL = 255, 127


class Background(Protocol):
    """A model of the empty scene that labels the pixels of an image.

    The constructors in `BACKGROUNDS` get `threshold` and `shadow_threshold` of
    `BackgroundSettings`. A model is deterministic: the same images give the same labels.

    Attributes:
        repeats: number of times that an image must be learned if it is the only one.
        empty: (h, w, 3) current estimate of the empty scene.
    """

    repeats: int

    @property
    def empty(self) -> Image:
        """See the attributes of the class."""
        ...

    def learn(self, image: Image, share: float) -> None:
        """Adds an image (h, w, 3) of the scene to the model.

        Args:
            share: weight of the image relative to all images so far, above 0; 1 for the first
                image.
        """
        ...

    def labels(self, image: Image) -> Image:
        """Labels (h, w) of an image: `FOREGROUND_LABEL`, `SHADOW_LABEL` or 0."""
        ...


class OpenCvBackground:
    """A background model of OpenCV; see `Background`.

    Args:
        model: a new model of OpenCV.
        frozen: learning rate at which the model does not change.
        repeats: see `Background`.
        shadow_threshold: as in `BackgroundSettings`.
    """

    def __init__(
        self,
        model: cv2.BackgroundSubtractorMOG2 | cv2.BackgroundSubtractorKNN,
        frozen: float,
        repeats: int,
        shadow_threshold: float,
    ) -> None:
        self.repeats = repeats
        self._model, self._frozen = model, frozen
        model.setDetectShadows(True)
        model.setShadowThreshold(shadow_threshold)

    @property
    def empty(self) -> Image:
        """See `Background`."""
        return np.asarray(self._model.getBackgroundImage(), dtype=np.uint8)

    def learn(self, image: Image, share: float) -> None:
        """See `Background.learn`."""
        self._model.apply(image, learningRate=share)

    def labels(self, image: Image) -> Image:
        """See `Background.labels`."""
        return np.asarray(self._model.apply(image, learningRate=self._frozen), dtype=np.uint8)


def mixture_background(threshold: float, shadow_threshold: float) -> Background:
    """Background model with a mixture of Gaussians for each pixel (MOG2)."""
    model = cv2.createBackgroundSubtractorMOG2(varThreshold=threshold)
    return OpenCvBackground(model, 0.0, 1, shadow_threshold)


def neighbour_background(threshold: float, shadow_threshold: float) -> Background:
    """Background model with the nearest neighbours among samples of each pixel (KNN)."""
    model = cv2.createBackgroundSubtractorKNN(dist2Threshold=20.0 * threshold)
    # At a learning rate of 0 the model would replace its samples immediately.
    return OpenCvBackground(model, 1e-7, 20, shadow_threshold)
