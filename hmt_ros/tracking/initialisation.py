"""The start of a track: poses, depth and lengths from joints in one image (KJS 2 and 5.2).

    E(x, l) = 1/2 sum_j |u_j(x, l) - p_j|^2_j + E_prior(x) + 1/2 (l - l_0)' S_l^-1 (l - l_0)

u_j is the projection of joint j for the pose x and the lengths l, and p_j its keypoint; the norm
uses the keypoint's covariance. Pose and lengths are fitted together, from several headings. The
prior of a length is its measurement or its spread over people; known gravity makes the pose
upright, and a depth image gives depths of joints. The lengths are then fixed. The flips of all
limbs that the image and the limits allow are enumerated and fitted again, and the best ones form
the first mixture.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.body.camera import AXES, Camera
from hmt_ros.body.ground_terms import without_root_lean
from hmt_ros.body.kinematics import directed_derivatives, forward, joint_length_jacobians
from hmt_ros.body.model_file import conditioned_covariance
from hmt_ros.core import elementary
from hmt_ros.flips.interpretation_tree import distinct_poses, enumerate_flips
from hmt_ros.image.joint_depths import MIN_JOINTS, JointDepths, joint_depths
from hmt_ros.image.likelihood import ImageLikelihood, LikelihoodSettings
from hmt_ros.image.observation import Box, Observation
from hmt_ros.image.pose_energy import DAMPING, MAX_ITERATIONS, TOLERANCE, PoseEnergy, scale_of
from hmt_ros.image.sampling import ImageMap
from hmt_ros.image.subject import Subject
from hmt_ros.image.terms.depth import DEPTH
from hmt_ros.image.terms.image_term import TermSettings
from hmt_ros.image.terms.keypoints import NOT_EXCHANGED, Keypoints, KeypointTerm
from hmt_ros.image.terms.silhouette import Outline
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.bounded_newton import Minimum, minimise
from hmt_ros.inference.energy import Derivatives, EnergyFunction, Quadratic
from hmt_ros.inference.linear_algebra import inverse, product
from hmt_ros.inference.mixture import GaussianMixture
from hmt_ros.tracking.ground import Gravity
from hmt_ros.tracking.misfit import of_depth
from hmt_ros.tracking.settings import (
    BOX_SIGMA,
    GATE_SIGMAS,
    HEADING_COUNT,
    MAX_STARTS,
    MEASURED_SIGMA,
    START_DISTANCE,
)
from hmt_ros.tracking.validity import UNDECIDED_MISFITS

# Standard deviation of a measured stature, m: the model has no skull and no heels.
STATURE_SIGMA = 2.0 * MEASURED_SIGMA
NO_POSE = 'no pose of the body explains the keypoints: are they in the image?'
MIN_SQUARES = TermSettings(1.0, 1.0, np.inf)


@dataclass(frozen=True, eq=False)
class Start:
    """Body and poses from which a track starts.

    Attributes:
        body: body of the person; its shape is estimated while the track lasts.
        poses: (M, d) distinct poses, best first; if `expected` is given, its means.
        expected: mixture over poses; None: all poses have the same weight.
        clicked: keypoints of a subject file, which replace the detected keypoints at the start.
    """

    body: Body
    poses: Array
    expected: GaussianMixture | None = None
    clicked: Keypoints | None = None

    @property
    def best(self) -> Array:
        """Most probable pose (1, d)."""
        return self.poses[[0 if self.expected is None else int(self.expected.weights.argmax())]]


def start_from_keypoints(
    body: Body,
    camera: Camera,
    subject: Subject,
    *,
    upright: Gravity | None = None,
    depths: ImageMap | None = None,
) -> Start:
    """Poses that explain the joints of a subject, and the body with the subject's lengths.

    Args:
        body: model of the person.
        camera: camera that saw the joints.
        subject: joints and measurements of the person.
        upright: gravity; None: unknown, and the prior keeps the root near the camera's axes.
        depths: depths of the image with the joints; None: unknown. They are dropped if the stature
            becomes implausible, or if they disagree with the surface of the best pose.

    Raises:
        ValueError: no pose can be fitted to the joints.
    """
    sized, keypoints = _sized(body, subject), subject.keypoints
    fits = _fit_with_lengths(
        sized, camera, keypoints, upright, joint_depths(sized, keypoints, depths)
    )
    best = np.argsort(fits.value, kind='stable')[:3]
    if not np.isfinite(fits.value[best[0]]):
        raise ValueError(NO_POSE)
    weights = elementary.exp(-(fits.value[best] - fits.value[best[0]]))
    d = body.dimension
    lengths = product(weights / weights.sum(), fits.x[best, d:])
    own = sized.with_segment_lengths(dict(zip(body.skeleton.length_names, lengths, strict=True)))
    spread = inverse(fits.hessian[best[0]])[d:, d:]
    own = replace(own, length_covariance=0.5 * (spread + spread.T))
    poses = _with_flips(own, camera, keypoints, upright, depths, fits.x[:, :d])
    if depths is not None:
        (misfit,) = of_depth(own, camera, poses[:1], depths)
        people = _is_a_stature(sized, own.skeleton.lengths)
        if not (people and misfit <= UNDECIDED_MISFITS[DEPTH.name]):
            return start_from_keypoints(body, camera, subject, upright=upright)
    return Start(own, poses)


def _with_flips(
    body: Body,
    camera: Camera,
    keypoints: Keypoints,
    upright: Gravity | None,
    depths: ImageMap | None,
    guesses: Array,
) -> Array:
    """Distinct poses (M, d) that explain joints, best first, from guesses (N, d) and their flips.

    Raises:
        ValueError: no pose fits.
    """
    least_squares = LikelihoodSettings.of_terms(keypoints=MIN_SQUARES, depth=DEPTH.settings)
    settings = replace(least_squares, prior_weight=1.0)
    leaning = body if upright is None else without_root_lean(body)
    likelihood = ImageLikelihood(leaning, camera, settings)
    evidence = {} if depths is None else {DEPTH.name: depths}
    observation = Observation(keypoints=keypoints, evidence=evidence)
    terms = (*likelihood.seen(observation, exchanges=NOT_EXCHANGED), *likelihood.priors)
    energy = PoseEnergy(likelihood, terms if upright is None else (*terms, upright.term(body)))

    heads = _distinct(energy.minimise(guesses), body, HEADING_COUNT // 2)
    if len(heads.x) == 0:
        raise ValueError(NO_POSE)
    trees = [enumerate_flips(body, heads.x, c)[0] for c in (*body.chains, *body.chain_pairs)]
    flips = np.concatenate([heads.x, *trees])
    raw = energy.energy(flips, derivatives=Derivatives.NONE).value
    keep = np.argsort(raw, kind='stable')[: 2 * MAX_STARTS]
    solved = _distinct(energy.minimise(flips[keep]), body, MAX_STARTS)
    return solved.x[np.argsort(solved.value, kind='stable')]


def poses_from_keypoints(
    body: Body,
    camera: Camera,
    keypoints: Keypoints,
    upright: Gravity | None = None,
    depths: ImageMap | None = None,
) -> Array:
    """Poses (M, d) that explain the joints of an image, best first, with known lengths.

    Depths that disagree with the surface of the best pose are not used.

    Raises:
        ValueError: no pose can be fitted to the joints.
    """
    measured = joint_depths(body, keypoints, depths)
    guesses = _first_guesses(body, camera, keypoints, upright, measured)
    poses = _with_flips(body, camera, keypoints, upright, depths, guesses)
    if depths is not None:
        (misfit,) = of_depth(body, camera, poses[:1], depths)
        if not misfit <= UNDECIDED_MISFITS[DEPTH.name]:
            return poses_from_keypoints(body, camera, keypoints, upright)
    return poses


def poses_from_outline(body: Body, camera: Camera, outline: Outline) -> Array:
    """Mean poses (HEADINGS, d) at several headings, scaled and placed to fit the silhouette."""
    rays = _level_rays(body, camera, outline.pixels)
    return _poses_between(body, *np.quantile(rays, [0.02, 0.98], axis=0))


def mixture_from_box(body: Body, camera: Camera, box: Box) -> GaussianMixture:
    """Mixture of mean poses at several headings that fill a box (left, top, right, bottom), px.

    Limbs have the variances of the body's prior; the standard deviation of the position is
    `BOX_SIGMA` times the distance.
    """
    left, top, right, bottom = box
    middle = (0.5 * (left + right), 0.5 * (top + bottom))
    sides = np.array([(left, middle[1]), (right, middle[1]), (middle[0], top), (middle[0], bottom)])
    rays = _level_rays(body, camera, sides)
    poses = _poses_between(body, rays.min(0), rays.max(0))
    variances = np.tile(
        np.where(np.isfinite(body.prior_sigma), body.prior_sigma, 0.5) ** 2, (HEADING_COUNT, 1)
    )
    places = np.flatnonzero(~body.skeleton.dof_is_rotation)
    variances[:, places] = (BOX_SIGMA * poses[:, 2:3]) ** 2
    variances[:, body.dof_names.index('root_z')] = (np.pi / HEADING_COUNT) ** 2
    covariances = variances[:, :, None] * np.eye(body.dimension)
    return GaussianMixture(np.full(HEADING_COUNT, 1.0 / HEADING_COUNT), poses, covariances)


def check_box(box: Box, camera: Camera) -> None:
    """Checks the box (left, top, right, bottom) of a person, px.

    Raises:
        ValueError: a number is not finite, or the box has no area or is outside the image.
    """
    left, top, right, bottom = box
    if not np.isfinite(box).all() or left >= right or top >= bottom:
        raise ValueError(f'a box must be (left, top, right, bottom) with an area, saw {tuple(box)}')
    if right <= 0 or bottom <= 0 or left >= camera.width or top >= camera.height:
        raise ValueError(
            f'a box must lie in the image of {camera.width}x{camera.height} pixels, '
            f'saw {tuple(box)}'
        )


def _level_rays(body: Body, camera: Camera, pixels: Array) -> Array:
    """Rays (N, 2) of pixels (N, 2): x / z and y / z in the axes of the body's level."""
    rays = product(camera.rays(pixels), body.level)
    return np.asarray(rays[:, :2] / rays[:, 2:])


