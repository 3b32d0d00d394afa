"""How much measurements say whose errors last: neighbours in time repeat each other.

    a(dt) = (1 - rho) / (1 + rho) = tanh(dt / (2 tau)),     rho = exp(-dt / tau)

An error that lasts for tau is an AR(1) process: between two measurements dt apart its correlation
is rho. n measurements in a row tell as much of a constant as a(dt) n independent ones (n large), so
that each counts with the share a(dt). For small dt the share is dt / (2 tau): what is told in a
second does not depend on the rate of the measurements. For large dt it is 1.
"""

from __future__ import annotations

import math


def share_of_time(dt: float, tau: float) -> float:
    """The share a(dt) of an independent measurement that a measurement counts for.

    Args:
        dt: time since the measurement before, s; infinite: there is none before.
        tau: how long the errors last, s; 0: they are independent.

    Raises:
        ValueError: a time that is negative or not a number.
    """
    if not (dt >= 0.0 and tau >= 0.0):
        raise ValueError(f'wanted times that are not negative, saw dt {dt} and tau {tau} s')
    return 1.0 if tau == 0.0 else math.tanh(0.5 * dt / tau)
