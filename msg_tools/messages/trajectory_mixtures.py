"""hmt_msgs/TrajectoryMixture: a mixture over a window of poses, as arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msg_tools.messages.headers import EARLIEST_NS, header_message, time_message, time_ns
from msg_tools.messages.message_error import (
    Array,
    MessageError,
    array_of_all,
    array_of_each,
    check_covariances,
    check_finite,
    check_names,
    check_weights,
    complete_mixture,
    flat,
    freeze_arrays,
    lengths_of,
    names_of,
)
from msg_tools.messages.message_types import MessageFactory

TRAJECTORY_MIXTURE = 'hmt_msgs/msg/TrajectoryMixture'


@dataclass(frozen=True, eq=False)
class TrajectoryMixture:
    """Content of a TrajectoryMixture message: M trajectories of T poses.

    Attributes:
        weights: (M,) weights that sum to 1.
        means: (M, T, d) poses, m and rad.
        marginal_covariances: (M, T, d, d) covariances of single poses, including the inflation;
            None if not computed.
        log_joint: (M,) log p(trajectory, images) at the mean.
        inflation: (M,) factor on the standard deviations.
        stamps_ns: (T,) times of the poses, increasing.
        final_until_ns: time up to which poses are final.
        free_energy: (I,) free energy per iteration, nats.
        body_model: name of the body.
        dof_names: (d,) names of the degrees of freedom, in order.
        frame_id: optical frame of the camera.
        segment_lengths: segment lengths by name, m, see `PoseMixture`; empty if unknown.
        joint_names: (J,) names of the joints, in order.
        joint_positions: (M, T, J, 3) joint positions at the means, m; None if not computed.
        identities: (M,) identities of the motions, constant within a track, from 1; 0 for no
            identity, None if all are 0.

    Raises:
        MessageError: invalid shapes or values.
    """

    weights: Array
    means: Array
    marginal_covariances: Array | None
    log_joint: Array
    inflation: Array
    stamps_ns: tuple[int, ...]
    final_until_ns: int
    free_energy: Array
    body_model: str
    dof_names: tuple[str, ...]
    frame_id: str
    segment_lengths: Mapping[str, float] = field(default_factory=dict)
    joint_names: tuple[str, ...] = ()
    joint_positions: Array | None = None
    identities: NDArray[np.uint32] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, 'stamps_ns', tuple(int(stamp) for stamp in self.stamps_ns))
        complete_mixture(self, 'trajectories')
        m, t, d = len(self.weights), len(self.stamps_ns), len(self.dof_names)
        if m == 0 or t == 0:
            raise MessageError(f'trajectories: {m} components of {t} poses, wanted one at least')
        shapes: dict[str, tuple[int, ...]] = {
            'weights': (m,),
            'means': (m, t, d),
            'marginal_covariances': (m, t, d, d),
            'log_joint': (m,),
            'inflation': (m,),
            'free_energy': (len(self.free_energy),),
            'joint_positions': (m, t, len(self.joint_names), 3),
        }
        optional = ('marginal_covariances', 'joint_positions')
        freeze_arrays(self, shapes, 'trajectories', optional=optional)
        if any(b <= a for a, b in zip(self.stamps_ns, self.stamps_ns[1:], strict=False)):
            raise MessageError('trajectories: stamps do not increase')
        check_weights(self.weights, 'trajectories')
        check_finite(self.means, 'trajectories: means')
        if self.joint_positions is not None:
            check_finite(self.joint_positions, 'trajectories: joint_positions')
        if self.marginal_covariances is not None:
            check_covariances(self.marginal_covariances, 'trajectories')


def trajectory_mixture_message(messages: MessageFactory, content: TrajectoryMixture) -> Any:
    """Makes an hmt_msgs/TrajectoryMixture with the components in order of falling weight."""
    assert content.identities is not None
    components = [
        messages.create(
            'hmt_msgs/msg/TrajectoryComponent',
            id=int(content.identities[m]),
            weight=float(content.weights[m]),
            log_joint=float(content.log_joint[m]),
            inflation=float(content.inflation[m]),
            means=content.means[m].reshape(-1),
            marginal_covariances=flat(content.marginal_covariances, m),
            joint_positions=flat(content.joint_positions, m),
        )
        for m in np.argsort(-content.weights, kind='stable')
    ]
    return messages.create(
        TRAJECTORY_MIXTURE,
        header=header_message(messages, content.stamps_ns[-1], content.frame_id),
        body_model=content.body_model,
        dof_names=list(content.dof_names),
        joint_names=list(content.joint_names),
        stamps=[time_message(messages, stamp) for stamp in content.stamps_ns],
        # A message can not contain an earlier time.
        final_until=time_message(messages, max(content.final_until_ns, EARLIEST_NS)),
        free_energy=content.free_energy,
        components=components,
        segment_names=list(content.segment_lengths),
        segment_lengths=np.array(list(content.segment_lengths.values()), dtype=np.float64),
    )


def trajectory_mixture_of(
    message: Any, dof_names: Sequence[str] | None = None
) -> TrajectoryMixture:
    """Reads an hmt_msgs/TrajectoryMixture message of `rosbags` or of ROS.

    Args:
        dof_names: required names in this order; None accepts any names.

    Raises:
        MessageError: unexpected names, inconsistent lengths of arrays, weights that are not
            probabilities, covariances that are not positive definite, or stamps that do not
            increase.
    """
    names = names_of(message.dof_names, 'trajectories: dof_names')
    check_names(names, dof_names, 'trajectories: dof_names')
    components = message.components
    if not components:
        raise MessageError('trajectories: no components')
    t, d = len(message.stamps), len(names)
    joints = names_of(message.joint_names, 'trajectories: joint_names')
    return TrajectoryMixture(
        weights=np.array([component.weight for component in components]),
        means=array_of_each(components, 'means', (t, d), 'trajectories'),
        marginal_covariances=array_of_all(
            components, 'marginal_covariances', (t, d, d), 'trajectories'
        ),
        log_joint=np.array([component.log_joint for component in components]),
        inflation=np.array([component.inflation for component in components]),
        stamps_ns=tuple(time_ns(stamp) for stamp in message.stamps),
        final_until_ns=time_ns(message.final_until),
        free_energy=np.array(message.free_energy, dtype=np.float64),
        body_model=str(message.body_model),
        dof_names=names,
        frame_id=str(message.header.frame_id),
        segment_lengths=lengths_of(message, 'trajectories'),
        joint_names=joints,
        joint_positions=array_of_all(
            components, 'joint_positions', (t, len(joints), 3), 'trajectories'
        ),
        identities=np.array([component.id for component in components]),
    )
