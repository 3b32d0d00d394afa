"""Experts that know depth: a mixture of poses from a window of keypoints (BME 2, other inputs).

    p(y | r) = sum_i g_i(r) N(y; f_i(r), diag s_i(r)^2)

y are the joints of a person of usual lengths, from the middle of the hips, along the axes of a
camera that looks at the person; r is a window of keypoints (`keypoint_windows`). Gates g, means f
and deviations s are one network with shared layers [Bishop 1994], learned from motion capture seen
by cameras and a detector that errs as real ones do (`keypoint_training`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.model_file import load_body
from hmt_ros.experts.keypoint_windows import (
    LANDMARKS,
    NEAR,
    PROPORTIONED,
    TIMES,
    filled,
    places_of,
    proportions,
    window_inputs,
)
from hmt_ros.experts.model_file import (
    FAULTS,
    check_header,
    damaged,
    header,
    parameters_of,
    read_arrays,
    write_arrays,
)
from hmt_ros.experts.network_learning import Floats, Layers
from hmt_ros.experts.pose_encoding import ray_rotations
from hmt_ros.image.keypoint_schemes import AUTO, position_deviations
from hmt_ros.image.lifted_poses import LiftedPoses, bone_lengths, from_positions
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference.arrays import Array

FOLDER = Path(__file__).resolve().parent / 'models'
SHIPPED = 'keypoints'
KIND = 'lifter'

# Earliest time of a window, s. Least z of a ray: one from beside the camera says little.
EARLIEST, BEFORE = float((TIMES - NEAR).min()), 0.1
# Standard deviation with which a keypoint is not looked at, m at the person.
ANYWHERE = 0.15


@dataclass(frozen=True, eq=False, kw_only=True)
class Network(Layers):
    """What gates, means and deviations share.

    The numbers after the layers are those of K + 6 J K: gates, means and log deviations.

    Attributes:
        mean, scale: (p,) of the inputs.
        middle: (J, 3) what means are relative to, m.
    """

    mean: Floats
    scale: Floats
    middle: Floats

    @property
    def experts(self) -> int:
        """Number of experts, K."""
        return int(self.last.shape[1]) // (1 + 6 * len(self.middle))

    def __call__(self, inputs: Floats) -> tuple[Array, Array, Array]:
        """Log gates (N, K), means (N, K, J, 3) and deviations (N, K, J, 3), m, of inputs (N, p)."""
        whitened: Floats = (inputs - self.mean) / self.scale
        out = self.outputs(whitened).astype(np.float64)
        n, k, j = len(inputs), self.experts, len(self.middle)
        gates, means = out[:, :k], out[:, k : k * (1 + 3 * j)].reshape(n, k, j, 3)
        spreads = out[:, k * (1 + 3 * j) :].reshape(n, k, j, 3)
        gates = gates - gates.max(1, keepdims=True)
        gates = gates - np.log(np.exp(gates).sum(1, keepdims=True))
        return gates, MEANS * means + self.middle, np.exp(np.clip(spreads + SPREAD, *SPREADS))


# Scale of the means, m; log of the usual deviation, and its limits, log m.
MEANS, SPREAD, SPREADS = 0.3, -2.5, (-5.0, 1.0)


class Lifter:
    """Predicts mixtures over whole poses from windows of keypoints.

    Args:
        joints: (J,) names of the joints of its poses.
        usual: body with the usual lengths, whose joints they are.
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
        """What a window takes in of a person's lengths; None: the body lacks some of them."""
        lengths = body.segment_lengths
        known = lengths.keys() >= {*PROPORTIONED}
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
    ) -> list[LiftedPoses | None]:
        """The mixtures at N times; None where nobody is seen.

        Args:
            stamps: (T,) times of the images, increasing, s.
            rays, confidences: (T, L, 2), (T, L) of the landmarks, see `landmark_rays`.
            at: (N,) times of images, s.
            ups: (N, 3) unit vectors against gravity, camera frame; None: unknown.
            person: proportions of the person; None: unknown.
            causal: whether images after those times do not count.
        """
        rows, there, times = filled(stamps, at, causal=causal)
        n = len(at)
        inputs = window_inputs(
            rays[rows], confidences[rows] * there[..., None], times,
            np.zeros((n, 3)) if ups is None else ups,
            np.zeros((n, len(PROPORTIONED))) if person is None else np.tile(person, (n, 1)),
        )  # fmt: skip
        result: list[LiftedPoses | None] = [None] * n
        seen = np.flatnonzero(inputs.known)
        if len(seen):
            gates, means, deviations = self.network(inputs.values[seen])
            for i, row in enumerate(seen):
                result[row] = LiftedPoses(
                    self.joints, gates[i], means[i], deviations[i], inputs.axes[row], self.lengths
                )
        return result

    def save(self, path: str | Path) -> Path:
        """Writes the lifter into an .npz file, with half precision, and returns its path."""
        parameters = {
            'joints': list(self.joints), 'landmarks': list(LANDMARKS), 'times': TIMES.tolist(),
            'body': self.usual.name, 'notes': self.notes,
        }  # fmt: skip
        return write_arrays(path, header(KIND, parameters) | self.network.to_arrays())

    @classmethod
    def load(cls, path: str | Path) -> Lifter:
        """Reads a lifter that `save` wrote.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: the file is no lifter, or one of another version.
        """
        arrays = read_arrays(path, KIND)
        check_header(arrays, KIND, str(path))
        try:
            parameters = parameters_of(arrays)
            if parameters['landmarks'] != list(LANDMARKS) or parameters['times'] != TIMES.tolist():
                raise ValueError(f'{path}: learned for other windows: train it anew')
            network = Network.from_arrays(arrays)
            usual = load_body(parameters['body'])
            made = cls(network, parameters['joints'], usual, parameters['notes'])
            network(np.zeros((1, len(network.mean)), dtype=np.float32))
        except FAULTS as fault:
            raise damaged(str(path), fault) from fault
        return made


