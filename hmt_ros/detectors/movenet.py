"""Mean of MoveNet Thunder and BlazePose: two detectors of the same person in each image.

BlazePose finds the person. MoveNet then estimates shoulders, elbows, wrists, hips, knees and ankles
again, from the square around BlazePose's landmarks, clipped to the image. The errors (BlazePose: 10
px, MoveNet: 8 px) vary over a clip and have a correlation of 0.4, so the best mean gives MoveNet
twice the weight of BlazePose. If the two differ by a vector d, px, the covariance of the mean is
s^2 1 + d d' / 4, where s is the standard deviation that belongs to BlazePose's confidence. All
other output is from BlazePose.

MoveNet has four heads of 64 x 64 cells: probabilities of the centre of a person, probabilities of
the landmarks, vectors from a centre to the landmarks, and offsets of the landmarks from their
cells. The centre is the most probable cell; cells near the border have lower weights. The centre
predicts the places of the landmarks; each landmark is in the cell with the largest ratio of its
probability to the distance from the predicted place.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from hmt_ros.detectors import blazepose_models, movenet_models
from hmt_ros.detectors.blazepose import BlazePose
from hmt_ros.detectors.detector import DetectorKind
from hmt_ros.detectors.movenet_graph import CELLS, HEADS, SIZE, translated
from hmt_ros.detectors.square import Square, sigmoid
from hmt_ros.image.keypoint_schemes import noise_of, schemes
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference.arrays import Array, Image, Mask

SCHEME = 'coco17'
# Offset added to the distance between a cell and a landmark's predicted place, cells.
_DISTANCE_OFFSET = 1.8
# MoveNet's weight in the mean, and minimum score of a landmark to be used.
_MEAN_WEIGHT, _MIN_SCORE = 2 / 3, 0.3
# Index of MoveNet's first landmark outside the face.
_FIRST_BODY_LANDMARK = 5


class MoveNet:
    """The network of MoveNet Thunder.

    Raises:
        DetectorError: the network is not installed.
    """

    def __init__(self) -> None:
        onnx, self._centres = translated(*movenet_models.require_network())
        self._network = cv2.dnn.readNetFromONNX(np.frombuffer(onnx, np.uint8))

    def landmarks(self, seen: Image) -> Array:
        """Landmarks (17, 3) in an image (256, 256, 3) RGB: column and row as fractions, score."""
        scaled = seen.astype(np.float32) * np.float32(2 / 255) - np.float32(1)
        self._network.setInput(np.ascontiguousarray(scaled.transpose(2, 0, 1)[None]))
        heat, centre, ways, offsets = (x[0] for x in self._network.forward(HEADS))
        return chosen(sigmoid(heat), sigmoid(centre[0]) * self._centres, ways, offsets)


def chosen(
    heat: NDArray[np.float32],
    centre: NDArray[np.float32],
    ways: NDArray[np.float32],
    offsets: NDArray[np.float32],
) -> Array:
    """Landmarks (n, 3) of the likeliest person: column and row as fractions of the image, score.

    Args:
        heat: (n, 64, 64) probabilities of landmarks.
        centre: (64, 64) weighted probability that a person's centre is in each cell.
        ways: (2 n, 64, 64) vectors (row, column) from a centre to the landmarks, cells.
        offsets: (2 n, 64, 64) vectors (row, column) from a cell to its landmark, cells.
    """
    at = np.divmod(int(centre.argmax()), CELLS)
    expected = ways[:, at[0], at[1]].reshape(-1, 2).astype(np.float64) + at
    cells = np.arange(CELLS)
    down, along = (cells - expected[..., None]).swapaxes(0, 1)
    distances = np.sqrt(down[:, :, None] ** 2 + along[:, None] ** 2)
    likely = (heat / (distances + _DISTANCE_OFFSET)).reshape(len(heat), -1)
    rows, columns = np.divmod(likely.argmax(axis=1), CELLS)
    each = np.arange(len(heat))
    moved = offsets.reshape(-1, 2, CELLS, CELLS)[each, :, rows, columns]
    places = (np.stack([columns, rows], axis=1) + moved[:, ::-1]) / CELLS
    return np.column_stack([places, heat[each, rows, columns]])


class BlazePoseAndMoveNet:
    """BlazePose averaged with MoveNet; see `BlazePose` for arguments, attributes and errors."""

    def __init__(self, *, with_mask: bool = False) -> None:
        self.mask: Mask | None = None
        self._first = BlazePose(with_mask=with_mask)
        self._second = MoveNet()

    def detect(self, image: Image, stamp_ns: int) -> Keypoints | None:
        """See `BlazePose.detect`."""
        found = self._first.detect(image, stamp_ns)
        self.mask = self._first.mask
        if found is None:
            return None
        last = np.array(image.shape[1::-1]) - 1
        square = Square.around(found.pixels.clip(0, last))
        if square.side < 1.0:
            return found
        told = self._second.landmarks(square.seen(image, SIZE, cv2.BORDER_REPLICATE))
        # The network's origin is the edge of the first pixel of the square.
        pixels = square.corner + square.side * (told[:, :2] - 0.5 / SIZE)
        rows = np.array(
            [found.names.index(name) for name in schemes()[SCHEME].names[_FIRST_BODY_LANDMARK:]]
        )
        own = found.pixels[rows]
        inside = (own >= -0.5).all(axis=1) & (own <= last + 0.5).all(axis=1)
        counted = inside & (told[_FIRST_BODY_LANDMARK:, 2] >= _MIN_SCORE)
        return together(found, rows[counted], pixels[_FIRST_BODY_LANDMARK:][counted])


def together(found: Keypoints, rows: NDArray[np.intp], pixels: Array) -> Keypoints:
    """Averages some keypoints of one detector with the keypoints of a second detector.

    Args:
        found: keypoints of the first detector.
        rows: (m,) indices of the keypoints that the second detector found as well.
        pixels: (m, 2) pixels of these keypoints from the second detector.
    """
    apart = pixels - found.pixels[rows]
    places, covariances = found.pixels.copy(), found.covariances.copy()
    places[rows] += _MEAN_WEIGHT * apart
    sigma = found.magnification() * noise_of(found.confidences[rows])
    spread = apart[:, :, None] * apart[:, None] / 4
    covariances[rows] = sigma[:, None, None] ** 2 * np.eye(2) + spread
    return replace(found, pixels=places, covariances=covariances)


def _is_installed() -> bool:
    return blazepose_models.is_installed() and movenet_models.FILES.exist()


def _install() -> None:
    blazepose_models.install()
    movenet_models.install()


WITH_MOVENET = DetectorKind(
    'MediaPipe Pose with MoveNet Thunder', BlazePoseAndMoveNet, _is_installed, _install
)
