"""Poses of a body fitted to lifted joints: each mixture component becomes a Gaussian.

    E(x) = 1/2 sum_ja ((a' (J_j(x) - t) - m_ja) / s_ja)^2 + 1/2 sum_l |A_l P_l(x)|^2 / n_l^2
           + E_prior(x)

J_j is joint j of the pose x, a the axes of the camera that points at the person, t the middle of
the hips; P_l is landmark l, A_l the projection perpendicular to the ray of its keypoint, n_l the
noise of the keypoint. A closed form gives the initial pose (`body.limb_angles`), and linear least
squares shift the pose so that the landmarks lie near their rays. Newton's method within the limits
finds the minimum; the inverse Hessian is the covariance. The distance of the person is hardly
observable, so the spread of people's size is added along the line of sight.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera, roll
from hmt_ros.body.kinematics import forward, point_energy
from hmt_ros.body.limb_angles import limb_angles
from hmt_ros.body.mirror import relevelled
from hmt_ros.body.pose_prior import LEARNED, pose_prior, prior_energies
from hmt_ros.core import elementary
from hmt_ros.experts.lifter import KeypointHistory, Lifter, landmark_offsets, landmark_rays
from hmt_ros.image.keypoint_schemes import AUTO, noise_of
from hmt_ros.image.lifted_poses import HIPS, WHOLE_BODY_CARRIERS, LiftedPoses
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.bounded_newton import minimise
from hmt_ros.inference.energy import Energy, EnergyFunction, add_energies
from hmt_ros.inference.linear_algebra import inverse, product, solve
from hmt_ros.inference.mixture import GaussianMixture

# Position of the hips until they are placed, camera frame, m.
INITIAL_HIPS = np.array([0.0, 0.0, 5.0])
# Weight of the body's prior, for angles that lifted joints do not determine, such as twists.
PRIOR_WEIGHT = 0.3
ITERATIONS, TOLERANCE = 12, 0.05
# Factor on joint deviations across the line of sight, where keypoints are used directly; scale of
# the robust kernel of keypoints, in standard deviations.
ACROSS_FACTOR, KERNEL = 4.0, 4.0
# Standard deviation of a landmark from its keypoint when the person is placed, m at the person.
LANDMARK_SIGMA = 0.03
# Factors on covariances: for correlated errors of keypoints and joints, and for unknown lengths of
# the person. Chosen on clips, where 90 % regions of single joints have a coverage of 88 %, or 80 %
# with unknown lengths.
JOINT_COVARIANCE_FACTOR, LENGTH_COVARIANCE_FACTOR = 4.0, 1.6
# Relative standard deviation of the size of a person.
KNOWN_SIZE, UNKNOWN_SIZE = 0.02, 0.06
# Probabilities that a detector exchanges no sides, all sides, only arms or only legs throughout a
# window. The last three happen in 5, 3 and 3 % of the images of clips, but in up to half of the
# images of some people. Chosen so that 90 % regions of such people have a coverage of 80 %.
EXCHANGE_SHARES = np.array([0.8, 0.1, 0.05, 0.05])
# Minimum distance of a person, m.
MIN_DISTANCE = 0.4


def lift_poses(
    lifter: Lifter,
    body: Body,
    camera: Camera,
    stamps: Array,
    keypoints: Sequence[Keypoints],
    ups: Array | None = None,
    *,
    lengths_known: bool = False,
    causal: bool = False,
    scheme: str = AUTO,
) -> list[GaussianMixture | None]:
    """Estimate mixtures over poses from the keypoints of a sequence, without images.

    Args:
        body: body of the person, with the person's lengths if they are known.
        camera: static camera of the keypoints.
        stamps: (T,) times of the images, increasing, s.
        ups: (T, 3) unit vectors against gravity, camera frame; None: unknown.
        lengths_known: whether the body has the lengths of the person.
        causal: whether each estimate ignores later images.
        scheme: scheme of the keypoints' names, see `keypoint_schemes`.

    Returns:
        T mixtures, heaviest component first; None if fewer than five landmarks are seen.

    Raises:
        ValueError: the scheme is unknown, or the body lacks joints.
    """
    seen = [landmark_rays(camera, one, scheme) for one in keypoints]
    rays, confidences = (np.array([one[i] for one in seen]) for i in range(2))
    person = lifter.proportions(body) if lengths_known else None
    lifted = lifter.lift(
        stamps, rays, confidences, stamps, ups, person, causal=causal, exchanges=EXCHANGE_SHARES
    )
    rows = [i for i, one in enumerate(lifted) if one is not None]
    level = body.level if ups is None else roll(ups.mean(0))
    upright = body.levelled(level)
    found = poses_of(
        upright,
        [one for one in lifted if one is not None],
        rays[rows],
        confidences[rows],
        KNOWN_SIZE if lengths_known else UNKNOWN_SIZE,
    )
    result: list[GaussianMixture | None] = [None] * len(lifted)
    for row, mixture in zip(rows, found, strict=True):
        result[row] = relevelled(upright, mixture, body)
    return result


def poses_of(
    body: Body,
    lifted: Sequence[LiftedPoses],
    rays: Array,
    confidences: Array,
    size_spread: float,
) -> list[GaussianMixture]:
    """Convert mixtures over lifted joints to mixtures over poses of a body.

    Args:
        body: body of the person, with the person's lengths if they are known.
        lifted: N mixtures with the same joints and the same number of components.
        rays: (N, L, 2) rays x/z and y/z of the landmarks (`LANDMARKS`) in the N images.
        confidences: (N, L) confidences of the landmarks; 0: not seen.
        size_spread: relative standard deviation of the person's size.

    Raises:
        ValueError: the body lacks some of the joints, or the mixtures lack joints of a whole pose.
    """
    if not lifted:
        return []
    if not lifted[0].are_whole:
        raise ValueError(
            f'lifted poses with the joints {lifted[0].joints} are not whole, wanted all of '
            f'{sorted(WHOLE_BODY_CARRIERS)}'
        )
    k = len(lifted[0].log_weights)
    rays, confidences = np.repeat(rays, k, axis=0), np.repeat(confidences, k, axis=0)
    poses, shifts = _placed(body, _postures(body, lifted), rays, confidences)
    poses, covariances = _fitted(body, poses, lifted, rays, confidences)
    covariances *= (
        JOINT_COVARIANCE_FACTOR
        if size_spread <= KNOWN_SIZE
        else JOINT_COVARIANCE_FACTOR * LENGTH_COVARIANCE_FACTOR
    )
    size = (size_spread * poses[:, :3, None]) * (size_spread * poses[:, None, :3])
    covariances[:, :3] = covariances[:, :, :3] = 0.0
    covariances[:, :3, :3] = shifts + size
    return [
        GaussianMixture(
            elementary.exp(one.log_weights),
            poses[i * k : (i + 1) * k],
            covariances[i * k : (i + 1) * k],
        ).sorted()
        for i, one in enumerate(lifted)
    ]


def _postures(body: Body, lifted: Sequence[LiftedPoses]) -> Array:
    """Closed-form poses (N K, d) near the lifted means, with the hips at `INITIAL_HIPS`."""
    skeleton, joints = body.skeleton, lifted[0].joints
    means = (
        np.concatenate([product(one.sized(skeleton), one.axes) for one in lifted]) + INITIAL_HIPS
    )
    place = {name: means[:, j] for j, name in enumerate(joints)}
    return limb_angles(skeleton, place, None)


def _fitted(
    body: Body, poses: Array, lifted: Sequence[LiftedPoses], rays: Array, confidences: Array
) -> tuple[Array, Array]:
    """Minimise the energy from poses (M, d); return poses and covariances (M, d, d)."""
    skeleton, joints = body.skeleton, lifted[0].joints
    which = skeleton.joint_index(joints)
    hips = body.joint_positions(poses)[:, skeleton.joint_index(HIPS)].mean(1)
    means = np.concatenate([product(one.sized(skeleton), one.axes) for one in lifted])
    means += hips[:, None]
    axes = np.repeat([one.axes for one in lifted], len(lifted[0].log_weights), axis=0)
    deviations = np.concatenate([one.deviations for one in lifted]) * (
        ACROSS_FACTOR,
        ACROSS_FACTOR,
        1.0,
    )
    whiten = axes[:, None] / deviations[..., None]
    carriers, offsets = skeleton.joint_segments[which], skeleton.joint_offsets[which]
    segments, local = _marks(body)
    # Maps a point (x, y, z) to its offsets from the ray, x - a z and y - b z.
    across = np.zeros((*confidences.shape, 2, 3))
    across[..., 0, 0] = across[..., 1, 1] = 1.0
    across[..., 2] = -rays
    seen = forward(skeleton, poses).places(segments, local)
    errors = np.square(product(across, seen[..., None])).sum((2, 3))
    precision = np.where(confidences > 0, 1.0 / noise_of(confidences) ** 2, 0.0)
    precision /= (1.0 + errors * precision / KERNEL**2) ** 2
    across *= np.sqrt(precision)[..., None, None]
    nowhere = np.zeros((len(poses), len(segments), 3))
    prior = pose_prior(body, LEARNED, PRIOR_WEIGHT)

    def energy(x: Array, rows: Index) -> tuple[Array, Array, Array]:
        frames = forward(skeleton, x)
        placed = point_energy(frames, carriers, offsets, means[rows], whiten[rows])
        marks = point_energy(frames, segments, local, nowhere[rows], across[rows])
        total = add_energies([Energy(*placed), Energy(*marks), prior_energies(prior, x)])
        return total.value, *total.derivatives()

    found = minimise(
        EnergyFunction(energy),
        poses,
        body.lower,
        body.upper,
        step_scale=np.where(skeleton.dof_is_rotation, 0.5, 0.3),
        damping=1.0,
        max_iterations=ITERATIONS,
        tolerance=TOLERANCE,
    )
    covariances = inverse(found.hessian + 1e-6 * np.eye(skeleton.dimension))
    return found.x, np.asarray(0.5 * (covariances + covariances.transpose(0, 2, 1)))


def _placed(body: Body, poses: Array, rays: Array, confidences: Array) -> tuple[Array, Array]:
    """Move poses (M, d) so that landmarks lie near rays (M, L, 2); also return root covariances."""
    places = forward(body.skeleton, poses).points(*_marks(body)).transpose(2, 0, 1)
    places = places - poses[:, None, :3]
    a, b = rays[..., 0], rays[..., 1]
    weight = np.sqrt(confidences)
    one, none = np.ones_like(a), np.zeros_like(a)
    rows = np.stack([np.stack([one, none, -a], 2), np.stack([none, one, -b], 2)], axis=2)
    wanted = np.stack([a, b], axis=2) * places[..., 2:] - places[..., :2]
    rows, wanted = rows * weight[..., None, None], wanted * weight[..., None]
    rows, wanted = rows.reshape(len(poses), -1, 3), wanted.reshape(len(poses), -1)
    normal = product(rows.transpose(0, 2, 1), rows) + 1e-9 * np.eye(3)
    roots = solve(normal, np.einsum('mri,mr->mi', rows, wanted)[..., None])[..., 0]
    near = np.maximum(roots[:, 2], max(MIN_DISTANCE, 1.05 * float(body.lower[2])))
    roots *= (near / np.maximum(roots[:, 2], 1e-3))[:, None]
    result = poses.copy()
    result[:, :3] = np.clip(roots, body.lower[:3], body.upper[:3])
    return result, np.asarray(LANDMARK_SIGMA**2 * inverse(normal))


def _marks(body: Body) -> tuple[Index, Array]:
    """Segments (L,) that carry the landmarks, and positions (L, 3) in their frames, m."""
    names, offsets = landmark_offsets(body)
    which = body.skeleton.joint_index(tuple(names))
    return body.skeleton.joint_segments[which], body.skeleton.joint_offsets[which] + offsets


class KeypointPredictor:
    """Predicts mixtures over the poses of one person, image by image; see `lift_poses`.

    Args:
        body: body of the person, with the person's lengths if they are known.
        size_known: whether the body has the size of the person.

    Attributes:
        newest: time of the newest image, s.
    """

    def __init__(
        self, lifter: Lifter, body: Body, camera: Camera, *, size_known: bool = False
    ) -> None:
        self._lifter, self._body = lifter, body
        self._spread = KNOWN_SIZE if size_known else UNKNOWN_SIZE
        self._history = KeypointHistory(camera)
        self._shown: tuple[Array, Array] | None = None
        self.newest = -math.inf

    def add(self, keypoints: Keypoints, stamp: float) -> None:
        """Add the keypoints of the next image; its stamp, s, must exceed all previous stamps."""
        self._shown, self.newest = self._history.add(keypoints, stamp), stamp

    def predict(self, up: Array | None = None) -> GaussianMixture | None:
        """Predict the mixture at the newest image, heaviest first; None if no person is seen.

        Args:
            up: (3,) unit vector against gravity, camera frame; None: unknown.
        """
        if self._shown is None:
            return None
        lifted = self._history.lift(self._lifter, up, exchanges=EXCHANGE_SHARES)
        if lifted is None:
            return None
        rays, confidences = self._shown
        (found,) = poses_of(self._body, [lifted], rays[None], confidences[None], self._spread)
        return found