def load_lifter(model: str = SHIPPED) -> Lifter:
    """The lifter that ships, by its name, or one from a file.

    Raises:
        FileNotFoundError: it is not the name, and there is no such file.
        ValueError: the file is no lifter, or one of another version.
    """
    path = FOLDER / f'{SHIPPED}.npz' if model == SHIPPED else Path(model)
    return _loaded(path, path.stat().st_mtime_ns)


# Every track of several people takes one.
@lru_cache(maxsize=4)
def _loaded(path: Path, _changed_ns: int) -> Lifter:
    return Lifter.load(path)


class KeypointHistory:
    """The keypoints of one person in the last images, from which a lifter sees a window."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._stamps: list[float] = []
        self._rays: list[Array] = []
        self._confidences: list[Array] = []

    def add(self, keypoints: Keypoints, stamp: float) -> tuple[Array, Array]:
        """Takes the keypoints of the next image; returns their `landmark_rays`.

        Args:
            stamp: of the image, s; later than those before.
        """
        rays, confidences = landmark_rays(self._camera, keypoints)
        while self._stamps and self._stamps[0] < stamp + EARLIEST:
            for values in (self._stamps, self._rays, self._confidences):
                values.pop(0)
        self._stamps.append(stamp)
        self._rays.append(rays)
        self._confidences.append(confidences)
        return rays, confidences

    def carry(self, rotation: Array) -> None:
        """Takes what is known into the frame (rotation (3, 3)) of a camera that has turned."""
        for i, rays in enumerate(self._rays):
            turned = np.concatenate([rays, np.ones((len(rays), 1))], axis=1) @ rotation.T
            self._rays[i] = turned[:, :2] / np.maximum(turned[:, 2:], BEFORE)

    def lift(
        self, lifter: Lifter, up: Array | None = None, person: Array | None = None
    ) -> LiftedPoses | None:
        """The mixture at the last image; None: nobody is seen.

        Args:
            up: (3,) unit vector against gravity, camera frame; None: unknown.
            person: proportions of the person; None: unknown.
        """
        stamps, ups = np.array(self._stamps), None if up is None else np.asarray(up)[None]
        seen = np.array(self._rays), np.array(self._confidences)
        return lifter.lift(stamps, *seen, stamps[-1:], ups, person, causal=True)[0]


def landmark_rays(camera: Camera, keypoints: Keypoints, scheme: str = AUTO) -> tuple[Array, Array]:
    """Rays (L, 2), x / z and y / z, and confidences (L,) of the landmarks that keypoints show."""
    rays, confidences = np.zeros((len(LANDMARKS), 2)), np.zeros(len(LANDMARKS))
    places = np.array(places_of(keypoints, scheme), dtype=np.intp)
    shown = np.flatnonzero(keypoints.seen & (places >= 0))
    if len(shown):
        found = camera.rays(keypoints.pixels[shown])
        rays[places[shown]] = found[:, :2] / np.maximum(found[:, 2:], BEFORE)
        # A keypoint that may be anywhere says nothing, however confident it is.
        sigma = np.sqrt(0.5 * np.trace(keypoints.covariances[shown], axis1=1, axis2=2))
        known = ~(sigma > ANYWHERE * keypoints.magnification())
        confidences[places[shown]] = np.where(known, keypoints.confidences[shown], 0.0)
    return rays, confidences


def lifted_positions(camera: Camera, keypoints: Keypoints) -> LiftedPoses | None:
    """The one pose that a detector which lifts guesses; None: it shows no hips."""
    assert keypoints.positions is not None
    seen = keypoints.seen
    if not seen.any():
        return None
    ray = camera.rays(keypoints.pixels[seen].mean(0, keepdims=True))
    axes = ray_rotations(ray)[0].T
    deviations = position_deviations(keypoints.scheme)
    return from_positions(keypoints.names, keypoints.positions, axes, deviations)
