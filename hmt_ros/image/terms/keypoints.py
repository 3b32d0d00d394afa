"""Keypoint energy: distances between projected and detected landmarks (KJS 2 and 5.1).

    E(x) = -log sum_e p_e exp(-sum_k E_k,e(x))
    E_k,e(x) = w sum_a rho([W_k (u_k,e(x) - p_k)]_a),         W_k' W_k = (S_k + (m s_k)^2 I)^-1

u_k,e is the projection of the landmark of keypoint k, which was detected at p_k with covariance S_k
(px^2) and noise s_k (metres on the person); m is the magnification (px/m). Detectors confuse left
and right: in the exchange e, of prior probability p_e, the keypoints of all limbs, of the arms or
of the legs show the landmarks of the other side. For lifted poses, the energy of a mixture over
joint depths is added (`Lifted`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera, Lens
from hmt_ros.body.kinematics import Frames, Tree, tree_of
from hmt_ros.body.skeleton import Skeleton, other_side
from hmt_ros.core import (
    RECORDED,
    elementary,
    exchange_posteriors,
    keypoint_errors,
    record_keypoints,
)
from hmt_ros.image.keypoint_schemes import (
    MIRROR,
    landmarks_of,
    noise_of,
    scheme_of,
)
from hmt_ros.image.lifted_poses import HIPS, LiftedPoses, middle_of_hips
from hmt_ros.image.terms.image_term import NO_FACTORS, TermSettings
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.linear_algebra import cholesky, inverse

KEYPOINTS = TermSettings(0.5, 1.0, 3.0)
# Assumed height of the visible part of a person whose distance is unknown, m.
USUAL_EXTENT = 1.4
# Stature of the person for whom the landmark offsets of the table hold, m.
USUAL_STATURE = 1.7
# Minimum standard deviation of a keypoint whose noise is learned, px.
MIN_SIGMA = 1.5
# Factor on the energy of a mixture over lifted poses, because errors of joints are correlated, and
# scale of the energy's kernel, in standard deviations, because limbs of lifted poses may be wrong.
# Both were chosen together with the time constant of `ERRORS['lifted']`.
LIFTED_WEIGHT, LIFTED_KERNEL = 0.1, 3.0
# Groups of landmarks that change sides together, and the groups (E, G) that change sides in each
# exchange: none, all, arms, legs.
CENTRE, ARMS, LEGS = range(3)
EXCHANGED = np.array([[0, 0, 0], [1, 1, 1], [0, 1, 0], [0, 0, 1]], dtype=np.int64)

# (1, E) log probabilities of the exchanges of keypoints whose sides are known to be right.
NOT_EXCHANGED = np.array([[0.0, -np.inf, -np.inf, -np.inf]])


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Image positions of joints, from any 2D detector or marked by hand.

    Attributes:
        names: (n,) joints of the body; before `named_for`, landmarks of the detector.
        pixels: (n, 2) column and row, px; NaN where a joint was not seen.
        covariances: (n, 2, 2) px^2; NaN where unknown, which is possible only before `named_for`.
        confidences: (n,) from 0 (ignored) to 1 (sure).
        positions: (n, 3) 3D positions, m, along the axes of the camera from a common origin; NaN
            where unknown. None if the detector gives no 3D positions.
        landmarks: (n,) canonical names of landmarks (`keypoint_schemes`), '' for joints; None:
            all keypoints are joints.
        scheme: keypoint scheme of the detector; None if unknown.
        lifted: mixture over whole poses from keypoints or positions; only its depths are used,
            because the keypoints themselves are the evidence across the line of sight.
        offsets: (n, 3) from each joint to its landmark in the frame of the joint's segment, m;
            None: the keypoints are joints.
        noise: (n,) standard deviations in addition to the covariances, m on the person; they
            include the effect of confidences. None: confidences are factors on the precisions.
    """

    names: tuple[str, ...]
    pixels: Array
    covariances: Array
    confidences: Array
    positions: Array | None = None
    offsets: Array | None = None
    noise: Array | None = None
    landmarks: tuple[str, ...] | None = None
    scheme: str | None = None
    lifted: LiftedPoses | None = None

    def __post_init__(self) -> None:
        n = len(self.names)
        shapes = (self.pixels.shape, self.covariances.shape, self.confidences.shape)
        if shapes != ((n, 2), (n, 2, 2), (n,)):
            raise ValueError(f'{n} keypoints with arrays of shapes {shapes}')
        for name, shape in (('positions', (n, 3)), ('offsets', (n, 3)), ('noise', (n,))):
            given = getattr(self, name)
            if given is not None and given.shape != shape:
                raise ValueError(f'{n} keypoints with {name} of shape {given.shape}')

    @cached_property
    def seen(self) -> NDArray[np.bool_]:
        """(n,) whether a keypoint has a position and a confidence above 0."""
        return np.asarray(np.isfinite(self.pixels).all(1) & (self.confidences > 0), dtype=np.bool_)

    @property
    def trunk(self) -> Array:
        """Vector (2,) from mid-hips to mid-shoulders, px; NaN unless all four joints are seen."""
        places = dict(zip(self.names, np.where(self.seen[:, None], self.pixels, np.nan)))
        unknown = np.full(2, np.nan)
        middles = [
            places.get(f'left_{name}', unknown) + places.get(f'right_{name}', unknown)
            for name in ('shoulder', 'hip')
        ]
        return np.asarray(0.5 * (middles[0] - middles[1]))

    def __getitem__(self, which: Index) -> Keypoints:
        """The keypoints with these indices."""
        more = {
            name: None if getattr(self, name) is None else getattr(self, name)[which]
            for name in ('positions', 'offsets', 'noise')
        }
        names = tuple(self.names[i] for i in which)
        return Keypoints(
            names,
            self.pixels[which],
            self.covariances[which],
            self.confidences[which],
            **more,
            landmarks=None if self.landmarks is None else tuple(self.landmarks[i] for i in which),
            scheme=self.scheme,
            lifted=self.lifted,
        )

    def named_for(self, body: Body, scheme: str = 'auto') -> tuple[Keypoints, list[str]]:
        """Keypoints renamed to joints of a body, and the names for which the body has no joint.

        Unknown covariances are replaced by the learned noise of the scheme.

        Args:
            scheme: scheme of the names, see `keypoint_schemes`; 'auto' selects a scheme with all
                names; 'joints': the names are joints of the body.

        Raises:
            ValueError: there is no such scheme.
        """
        marks = landmarks_of(self.names, body.joint_names, scheme)
        found = scheme_of(self.names, scheme)
        names = [
            name if mark is None else mark.joint
            for name, mark in zip(self.names, marks, strict=True)
        ]
        strange = [
            given
            for given, name, mark in zip(self.names, names, marks, strict=True)
            if name not in body.joint_names and (mark is None or mark.joint)
        ]
        kept = [i for i, name in enumerate(names) if name in body.joint_names]
        known = self[np.array(kept, dtype=np.intp)]
        size = body.stature / USUAL_STATURE
        offsets = np.zeros((len(kept), 3))
        sigma = np.zeros(len(kept))
        for row, i in enumerate(kept):
            mark = marks[i]
            if mark is not None:
                offsets[row], sigma[row] = size * mark.offset, mark.sigma
        unknown = ~np.isfinite(known.covariances).all((1, 2))
        covariances = known.covariances.copy()
        covariances[unknown] = MIN_SIGMA**2 * np.eye(2)
        noise = None
        if unknown.any():
            by_confidence = noise_of(known.confidences)
            noise = np.where(unknown, elementary.hypot(by_confidence, sigma), sigma)
        renamed = replace(
            known,
            names=tuple(names[i] for i in kept),
            covariances=covariances,
            offsets=offsets if offsets.any() else None,
            noise=noise,
            landmarks=tuple('' if (mark := marks[i]) is None else mark.name for i in kept),
            scheme=None if found is None else found.name,
        )
        return renamed, strange

    def magnification(self) -> float:
        """Approximate magnification at the person, px/m, from the extent of the keypoints."""
        seen = self.pixels[self.seen]
        if len(seen) < 2:
            return 1.0
        return max(float((seen.max(0) - seen.min(0)).max()) / USUAL_EXTENT, 1e-3)


