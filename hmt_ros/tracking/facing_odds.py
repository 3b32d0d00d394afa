"""Odds of the two ways to face, of one track from image to image.

    S_t = clip(S_(t-1) + gamma D_t, -most, most)       D_t = min E(facing back) - min E(facing on)
    most = LEAST + RANGE (1 - (l . r)^2)               l to the person's left, r the line of sight

Seen from the side a pose and its reversal in depth face the same way, so there a turn can be taken
the wrong way round, and what was known of the way counts little. Later every image tells the two
apart by a little, and errors of the images last: D is counted with the small factor gamma, and by
the best mode of either way, because single modes come and go. Who has turned about in the odds
takes over the track; nobody turns about by one image.
"""

from __future__ import annotations

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.body.mirror import faces_back, left_directions
from hmt_ros.inference.arrays import Array, Mask
from hmt_ros.tracking.camera_motion import CameraMotion

# Log odds up to which the way is known when the person is seen from the side, and how much better
# from the front or from behind.
LEAST, RANGE = 1.0, 9.0
# Odds of a way that has just come up.
NEW = 3.0


class FacingOdds:
    """Log odds that the person faces as the track says, and not the other way.

    Attributes:
        log_odds: S.
    """

    def __init__(self) -> None:
        self.log_odds = NEW
        self._lead: Array | None = None
        self._left = np.zeros(3)

    def carry(self, body: Body, motion: CameraMotion) -> None:
        """Takes the pose that leads into the camera frame of the next image."""
        if self._lead is not None:
            self._lead = motion.poses(body, self._lead[None])[0]
            self._left = motion.directions(self._left)

    def back(self, body: Body, poses: Array) -> Mask:
        """Which of poses (N, d) face the other way than the track did in the last image."""
        if self._lead is None:
            return np.zeros(len(poses), dtype=np.bool_)
        return faces_back(body, poses, self._lead)

    def update(self, back: Mask, energies: Array, known: Mask, pose: Array, gamma: float) -> None:
        """Takes in the hypotheses of an image.

        Args:
            back: (N,) which face the other way.
            energies: (N,) nats.
            known: (N,) which were followed from the image before.
            pose: (3,) line of sight to the person.
            gamma: factor on differences of energies.
        """
        if self._lead is None:
            return
        ray = pose / np.linalg.norm(pose)
        most = LEAST + RANGE * (1.0 - float(self._left @ ray) ** 2)
        change = 0.0
        if (back & known).any() and (~back & known).any():
            change = gamma * float(energies[back & known].min() - energies[~back & known].min())
        self.log_odds = float(np.clip(self.log_odds + change, -most, most))

    def weigh(
        self,
        body: Body,
        poses: Array,
        energies: Array,
        log_weights: Array,
        known: Mask,
        gamma: float,
    ) -> Array:
        """Takes in the hypotheses of an image; returns their log weights (N,) with the odds.

        Args:
            body: of the poses.
            poses: (N, d).
            energies: (N,) nats.
            log_weights: (N,) without the odds.
            known: (N,) which were followed from the image before.
            gamma: factor on differences of energies.
        """
        back = self.back(body, poses)
        self.update(back, energies, known, poses[0, :3], gamma)
        log_weights = self.shared(back, log_weights)
        self.follow(body, poses, log_weights, back)
        return log_weights

    def shared(self, back: Mask, log_weights: Array) -> Array:
        """Log weights (N,) with the odds of the two ways; within each they keep their ratios."""
        if back.all() or not back.any():
            return log_weights
        result = log_weights.copy()
        for which, sign in ((~back, 1.0), (back, -1.0)):
            share = -np.logaddexp(0.0, -sign * self.log_odds)
            result[which] += share - np.logaddexp.reduce(log_weights[which])
        return result

    def follow(self, body: Body, poses: Array, log_weights: Array, back: Mask) -> None:
        """The heaviest of poses (N, d) of the likelier way says how the track faces from now on."""
        turned = bool(back.any()) and (self.log_odds < 0 or bool(back.all()))
        lead = int(np.argmax(np.where(back == turned, log_weights, -np.inf)))
        if turned:
            self.log_odds = abs(self.log_odds)
        self._lead = poses[lead]
        self._left = left_directions(body, poses[lead][None])[0]
