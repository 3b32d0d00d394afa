"""What else refines one trajectory: scipy's sparse least squares, and GTSAM.

All are given the same problem, which each can express: a random walk, and at every time a Gaussian
with full covariance under a Geman-McClure kernel, some of them outliers,

    E(X) = 1/2 sum_t |Q^-1/2 (x_{t+1} - x_t)|^2 + 1/2 sum_t s_t / (1 + s_t / c^2),
    s_t = (x_t - m_t)' S_t^-1 (x_t - m_t)
"""

from __future__ import annotations

import importlib.util
import time
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.optimize import least_squares

from hmt_ros.inference.energy import Derivatives, Energy

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class RobustSequence:
    """The observations, as an object that the smoother's refinement takes.

    Attributes:
        means: (T, d).
        whiteners: (T, d, d) W with S^-1 = W' W.
        kernel: c.
    """

    means: Array
    whiteners: Array
    kernel: float

    @property
    def times(self) -> int:
        """T."""
        return len(self.means)

    def energy(
        self,
        x: Array,
        rows: NDArray[np.intp],
        *,
        derivatives: Derivatives = Derivatives.POSITIVE,
    ) -> Energy:
        """Value, gradient and Hessian at poses x (N, d) of times (N,)."""
        w = self.whiteners[rows]
        white = (w @ (x - self.means[rows])[:, :, None])[:, :, 0]
        s = (white * white).sum(1)
        soft = 1.0 / (1.0 + s / self.kernel**2)
        pull = (w.swapaxes(1, 2) @ white[:, :, None])[:, :, 0]
        hessian = soft[:, None, None] ** 2 * (w.swapaxes(1, 2) @ w)
        if derivatives == Derivatives.EXACT:
            factor = 4.0 * soft**3 / self.kernel**2
            hessian = hessian - factor[:, None, None] * pull[:, :, None] * pull[:, None, :]
        return Energy(0.5 * s * soft, soft[:, None] ** 2 * pull, hessian)


def scipy_trajectory(
    sequence: RobustSequence, variances: Array, start: Array
) -> tuple[float, float, int]:
    """Energy, seconds and evaluations of `least_squares` (trf, lsmr, sparse Jacobian)."""
    times, d = start.shape
    sigma = np.sqrt(variances)
    step = sp.kron(sp.eye(times - 1, times, k=1) - sp.eye(times - 1, times), sp.diags(1 / sigma))

    def parts(x: Array) -> tuple[Array, Array]:
        offset = x.reshape(times, d) - sequence.means
        white = np.einsum('tij,tj->ti', sequence.whiteners, offset)
        return white, 1.0 + (white * white).sum(1) / sequence.kernel**2

    def residuals(x: Array) -> Array:
        white, spread = parts(x)
        return np.concatenate([step @ x, (white / np.sqrt(spread)[:, None]).reshape(-1)])

    def jacobian(x: Array) -> sp.csr_matrix:
        white, spread = parts(x)
        pull = np.einsum('tij,ti->tj', sequence.whiteners, white)
        blocks = sequence.whiteners / np.sqrt(spread)[:, None, None]
        outer = white[:, :, None] * pull[:, None, :]
        blocks = blocks - outer / (sequence.kernel**2 * spread**1.5)[:, None, None]
        return sp.vstack([step, sp.block_diag(list(blocks))]).tocsr()

    begin = time.perf_counter()
    found = least_squares(
        residuals, start.reshape(-1), jacobian, method='trf', tr_solver='lsmr',
        ftol=1e-10, xtol=1e-10, gtol=1e-10, max_nfev=500,
    )  # fmt: skip
    return float(found.cost), time.perf_counter() - begin, int(found.nfev)


def gtsam_missing() -> str | None:
    """Why GTSAM can not be compared with, or None."""
    if importlib.util.find_spec('gtsam') is None:
        return 'gtsam is not installed (on Python 3.10 its wheels need numpy 1)'
    return None


def gtsam_trajectory(
    sequence: RobustSequence, variances: Array, start: Array
) -> tuple[float, float, int]:
    """Energy, seconds and iterations of GTSAM's Levenberg-Marquardt; building the graph is free."""
    import gtsam

    times, d = start.shape
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    walk = gtsam.noiseModel.Diagonal.Sigmas(np.sqrt(variances))
    kernel = gtsam.noiseModel.mEstimator.GemanMcClure.Create(sequence.kernel)
    for t in range(times):
        values.insert(t, start[t])
        whitener = sequence.whiteners[t]
        noise = gtsam.noiseModel.Gaussian.Information(whitener.T @ whitener)
        robust = gtsam.noiseModel.Robust.Create(kernel, noise)
        graph.add(gtsam.PriorFactorVector(t, sequence.means[t], robust))
        if t > 0:
            graph.add(gtsam.BetweenFactorVector(t - 1, t, np.zeros(d), walk))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(500)
    parameters.setRelativeErrorTol(1e-10)
    parameters.setAbsoluteErrorTol(1e-7)
    begin = time.perf_counter()
    optimiser = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
    result = optimiser.optimize()
    spent = time.perf_counter() - begin
    return float(graph.error(result)), spent, int(optimiser.iterations())
