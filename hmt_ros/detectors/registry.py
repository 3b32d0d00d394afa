"""All detectors of keypoints, by the names under which users choose them."""

from __future__ import annotations

from hmt_ros.detectors.blazepose import MEDIAPIPE
from hmt_ros.detectors.detector import DetectorKind
from hmt_ros.detectors.movenet import WITH_MOVENET

# A new detector is a file beside this one and a line here.
DETECTORS: dict[str, DetectorKind] = {
    'mediapipe': MEDIAPIPE,
    'mediapipe+movenet': WITH_MOVENET,
}
# The detector that is used unless another is named.
USUAL_DETECTOR = 'mediapipe'
# Detectors for uses without a time limit, the surest first.
_SUREST = ('mediapipe+movenet', USUAL_DETECTOR)


def surest_detector() -> str | None:
    """Name of the surest detector that is installed; None if none is installed."""
    return next((name for name in _SUREST if DETECTORS[name].is_installed()), None)
