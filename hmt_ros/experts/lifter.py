"""Mixture of experts that lifts a window of 2D keypoints to 3D poses (BME 2, other inputs).

    p(y | r) = sum_i g_i(r) N(y; f_i(r), diag s_i(r)^2)

y are the joint positions of a person of usual lengths, relative to the middle of the hips, in the
frame of a camera that points at the person; r is a window of keypoints. One network with shared
layers [Bishop 1994] gives the gates g, means f and deviations s. It is trained on motion capture
with simulated cameras and detector errors (`keypoint_training`).

    keypoints -> landmarks of all schemes -> rays -> the view of a camera that points at the trunk

A window has one slot for each of `TIMES`, relative to the image of the estimate. The nearest image
fills the slot if its time differs by at most `TIME_TOLERANCES`, so any frame rate works. The inputs
are the positions of the landmarks in the plane of a camera that points at the trunk, divided by
their extent, with confidences; the time offset of each image from its slot; the extent; and, if
known, the direction against gravity in that camera and the proportions of the person. If gravity is
known, that camera is rolled upright, because the experts were trained on upright cameras only.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body import Body
from hmt_ros.body.camera import Camera, roll
from hmt_ros.body.learned_file import (
    Arrays,
    body_of,
    check_positive,
    header,
    parameters_of,
    read_model,
    require,
    write_model,
)
from hmt_ros.body.skeleton import other_side
from hmt_ros.core import elementary, fill_window_inputs, window_middles
from hmt_ros.experts.gates import log_softmax
from hmt_ros.experts.network_experts import Floats, Layers
from hmt_ros.experts.pose_encoding import ray_rotations
from hmt_ros.image.keypoint_schemes import AUTO, landmarks, landmarks_of, position_deviations
from hmt_ros.image.lifted_poses import (
    WHOLE_BODY_CARRIERS,
    LiftedPoses,
    bone_lengths,
    from_positions,
)
from hmt_ros.image.terms.keypoints import (
    ARMS,
    CENTRE,
    EXCHANGED,
    LEGS,
    USUAL_STATURE,
    Keypoints,
)
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.linear_algebra import product
from hmt_ros.inference.mixture import GaussianMixture
from hmt_ros.inference.random_numbers import standard_normals

# Slot times relative to the image of the window, s; maximum offset of an image from its slot, s.
TIMES = np.array([0.0, -0.067, -0.15, -0.3, -0.5, -0.8, 0.067, 0.15, 0.3, 0.5, 0.8])
TIME_TOLERANCES = np.array([0.02, *([0.045, 0.06, 0.09, 0.12, 0.17] * 2)])

_SIDED = ('shoulder', 'elbow', 'wrist', 'hip', 'knee', 'ankle', 'heel', 'toe')
LANDMARKS = (
    'nose',
    'left_ear',
    'right_ear',
    *(f'{side}_{name}' for name in _SIDED for side in ('left', 'right')),
    'neck_base',
    'mid_hip',
    'centre_of_head',
)
# Landmark that replaces each joint centre of other keypoint schemes.
SUBSTITUTES = {
    **{
        f'centre_of_{side}_{name}': f'{side}_{name}'
        for name in ('shoulder', 'hip')
        for side in ('left', 'right')
    },
    'centre_of_pelvis': 'mid_hip',
    'centre_of_neck': 'neck_base',
}
TRUNK = np.array(
    [
        LANDMARKS.index(name)
        for name in ('left_shoulder', 'right_shoulder', 'left_hip', 'right_hip', 'mid_hip')
    ]
)
# Landmarks of body joints, for keypoints that are named after joints.
OF_JOINTS = {'pelvis': 'mid_hip', 'neck': 'neck_base', 'head': 'centre_of_head'}
# Lengths whose proportions are inputs; the rise of the shoulders is excluded.
PROPORTION_LENGTHS = (
    'thigh',
    'shin',
    'foot',
    'upper_arm',
    'forearm',
    'hand',
    'hip_width',
    'hip_drop',
    'shoulder_width',
    'trunk',
    'neck_to_head',
)
# Minimum ratio of a length to the usual length; smaller ratios are clipped.
MIN_LENGTH_RATIO = 0.3
# Maximum number of components of a mixture over exchanges of sides.
MAX_COMPONENTS = 12
# Minimum confidence of a keypoint that is used; minimum number of landmarks of a person.
MIN_CONFIDENCE, MIN_LANDMARKS = 0.02, 5
# Number of inputs of a window.
INPUTS = len(TIMES) * (3 * len(LANDMARKS) + 2) + 5 + len(PROPORTION_LENGTHS) + 1
# Landmark (E, L) that each landmark becomes under each exchange in `terms.keypoints.EXCHANGED`.
_ARM, _LEG = ('shoulder', 'elbow', 'wrist'), ('hip', 'knee', 'ankle', 'heel', 'toe')
_GROUPS = [ARMS if x.endswith(_ARM) else LEGS if x.endswith(_LEG) else CENTRE for x in LANDMARKS]
EXCHANGES = np.where(
    EXCHANGED[:, _GROUPS],
    [LANDMARKS.index(other_side(name)) for name in LANDMARKS],
    np.arange(len(LANDMARKS)),
)


@dataclass(frozen=True, eq=False)
class WindowInputs:
    """Inputs of N windows.

    Attributes:
        values: (N, p) inputs of the experts.
        axes: (N, 3, 3) axes, in rows, of a camera that points at the person; camera frame.
        known: (N,) whether a person is seen in the image of the window.
    """

    values: NDArray[np.float32]
    axes: Array
    known: NDArray[np.bool_]


def log_ratios(usual: Body, lengths: Mapping[str, float]) -> Array:
    """Log ratios (P,) of a person's lengths to the usual lengths.

    Args:
        usual: body with the usual lengths.
        lengths: lengths of the person by name, m.
    """
    own = usual.segment_lengths
    return np.asarray(
        elementary.log(
            [max(lengths[name] / own[name], MIN_LENGTH_RATIO) for name in PROPORTION_LENGTHS]
        )
    )


def relative(usual: Body, logs: Array) -> Array:
    """Subtract from log ratios (..., P) their weighted mean, which is the person's size."""
    weights = np.array([usual.segment_lengths[name] for name in PROPORTION_LENGTHS])
    return np.asarray(logs - product(logs, weights)[..., None] / weights.sum())


