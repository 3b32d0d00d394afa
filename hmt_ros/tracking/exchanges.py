"""What a detector takes for what: exchange of left and right, in each mode from image to image.

    p(e_t | m) = sum_e' p(e_t | e') p(e' | ancestor of m),     p(e_t | e') = [exp(Q dt)]_e'e
    p(e_t | m, keypoints) ~ p(e_t | m) exp(-E_e(x_m))

Q are the rates at which detectors begin and cease to exchange sides (`image.keypoint_schemes`). A
person who is turned about and whose sides are exchanged looks the same to the keypoints as one who
is not: what tells the two apart is that people turn slowly and detectors change their mind at once.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import expm

from hmt_ros.body.kinematics import forward
from hmt_ros.image.keypoint_schemes import exchange_rates, usual_exchanges
from hmt_ros.image.likelihood import ImageLikelihood
from hmt_ros.image.observation import Observation
from hmt_ros.inference.arrays import Array, Index, Mask

# Least probability of an exchange.
LEAST = 1e-6


class SideExchanges:
    """Probabilities of the exchanges, of each mode of a track.

    Attributes:
        prior: (K, E) log probabilities in the next image, by mode of the last one; None: usual.
    """

    def __init__(self) -> None:
        self.prior: Array | None = None
        self._posterior: Array | None = None

    def predict(self, dt: float) -> None:
        """Goes on by dt seconds."""
        if self._posterior is None:
            self.prior = None
            return
        moved = np.exp(self._posterior) @ expm(exchange_rates() * dt)
        self.prior = np.log(np.maximum(moved, LEAST))

    def of(self, ancestors: Index, anew: Mask) -> Array:
        """Log probabilities (N, E) before the image, of hypotheses with ancestors (N,).

        Args:
            ancestors: modes of the image before.
            anew: (N,) hypotheses that say that the track was wrong: what it took the detector for
                was wrong as well.
        """
        usual = np.repeat(usual_exchanges(), len(ancestors), axis=0)
        if self.prior is None:
            return usual
        return np.where(anew[:, None], usual, self.prior[ancestors])

    def update(
        self, likelihood: ImageLikelihood, observation: Observation, poses: Array, prior: Array
    ) -> None:
        """Takes in an image.

        Args:
            likelihood: of the body.
            observation: of the image.
            poses: (K, d) modes.
            prior: (K, E) of the modes, log probabilities before the image.
        """
        seen = observation.keypoints is not None and likelihood.settings.keypoints.weight > 0
        if seen or self._posterior is not None:
            self._posterior = prior
        if seen:
            term = likelihood.keypoint_term(observation, prior)
            frames = forward(likelihood.body.skeleton, poses)
            self._posterior = term.exchanged(frames, np.arange(len(poses)))

    def forget(self) -> None:
        """Knows nothing, as at the start."""
        self.prior = self._posterior = None

    @property
    def probabilities(self) -> Array | None:
        """(K, E) of the modes after the last image; None: nothing is known."""
        return None if self._posterior is None else np.exp(self._posterior)
