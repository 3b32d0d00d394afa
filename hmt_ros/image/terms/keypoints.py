"""Keypoints: distances of projected landmarks from where a detector saw them (KJS 2 and 5.1).

    E(x) = -log sum_e p_e exp(-sum_k E_k,e(x))
    E_k,e(x) = w sum_a rho([W_k (u_k,e(x) - p_k)]_a),         W_k' W_k = (S_k + (m s_k)^2 I)^-1

u_k,e projects the landmark that keypoint k shows, seen at p_k with covariance S_k (px^2) and noise
s_k on the person (m, at the magnification m, px/m). Detectors take left for right: in the exchange
e, of prior probability p_e, the keypoints of all limbs, of the arms or of the legs show the
landmarks of the other side. What a detector says of depth counts by the slopes of bones.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.kinematics import Frames, forward
from hmt_ros.body.skeleton import Skeleton, other_side
from hmt_ros.image.keypoint_schemes import (
    MIRROR,
    SlopeModel,
    landmarks_of,
    noise_of,
    slope_models,
)
from hmt_ros.image.surface import lens_of
from hmt_ros.image.terms.image_term import TermSettings
from hmt_ros.image.terms.keypoint_kernel import (
    KeypointInputs,
    Points,
    Slopes,
    add_keypoints,
    exchange_log_posterior,
    group_energies,
    keypoint_errors,
    record_keypoints,
)
from hmt_ros.image.terms.residuals import RECORDED, tree_of
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.energy import Derivatives, Energy

KEYPOINTS = TermSettings(0.5, 1.0, 3.0)
# Height of what keypoints show of a person whose distance is unknown, m.
USUAL_EXTENT = 1.4
# A person whose landmarks have the offsets of the table, m.
USUAL_STATURE = 1.7
# Least standard deviation of a keypoint whose noise is learned, px.
SMALLEST_SIGMA = 1.5
# Groups of landmarks that are exchanged together, and which of them (E, G) an exchange exchanges:
# nothing, all, arms, legs.
CENTRE, ARMS, LEGS = range(3)
EXCHANGED = np.array([[0, 0, 0], [1, 1, 1], [0, 1, 0], [0, 0, 1]], dtype=np.int64)

# (1, E) log probabilities of exchanges of keypoints that are known to be called by their sides.
NOT_EXCHANGED = np.array([[0.0, -np.inf, -np.inf, -np.inf]])


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Image positions of joints, from any 2D detector or by hand.

    Attributes:
        names: (n,) joints of the body; of a detector, before `named_for`, its landmarks.
        pixels: (n, 2) column and row, px; NaN where a joint was not seen.
        covariances: (n, 2, 2) px^2; NaN before `named_for`: unknown.
        confidences: (n,) from 0, ignore, to 1, sure.
        positions: (n, 3) of a detector that lifts, m, along the axes of the camera from an origin
            that all share; NaN where there is none. None: it does not lift.
        offsets: (n, 3) of what was seen from the joint in the frame of its segment, m; None: joints
            were seen.
        noise: (n,) standard deviation beside the covariances, m on the person; it accounts for the
            confidences. None: none, and confidences divide the precisions.
    """

    names: tuple[str, ...]
    pixels: Array
    covariances: Array
    confidences: Array
    positions: Array | None = None
    offsets: Array | None = None
    noise: Array | None = None

    def __post_init__(self) -> None:
        n = len(self.names)
        shapes = (self.pixels.shape, self.covariances.shape, self.confidences.shape)
        if shapes != ((n, 2), (n, 2, 2), (n,)):
            raise ValueError(f'{n} keypoints with arrays of shapes {shapes}')
        for name, shape in (('positions', (n, 3)), ('offsets', (n, 3)), ('noise', (n,))):
            given = getattr(self, name)
            if given is not None and given.shape != shape:
                raise ValueError(f'{n} keypoints with {name} of shape {given.shape}')

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(n,) joints that have a position and are not to be ignored."""
        return np.asarray(np.isfinite(self.pixels).all(1) & (self.confidences > 0), dtype=np.bool_)

    def __getitem__(self, which: Index) -> Keypoints:
        """Some of them."""
        more = {
            name: None if getattr(self, name) is None else getattr(self, name)[which]
            for name in ('positions', 'offsets', 'noise')
        }
        names = tuple(self.names[i] for i in which)
        return Keypoints(
            names, self.pixels[which], self.covariances[which], self.confidences[which], **more
        )

    def named_for(self, body: Body, scheme: str = 'auto') -> tuple[Keypoints, list[str]]:
        """Those that are at joints of a body, under the body's names, and the names of the others.

        Unknown covariances become those that are learned for keypoints of a scheme.

        Args:
            body: with the joints.
            scheme: of the names, see `keypoint_schemes`; 'auto': the one that has them all,
                'joints': none, they are names of joints.

        Raises:
            ValueError: there is no such scheme.
        """
        marks = landmarks_of(self.names, body.joint_names, scheme)
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
        covariances[unknown] = SMALLEST_SIGMA**2 * np.eye(2)
        noise = None
        if unknown.any():
            by_confidence = noise_of(known.confidences)
            noise = np.where(unknown, np.hypot(by_confidence, sigma), sigma)
        renamed = replace(
            known,
            names=tuple(names[i] for i in kept),
            covariances=covariances,
            offsets=offsets if offsets.any() else None,
            noise=noise,
        )
        return renamed, strange

    def magnification(self) -> float:
        """About how many px a metre has at the person, by how far the keypoints reach."""
        seen = self.pixels[self.seen]
        if len(seen) < 2:
            return 1.0
        return max(float((seen.max(0) - seen.min(0)).max()) / USUAL_EXTENT, 1e-3)


@dataclass(frozen=True, eq=False)
class KeypointTerm:
    """Minus the log-likelihood of keypoints; a `FrameTerm`.

    Keypoints that were not seen (NaN) or have no confidence do not count.

    Attributes:
        skeleton, camera: who is seen by what.
        keypoints: that were seen.
        settings: weight w, factor on the standard deviations, and scale of the kernel; inf: least
            squares.
        magnification: px for a metre at the person; 0: unknown.
        exchanges: (R, E) log probability of each exchange before the image, a row for each problem
            or one for all; None: nothing is exchanged.
        beliefs: (G,) factors on the energies of the groups of landmarks; None: 1.

    Raises:
        KeyError: a keypoint that is not a joint of the body.
    """

    skeleton: Skeleton
    camera: Camera
    keypoints: Keypoints
    settings: TermSettings = KEYPOINTS
    magnification: float = 0.0
    exchanges: Array | None = None
    beliefs: Array | None = None

    def energy(
        self, frames: Frames, rows: Index, *, derivatives: Derivatives = Derivatives.POSITIVE
    ) -> Energy:
        """See `hmt_ros.body.pose_terms.FrameTerm`."""
        n, d = frames.count, self.skeleton.dimension
        poses = n if derivatives else 0
        value, gradient, hessian = np.zeros(n), np.zeros((poses, d)), np.zeros((poses, d, d))
        inputs = self.compiled
        chosen = rows if len(inputs.log_priors) > 1 else np.zeros(n, dtype=np.intp)
        add_keypoints(
            inputs, inputs.log_priors[chosen], *frames.by_pose(), *frames.dofs_by_pose(), value,
            gradient, hessian,
        )  # fmt: skip
        return Energy(value, gradient, hessian) if derivatives else Energy(value)

    @property
    def compiled(self) -> KeypointInputs:
        """As compiled code reads it."""
        exchanges = np.zeros((1, 1)) if self.exchanges is None else self.exchanges
        measured = self.measured
        return KeypointInputs(
            measured.points, measured.slopes, tree_of(self.skeleton), lens_of(self.camera),
            float(self.settings.scale), self.weights,
            EXCHANGED[: exchanges.shape[1]], np.ascontiguousarray(exchanges, dtype=np.float64),
        )  # fmt: skip

    def exchanged(self, frames: Frames, rows: Index) -> Array:
        """Log probabilities (N, E) of the exchanges at the frames of N poses."""
        measured = self.measured
        exchanged, priors = self._priors(rows, frames.count)
        result = np.empty(priors.shape)
        energies = np.empty((exchanged.shape[1], 2))
        columns, origins = frames.by_pose()
        for n in range(frames.count):
            group_energies(
                measured.points, measured.slopes, lens_of(self.camera), float(self.settings.scale),
                columns[n], origins[n], energies,
            )  # fmt: skip
            exchange_log_posterior(energies, self.weights, exchanged, priors[n], result[n])
        return result

    def residuals(self, frames: Frames) -> tuple[Index, Array, Array, Array, Array]:
        """The residuals at the frames of one pose, in the exchange that is likeliest there.

        Returns:
            (M,) joint of the skeleton, (M, 3) position of the landmark, (M, 3) derivative of the
            residual by the position, (M,) derivative and (M,) curvature of the energy by the
            residual; two residuals a keypoint. Landmarks behind the camera have none.
        """
        (found,) = self.recorded(frames)
        rows = found[1 : 1 + int(found[0, 0])]
        return rows[:, 0].astype(np.intp), rows[:, 1:4], rows[:, 4:7], rows[:, 7], rows[:, 8]

    def recorded(self, frames: Frames) -> Array:
        """The residuals at the frames of N poses, as `residuals` of one; see `record_keypoints`.

        Returns:
            (N, 1 + M, RECORDED): rows 1 to m of a pose are joint, position, derivative of the
            residual by it, derivative and curvature of the energy; m is the first number of row 0.
        """
        measured = self.measured
        result = np.zeros((frames.count, 1 + 2 * len(measured.joints), RECORDED))
        record_keypoints(self.compiled, measured.joints, *frames.by_pose(), result)
        return result

    def distances(self, frames: Frames) -> Array:
        """How far the P keypoints that were seen are from N poses, (N, P), in deviations.

        The exchange of sides is the likeliest; of a landmark behind the camera it is NaN.
        """
        errors = np.empty((frames.count, len(self.measured.joints), 2))
        keypoint_errors(self.compiled, *frames.by_pose(), errors)
        return np.asarray(np.linalg.norm(errors, axis=2))

    def _priors(self, rows: Index, count: int) -> tuple[NDArray[np.int64], Array]:
        """Which groups each exchange exchanges (E, G), and log priors (N, E)."""
        if self.exchanges is None:
            return EXCHANGED[:1], np.zeros((count, 1))
        chosen = self.exchanges[rows] if len(self.exchanges) > 1 else self.exchanges[[0] * count]
        return EXCHANGED, np.ascontiguousarray(chosen)

    @property
    def weights(self) -> Array:
        """Factors (G,) on the energies of the groups."""
        beliefs = np.ones(EXCHANGED.shape[1]) if self.beliefs is None else self.beliefs
        return np.asarray(self.settings.weight * beliefs, dtype=np.float64)

    @property
    def measured(self) -> MeasuredKeypoints:
        """What the keypoints say of the skeleton, whatever its pose."""
        sigma = self.settings.sigma
        return _measured(self.skeleton, self.camera, self.keypoints, sigma, self.magnification)


@dataclass(frozen=True, eq=False)
class MeasuredKeypoints:
    """What P keypoints that count say of a skeleton, whatever its pose.

    Attributes:
        joints: (P, 2) of the skeleton that they show, as they are called and exchanged.
        points: where they were seen, and on which segment they lie.
        slopes: of the bones that were lifted.
    """

    joints: Index
    points: Points
    slopes: Slopes


# A track makes a term for every set of hypotheses of an image, and a start one for every trial of
# lengths. What does not depend on the hypotheses, or on the lengths, is worked out once.
@lru_cache(maxsize=16)
def _measured(
    skeleton: Skeleton, camera: Camera, keypoints: Keypoints, sigma: float, magnification: float
) -> MeasuredKeypoints:
    counted, whiteners = _whitened(keypoints, sigma, magnification)
    names, known = counted.names, skeleton.joint_names
    others = [x if other_side(x) not in known else other_side(x) for x in names]
    joints = np.stack([skeleton.joint_index(names), skeleton.joint_index(others)], axis=1)
    own = np.zeros((len(joints), 3)) if counted.offsets is None else counted.offsets
    offsets = skeleton.joint_offsets[joints] + np.stack([own, own * MIRROR], axis=1)
    segments = skeleton.joint_segments[joints].astype(np.int64)
    groups = np.array([group_of(skeleton, i) for i in segments[:, 0]], dtype=np.int64)
    points = Points(segments, offsets, counted.pixels, whiteners, groups)
    return MeasuredKeypoints(joints, points, _slopes(skeleton, camera, counted, sigma))


@lru_cache(maxsize=16)
def _whitened(keypoints: Keypoints, sigma: float, magnification: float) -> tuple[Keypoints, Array]:
    """The keypoints that count, and matrices (P, 2, 2) that make their noise white."""
    k = keypoints[np.flatnonzero(keypoints.seen)]
    covariances = sigma**2 * k.covariances
    confidences = k.confidences[:, None, None]
    if k.noise is not None:
        blur = (sigma * (magnification or k.magnification()) * k.noise) ** 2
        covariances = covariances + blur[:, None, None] * np.eye(2)
        confidences = np.ones_like(confidences)
    precision = np.linalg.inv(covariances) * confidences
    return k, np.ascontiguousarray(np.linalg.cholesky(precision).transpose(0, 2, 1))


def _slopes(skeleton: Skeleton, camera: Camera, keypoints: Keypoints, sigma: float) -> Slopes:
    """The bones that were lifted."""
    if keypoints.positions is None:
        return NO_SLOPES
    known = _known_bones(skeleton, keypoints.names)
    ends, middles = (
        _first_of(known.codes, values)[known.ends].mean(2)
        for values in (keypoints.positions, keypoints.pixels)
    )
    along, middles = ends[:, 1] - ends[:, 0], middles.mean(1)
    lengths = np.linalg.norm(along, axis=1)
    seen = np.flatnonzero((lengths > 0) & np.isfinite(lengths) & np.isfinite(middles).all(1))
    rays = camera.rays(middles[seen])
    return Slopes(
        known.segments[seen], known.directions[seen], rays,
        np.einsum('mk,mk->m', along[seen] / lengths[seen, None], rays),
        1.0 / (sigma * known.sigmas[seen]), known.groups[seen],
    )  # fmt: skip


NO_SLOPES = Slopes(
    np.zeros((0, 2), np.int64), np.zeros((0, 2, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0),
    np.zeros(0, np.int64),
)  # fmt: skip


class _KnownBones(NamedTuple):
    """The B bones of a skeleton whose ends are among P names.

    Attributes:
        codes: (P,) of the names, the same for the same name.
        ends: (B, 2, 2) codes of both ends; an end lies between two names, or is twice the same.
        segments, directions, sigmas, groups: (B, 2), (B, 2, 3), (B,), (B,) of the bones.
    """

    codes: Index
    ends: Index
    segments: NDArray[np.int64]
    directions: Array
    sigmas: Array
    groups: NDArray[np.int64]


@lru_cache(maxsize=16)
def _known_bones(skeleton: Skeleton, names: tuple[str, ...]) -> _KnownBones:
    code = {name: i for i, name in enumerate(dict.fromkeys(names))}
    rows = []
    for bone, segments, along in _bones(skeleton):
        pairs = [[x.replace('mid_', side) for side in ('left_', 'right_')] for x in bone.ends]
        if any(name not in code for pair in pairs for name in pair):
            continue
        first = skeleton.joint_index([pairs[0][0]])
        group = group_of(skeleton, int(skeleton.joint_segments[first][0]))
        rows.append(([[code[x] for x in pair] for pair in pairs], segments, along, bone, group))
    n = len(rows)
    return _KnownBones(
        np.array([code[name] for name in names], dtype=np.intp),
        np.reshape([row[0] for row in rows], (n, 2, 2)).astype(np.intp),
        np.reshape([row[1] for row in rows], (n, 2)).astype(np.int64),
        np.reshape([row[2] for row in rows], (n, 2, 3)).astype(np.float64),
        np.array([row[3].sigma for row in rows], dtype=np.float64),
        np.array([row[4] for row in rows], dtype=np.int64),
    )


def _first_of(codes: Index, values: Array) -> Array:
    """The first finite value of each code, (C, ...); NaN where there is none."""
    rows = np.flatnonzero(np.isfinite(values).all(1))[::-1]
    result = np.full((int(codes.max(initial=-1)) + 1, values.shape[1]), np.nan)
    result[codes[rows]] = values[rows]
    return result


@lru_cache(maxsize=16)
def _bones(skeleton: Skeleton) -> list[tuple[SlopeModel, tuple[int, int], Array]]:
    """The bones that a skeleton has: their model, segments as called and exchanged, and directions.

    The directions (2, 3) are in the frames of these segments; that of the other side has the sign
    of the model.
    """
    at_rest = forward(skeleton, np.zeros((1, skeleton.dimension)))
    places = dict(zip(skeleton.joint_names, at_rest.joints()[..., 0], strict=True))
    columns = at_rest.by_pose()[0][0]
    result = []
    for bone in slope_models():
        other = bone.mirrored()
        known = {bone.segment, other.segment} <= {*skeleton.segment_names}
        own, far = _direction(places, bone), _direction(places, other)
        if known and own is not None and far is not None:
            i, j = (skeleton.segment_names.index(x.segment) for x in (bone, other))
            directions = np.stack([columns[i] @ own, bone.sign * columns[j] @ far])
            result.append((bone, (i, j), directions))
    return result


def _end(places: Mapping[str, Array], name: str) -> Array | None:
    """A place by name; that of `mid_x` is between the left and the right x."""
    if not name.startswith('mid_'):
        return places.get(name)
    pair = [places.get(name.replace('mid_', side)) for side in ('left_', 'right_')]
    if pair[0] is None or pair[1] is None:
        return None
    return 0.5 * (pair[0] + pair[1])


def _direction(places: Mapping[str, Array], bone: SlopeModel) -> Array | None:
    """Unit vector (3,) along a bone; None: an end is missing, or both are one."""
    first, last = (_end(places, name) for name in bone.ends)
    if first is None or last is None:
        return None
    length = float(np.linalg.norm(last - first))
    return (last - first) / length if length > 0 else None


def group_of(skeleton: Skeleton, segment: int) -> int:
    """Group that what lies on a segment is exchanged with."""
    for chain, segments in skeleton.chains.items():
        if segment in segments:
            return {'arm': ARMS, 'leg': LEGS}.get(chain.rpartition('_')[2], CENTRE)
    return CENTRE