def _poses_between(body: Body, low: Array, high: Array) -> Array:
    """Mean poses (HEADINGS, d) that fill a box with two level rays (2,) as corners."""
    middle = 0.5 * (low + high)
    result = np.tile(body.prior_mean, (HEADING_COUNT, 1))
    result[:, :3] = 0.0
    result[:, body.dof_names.index('root_z')] = np.linspace(
        -np.pi, np.pi, HEADING_COUNT, endpoint=False
    )
    heights = product(body.joint_positions(result), body.level)[..., 1]
    top, bottom = heights.min(1), heights.max(1)
    depth = (bottom - top) / max(high[1] - low[1], np.finfo(np.float64).eps)
    result[:, :3] = depth[:, None] * np.append(middle, 1.0)
    result[:, 1] -= 0.5 * (top + bottom)
    result[:, :3] = product(result[:, :3], body.level.T)
    return np.clip(result, body.lower, body.upper)


def _sized(body: Body, subject: Subject) -> Body:
    """Body with the measured lengths of the person, and their covariance."""
    if subject.stature is not None:
        body = body.with_stature(subject.stature)
    known = subject.segment_lengths
    names = body.skeleton.length_names
    if known:
        # Unmeasured lengths are scaled like the measured lengths.
        factor = sum(known.values()) / sum(body.segment_lengths[x] for x in known)
        scaled = {x: body.segment_lengths[x] * factor for x in names if x not in known}
        body = body.with_segment_lengths({**scaled, **known})
    rows = [np.eye(len(names))[[name in known for name in names]]]
    sigma = [MEASURED_SIGMA] * len(known)
    if subject.stature is not None:
        rows.append(body.stature_rates[None])
        sigma.append(STATURE_SIGMA)
    covariance = conditioned_covariance(body.length_covariance, np.concatenate(rows), sigma)
    return replace(body, length_covariance=covariance)