def proportions(usual: Body, lengths: Mapping[str, float]) -> Array:
    """Proportions (P,) of a person: log ratios to the usual lengths, minus their weighted mean."""
    return relative(usual, log_ratios(usual, lengths))


def places_of(keypoints: Keypoints, scheme: str = AUTO) -> list[int]:
    """Return the landmark (row of `LANDMARKS`) that each keypoint shows; -1 if none.

    Args:
        keypoints: keypoints of a detector, or keypoints with the joint names of a body.
        scheme: keypoint scheme of the detector; see `keypoint_schemes.scheme_of`.

    Raises:
        ValueError: the scheme is unknown.
    """
    called = keypoints.landmarks
    if called is None:
        marks = landmarks_of(keypoints.names, (), scheme)
        called = tuple('' if mark is None else mark.name for mark in marks)
    result = []
    for name, landmark in zip(keypoints.names, called, strict=True):
        found = landmark or OF_JOINTS.get(name, name)
        found = SUBSTITUTES.get(found, found)
        result.append(LANDMARKS.index(found) if found in LANDMARKS else -1)
    return result


def landmark_offsets(body: Body, names: Sequence[str] = LANDMARKS) -> tuple[list[str], Array]:
    """Return the joint of each of L landmarks, and offsets (L, 3) in the segment's frame, m."""
    size = body.stature / USUAL_STATURE
    marks = [landmarks()[name] for name in names]
    return [mark.joint for mark in marks], size * np.array([mark.offset for mark in marks])


def filled(
    stamps: Array, at: Array, *, causal: bool
) -> tuple[NDArray[np.intp], NDArray[np.bool_], Array]:
    """Select an image for each of the S slots of N windows.

    Args:
        stamps: (T,) times of the images, increasing, s.
        at: (N,) times of the windows, s.
        causal: whether images after the time of a window are left out.

    Returns:
        Indices (N, S) of the images, whether each is near enough (N, S), and their times (N, S)
        relative to the windows, s.
    """
    wanted = at[:, None] + TIMES
    right = np.clip(np.searchsorted(stamps, wanted), 1, max(len(stamps) - 1, 1))
    left = right - 1
    right = np.minimum(right, len(stamps) - 1)
    nearer = np.abs(stamps[right] - wanted) < np.abs(stamps[left] - wanted)
    rows = np.where(nearer, right, left)
    times = stamps[rows] - at[:, None]
    there = np.abs(times - TIMES) <= TIME_TOLERANCES
    if causal:
        there &= times <= 1e-6
    return rows, there, times


