"""Table of all keypoint detectors, with the names by which users select them."""

from __future__ import annotations

from hmt_ros.detectors.blazepose import MEDIAPIPE
from hmt_ros.detectors.detector import DetectorKind
from hmt_ros.detectors.movenet import WITH_MOVENET

# A new detector needs a file in this folder and a line here.
DETECTORS: dict[str, DetectorKind] = {
    'mediapipe': MEDIAPIPE,
    'mediapipe+movenet': WITH_MOVENET,
}
# Default detector.
USUAL_DETECTOR = 'mediapipe'
# Names of detectors for processing without a time limit, most accurate first.
_BY_ACCURACY = ('mediapipe+movenet', USUAL_DETECTOR)


def surest_detector() -> str | None:
    """Name of the most accurate installed detector; None if none is installed."""
    return next((name for name in _BY_ACCURACY if DETECTORS[name].is_installed()), None)