class Points(NamedTuple):
    """P keypoints, each with its own landmark and the landmark of the other side.

    Attributes:
        segments: (P, 2) segments that carry the landmarks.
        offsets: (P, 2, 3) positions of the landmarks in the frames of the segments, m.
        pixels: (P, 2) detected positions, px.
        whiteners: (P, 2, 2) W, where W' W is the precision.
        groups: (P,) group with which each keypoint changes sides.
    """

    segments: Index
    offsets: Array
    pixels: Array
    whiteners: Array
    groups: Index


class Lifted(NamedTuple):
    """Mixture of C components over the depths of J joints behind the middle of the hips.

    Attributes:
        segments: (J,) segments that carry the joints.
        offsets: (J, 3) positions of the joints in the frames of the segments, m.
        middle: (3,) middle of the hips in the frame of the root, m.
        ray: (3,) line of sight, unit vector.
        log_weights: (C,) log weights, including the normalisers of the components.
        depths: (2, C, J) means along the ray from the middle of the hips, m, with sides as named
            and with sides exchanged.
        precisions: (2, C, J) square roots of the precisions, 1/m.
        readings: (E,) row of `depths` and `precisions`, 0 or 1, for each exchange of sides.
        weight: factor on the energy; 0 without a mixture.
        scale: scale of the kernel, in standard deviations; it bounds the energy of a joint.
    """

    segments: Index
    offsets: Array
    middle: Array
    ray: Array
    log_weights: Array
    depths: Array
    precisions: Array
    readings: Index
    weight: float
    scale: float


