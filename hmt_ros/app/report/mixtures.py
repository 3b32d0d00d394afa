"""The mixtures in a bag as joint positions over time, for the report."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
from scipy.special import ndtr

from hmt_ros.app.evaluate import chosen_topics
from hmt_ros.app.recorded_bodies import RecordedBodies, topic_beside
from hmt_ros.body import Body
from hmt_ros.inference.arrays import Array
from msg_tools import BagMessage, BagReader
from msg_tools.messages.ground import GroundState
from msg_tools.messages.headers import time_ns
from msg_tools.messages.keep_out import KEEP_OUT, KeepOutState
from msg_tools.messages.pose_mixtures import POSE_MIXTURE, PoseMixture, pose_mixture_of
from msg_tools.messages.trajectory_mixtures import trajectory_mixture_of

# Probabilities of the lower end, the median and the upper end of a 90 % interval.
PROBABILITIES = np.array([0.05, 0.5, 0.95])
# Horizontal plane through a level camera, used if the floor is unknown.
_LEVEL_PLANE = np.array([0.0, -1.0, 0.0, 0.0])
_BISECTION_STEPS = 22
# Radius of the 90 % region of a 3D normal distribution, in standard deviations.
_RADIUS = 2.500278

# Joints whose paths are drawn for trajectories, and maximum number of drawn trajectories.
PATH_JOINTS = ('pelvis', 'head', 'left_wrist', 'right_wrist', 'left_ankle', 'right_ankle')
MAX_TRAJECTORIES = 8
# Kinds of mixtures that are shown with regions, and with heights and angles over time.
KINDS_WITH_BANDS = ('posterior', 'smoothed')
_TRAJECTORIES = 'trajectories'
_ORDER = (
    'posterior',
    'smoothed',
    'forecast',
    'likelihood',
    'prediction',
    'ground_truth',
    _TRAJECTORIES,
)


def angles_of(body: Body | None) -> tuple[str, ...]:
    """Names of the angles of a body; empty if the body is unknown."""
    if body is None:
        return ()
    return tuple(body.dof_names[i] for i in np.flatnonzero(body.skeleton.dof_is_rotation))


def ground_at(grounds: Mapping[int, GroundState], stamp_ns: int) -> GroundState | None:
    """The ground at a time, or else the first known ground; None if missing."""
    return grounds.get(stamp_ns) or next(iter(grounds.values()), None)


def _plane_of(ground: GroundState | None) -> Array:
    """The floor (4,), or else a horizontal plane through a level camera."""
    plane = None if ground is None else ground.plane
    return _LEVEL_PLANE if plane is None else plane


def heights_of(joints: Array, ground: GroundState | None) -> Array:
    """Heights (...,) of positions (..., 3): above the floor, or above a level camera, m."""
    plane = _plane_of(ground)
    return np.asarray(joints @ plane[:3] + plane[3], dtype=np.float64)


def marginals_of(content: PoseMixture, body: Body | None, ground: GroundState | None) -> Array:
    """Marginals of each component over joint heights, m, and angles, degrees.

    Returns:
        (2, K, J + A) means and standard deviations; (2, K, 0) if covariances are unknown.
    """
    covariances, spread = content.covariances, content.joint_covariances
    if covariances is None or spread is None:
        return np.empty((2, len(content.weights), 0))
    up = _plane_of(ground)[:3]
    sigmas = np.sqrt(np.einsum('i,kjil,l->kj', up, spread, up))
    result = [np.stack([heights_of(content.joint_positions, ground), sigmas])]
    if body is not None:
        turns = body.skeleton.dof_is_rotation
        angles = content.means[:, turns]
        near = angles[np.argmax(content.weights)]
        angles = angles - 2.0 * np.pi * np.round((angles - near) / (2.0 * np.pi))
        sigmas = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2)[:, turns])
        result.append(np.degrees(np.stack([angles, sigmas])))
    return np.concatenate(result, axis=-1)


def regions_of(content: PoseMixture) -> Array:
    """Ellipsoids that contain each joint with 90 % probability, relative to the pelvis.

    Returns:
        (K, J, 6) entries xx, yy, zz, xy, xz, yz of the symmetric matrix, m, that maps the unit ball
        to the ellipsoid around the joint; (K, 0, 6) if covariances are unknown.
    """
    spread = content.joint_covariances_relative
    if spread is None:
        return np.empty((len(content.weights), 0, 6))
    squares, axes = np.linalg.eigh(spread)
    roots = (axes * _RADIUS * np.sqrt(np.maximum(squares, 0.0))[..., None, :]) @ axes.swapaxes(
        -1, -2
    )
    return np.asarray(roots[..., [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]], dtype=np.float64)


def intervals(weights: Array, marginals: Array) -> Array:
    """Quantiles (V, 3) of mixtures of normal distributions at `PROBABILITIES`.

    Args:
        weights: (K,) weights that sum to 1.
        marginals: (2, K, V) means and positive standard deviations.
    """
    means, sigmas = np.asarray(marginals, dtype=np.float64)[..., None]
    low = np.broadcast_to((means - 6.0 * sigmas).min(axis=0), (*means.shape[1:2], 3)).copy()
    high = np.broadcast_to((means + 6.0 * sigmas).max(axis=0), low.shape).copy()
    for _ in range(_BISECTION_STEPS):
        middle = 0.5 * (low + high)
        below = np.einsum('k,kvp->vp', weights, ndtr((middle - means) / sigmas)) < PROBABILITIES
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return np.asarray(0.5 * (low + high), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Moment:
    """A mixture over poses.

    Attributes:
        stamp_ns: time of the poses.
        weights: (K,) weights, heaviest first.
        joints: (K, J, 3) joint positions, camera optical frame, m.
        existence: probability that a person is in view; NaN if unknown.
        cues: probability that each image cue shows the person, by name; empty if unknown.
        identities: (K,) identities of the modes; 0 if missing.
        marginals: (2, K, J + A) heights and angles, see `marginals_of`; (2, K, 0) if unknown.
        regions: (K, J, 6) regions of the joints, see `regions_of`; (K, 0, 6) if unknown.
    """

    stamp_ns: int
    weights: Array
    joints: Array
    existence: float = math.nan
    cues: Mapping[str, float] = field(default_factory=dict)
    identities: Array = field(default_factory=lambda: np.empty(0))
    marginals: Array = field(default_factory=lambda: np.empty((2, 0, 0)))
    regions: Array = field(default_factory=lambda: np.empty((0, 0, 6)))


@dataclass(frozen=True, eq=False)
class Window:
    """A mixture over trajectories.

    Attributes:
        stamp_ns: time of the end of the window.
        stamps_ns: (T,) times of the poses.
        weights: (M,) weights of all trajectories, heaviest first.
        free_energy: (I,) free energy per iteration, nats; empty if not recorded.
        joint_paths: (at most `MAX_TRAJECTORIES`, T, J, 3) paths of the joints in `PATH_JOINTS` that
            the body has, m, heaviest trajectory first; None if the body is unknown.
    """

    stamp_ns: int
    stamps_ns: tuple[int, ...]
    weights: Array
    free_energy: Array
    joint_paths: Array | None


Mixture = TypeVar('Mixture', Moment, Window)


@dataclass(frozen=True, eq=False)
class Layer(Generic[Mixture]):
    """The mixtures on one topic.

    Attributes:
        topic: name of the topic.
        kind: kind of the mixtures, e.g. 'posterior', or 'trajectories'.
        frame_id: frame of the positions.
        joint_names: (J,) names of the joints.
        mixtures: mixtures by stamp in ns, in temporal order.
        angles: (A,) names of the angles of the body; empty if the body is unknown.
    """

    topic: str
    kind: str
    frame_id: str
    joint_names: tuple[str, ...]
    mixtures: dict[int, Mixture]
    angles: tuple[str, ...] = ()

    def at(self, stamps: Collection[int]) -> Layer[Mixture]:
        """Copy with only the mixtures at the given stamps."""
        chosen = {stamp: one for stamp, one in self.mixtures.items() if stamp in stamps}
        return replace(self, mixtures=chosen)

    def spread(self, count: int) -> list[int]:
        """At most `count` stamps, spread evenly over all mixtures."""
        last = len(self.mixtures) - 1
        chosen = np.unique(np.rint((np.arange(count) + 0.5) / count * last).astype(int))
        stamps = list(self.mixtures)
        return [stamps[i] for i in chosen]


@dataclass(frozen=True, eq=False)
class RecordedMixtures:
    """The mixtures in a bag.

    Attributes:
        layers: mixtures over poses, the posterior first.
        trajectories: mixtures over trajectories.
        answered: reason why an image has no pose, by stamp, ns; '' if it has a pose.
    """

    layers: list[Layer[Moment]]
    trajectories: list[Layer[Window]]
    answered: Mapping[int, str] = field(default_factory=dict)

    @property
    def stamps(self) -> list[int]:
        """Sorted stamps of images, poses and window ends; without poses, all stamps of windows."""
        stamps = {*self.answered, *(stamp for layer in self.layers for stamp in layer.mixtures)}
        for layer in self.trajectories:
            stamps.update(layer.mixtures)
            if not self.layers:
                stamps.update(stamp for one in layer.mixtures.values() for stamp in one.stamps_ns)
        return sorted(stamps)

    @property
    def empty(self) -> set[int]:
        """Stamps of the images, ns, in which nobody is seen."""
        windows = (one.stamps_ns for layer in self.trajectories for one in layer.mixtures.values())
        return set(self.answered).difference(*(layer.mixtures for layer in self.layers), *windows)

    def at(self, stamps: Iterable[int]) -> RecordedMixtures:
        """Copy with only the given stamps; topics without a window at any of them keep the last."""
        wanted = set(stamps)
        layers = [layer.at(wanted) for layer in self.layers]
        return RecordedMixtures(
            [layer for layer in layers if layer.mixtures],
            [
                layer.at(wanted if wanted & layer.mixtures.keys() else {max(layer.mixtures)})
                for layer in self.trajectories
            ],
            {stamp: text for stamp, text in self.answered.items() if stamp in wanted},
        )


def read_mixtures(
    path: Path,
    *,
    topics: Sequence[str] = (),
    body_model: str | None = None,
    grounds: Mapping[int, GroundState] | None = None,
    progress: Callable[[int], object] = lambda count: None,
) -> RecordedMixtures:
    """Reads the mixtures in a bag; the first mixture of each topic and stamp is used.

    Args:
        path: path of the bag.
        topics: names of the topics to read; empty selects all mixtures except ground truth.
        body_model: name or file of the body model, which replaces the name in the bag.
        grounds: ground by stamp, from which heights are computed.
        progress: called with the number of messages that were read.

    Raises:
        ValueError: no mixtures, invalid messages, or several coordinate frames.
    """
    found: dict[str, Layer[Any]] = {}
    with BagReader(path) as bag:
        names = chosen_topics(bag, topics)
        every = bag.messages(filter(None, [topic_beside(bag, KEEP_OUT, names[0])]))
        told = (x.message for x in every if x.message.state != KeepOutState.STALE)
        answered = {time_ns(x.header.stamp): str(x.reason) for x in told}
        bodies = RecordedBodies(body_model)
        for stored in bodies.messages(bag, names, progress):
            _take(found, stored, bodies, grounds or {})
            if stored.msgtype == POSE_MIXTURE:
                answered.setdefault(time_ns(stored.message.header.stamp), '')
    for name, layer in found.items():
        found[name] = replace(layer, mixtures=dict(sorted(layer.mixtures.items())))
    layers = [found[name] for name in names if name in found]
    layers.sort(key=lambda layer: _ORDER.index(layer.kind))
    poses = [layer for layer in layers if layer.kind != _TRAJECTORIES]
    result = RecordedMixtures(poses, layers[len(poses) :], answered)
    if not result.stamps:
        raise ValueError(f'{path}: nobody is seen in any mixture on {", ".join(names)}')
    for first, layer in pairwise(layers):
        if layer.frame_id != first.frame_id:
            raise ValueError(
                f'{path}: {layer.topic} is in the frame {layer.frame_id!r}, {first.topic} in '
                f'{first.frame_id!r}: name those of one camera with --topic'
            )
    return result


def _take(
    found: dict[str, Layer[Any]],
    stored: BagMessage,
    bodies: RecordedBodies,
    grounds: Mapping[int, GroundState],
) -> None:
    """Adds a message to the layer of its topic."""
    read: Callable[[Any], Layer[Any] | None] = partial(_trajectory_layer, stored.topic, bodies)
    if stored.msgtype == POSE_MIXTURE:
        read = partial(_pose_layer, stored.topic, bodies, grounds)
    new = stored.content(read)
    if new is None:
        return
    known = found.setdefault(stored.topic, new)
    pairs: tuple[tuple[str, object, object], ...] = (
        ('kind', known.kind, new.kind),
        ('frame', known.frame_id, new.frame_id),
        ('joints', known.joint_names, new.joint_names),
    )
    for what, was, seen in pairs:
        if was != seen:
            raise ValueError(
                f'{stored.topic} at {stored.log_time_ns} ns: mixture has the {what} {seen!r}, '
                f'before it was {was!r}'
            )
    for stamp, mixture in new.mixtures.items():
        known.mixtures.setdefault(stamp, mixture)


def _pose_layer(
    topic: str, bodies: RecordedBodies, grounds: Mapping[int, GroundState], message: Any
) -> Layer[Moment] | None:
    """A layer with the mixture of one message; None if nobody was seen."""
    content = pose_mixture_of(message)
    if not len(content.weights):
        return None
    assert content.identities is not None
    order = np.argsort(-content.weights, kind='stable')
    stamp, kind = content.stamp_ns, content.kind.name.lower()
    body, marginals = None, np.empty((2, len(order), 0))
    regions = np.empty((len(order), 0, 6))
    if kind in KINDS_WITH_BANDS:
        body = bodies.of(topic, content)
        marginals = marginals_of(content, body, ground_at(grounds, stamp))
        regions = regions_of(content)
    moment = Moment(
        stamp,
        content.weights[order],
        content.joint_positions[order],
        content.existence_probability,
        content.cue_probabilities,
        content.identities[order].astype(np.float64),
        marginals[:, order].astype(np.float32),
        regions[order].astype(np.float32),
    )
    names = content.joint_names
    return Layer(topic, kind, content.frame_id, names, {stamp: moment}, angles_of(body))


def _trajectory_layer(topic: str, bodies: RecordedBodies, message: Any) -> Layer[Window]:
    """A layer with the window of one message."""
    content = trajectory_mixture_of(message)
    body = bodies.of(topic, content)
    ends = () if body is None else tuple(x for x in PATH_JOINTS if x in body.joint_names)
    order = np.argsort(-content.weights, kind='stable')
    joint_paths = None
    if body is not None:
        means = content.means[order[:MAX_TRAJECTORIES]]
        joints = body.joint_positions(means.reshape(-1, body.dimension))
        joint_paths = joints[:, body.skeleton.joint_index(ends)]
        joint_paths = joint_paths.reshape(*means.shape[:2], len(ends), 3)
    stamp = content.stamps_ns[-1]
    window = Window(
        stamp, content.stamps_ns, content.weights[order], content.free_energy, joint_paths
    )
    return Layer(topic, _TRAJECTORIES, content.frame_id, ends, {stamp: window})
