"""hmt_msgs/PoseMixture: a mixture over the pose of a body, as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmt_ros.inference import GaussianMixture
from msg_tools.messages.headers import header_message, time_ns
from msg_tools.messages.message_error import (
    MessageError,
    MessageFault,
    check_covariances,
    check_finite,
    check_names,
    check_weights,
    names_of,
    numbers,
)
from msg_tools.messages.message_factory import MessageFactory

Array = NDArray[np.float64]

# As many as any node publishes; a message of more costs whoever reads it time without end.
MAX_COMPONENTS = 1024


class MixtureKind(IntEnum):
    """What a mixture is the density of; the constants of PoseMixture.msg."""

    POSTERIOR = 0
    LIKELIHOOD = 1
    PREDICTION = 2
    SMOOTHED = 3
    GROUND_TRUTH = 4


@dataclass(frozen=True, eq=False)
class PoseMixture:
    """The content of the message.

    Attributes:
        mixture: K Gaussians over d degrees of freedom; weights sum to 1.
        body_model: name of the body.
        dof_names: (d,) order of the variables.
        joint_names: (J,) order of the joints.
        joint_positions: (K, J, 3) m, at the means, in the frame of the header.
        kind: see `MixtureKind`.
        stamp_ns: of the image.
        frame_id: optical frame of the camera.
        log_likelihoods: (K,) log p(image | mean) up to a constant; NaN: unknown. None: all unknown.
        degrees_of_freedom: (K,) of Student components; 0: Gaussian. None: all Gaussian.

    Raises:
        MessageError: shapes, weights or covariances that a message must not have.
    """

    mixture: GaussianMixture
    body_model: str
    dof_names: tuple[str, ...]
    joint_names: tuple[str, ...]
    joint_positions: Array
    kind: MixtureKind
    stamp_ns: int
    frame_id: str
    log_likelihoods: Array | None = None
    degrees_of_freedom: Array | None = None

    def __post_init__(self) -> None:
        components, d = self.mixture.means.shape
        if components == 0:
            raise MessageError('mixture has no components', MessageFault.NO_COMPONENTS)
        object.__setattr__(self, 'dof_names', names_of(self.dof_names, 'mixture: dof_names'))
        object.__setattr__(self, 'joint_names', names_of(self.joint_names, 'mixture: joint_names'))
        if len(self.dof_names) != d:
            raise MessageError(f'mixture has {d} variables, but {len(self.dof_names)} dof_names')
        shapes = {
            'joint_positions': (components, len(self.joint_names), 3),
            'log_likelihoods': (components,),
            'degrees_of_freedom': (components,),
        }
        unknown = {
            'log_likelihoods': np.full(components, np.nan),
            'degrees_of_freedom': np.zeros(components),
        }
        for name, shape in shapes.items():
            value = getattr(self, name)
            array = np.array(unknown[name] if value is None else value, dtype=np.float64)
            if array.shape != shape:
                raise MessageError(f'mixture: {name} has shape {array.shape}, wanted {shape}')
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        check_finite(self.joint_positions, 'mixture: joint_positions')
        check_weights(self.mixture.weights, 'mixture')
        check_covariances(self.mixture.covariances, 'mixture')


def pose_mixture_message(messages: MessageFactory, content: PoseMixture) -> Any:
    """hmt_msgs/PoseMixture; the components heaviest first, of equal weights in their order."""
    mixture = content.mixture
    assert content.log_likelihoods is not None
    assert content.degrees_of_freedom is not None
    components = [
        messages.create(
            'hmt_msgs/msg/PoseComponent',
            weight=float(mixture.weights[k]),
            mean=mixture.means[k],
            covariance=mixture.covariances[k].reshape(-1),
            log_likelihood=float(content.log_likelihoods[k]),
            degrees_of_freedom=float(content.degrees_of_freedom[k]),
            joint_positions=messages.points(content.joint_positions[k]),
        )
        for k in np.argsort(-mixture.weights, kind='stable')
    ]
    return messages.create(
        'hmt_msgs/msg/PoseMixture',
        header=header_message(messages, content.stamp_ns, content.frame_id),
        body_model=content.body_model,
        dof_names=list(content.dof_names),
        joint_names=list(content.joint_names),
        kind=int(content.kind),
        components=components,
    )


def pose_mixture_of(
    message: Any,
    dof_names: Sequence[str] | None = None,
    joint_names: Sequence[str] | None = None,
) -> PoseMixture:
    """The content of an hmt_msgs/PoseMixture, of `rosbags` or of ROS.

    Args:
        message: the message.
        dof_names, joint_names: what it has to be about, in this order; None: anything.

    Raises:
        MessageError: names that differ, arrays whose lengths contradict each other, weights that
            are no probabilities, covariances that are unknown or not positive definite.
    """
    names = names_of(message.dof_names, 'mixture: dof_names')
    joints = names_of(message.joint_names, 'mixture: joint_names')
    check_names(names, dof_names, 'mixture: dof_names')
    check_names(joints, joint_names, 'mixture: joint_names')
    if not message.components:
        raise MessageError('mixture has no components', MessageFault.NO_COMPONENTS)
    if len(message.components) > MAX_COMPONENTS:
        raise MessageError(
            f'mixture has {len(message.components)} components, the limit is {MAX_COMPONENTS}'
        )
    d = len(names)
    means, covariances, positions = [], [], []
    for k, component in enumerate(message.components):
        what = f'mixture: component {k}'
        means.append(numbers(component.mean, (d,), f'{what}: mean'))
        if len(component.covariance) == 0 and d:
            raise MessageError(f'{what} has no covariance', MessageFault.COVARIANCES)
        covariances.append(numbers(component.covariance, (d, d), f'{what}: covariance'))
        points = component.joint_positions
        if len(points) != len(joints):
            raise MessageError(f'{what} has {len(points)} joint_positions, wanted {len(joints)}')
        positions.append([(point.x, point.y, point.z) for point in points])
    weights = np.array([component.weight for component in message.components])
    check_weights(weights, 'mixture')
    check_finite(np.array(means), 'mixture: mean')
    check_finite(np.array(covariances), 'mixture: covariance')
    try:
        kind = MixtureKind(int(message.kind))
    except ValueError:
        raise MessageError(f'mixture has the kind {message.kind}, which is not known') from None
    return PoseMixture(
        mixture=GaussianMixture(weights, np.array(means), np.array(covariances)),
        body_model=str(message.body_model),
        dof_names=names,
        joint_names=joints,
        joint_positions=np.reshape(positions, (len(weights), len(joints), 3)),
        kind=kind,
        stamp_ns=time_ns(message.header.stamp),
        frame_id=str(message.header.frame_id),
        log_likelihoods=np.array([c.log_likelihood for c in message.components]),
        degrees_of_freedom=np.array([c.degrees_of_freedom for c in message.components]),
    )