class KeypointInputs(NamedTuple):
    """Inputs of the energy of keypoints.

    Attributes:
        points: the measured keypoints.
        lifted: the mixture over whole poses.
        tree, lens: skeleton and camera.
        scale: scale of the kernel, in standard deviations.
        weights: (G,) factors on the energies of the groups of landmarks.
        factors: (S,) factors on the energies of keypoints on each segment, with sides as named;
            (0,) if all are 1.
        exchanged: (E, G) 1 where a group changes sides in an exchange.
        log_priors: (R, E) log priors of the exchanges, one row per problem or a single row.
    """

    points: Points
    lifted: Lifted
    tree: Tree
    lens: Lens
    scale: float
    weights: Array
    factors: Array
    exchanged: Index
    log_priors: Array


@dataclass(frozen=True, eq=False)
class KeypointTerm:
    """Minus the log-likelihood of keypoints.

    Keypoints that were not seen (NaN) or have confidence 0 are ignored.

    Attributes:
        skeleton, camera: skeleton of the person, and the camera.
        keypoints: the detected keypoints.
        settings: weight w, factor on the standard deviations, and scale of the kernel; an
            infinite scale gives least squares.
        magnification: px/m at the person; 0 if unknown.
        exchanges: (R, E) log prior probability of each exchange, one row per problem or a single
            row; None if sides are never exchanged.
        beliefs: (G,) factors on the energies of the groups of landmarks; None if all are 1.
        lifted_share: factor on the energy of the mixture over whole poses.
        segments: (S,) factors on the energies of keypoints on each segment, with sides as named;
            (0,) or None if all are 1.

    Raises:
        KeyError: the skeleton lacks the joint of a keypoint.
    """

    skeleton: Skeleton
    camera: Camera
    keypoints: Keypoints
    settings: TermSettings = KEYPOINTS
    magnification: float = 0.0
    exchanges: Array | None = None
    beliefs: Array | None = None
    lifted_share: float = 1.0
    segments: Array | None = None

    @cached_property
    def compiled(self) -> KeypointInputs:
        """The term as input of the compiled core."""
        exchanges = np.zeros((1, 1)) if self.exchanges is None else self.exchanges
        lifted = self.measured.lifted
        return KeypointInputs(
            self.measured.points,
            lifted._replace(weight=self.lifted_share * lifted.weight),
            tree_of(self.skeleton),
            self.camera.lens,
            float(self.settings.scale),
            self.weights,
            NO_FACTORS if self.segments is None else self.segments,
            EXCHANGED[: exchanges.shape[1]],
            np.ascontiguousarray(exchanges, dtype=np.float64),
        )

    def exchanged(self, frames: Frames, rows: Index) -> Array:
        """Posterior log probabilities (N, E) of the exchanges at N poses, given as frames."""
        inputs = self.compiled
        priors = inputs.log_priors[rows if len(inputs.log_priors) > 1 else [0] * frames.count]
        result = np.empty(priors.shape)
        exchange_posteriors(inputs, priors, *frames.by_pose(), result)
        return result

    def residuals(self, frames: Frames) -> tuple[Index, Array, Array, Array, Array]:
        """The residuals at one pose, given as frames, in the likeliest exchange of sides.

        Returns:
            (M,) joint of the skeleton, (M, 3) position of the landmark, (M, 3) derivative of the
            residual with respect to the position, (M,) derivative and (M,) curvature of the energy
            with respect to the residual; two residuals per keypoint. Landmarks behind the camera
            have no residuals.
        """
        (found,) = self.recorded(frames)
        rows = found[1 : 1 + int(found[0, 0])]
        return rows[:, 0].astype(np.intp), rows[:, 1:4], rows[:, 4:7], rows[:, 7], rows[:, 8]

    def recorded(self, frames: Frames) -> Array:
        """The residuals at N poses, given as frames; see `residuals` and `record_keypoints`.

        Returns:
            (N, 1 + M, RECORDED): the first number of row 0 is m; rows 1 to m are joint, position,
            derivative of the residual with respect to the position, derivative and curvature of the
            energy.
        """
        measured = self.measured
        result = np.zeros((frames.count, 1 + 2 * len(measured.joints), RECORDED))
        record_keypoints(self.compiled, measured.joints, *frames.by_pose(), result)
        return result

    def distances(self, frames: Frames) -> Array:
        """Distances (N, P) of the P seen keypoints from N poses, in standard deviations.

        The likeliest exchange of sides is used; NaN for landmarks behind the camera.
        """
        errors = np.empty((frames.count, len(self.measured.joints), 2))
        keypoint_errors(self.compiled, *frames.by_pose(), errors)
        return np.asarray(np.linalg.norm(errors, axis=2))

    @property
    def weights(self) -> Array:
        """Factors (G,) on the energies of the groups of landmarks."""
        beliefs = np.ones(EXCHANGED.shape[1]) if self.beliefs is None else self.beliefs
        return np.asarray(self.settings.weight * beliefs, dtype=np.float64)

    @property
    def measured(self) -> MeasuredKeypoints:
        """The keypoints as inputs of the kernel, for all poses of the skeleton."""
        sigma = self.settings.sigma
        return _measured(self.skeleton, self.keypoints, sigma, self.magnification)