def window_inputs(
    rays: Array, confidences: Array, times: Array, ups: Array, persons: Array
) -> WindowInputs:
    """Inputs of N windows of S images with L landmarks.

    Args:
        rays: (N, S, L, 2) x / z and y / z of the rays of the landmarks; arbitrary if the
            confidence is 0.
        confidences: (N, S, L) confidences from 0 (not seen) to 1.
        times: (N, S) times of the images relative to the time of the window, s.
        ups: (N, 3) unit vectors against gravity, camera frame; 0: unknown.
        persons: (N, len(PROPORTION_LENGTHS)) proportions of the persons; 0: unknown.
    """
    rays, confidences, times, ups, persons = (
        np.ascontiguousarray(x, dtype=np.float64) for x in (rays, confidences, times, ups, persons)
    )
    middles = np.empty((len(rays), 3))
    window_middles(rays, confidences, TRUNK, MIN_CONFIDENCE, middles)
    level = roll(ups)
    upright = ray_rotations(product(middles[:, None], level)[:, 0]).transpose(0, 2, 1)
    axes = product(upright, level.transpose(0, 2, 1))
    values = np.empty((len(rays), INPUTS), dtype=np.float32)
    fill_window_inputs(rays, confidences, times, TIMES, ups, persons, axes, MIN_CONFIDENCE, values)
    seen = (confidences[:, 0] >= MIN_CONFIDENCE).sum(1)
    return WindowInputs(values, axes, seen >= MIN_LANDMARKS)


def _exchanged_inputs(order: Index) -> Index:
    """Return the permutation (p,) of the inputs for a permutation (L,) of the landmarks."""
    s, count = len(TIMES), len(LANDMARKS)
    places = np.arange(2 * s * count).reshape(s, count, 2)[:, order].ravel()
    confidences = np.arange(2 * s * count, 3 * s * count).reshape(s, count)[:, order].ravel()
    return np.concatenate([places, confidences, np.arange(3 * s * count, INPUTS)])


EXCHANGED_INPUTS = np.stack([_exchanged_inputs(order) for order in EXCHANGES])

FOLDER = Path(__file__).resolve().parent / 'models'
SHIPPED = 'keypoints'
KIND = 'lifter'

# Earliest time in a window, relative to its image, s; minimum z by which unit rays are divided.
EARLIEST_TIME, MIN_RAY_DEPTH = float((TIMES - TIME_TOLERANCES).min()), 0.1
# Standard deviation above which a keypoint is ignored, m at the person.
USELESS_SIGMA = 0.15


@dataclass(frozen=True, eq=False, kw_only=True)
class Network(Layers):
    """Network with shared layers that gives gates, means and deviations.

    Its K + 6 J K outputs are gates, means and log deviations, in this order.

    Attributes:
        mean, scale: (p,) mean and scale of the inputs.
        middle: (J, 3) constant that is added to the means, m.
    """

    mean: Floats
    scale: Floats
    middle: Floats

    def __call__(self, inputs: Floats) -> tuple[Array, Array, Array]:
        """Log gates (N, K), means (N, K, J, 3) and deviations (N, K, J, 3), m, of inputs (N, p)."""
        out = self.outputs(self.whitened(inputs)).astype(np.float64)
        n, j = len(inputs), len(self.middle)
        k = out.shape[1] // (1 + 6 * j)
        gates, means = out[:, :k], out[:, k : k * (1 + 3 * j)].reshape(n, k, j, 3)
        spreads = out[:, k * (1 + 3 * j) :].reshape(n, k, j, 3)
        deviations = elementary.exp(np.clip(spreads + USUAL_LOG_SIGMA, *LOG_SIGMA_LIMITS))
        return log_softmax(gates), MEAN_SCALE * means + self.middle, deviations

    def whitened(self, inputs: Floats) -> Floats:
        """Return inputs (N, p) with zero mean and unit scale, for the layers."""
        return np.asarray((inputs - self.mean) / self.scale)


# Scale of the means, m; log of the usual deviation, and limits of log deviations, log m.
MEAN_SCALE, USUAL_LOG_SIGMA, LOG_SIGMA_LIMITS = 0.3, -2.5, (-5.0, 1.0)