def _is_a_stature(body: Body, lengths: Array) -> bool:
    """Whether the stature with lengths (L,) is plausible."""
    rates = body.stature_rates
    change = float(product(rates, lengths - body.skeleton.lengths))
    variance = float(product(product(rates, body.length_covariance), rates)) + STATURE_SIGMA**2
    return abs(change) <= GATE_SIGMAS * math.sqrt(variance)


def _fit_with_lengths(
    body: Body,
    camera: Camera,
    keypoints: Keypoints,
    upright: Gravity | None,
    measured: JointDepths,
) -> Minimum:
    """Fits (pose, lengths) to the joints from several headings; x is (HEADINGS, d + L)."""
    skeleton = body.skeleton
    d, count = body.dimension, len(skeleton.length_names)
    # Lifted 3D positions are used only once the lengths are known.
    term = KeypointTerm(skeleton, camera, replace(keypoints, positions=None), MIN_SQUARES)
    residuals = 2 * int(keypoints.seen.sum())
    sigma = body.length_sigma
    length_precision = inverse(body.length_covariance)
    leaning, lean = body, None
    if upright is not None:
        leaning = without_root_lean(body)
        lean = PoseEnergy(ImageLikelihood(body, camera), (upright.term(body),))
    prior_precision = 1.0 / leaning.prior_sigma**2
    default = skeleton.lengths

    of_angles = Quadratic(body.prior_mean, prior_precision)

    def energy(x: Array, rows: Index) -> tuple[Array, Array, Array]:
        poses, lengths = x[:, :d], x[:, d:]
        value = np.empty(len(x))
        gradient = np.empty_like(x)
        hessian = np.empty((len(x), d + count, d + count))
        for i in range(len(x)):
            own = skeleton.with_lengths(dict(zip(skeleton.length_names, lengths[i], strict=True)))
            frames = forward(own, poses[i : i + 1])
            joints, places, directions, error, _ = replace(term, skeleton=own).residuals(frames)
            if len(error) < residuals:
                value[i], gradient[i], hessian[i] = np.inf, 0.0, np.eye(d + count)
                continue
            # The first rows are keypoints, the other rows depths of joints.
            far = frames.joints()[measured.joints, :, 0]
            cost, pull, curvature = measured.residuals(far[:, 2])
            joints = np.concatenate([joints, measured.joints])
            places = np.concatenate([places, far])
            directions = np.concatenate([directions, np.tile(AXES[2], (len(far), 1))])
            lengthened = joint_length_jacobians(own, poses[i : i + 1])[0][joints]
            jacobian = np.concatenate(
                [
                    directed_derivatives(
                        frames, skeleton.joint_segments[joints], places, directions
                    ),
                    np.einsum('mk,mkl->ml', directions, lengthened),
                ],
                axis=1,
            )
            value[i] = 0.5 * (error * error).sum() + cost.sum()
            gradient[i] = product(np.concatenate([error, pull]), jacobian)
            curvature = np.concatenate([np.ones(len(error)), curvature])
            hessian[i] = product((jacobian * curvature[:, None]).T, jacobian)
        for own_term in (lean, of_angles):
            if own_term is not None:
                found = own_term.energy(poses, rows)
                slope, curvature = found.derivatives()
                value += found.value
                gradient[:, :d] += slope
                hessian[:, :d, :d] += curvature
        change = lengths - default
        value += 0.5 * np.einsum('nl,lm,nm->n', change, length_precision, change)
        gradient[:, d:] += product(change, length_precision)
        hessian[:, d:, d:] += length_precision
        return value, gradient, hessian

    starts = np.concatenate(
        [
            _first_guesses(body, camera, keypoints, upright, measured),
            np.tile(default, (HEADING_COUNT, 1)),
        ],
        axis=1,
    )
    reach = 5.0 * sigma
    # A length with a standard deviation larger than itself may become negative.
    least = np.where(sigma < default, np.finfo(np.float64).eps, -np.inf)
    return minimise(
        EnergyFunction(energy),
        starts,
        np.concatenate([body.lower, np.maximum(np.minimum(default - reach, 0.5 * default), least)]),
        np.concatenate([body.upper, np.maximum(default + reach, 2.0 * default)]),
        step_scale=np.concatenate([scale_of(body), np.full(count, 0.05)]),
        damping=10.0 * DAMPING,
        max_iterations=2 * MAX_ITERATIONS,
        tolerance=TOLERANCE,
    )