@dataclass(frozen=True, eq=False)
class MeasuredKeypoints:
    """P usable keypoints as inputs of the kernel, for all poses of a skeleton.

    Attributes:
        joints: (P, 2) joint of each keypoint, with sides as named and with sides exchanged.
        points: pixels of the keypoints, and the segments on which they lie.
        lifted: the mixture over whole poses.
    """

    joints: Index
    points: Points
    lifted: Lifted


# A track makes a term for every set of hypotheses of an image, and the start of a track for every
# trial of bone lengths. Inputs that depend on neither are computed once.
@lru_cache(maxsize=16)
def _measured(
    skeleton: Skeleton, keypoints: Keypoints, sigma: float, magnification: float
) -> MeasuredKeypoints:
    counted, whiteners = _whitened(keypoints, sigma, magnification)
    names, known = counted.names, skeleton.joint_names
    others = [x if other_side(x) not in known else other_side(x) for x in names]
    joints = np.stack([skeleton.joint_index(names), skeleton.joint_index(others)], axis=1)
    own = np.zeros((len(joints), 3)) if counted.offsets is None else counted.offsets
    offsets = skeleton.joint_offsets[joints] + np.stack([own, own * MIRROR], axis=1)
    segments = skeleton.joint_segments[joints].astype(np.int64)
    groups = groups_of(skeleton)[segments[:, 0]]
    points = Points(segments, offsets, counted.pixels, whiteners, groups)
    return MeasuredKeypoints(joints, points, _lifted(skeleton, keypoints.lifted, sigma))


