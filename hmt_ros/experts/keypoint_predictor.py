"""Poses from the keypoints of one image after the other: lifted joints, then poses of the body."""

from __future__ import annotations

import math

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.experts.lifted_fit import KNOWN_SIZE, UNKNOWN_SIZE, poses_of
from hmt_ros.experts.lifter import KeypointHistory, Lifter
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.mixture import GaussianMixture


class KeypointPredictor:
    """Predicts mixtures over the poses of one person, as images come; see `lift_poses`.

    Args:
        lifter: see `load_lifter`.
        body: of the person, with the lengths as far as they are known.
        camera: that sees the keypoints.
        size_known: whether the body is as large as the person.

    Attributes:
        newest: time of the newest image, s.
    """

    def __init__(
        self, lifter: Lifter, body: Body, camera: Camera, *, size_known: bool = False
    ) -> None:
        self._lifter, self._body = lifter, body
        self._spread = KNOWN_SIZE if size_known else UNKNOWN_SIZE
        self._history = KeypointHistory(camera)
        self._shown: tuple[Array, Array] | None = None
        self.newest = -math.inf

    def add(self, keypoints: Keypoints, stamp: float) -> None:
        """Takes the keypoints of the next image, of a time in s that is later than those before."""
        self._shown, self.newest = self._history.add(keypoints, stamp), stamp

    def predict(self, up: Array | None = None) -> GaussianMixture | None:
        """The mixture at the newest image, heaviest first; None: nobody is seen.

        Args:
            up: (3,) unit vector against gravity, camera frame; None: unknown.
        """
        lifted = None if self._shown is None else self._history.lift(self._lifter, up)
        if lifted is None or self._shown is None:
            return None
        rays, confidences = self._shown
        (found,) = poses_of(self._body, [lifted], rays[None], confidences[None], self._spread)
        return found
