"""Widths of the flesh from the first images of a track (KJS 2: shape estimated at initialisation).

How thick limbs and clothes are is unknown at the start, and a wrong width pushes poses: a model
that is too thin hugs one side of a limb, one that is too thick turns it away. The widths of the
parts, left and right alike, are moved by damped Newton steps on the energy of the silhouette and
the edges at the present modes; every image adds its curvature, so that later ones move them less
and less.
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