@lru_cache(maxsize=16)
def _whitened(keypoints: Keypoints, sigma: float, magnification: float) -> tuple[Keypoints, Array]:
    """The usable keypoints, and matrices (P, 2, 2) that whiten their noise."""
    k = keypoints[np.flatnonzero(keypoints.seen)]
    covariances = sigma**2 * k.covariances
    confidences = k.confidences[:, None, None]
    if k.noise is not None:
        blur = (sigma * (magnification or k.magnification()) * k.noise) ** 2
        covariances = covariances + blur[:, None, None] * np.eye(2)
        confidences = np.ones_like(confidences)
    precision = inverse(covariances) * confidences
    return k, np.ascontiguousarray(cholesky(precision).transpose(0, 2, 1))


NOT_LIFTED = Lifted(
    np.zeros(0, np.int64),
    np.zeros((0, 3)),
    np.zeros(3),
    np.array([0.0, 0.0, 1.0]),
    np.zeros(1),
    np.zeros((2, 1, 0)),
    np.zeros((2, 1, 0)),
    np.zeros(len(EXCHANGED), np.int64),
    0.0,
    1.0,
)


@lru_cache(maxsize=16)
def _lifted(skeleton: Skeleton, poses: LiftedPoses | None, sigma: float) -> Lifted:
    """A mixture over whole poses as input of the compiled core."""
    known = set(skeleton.joint_names)
    if poses is None or not known.issuperset(HIPS):
        return NOT_LIFTED
    poses = poses.of_joints([name for name in poses.joints if name in known])
    joints = skeleton.joint_index(poses.joints)
    both = poses, poses.exchanged()
    depths = np.stack([x.sized(skeleton)[:, :, 2] for x in both])
    deviations = sigma * np.stack([x.deviations[:, :, 2] for x in both])
    return Lifted(
        skeleton.joint_segments[joints].astype(np.int64),
        skeleton.joint_offsets[joints],
        middle_of_hips(skeleton),
        np.ascontiguousarray(poses.axes[2]),
        poses.log_weights - elementary.log(deviations[0]).sum(1),
        np.ascontiguousarray(depths),
        np.ascontiguousarray(1.0 / deviations),
        EXCHANGED.min(1),
        LIFTED_WEIGHT,
        LIFTED_KERNEL,
    )


@lru_cache(maxsize=16)
def groups_of(skeleton: Skeleton) -> Index:
    """Group (S,) with which the landmarks on each segment change sides."""
    result = np.full(len(skeleton.parents), CENTRE, dtype=np.int64)
    for chain, segments in skeleton.chains.items():
        result[list(segments)] = {'arm': ARMS, 'leg': LEGS}.get(chain.rpartition('_')[2], CENTRE)
    return result
