"""Widths of the flesh from the first images of a track (KJS 2: shape estimated at initialisation).

    P_g <- P_g + max(d2E/du_g^2, 0),    u_g <- u_g - (dE/du_g + u_g / (s^2 n)) / P_g

u_g is the log width of a group of parts, left and right alike, E the energy of the image terms at
the present modes, weighted, n the number of images so far, and s the spread of widths over people.
A wrong width pushes poses: a model that is too thin hugs one side of a limb, one that is too thick
turns it away. Every image adds its curvature, so that later images move the widths less.
"""

from __future__ import annotations

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.body.kinematics import forward
from hmt_ros.image.likelihood import ImageLikelihood
from hmt_ros.image.observation import Observation
from hmt_ros.inference.arrays import Array

# Standard deviation of the logarithm of a width over people and clothes.
SPREAD = 0.25
# Step of the differences, and the largest change an image makes, in the logarithm.
STEP, LARGEST = 0.06, 0.1


class FleshFit:
    """Estimates the widths of a body's parts from images.

    Args:
        body: whose flesh is fitted.

    Attributes:
        images: how many have been used.
    """

    def __init__(self, body: Body) -> None:
        names = [body.skeleton.segment_names[p.segment] for p in body.flesh.parts]
        groups = [n.removeprefix('left_').removeprefix('right_') for n in names]
        self._names = sorted(set(groups))
        self._group = np.array([self._names.index(g) for g in groups], dtype=np.intp)
        self._first = np.array(body.widths)
        self._log_widths = np.zeros(len(self._names))
        self._precision = np.full(len(self._names), SPREAD**-2.0)
        self.images = 0

    @property
    def widths(self) -> dict[str, float]:
        """Factors on the model's widths by part."""
        return dict(zip(self._names, map(float, np.exp(self._log_widths)), strict=True))

    def update(
        self, likelihood: ImageLikelihood, observation: Observation, poses: Array, weights: Array
    ) -> Body:
        """Uses one more image; returns the body with the new widths.

        Args:
            likelihood: of the body with the present widths.
            observation: of the image; its keypoints say nothing of widths.
            poses, weights: (K, d), (K,) modes at the image.
        """
        frames = forward(likelihood.body.skeleton, poses)

        def energy(change: Array) -> float:
            scaled = likelihood.with_scaled_widths(np.exp(change[self._group]))
            terms = scaled.energies(frames, observation, derivatives=False)
            return float(weights @ terms.value)

        here = energy(np.zeros(len(self._names)))
        gradient, curvature = np.zeros(len(self._names)), np.zeros(len(self._names))
        for g in range(len(self._names)):
            step = np.zeros(len(self._names))
            step[g] = STEP
            more, less = energy(step), energy(-step)
            gradient[g] = (more - less) / (2 * STEP)
            curvature[g] = max((more - 2 * here + less) / STEP**2, 0.0)
        self._precision += curvature
        pull = gradient + self._log_widths * SPREAD**-2.0 / (1 + self.images)
        move = np.clip(-pull / self._precision, -LARGEST, LARGEST)
        self._log_widths = np.clip(self._log_widths + move, -0.7, 0.7)
        self.images += 1
        return likelihood.body.with_widths(
            tuple(self._first * np.exp(self._log_widths[self._group]))
        )