def _first_guesses(
    body: Body,
    camera: Camera,
    keypoints: Keypoints,
    upright: Gravity | None,
    measured: JointDepths,
) -> Array:
    """Mean poses at several headings, placed at the keypoints, whose spread gives the distance."""
    seen = keypoints.seen
    pixels = keypoints.pixels[seen]
    names = [x for x, ok in zip(keypoints.names, seen, strict=True) if ok]
    rays = camera.rays(pixels)
    rays = rays / rays[:, 2:]
    pose = body.prior_mean.copy()
    pose[~body.skeleton.dof_is_rotation] = 0.0
    joints = body.joint_positions(pose[None])[0][body.skeleton.joint_index(names)]
    # Depth = size in space / size in the image; the fit corrects errors due to arms and heading.
    extent = np.linalg.norm(rays - rays.mean(0), axis=1).mean()
    spread = np.linalg.norm((joints - joints.mean(0))[:, :2], axis=1).mean()
    if not extent > 0:
        raise ValueError('the keypoints all lie on one point')
    depth = float(np.clip(spread / extent, body.lower[2], body.upper[2]))
    if len(measured.depths) >= MIN_JOINTS:
        depth = float(np.median(measured.depths))
    middle = rays.mean(0) * depth
    result = np.tile(pose, (HEADING_COUNT, 1))
    turn = body.dof_names.index('root_z')
    result[:, turn] = np.linspace(-np.pi, np.pi, HEADING_COUNT, endpoint=False)
    if upright is not None:
        result = upright.turned(body, result)
    turned = body.joint_positions(result)[:, body.skeleton.joint_index(names)]
    result[:, :3] = middle - turned.mean(1)
    return result


def _distinct(solved: Minimum, body: Body, count: int) -> Minimum:
    """The best minima that differ by more than `START_DISTANCE` in some joint."""
    order = np.argsort(solved.value, kind='stable')
    order = order[np.isfinite(solved.value[order])]
    distinct = distinct_poses(body.joint_positions(solved.x[order]), START_DISTANCE, count)
    return solved[order[distinct.kept]]
