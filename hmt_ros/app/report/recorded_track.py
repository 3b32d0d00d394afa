"""A track that was recorded in a bag."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmt_ros.app.truth import Truth
from hmt_ros.evaluation.pose_scores import EVALUATED_JOINTS, ORIGIN
from msg_tools.messages.message_error import MessageError, check_finite, check_weights, names_of

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Moment:
    """The mixture at one time.

    Attributes:
        stamp_ns: of the image.
        weights: (K,) heaviest first.
        joints: (K, J, 3) camera optical frame, m.
    """

    stamp_ns: int
    weights: Array
    joints: Array


@dataclass(frozen=True, eq=False)
class RecordedTrack:
    """Mixtures over time.

    Attributes:
        joint_names: (J,).
        moments: in the order of time.
    """

    joint_names: tuple[str, ...]
    moments: list[Moment]


def bare_mixture(message: Any) -> tuple[Array, Array, tuple[str, ...]]:
    """Weights (K,), joint positions (K, J, 3) and joint names of a PoseMixture.

    Covariances are not looked at: they may be unknown.

    Raises:
        MessageError: no components, weights that are no probabilities, positions that are not
            finite or do not fit the names.
    """
    names = names_of(message.joint_names, 'mixture: joint_names')
    components = message.components
    if not components:
        raise MessageError('mixture has no components')
    weights = np.array([component.weight for component in components], dtype=np.float64)
    check_weights(weights, 'mixture')
    for k, component in enumerate(components):
        if len(component.joint_positions) != len(names):
            raise MessageError(
                f'mixture: component {k} has {len(component.joint_positions)} joint_positions, '
                f'wanted {len(names)}'
            )
    positions = np.array([[(p.x, p.y, p.z) for p in c.joint_positions] for c in components])
    positions = positions.reshape(len(weights), len(names), 3)
    check_finite(positions, 'mixture: joint_positions')
    return weights, positions, names


def mode_errors(track: RecordedTrack, truth: Truth) -> dict[int, Array]:
    """Mean distance of the evaluated joints from the truth, pelvis on pelvis, of each mode (K,), m.

    By stamp, where the truth is known; nothing where track and truth share no joints.
    """
    names = [x for x in EVALUATED_JOINTS if x in truth.joint_names and x in track.joint_names]
    if not names or any(ORIGIN not in known for known in (truth.joint_names, track.joint_names)):
        return {}
    own = [track.joint_names.index(name) for name in (ORIGIN, *names)]
    true = [truth.joint_names.index(name) for name in (ORIGIN, *names)]
    result = {}
    for moment in track.moments:
        if moment.stamp_ns not in truth.joints:
            continue
        seen = moment.joints[:, own]
        there = truth.joints[moment.stamp_ns][true]
        offset = (seen - seen[:, :1])[:, 1:] - (there - there[:1])[1:]
        result[moment.stamp_ns] = np.linalg.norm(offset, axis=2).mean(1)
    return result


def spread(track: RecordedTrack, count: int) -> list[int]:
    """Stamps spread evenly over a track."""
    last = len(track.moments) - 1
    chosen = np.unique(np.rint((np.arange(count) + 0.5) / count * last).astype(int))
    return [track.moments[i].stamp_ns for i in chosen]
