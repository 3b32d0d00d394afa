"""A track that was recorded in a bag."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hmt_ros.app.truth import Truth
from hmt_ros.evaluation.pose_scores import EVALUATED_JOINTS, ORIGIN

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
