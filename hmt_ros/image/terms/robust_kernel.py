"""The robust kernel that image residuals pass through."""

from __future__ import annotations

from numba import njit


@njit(cache=True, nogil=True, inline='always')
def geman_mcclure(residual, scale, weight):  # type: ignore[no-untyped-def]
    """Geman-McClure kernel: value, derivative and Gauss-Newton curvature.

        rho(r) = 1/2 w r^2 / (1 + r^2 / c^2)

    Quadratic near zero, at most w c^2 / 2. The curvature is the weight rho'(r) / r of iteratively
    reweighted least squares, which is positive everywhere.

    Args:
        residual: r, in standard deviations.
        scale: c, in standard deviations.
        weight: w, factor on the energy.
    """
    square = residual * residual
    shrink = 1.0 / (1.0 + square / (scale * scale))
    curvature = weight * shrink * shrink
    return 0.5 * weight * square * shrink, curvature * residual, curvature
