"""bme_node with an estimate that costs nothing, so that only the cost of ROS remains.

    python -m benchmarks.prompt_node --ros-args --params-file FILE

Everything else is as in the real node: subscription, queue, estimating thread, decoding of the
image, and a mixture message of the usual size.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np

from hmt_ros.body import Camera
from hmt_ros.inference import GaussianMixture
from hmt_ros.nodes.bme_node import BmeNode
from hmt_ros.nodes.run_node import run
from hmt_ros.sessions.bme_session import BmeSession
from hmt_ros.sessions.camera_session import WaitingImage


class PromptSession(BmeSession):
    """A session with the same answer for every image."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        body, count = self._predictor.body, self.parameters.max_hypotheses
        means = np.tile(body.prior_mean, (count, 1))
        means[:, 2] = 4.0
        covariances = np.tile(1e-2 * np.eye(body.dimension), (count, 1, 1))
        self._said = GaussianMixture(np.full(count, 1.0 / count), means, covariances)

    def _mixture_of(self, waiting: WaitingImage, camera: Camera) -> GaussianMixture:
        return self._said


class PromptNode(BmeNode):
    """The node with this session."""

    SESSION = PromptSession


if __name__ == '__main__':
    sys.exit(run(PromptNode))
