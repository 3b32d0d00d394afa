"""hmt_msgs/PoseMixture: a mixture over the pose of a body, as arrays.

`pose_mixture_of` is the only reader of the message, and `pose_mixture_message` the only writer.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body import Body
from hmt_ros.body.mirror import relevelled
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.linear_algebra import product
from msg_tools.messages.headers import header_message, time_message, time_ns
from msg_tools.messages.message_error import (
    Array,
    MessageError,
    array_of_all,
    array_of_each,
    check_covariances,
    check_finite,
    check_names,
    check_once,
    check_weights,
    complete_mixture,
    constant_of,
    flat,
    freeze_arrays,
    identities_of,
    lengths_of,
    named_numbers,
    names_of,
    numbers,
)
from msg_tools.messages.message_types import MessageFactory

POSE_MIXTURE = 'hmt_msgs/msg/PoseMixture'
# Maximum number of components; a message with millions would block its reader.
MAX_COMPONENTS = 1024
# Optional fields of `PoseMixture`: arrays of likelihoods, and arrays of joints.
LIKELIHOOD_ARRAYS = ('shape_covariance', 'posterior_weights', 'ancestry')
JOINT_ARRAYS = ('joint_covariances', 'joint_covariances_relative', 'joint_velocities')


class MixtureKind(IntEnum):
    """Kind of density that a mixture represents; values as in PoseMixture.msg."""

    POSTERIOR = 0
    LIKELIHOOD = 1
    PREDICTION = 2
    SMOOTHED = 3
    GROUND_TRUTH = 4
    FORECAST = 5


class TrackState(IntEnum):
    """Tracking state of a person; values as in PoseMixture.msg."""

    UNKNOWN = 0
    TRACKING = 1
    LOST = 2
    NOBODY = 3


@dataclass(frozen=True, eq=False)
class PoseMixture:
    """Content of a PoseMixture message: K components over d degrees of freedom.

    Attributes:
        weights: (K,) weights that sum to 1; K = 0 if nobody was seen.
        means: (K, d) poses, m and rad.
        covariances: (K, d, d) covariances, positive definite; None if unknown.
        body_model: name of the body model.
        dof_names: (d,) names of the degrees of freedom, in order.
        joint_names: (J,) names of the joints, in order.
        joint_positions: (K, J, 3) joint positions at the means, m, in the frame of the header.
        kind: see `MixtureKind`.
        stamp_ns: stamp of the image.
        frame_id: optical frame of the camera.
        segment_lengths: segment lengths by name, m, which replace the lengths in the body model.
            Empty if unknown, as in messages of other publishers; the lengths are then from the Body
            topic, or else from the body model.
        log_likelihoods: (K,) log p(image | mean) up to a constant; NaN or None if unknown.
        degrees_of_freedom: (K,) degrees of freedom of Student components; 0 for a Gaussian
            component, None if all are Gaussian.
        state: state of the track, see `TrackState`.
        track_id: number of the track, from 1; 0 if the mixture belongs to no track.
        identities: (K,) identities of the components, from 1, constant over the images of a track;
            0 for no identity, None if all are 0.
        joint_covariances: (K, J, 3, 3) covariances of the joint positions, m^2; None if unknown.
        joint_covariances_relative: (K, J, 3, 3) covariances of the joint positions relative to the
            first joint, m^2; None if unknown.
        joint_velocities: (K, J, 3) joint velocities, m/s, in the frame of the header; None if
            unknown.
        existence_probability: probability that a person is in view, given all images so far; NaN
            if unknown, as in messages of other publishers.
        cue_probabilities: probability that each image cue shows the person, by the name of the cue;
            'track' is the probability that some component is near the person. Empty if unknown;
            only posteriors of the filter have them.
        error_share: for a likelihood, the fraction of the evidence of one image that is independent
            of other images, in (0, 1]; NaN if unknown.
        error_time: correlation time of the errors of images, s; NaN if unknown.
        shape_covariance: (d, d) covariance of the pose errors that are common to all images because
            the person's lengths and flesh are uncertain, for a likelihood; None if unknown.
        reason: reason why the pose is unknown; '' if it is known.
        posterior_weights: (K,) weights of the components given all images so far, which sum to 1,
            for a likelihood of the filter; None if unknown.
        ancestry: (K, M) probability that component k continues component m of the previous
            likelihood; each row sums to 1. M = 0 for new modes; None if unknown.
        ancestry_stamp_ns: stamp of the previous likelihood; 0 if unknown or missing.
        ancestry_ids: (M,) identities of the previous likelihood; None if missing.

    Raises:
        MessageError: invalid shapes or values.
    """

    weights: Array
    means: Array
    covariances: Array | None
    body_model: str
    dof_names: tuple[str, ...]
    joint_names: tuple[str, ...]
    joint_positions: Array
    kind: MixtureKind
    stamp_ns: int
    frame_id: str
    segment_lengths: Mapping[str, float] = field(default_factory=dict)
    log_likelihoods: Array | None = None
    degrees_of_freedom: Array | None = None
    state: TrackState = TrackState.UNKNOWN
    track_id: int = 0
    identities: NDArray[np.uint32] | None = None
    joint_covariances: Array | None = None
    joint_velocities: Array | None = None
    existence_probability: float = math.nan
    joint_covariances_relative: Array | None = None
    error_share: float = math.nan
    error_time: float = math.nan
    cue_probabilities: Mapping[str, float] = field(default_factory=dict)
    shape_covariance: Array | None = None
    reason: str = ''
    posterior_weights: Array | None = None
    ancestry: Array | None = None
    ancestry_stamp_ns: int = 0
    ancestry_ids: NDArray[np.uint32] | None = None

    def __post_init__(self) -> None:
        complete_mixture(self, 'mixture')
        components, d, joints = len(self.weights), len(self.dof_names), len(self.joint_names)
        ancestors = 0 if self.ancestry_ids is None else len(self.ancestry_ids)
        ids = identities_of(self.ancestry_ids, ancestors, 'mixture: ancestry')
        object.__setattr__(self, 'ancestry_ids', ids)
        shapes = {
            'weights': (components,),
            'means': (components, d),
            'covariances': (components, d, d),
            'joint_positions': (components, joints, 3),
            'joint_covariances': (components, joints, 3, 3),
            'joint_covariances_relative': (components, joints, 3, 3),
            'joint_velocities': (components, joints, 3),
            'log_likelihoods': (components,),
            'degrees_of_freedom': (components,),
            'shape_covariance': (d, d),
            'posterior_weights': (components,),
            'ancestry': (components, ancestors),
        }
        if self.log_likelihoods is None:
            object.__setattr__(self, 'log_likelihoods', np.full(components, np.nan))
        if self.degrees_of_freedom is None:
            object.__setattr__(self, 'degrees_of_freedom', np.zeros(components))
        freeze_arrays(
            self, shapes, 'mixture', optional=('covariances', *LIKELIHOOD_ARRAYS, *JOINT_ARRAYS)
        )
        check_finite(self.means, 'mixture: mean')
        for name in ('joint_positions', *JOINT_ARRAYS):
            if (values := getattr(self, name)) is not None:
                check_finite(values, f'mixture: {name}')
        if components:
            check_weights(self.weights, 'mixture')
        self._check_chain(ids)
        for cue, probability in self.cue_probabilities.items():
            if not 0.0 <= probability <= 1.0:
                raise MessageError(
                    f'mixture: cue_probabilities of {cue!r} must lie in [0, 1], saw {probability}'
                )
        for name, known, wanted in (
            ('existence_probability', 0.0 <= self.existence_probability <= 1.0, 'lie in [0, 1] or'),
            ('error_share', 0.0 < self.error_share <= 1.0, 'lie in (0, 1] or'),
            ('error_time', 0.0 <= self.error_time < math.inf, 'be 0 s or more, or'),
        ):
            if not (known or math.isnan(getattr(self, name))):
                value = getattr(self, name)
                raise MessageError(f'mixture: {name} must {wanted} be NaN, saw {value}')
        if self.covariances is not None:
            check_covariances(self.covariances, 'mixture')
        if self.shape_covariance is not None:
            check_covariances(self.shape_covariance, 'the shape', singular=True)

    def _check_chain(self, ancestry_ids: NDArray[np.uint32]) -> None:
        """Raises MessageError if posterior weights or ancestry are not probabilities."""
        assert self.identities is not None
        if len(self.weights) and self.posterior_weights is not None:
            check_weights(self.posterior_weights, 'mixture: posterior')
            check_once(self.identities, 'mixture')
        if not len(ancestry_ids):
            return
        check_once(ancestry_ids, 'mixture: ancestry')
        if self.ancestry is None:
            raise MessageError('mixture has ancestry_ids, and no ancestry')
        for k, row in enumerate(self.ancestry):
            check_weights(row, f'mixture: ancestry of component {k}')

    @classmethod
    def of_body(
        cls,
        body: Body,
        mixture: GaussianMixture | None,
        kind: MixtureKind,
        stamp_ns: int,
        frame_id: str,
        *,
        joint_positions: Array | None = None,
        log_likelihoods: Array | None = None,
        state: TrackState = TrackState.UNKNOWN,
        track_id: int = 0,
        identities: NDArray[Any] | None = None,
        velocities: Array | None = None,
        existence_probability: float = math.nan,
        error_share: float = math.nan,
        error_time: float = math.nan,
        cue_probabilities: Mapping[str, float] | None = None,
        shape_covariance: Array | None = None,
        reason: str = '',
        posterior_weights: Array | None = None,
        ancestry: Array | None = None,
        ancestry_stamp_ns: int = 0,
        ancestry_ids: NDArray[Any] | None = None,
    ) -> PoseMixture:
        """A mixture over the poses of a body with its current segment lengths.

        Covariances and velocities of the joints follow from those of the poses by linearisation:

            S_joint = J S J',    v_joint = J v,    J = d joint / d pose at the mean

        The relative covariances use J - J_pelvis in place of J; the pelvis is the first joint.

        For the other arguments see the attributes.

        Args:
            mixture: K Gaussians over poses of the body; None if nobody was seen. Root angles of the
                result are relative to the camera, even if the body is levelled.
            joint_positions: (K, J, 3) joint positions at the means, m; None computes them.
            velocities: (K, d) velocities of the poses, per second; None if unknown.
            cue_probabilities: see the attributes; None if unknown.

        Raises:
            MessageError: invalid shapes or values.
        """
        if mixture is None:
            d = body.dimension
            mixture = GaussianMixture(np.empty(0), np.empty((0, d)), np.empty((0, d, d)))
        if joint_positions is None:
            joint_positions = body.joint_positions(mixture.means)
        jacobians = body.joint_jacobians(mixture.means)
        joint_velocities = None
        if velocities is not None:
            joint_velocities = np.einsum('kjad,kd->kja', jacobians, velocities)
        upright = body.levelled(np.eye(3))
        placed = relevelled(body, mixture, upright)
        if shape_covariance is not None and upright is not body:
            at_best = GaussianMixture(np.ones(1), mixture.means[:1], shape_covariance[None])
            shape_covariance = relevelled(body, at_best, upright).covariances[0]
        return cls(
            weights=mixture.weights,
            means=placed.means,
            covariances=placed.covariances,
            body_model=body.name,
            dof_names=body.dof_names,
            joint_names=body.joint_names,
            joint_positions=joint_positions,
            kind=kind,
            stamp_ns=stamp_ns,
            frame_id=frame_id,
            segment_lengths=body.segment_lengths,
            log_likelihoods=log_likelihoods,
            state=state,
            track_id=track_id,
            identities=identities,
            joint_covariances=_joint_covariances(body, jacobians, mixture.covariances),
            joint_covariances_relative=_joint_covariances(
                body, jacobians - jacobians[:, :1], mixture.covariances
            ),
            joint_velocities=joint_velocities,
            existence_probability=existence_probability,
            error_share=error_share,
            error_time=error_time,
            cue_probabilities=cue_probabilities or {},
            shape_covariance=shape_covariance,
            reason=reason,
            posterior_weights=posterior_weights,
            ancestry=ancestry,
            ancestry_stamp_ns=ancestry_stamp_ns,
            ancestry_ids=ancestry_ids,
        )

    @cached_property
    def mixture(self) -> GaussianMixture:
        """The components as Gaussians.

        Raises:
            MessageError: there is no component, or the covariances are unknown.
        """
        if not len(self.weights):
            raise MessageError('mixture has no components', 'no components')
        if self.covariances is None:
            raise MessageError('mixture has no covariances', 'covariances')
        return GaussianMixture(self.weights, self.means, self.covariances)


def _joint_covariances(body: Body, jacobians: Array, covariances: Array) -> Array:
    """Covariances (K, J, 3, 3) of joints, from the poses and from errors of the body model.

    Args:
        jacobians: (K, J, 3, d) Jacobians of the positions.
        covariances: (K, d, d) covariances of the poses.
    """
    k, joints, _, d = jacobians.shape
    rows = product(jacobians.reshape(k, 3 * joints, d), covariances).reshape(jacobians.shape)
    result = product(rows, jacobians.swapaxes(2, 3))
    own = np.square(body.joint_errors)[:, None, None] * np.eye(3)
    return np.asarray(0.5 * (result + result.swapaxes(2, 3)) + own, dtype=np.float64)


def pose_mixture_message(messages: MessageFactory, content: PoseMixture) -> Any:
    """Makes an hmt_msgs/PoseMixture with the components in order of falling weight."""
    assert content.log_likelihoods is not None
    assert content.degrees_of_freedom is not None
    assert content.identities is not None
    shape, weights = content.shape_covariance, content.posterior_weights
    if weights is None:
        weights = np.zeros(len(content.weights))
    components = [
        messages.create(
            'hmt_msgs/msg/PoseComponent',
            id=int(content.identities[k]),
            weight=float(content.weights[k]),
            mean=content.means[k],
            covariance=flat(content.covariances, k),
            log_likelihood=float(content.log_likelihoods[k]),
            degrees_of_freedom=float(content.degrees_of_freedom[k]),
            joint_positions=messages.points(content.joint_positions[k]),
            joint_covariances=flat(content.joint_covariances, k),
            joint_covariances_relative=flat(content.joint_covariances_relative, k),
            joint_velocities=flat(content.joint_velocities, k),
            posterior_weight=float(weights[k]),
            ancestry=flat(content.ancestry, k),
        )
        for k in np.argsort(-content.weights, kind='stable')
    ]
    return messages.create(
        POSE_MIXTURE,
        header=header_message(messages, content.stamp_ns, content.frame_id),
        body_model=content.body_model,
        dof_names=list(content.dof_names),
        joint_names=list(content.joint_names),
        kind=int(content.kind),
        state=int(content.state),
        track_id=content.track_id,
        existence_probability=content.existence_probability,
        cue_names=list(content.cue_probabilities),
        cue_probabilities=np.array(list(content.cue_probabilities.values()), dtype=np.float64),
        error_share=content.error_share,
        error_time=content.error_time,
        shape_covariance=np.empty(0) if shape is None else shape.reshape(-1),
        components=components,
        segment_names=list(content.segment_lengths),
        segment_lengths=np.array(list(content.segment_lengths.values()), dtype=np.float64),
        reason=content.reason,
        ancestry_stamp=time_message(messages, content.ancestry_stamp_ns),
        ancestry_ids=content.ancestry_ids,
    )


def pose_mixture_of(
    message: Any,
    dof_names: Sequence[str] | None = None,
    joint_names: Sequence[str] | None = None,
) -> PoseMixture:
    """Reads an hmt_msgs/PoseMixture message of `rosbags` or of ROS.

    A message may lack components (nobody was seen), covariances or segment lengths (see
    `PoseMixture`); `PoseMixture.mixture` needs components and covariances.

    Args:
        dof_names, joint_names: required names in this order; None accepts any names.

    Raises:
        MessageError: unexpected names, inconsistent lengths of arrays, weights that are not
            probabilities, or covariances that are not positive definite.
    """
    names = names_of(message.dof_names, 'mixture: dof_names')
    joints = names_of(message.joint_names, 'mixture: joint_names')
    check_names(names, dof_names, 'mixture: dof_names')
    check_names(joints, joint_names, 'mixture: joint_names')
    components = message.components
    if len(components) > MAX_COMPONENTS:
        raise MessageError(
            f'mixture has {len(components)} components, the limit is {MAX_COMPONENTS}'
        )
    n, d = len(components), len(names)
    means = array_of_each(components, 'mean', (d,), 'mixture')
    positions = list[float]()
    for k, component in enumerate(components):
        points = component.joint_positions
        if len(points) != len(joints):
            text = f'mixture: component {k} has {len(points)} joint_positions'
            raise MessageError(f'{text}, wanted {len(joints)}')
        for point in points:
            positions += (point.x, point.y, point.z)
    state = constant_of(
        TrackState, message.state, f'mixture has the state {message.state}, which is not known'
    )
    return PoseMixture(
        weights=np.array([component.weight for component in components]),
        means=means,
        covariances=array_of_all(components, 'covariance', (d, d), 'mixture'),
        body_model=str(message.body_model),
        dof_names=names,
        joint_names=joints,
        joint_positions=np.reshape(positions, (n, len(joints), 3)),
        kind=constant_of(
            MixtureKind, message.kind, f'mixture has the kind {message.kind}, which is not known'
        ),
        stamp_ns=time_ns(message.header.stamp),
        frame_id=str(message.header.frame_id),
        segment_lengths=lengths_of(message, 'mixture'),
        log_likelihoods=np.array([c.log_likelihood for c in components]),
        degrees_of_freedom=np.array([c.degrees_of_freedom for c in components]),
        state=state,
        track_id=int(message.track_id),
        identities=np.array([c.id for c in components], dtype=np.uint32),
        joint_covariances=array_of_all(
            components, 'joint_covariances', (len(joints), 3, 3), 'mixture'
        ),
        joint_velocities=array_of_all(components, 'joint_velocities', (len(joints), 3), 'mixture'),
        existence_probability=_existence(message, state),
        joint_covariances_relative=array_of_all(
            components, 'joint_covariances_relative', (len(joints), 3, 3), 'mixture'
        ),
        cue_probabilities=named_numbers(message, 'cue_names', 'cue_probabilities', 'mixture'),
        shape_covariance=_shape_covariance(message, d),
        reason=str(message.reason),
        **_errors(message),
        **_chain(message),
    )


def _existence(message: Any, state: TrackState) -> float:
    """Existence probability; NaN if the publisher has left the field at 0."""
    value = float(message.existence_probability)
    return math.nan if state is TrackState.UNKNOWN and value == 0.0 else value


def _errors(message: Any) -> dict[str, Any]:
    """Error model as arguments of `PoseMixture`; empty if the publisher has not set it."""
    if message.error_share == 0.0:
        return {}
    return {'error_share': float(message.error_share), 'error_time': float(message.error_time)}


def _chain(message: Any) -> dict[str, Any]:
    """Posterior weights and ancestry as arguments of `PoseMixture`; None if not set."""
    weights = np.array([c.posterior_weight for c in message.components])
    told, ids = np.nan_to_num(weights).any(), message.ancestry_ids
    rows = array_of_each(message.components, 'ancestry', (len(ids),), 'mixture')
    return {
        'posterior_weights': weights if told else None,
        'ancestry': rows if told or len(ids) else None,
        'ancestry_stamp_ns': time_ns(message.ancestry_stamp),
        'ancestry_ids': np.array(ids),
    }


def _shape_covariance(message: Any, d: int) -> Array | None:
    """The shape covariance (d, d); None if the field is empty."""
    values = message.shape_covariance
    return numbers(values, (d, d), 'mixture: shape_covariance') if len(values) else None
