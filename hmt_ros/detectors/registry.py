"""All detectors of keypoints, by the names under which users choose them."""

from __future__ import annotations

from hmt_ros.detectors.blazepose import MEDIAPIPE
from hmt_ros.detectors.detector import DetectorKind

# A new detector is a file beside this one and a line here.
DETECTORS: dict[str, DetectorKind] = {
    'mediapipe': MEDIAPIPE,
}
# The detector that is used unless another is named.
USUAL_DETECTOR = 'mediapipe'
