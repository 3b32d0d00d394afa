"""Interface of keypoint detectors, and of their construction and installation.

A new detector needs a file in this folder with a `DetectorKind`, and a line in
`registry.DETECTORS`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference.arrays import Image, Mask


class DetectorError(ValueError):
    """The detector is not installed; the message is one line with the command to run."""


class Detector(Protocol):
    """Finds the keypoints of one person in successive images.

    The only state of a detector is the tracking of the person through a sequence of images. It is
    deterministic: the same images with the same stamps give the same output. It draws no random
    numbers and reads no clock.

    Attributes:
        mask: (H, W) pixels of the person in the last image; None if no mask was requested or the
            detector makes none.
    """

    mask: Mask | None

    def detect(self, image: Image, stamp_ns: int) -> Keypoints | None:
        """The keypoints of the person in an image.

        An image starts a new sequence if it is not newer than the previous image, or differs in
        size.

        Args:
            image: (H, W, 3) BGR, with square pixels.
            stamp_ns: stamp of the image.

        Returns:
            Landmarks named as in a scheme of `keypoint_schemes.yaml`; pixels, where (0, 0) is the
            centre of the first pixel; covariances in px^2, NaN where unknown; confidences from 0 to
            1; 3D `positions` in m along the axes of the camera, if estimated. None if nobody was
            seen.
        """
        ...


@dataclass(frozen=True)
class DetectorKind:
    """A kind of detector, which users select by name in `registry.DETECTORS`.

    Attributes:
        title: name of the detector, for users.
        make: `make(with_mask=...)` makes a new detector; `with_mask`: whether to compute `mask`.
            Raises DetectorError if the detector is not installed.
        is_installed: whether the detector can run here.
        install: installs missing files; raises ValueError with a one-line message if this fails.
    """

    title: str
    make: Callable[..., Detector]
    is_installed: Callable[[], bool]
    install: Callable[[], None]