class Lifter:
    """Predicts mixtures over whole poses from windows of keypoints.

    Args:
        usual: body with the usual lengths, including all `joints`.
        notes: card of the file, serialisable as JSON.
    """

    def __init__(
        self,
        network: Network,
        joints: Sequence[str],
        usual: Body,
        notes: dict[str, Any] | None = None,
    ) -> None:
        self.network, self.joints, self.usual = network, tuple(joints), usual
        self.lengths = bone_lengths(usual.skeleton, self.joints)
        self.notes = dict(notes or {})

    def proportions(self, body: Body) -> Array | None:
        """Return a person's proportions for a window, or None if the body lacks some lengths."""
        lengths = body.segment_lengths
        known = lengths.keys() >= {*PROPORTION_LENGTHS}
        return proportions(self.usual, lengths) if known else None

    def lift(
        self,
        stamps: Array,
        rays: Array,
        confidences: Array,
        at: Array,
        ups: Array | None = None,
        person: Array | None = None,
        *,
        causal: bool,
        exchanges: Array | None = None,
    ) -> list[LiftedPoses | None]:
        """Predict the mixtures at N times; None if no person is seen.

        With `exchanges` the result is sum_e P(e) p(y | r with the sides exchanged by e). If a
        detector exchanges the sides, the person seems to face the other way, and the keypoints
        alone cannot show the error.

        Args:
            stamps: (T,) times of the images, increasing, s.
            rays, confidences: (T, L, 2) and (T, L), see `landmark_rays`.
            at: (N,) times of the estimates, s.
            ups: (N, 3) unit vectors against gravity, camera frame; None: unknown.
            person: proportions of the person; None: unknown.
            causal: whether each estimate ignores later images.
            exchanges: (E,) probabilities of `EXCHANGES`; the `MAX_COMPONENTS` heaviest components
                are kept. None: the sides of the keypoints are correct.
        """
        rows, there, times = filled(stamps, at, causal=causal)
        n = len(at)
        inputs = window_inputs(
            rays[rows],
            confidences[rows] * there[..., None],
            times,
            np.zeros((n, 3)) if ups is None else ups,
            np.zeros((n, len(PROPORTION_LENGTHS))) if person is None else np.tile(person, (n, 1)),
        )
        result: list[LiftedPoses | None] = [None] * n
        seen = np.flatnonzero(inputs.known)
        if len(seen):
            found = self._components(inputs.values[seen], exchanges)
            for row, gates, means, deviations in zip(seen, *found, strict=True):
                result[row] = LiftedPoses(
                    self.joints, gates, means, deviations, inputs.axes[row], self.lengths
                )
        return result

    def _components(self, inputs: Floats, exchanges: Array | None) -> tuple[Array, Array, Array]:
        """Log weights (N, C), means and deviations (N, C, J, 3) for inputs (N, p)."""
        if exchanges is None:
            return self.network(inputs)
        n = len(inputs)
        found = self.network(inputs[:, EXCHANGED_INPUTS].reshape(-1, INPUTS))
        gates, means, deviations = (x.reshape(n, -1, *x.shape[2:]) for x in found)
        gates = gates + np.repeat(elementary.log(exchanges), gates.shape[1] // len(exchanges))
        kept = np.arange(n)[:, None], np.argsort(-gates, axis=1, kind='stable')[:, :MAX_COMPONENTS]
        return log_softmax(gates[kept]), means[kept], deviations[kept]

    def to_arrays(self) -> Arrays:
        """Return the arrays of a file; the weights of the network have half precision."""
        parameters = {
            'joints': list(self.joints),
            'landmarks': list(LANDMARKS),
            'times': TIMES.tolist(),
            'body': self.usual.name,
        }
        return header(KIND, parameters) | self.network.to_arrays()

    @classmethod
    def from_arrays(cls, arrays: Arrays) -> Lifter:
        """Build the lifter that `to_arrays` and a card describe.

        Raises:
            ValueError, LookupError, TypeError: arrays or parameters are missing or invalid.
        """
        parameters, card = parameters_of(arrays), parameters_of(arrays, 'card')
        windows = parameters['landmarks'], parameters['times']
        require(windows == (list(LANDMARKS), TIMES.tolist()), 'it has learned other windows')
        joints = tuple(map(str, parameters['joints']))
        whole = len({*joints}) == len(joints) and {*joints} >= WHOLE_BODY_CARRIERS
        require(whole, 'its joints are not those of a whole pose')
        network = Network.from_arrays(arrays, INPUTS)
        sizes = network.mean.shape, network.scale.shape
        require(sizes == ((INPUTS,), (INPUTS,)), f'mean and scale are not those of {INPUTS} inputs')
        check_positive('scale', network.scale)
        return cls(network, joints, body_of(parameters), card)

    def answer(self, given: Array) -> GaussianMixture:
        """Return the mixture over joints, (3 J,), for the inputs (p,) of a window."""
        gates, means, deviations = (x[0] for x in self.network(given[None].astype(np.float32)))
        spread = deviations.reshape(len(gates), -1, 1) ** 2 * np.eye(3 * len(self.joints))
        return GaussianMixture(elementary.exp(gates), means.reshape(len(gates), -1), spread)

    def save(self, path: str | Path) -> Path:
        """Write the lifter to an .npz file, with its notes as the card, and return its path."""
        drawn = standard_normals(np.random.default_rng(0), (INPUTS,))
        example = self.network.mean + self.network.scale * drawn
        return write_model(path, self, self.from_arrays, self.notes, example)

    @classmethod
    def load(cls, path: str | Path) -> Lifter:
        """Reads a lifter that `save` wrote.

        Raises:
            FileNotFoundError: the file does not exist.
            ValueError: the file is not a lifter, has an unsupported version, or is invalid.
        """
        return read_model(path, KIND, cls.from_arrays)


def load_lifter(model: str = SHIPPED) -> Lifter:
    """Load the shipped lifter by its name, or a lifter from a file.

    Raises:
        FileNotFoundError: the argument is neither the shipped name nor an existing file.
        ValueError: the file is not a lifter, or has an unsupported version.
    """
    path = FOLDER / f'{SHIPPED}.npz' if model == SHIPPED else Path(model)
    return _loaded(path, path.stat().st_mtime_ns)


# Cached, because each track loads the lifter.
@lru_cache(maxsize=4)
def _loaded(path: Path, _changed_ns: int) -> Lifter:
    return Lifter.load(path)


class KeypointHistory:
    """The keypoints of one person in the last images, as input to a lifter."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        # Stamp, rays and confidences of each image.
        self._seen: list[tuple[float, Array, Array]] = []

    def add(self, keypoints: Keypoints, stamp: float) -> tuple[Array, Array]:
        """Add the keypoints of the next image and return their `landmark_rays`.

        Args:
            stamp: time of the image, s; later than all previous times.
        """
        rays, confidences = landmark_rays(self._camera, keypoints)
        recent = [one for one in self._seen if one[0] >= stamp + EARLIEST_TIME]
        self._seen = [*recent, (stamp, rays, confidences)]
        return rays, confidences

    def carry(self, rotation: Array) -> None:
        """Rotate the history by `rotation` (3, 3) into the frame of a camera that has turned."""
        for i, (stamp, rays, confidences) in enumerate(self._seen):
            turned = product(np.concatenate([rays, np.ones((len(rays), 1))], axis=1), rotation.T)
            turned = turned[:, :2] / np.maximum(turned[:, 2:], MIN_RAY_DEPTH)
            self._seen[i] = stamp, turned, confidences

    def lift(
        self,
        lifter: Lifter,
        up: Array | None = None,
        person: Array | None = None,
        exchanges: Array | None = None,
    ) -> LiftedPoses | None:
        """Predict the mixture at the last image; None if no person is seen.

        Args:
            up: (3,) unit vector against gravity, camera frame; None: unknown.
            person: proportions of the person; None: unknown.
            exchanges: see `Lifter.lift`.
        """
        stamps, rays, confidences = (np.array(x) for x in zip(*self._seen, strict=True))
        ups = None if up is None else np.asarray(up)[None]
        (found,) = lifter.lift(
            stamps, rays, confidences, stamps[-1:], ups, person, causal=True, exchanges=exchanges
        )
        return found


def landmark_rays(camera: Camera, keypoints: Keypoints, scheme: str = AUTO) -> tuple[Array, Array]:
    """Return rays (L, 2), x / z and y / z, and confidences (L,) of the landmarks of keypoints."""
    rays, confidences = np.zeros((len(LANDMARKS), 2)), np.zeros(len(LANDMARKS))
    places = np.array(places_of(keypoints, scheme), dtype=np.intp)
    shown = np.flatnonzero(keypoints.seen & (places >= 0))
    if len(shown):
        found = camera.rays(keypoints.pixels[shown])
        rays[places[shown]] = found[:, :2] / np.maximum(found[:, 2:], MIN_RAY_DEPTH)
        # A keypoint with a large covariance carries no information, whatever its confidence.
        sigma = np.sqrt(0.5 * np.trace(keypoints.covariances[shown], axis1=1, axis2=2))
        known = ~(sigma > USELESS_SIGMA * keypoints.magnification())
        confidences[places[shown]] = np.where(known, keypoints.confidences[shown], 0.0)
    return rays, confidences


def lifted_positions(camera: Camera, keypoints: Keypoints) -> LiftedPoses | None:
    """Return the 3D pose that a detector estimates; None if the detector lacks the hips."""
    assert keypoints.positions is not None
    seen = keypoints.seen
    if not seen.any():
        return None
    ray = camera.rays(keypoints.pixels[seen].mean(0, keepdims=True))
    axes = ray_rotations(ray)[0].T
    deviations = position_deviations(keypoints.scheme)
    return from_positions(keypoints.names, keypoints.positions, axes, deviations, seen)
