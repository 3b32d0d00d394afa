"""How far an image is believed: one trust for weights and covariances, learned from the track.

    beta  = trust * s0 / sqrt(s0^2 + v)            what is new in an image
    share = beta (1 - rho) / (1 + rho)             what an image adds to those before

Neighbouring measurements of an image err together: energies count by `trust` < 1. The least energy
also changes from image to image by what the search misses and the model lacks; v is the variance of
these changes in the track so far, and where it is large, differences between modes say less. Errors
last from image to image with correlation rho: of an energy only E_t - rho E_(t-1) is new, and n
images hold the information of n (1 - rho) / (1 + rho) independent ones [Bartlett 1946].
"""

from __future__ import annotations

import numpy as np

# Standard deviation of the changes of the least energy that leaves the trust nearly as it is, nats.
USUAL_CHANGE = 3.0
# How far the variance of the changes follows the newest.
GAIN = 0.1
# Changes count up to so many standard deviations.
LARGEST = 4.0


class Trust:
    """Trust of one track.

    Args:
        trust: in what is new in an image, at most.
        correlation: rho of the errors of two images in a row.
    """

    def __init__(self, trust: float, correlation: float) -> None:
        self._trust, self.correlation = trust, correlation
        self._variance, self._last = USUAL_CHANGE**2, np.inf

    @property
    def inverse_temperature(self) -> float:
        """Factor beta on what is new in the energy of an image."""
        return self._trust * USUAL_CHANGE / float(np.sqrt(USUAL_CHANGE**2 + self._variance))

    @property
    def lasting(self) -> float:
        """Factor on a difference of energies that lasts."""
        return self.inverse_temperature * (1.0 - self.correlation)

    @property
    def information(self) -> float:
        """Share of the curvature of an image's energy in the covariance of a mode."""
        rho = self.correlation
        return self.inverse_temperature * (1.0 - rho) / (1.0 + rho)

    def update(self, least_energy: float) -> None:
        """Takes in the least energy of an image, nats."""
        if np.isfinite(self._last):
            square = min((least_energy - self._last) ** 2, LARGEST**2 * self._variance)
            self._variance += GAIN * (square - self._variance)
        self._last = least_energy
