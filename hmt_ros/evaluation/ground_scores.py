"""Scores of the feet (sliding, and depth below the true floor) and of the estimated vertical.

The sliding of a foot is the speed of its ankle in the world between two frames in which the foot
truly stands. The depth is the distance of ankles and toes below the true plane of the floor. The
sole lies some centimetres below the ankle, so the depth of a pose is 0 unless it sinks in.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from hmt_ros.inference.arrays import Array

ANKLES = ('left_ankle', 'right_ankle')
FEET = (*ANKLES, 'left_toe', 'right_toe')
# Depth below the floor beyond which a joint counts as sunk, m.
MAX_SINKING = 0.02
# Maximum interval between neighbouring frames, relative to the median interval.
_MAX_GAP_RATIO = 1.5


@dataclass(frozen=True, eq=False)
class TrueGround:
    """The true floor, feet and camera at one time.

    Attributes:
        up: (3,) unit vector against gravity, camera frame.
        height: height of the camera above the floor, m.
        standing: (2,) whether the left and the right foot rest on the floor; None: unknown.
        camera_rotation: (3, 3) rotation from the camera to a stationary world frame.
        camera_position: (3,) position of the camera in the world frame, m.
    """

    up: Array
    height: float
    standing: Array | None
    camera_rotation: Array
    camera_position: Array


@dataclass(frozen=True)
class GroundScores:
    """Scores of the feet, from one pose per frame, such as the heaviest mode.

    Attributes:
        sliding: mean speed of standing ankles, m/s; None if no foot is known to stand.
        depth: mean depth of ankles and toes below the floor, m; 0 for joints above the floor.
        sunk: fraction of the frames in which an ankle or a toe is more than `MAX_SINKING` below the
            floor.
        frames: number of frames.
    """

    sliding: float | None
    depth: float
    sunk: float
    frames: int

    def summary(self) -> dict[str, float | int | None]:
        """Return the scores by name, lengths in mm."""
        return {
            'sliding_m_per_s': self.sliding,
            'below_floor_mm': 1e3 * self.depth,
            'fraction_below_floor': self.sunk,
            'frames': self.frames,
        }

    def __str__(self) -> str:
        sliding = '' if self.sliding is None else f'standing ankles slide {self.sliding:.3f} m/s; '
        return (
            f'{sliding}ankles and toes lie {1e3 * self.depth:.1f} mm below the floor on average, '
            f'one more than {1e3 * MAX_SINKING:.0f} mm in {self.sunk:.0%} of the frames'
        )


@dataclass(frozen=True)
class GravityScores:
    """Scores of the vertical estimated by a track.

    Attributes:
        error: median angle to the true vertical, rad.
        said: median of the reported standard deviation of the vertical, about a horizontal axis,
            rad; NaN: not reported.
        frames: number of frames.
    """

    error: float
    said: float
    frames: int

    def summary(self) -> dict[str, float | int | None]:
        """Return the scores by name, angles in degrees."""
        return {
            'error_degrees': float(np.degrees(self.error)),
            'said_degrees': None if np.isnan(self.said) else float(np.degrees(self.said)),
            'frames': self.frames,
        }

    def __str__(self) -> str:
        said = 'unknown' if np.isnan(self.said) else f'{np.degrees(self.said):.1f} degrees'
        return (
            f'the vertical errs by {np.degrees(self.error):.1f} degrees (median), and is said to '
            f'be known to {said}'
        )


def gravity_scores(
    ups: Mapping[int, tuple[Array, float]], truth: Mapping[int, TrueGround]
) -> GravityScores | None:
    """Score an estimated vertical; return None if no frame has a true vertical.

    Args:
        ups: stamp in ns -> unit vector (3,) against gravity, camera frame, and its standard
            deviation, rad.
        truth: true ground by stamp in ns.
    """
    stamps = sorted(ups.keys() & truth.keys())
    if not stamps:
        return None
    cosines = [float(np.clip(ups[t][0] @ truth[t].up, -1.0, 1.0)) for t in stamps]
    said = float(np.median([ups[t][1] for t in stamps]))
    return GravityScores(float(np.median(np.arccos(cosines))), said, len(stamps))


def ground_scores(
    joints: Mapping[int, Array], names: Sequence[str], truth: Mapping[int, TrueGround]
) -> GroundScores | None:
    """Score the feet; return None if no frame has a true floor, or there are no joints of feet.

    Args:
        joints: stamp in ns -> (J, 3) joint positions of one pose, m, camera frame.
        names: (J,) names of the joints.
        truth: true ground by stamp in ns.
    """
    stamps = sorted(joints.keys() & truth.keys())
    feet = [names.index(name) for name in FEET if name in names]
    if not stamps or not feet:
        return None
    depths = np.array(
        [np.maximum(-(joints[t][feet] @ truth[t].up + truth[t].height), 0.0) for t in stamps]
    )
    return GroundScores(
        sliding=_sliding(stamps, joints, names, truth),
        depth=float(depths.mean()),
        sunk=float((depths.max(1) > MAX_SINKING).mean()),
        frames=len(stamps),
    )


def _sliding(
    stamps: Sequence[int],
    joints: Mapping[int, Array],
    names: Sequence[str],
    truth: Mapping[int, TrueGround],
) -> float | None:
    """Return the mean speed of standing ankles, m/s; None if no foot is known to stand."""
    if len(stamps) < 2:
        return None
    usual = _MAX_GAP_RATIO * float(np.median(np.diff(stamps)))
    speeds = []
    for side, ankle in enumerate(ANKLES):
        if ankle not in names:
            continue
        at = names.index(ankle)
        for before, now in pairwise(stamps):
            one, other = truth[before], truth[now]
            if now - before > usual or one.standing is None or other.standing is None:
                continue
            if one.standing[side] and other.standing[side]:
                moved = _placed(joints[now][at], other) - _placed(joints[before][at], one)
                speeds.append(float(np.linalg.norm(moved)) / (1e-9 * (now - before)))
    return float(np.mean(speeds)) if speeds else None


def _placed(point: Array, truth: TrueGround) -> Array:
    """Transform a point (3,) from the camera frame to the world frame."""
    return truth.camera_rotation @ point + truth.camera_position
