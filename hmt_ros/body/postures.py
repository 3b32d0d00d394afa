"""Postures of limbs that no image shows: standing, striding, sitting, kneeling.

    p(x) = sum_c q_c prod_i N(x_i; m_ci, s_ci^2)                    angles i of the limbs
    y_i ~ N(x_i, S_ii + b_i t_i)                                    angles i according to a mode

The modes (y, S) of a tracker locate the limbs that an image shows. Their information about a hidden
limb decays, because its angles diffuse at the rates b of the body for the time t since it was last
seen. There is no information about a limb that was never seen. Postures are narrow, so within a
posture a linear map from angles to joints is accurate enough.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.body.mirror import mirror_order
from hmt_ros.body.model_file import usual_postures
from hmt_ros.core import elementary
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.linear_algebra import log_sum_exp, product, pseudo_inverse
from hmt_ros.inference.mixture import GaussianMixture

# Share of the mode's own prediction for a limb hidden for a long time, and time constant of the
# decay from 1 to this share, s. Chosen on clips.
PREDICTION_SHARE, FORGETTING_TIME = 0.5, 1.0
# Minimum weight of a component (a mode with a posture) that is kept.
MIN_WEIGHT = 0.006
# Joints that stay fixed while the pelvis turns.
FIXED_JOINTS = ('neck', 'left_shoulder', 'right_shoulder')


@dataclass(frozen=True, eq=False)
class Postures:
    """P postures of a body.

    Attributes:
        body: body of the angles.
        shares: (P,) prior probabilities of the postures.
        means, sigmas: (P, d) means and standard deviations of the degrees of freedom.
    """

    body: Body
    shares: Array
    means: Array
    sigmas: Array

    def spread(self, modes: GaussianMixture, unseen: Array) -> tuple[GaussianMixture, Index, Index]:
        """Spread the unseen angles of modes over postures.

        Args:
            modes: K modes over poses (d,).
            unseen: (d,) time since an image last showed each angle, s; 0: the current image; inf:
                never.

        Returns:
            A mixture of N components, heaviest first: every mode itself, and every mode with each
            likely posture. Index (N,) of the mode of each component. Number (N,) of the posture of
            each component, 0 for the mode's own prediction.
        """
        spine = np.isin(self.body.skeleton.dof_segments, self.body.skeleton.spine)
        hidden, variances = np.flatnonzero((unseen > 0.0) & ~spine), self.sigmas**2
        noise = np.einsum('kii->ki', modes.covariances) + self.body.rates * unseen
        differs = np.ptp(self.means, axis=0) > 0.0
        told = differs & np.isfinite(unseen)
        total = noise[:, None, told] + variances[:, told]
        offsets = modes.means[:, None, told] - self.means[:, told]
        log_shares = elementary.log(self.shares) - 0.5 * (
            offsets**2 / total + elementary.log(total)
        ).sum(2)
        if not differs[hidden].any():
            log_shares[:, 1:] = -np.inf
        shares = elementary.exp(log_shares - log_sum_exp(log_shares, axis=1)[:, None])
        other = (1.0 - PREDICTION_SHARE) * -elementary.expm1(-unseen.max() / FORGETTING_TIME)
        shares = np.insert(other * shares, 0, 1.0 - other, axis=1)
        weights = modes.normalised().weights[:, None]
        shares[(weights * shares < MIN_WEIGHT) & (np.arange(shares.shape[1]) > 0)] = 0.0
        weights = weights * shares / shares.sum(1)[:, None]
        rows, postures = np.nonzero(weights)
        order = np.argsort(-weights[rows, postures], kind='stable')
        rows, postures = rows[order], postures[order]
        means, covariances = modes.means[rows], modes.covariances[rows]
        others = np.flatnonzero(postures)
        place, at = np.ix_(others, hidden), postures[others] - 1
        middle, own = self.means[at][:, hidden], variances[at][:, hidden]
        left = own / (own + noise[rows[others]][:, hidden])
        moved = middle + left * (means[place] - middle)
        means[place] = np.clip(moved, self.body.lower[hidden], self.body.upper[hidden])
        covariances[place] = covariances.swapaxes(1, 2)[place] = 0.0
        covariances[others[:, None], hidden, hidden] = own * (1.0 - left)
        covariances += self._swaying(means, np.where(spine, unseen, 0.0))
        return GaussianMixture(weights[rows, postures], means, covariances), rows, postures

    def _swaying(self, poses: Array, unseen: Array) -> Array:
        """Return covariances (N, d, d) of a pelvis that turns below a fixed trunk.

        The angles between pelvis and trunk have the variances of the soft prior, or smaller
        variances if they were seen recently.

        Args:
            poses: (N, d).
            unseen: (d,) time since an image last showed each of these angles, s; 0 for all other
                variables.
        """
        skeleton = self.body.skeleton
        own = np.flatnonzero(unseen > 0.0)
        root = list(skeleton.segment_dofs[0])
        top = skeleton.joint_index([x for x in skeleton.trunk_joints if x in FIXED_JOINTS])
        slopes = self.body.joint_jacobians(poses)[:, top].reshape(len(poses), -1, len(unseen))
        moves = np.zeros((len(poses), len(unseen), len(own)))
        moves[:, own, np.arange(len(own))] = 1.0
        moves[:, root] = product(-pseudo_inverse(slopes[..., root]), slopes[..., own])
        drift = np.minimum(self.body.prior_sigma**2, self.body.rates * unseen)[own]
        return np.asarray(product(moves * drift, moves.swapaxes(1, 2)))


def postures_of(body: Body) -> Postures:
    """Return the postures of a body; angles missing in the table follow their soft prior."""
    names, rows = list(body.dof_names), []
    order, signs = mirror_order(body.skeleton)
    for entry in usual_postures().values():
        mean, sigma = body.prior_mean.copy(), body.prior_sigma.copy()
        for name, numbers in entry['angles'].items():
            if name in names:
                mean[names.index(name)], sigma[names.index(name)] = np.radians(numbers)
        rows += [(mean, sigma, entry['share'])]
        if entry['mirrored']:
            rows += [(mean[order] * signs, sigma[order], entry['share'])]
    means, sigmas, shares = map(np.array, zip(*rows, strict=True))
    return Postures(body, shares / shares.sum(), means, sigmas)
