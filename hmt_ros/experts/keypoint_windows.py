"""Windows of keypoints as inputs of experts: the images around one, as a camera on the person.

    keypoints -> landmarks of all schemes -> rays -> the view of a camera that looks at the trunk

A window has a place for each of `TIMES`, relative to the image that is asked for; the nearest image
fills it, if it is near enough, so that any frame rate fits. Its inputs are the places of the
landmarks in the plane of a camera that looks at the trunk, over their extent, with confidences, how
far each image is from its time, the extent, the direction against gravity in that camera, and the
proportions of the person, as far as both are known.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body import Body
from hmt_ros.experts.pose_encoding import ray_rotations
from hmt_ros.image.keypoint_schemes import AUTO, landmarks, landmarks_of
from hmt_ros.image.terms.keypoints import USUAL_STATURE, Keypoints
from hmt_ros.inference.arrays import Array

# Times of a window relative to now, s, and how far an image may be from each.
TIMES = np.array([0.0, -0.067, -0.15, -0.3, -0.5, -0.8, 0.067, 0.15, 0.3, 0.5, 0.8])
NEAR = np.array([0.02, *([0.045, 0.06, 0.09, 0.12, 0.17] * 2)])

_SIDED = ('shoulder', 'elbow', 'wrist', 'hip', 'knee', 'ankle', 'heel', 'toe')
LANDMARKS = (
    'nose', 'left_ear', 'right_ear',
    *(f'{side}_{name}' for name in _SIDED for side in ('left', 'right')),
    'neck_base', 'mid_hip', 'centre_of_head',
)  # fmt: skip
# What schemes of joint centres have in the place of a landmark on the skin.
INSTEAD = {
    **{f'centre_of_{side}_{name}': f'{side}_{name}'
       for name in ('shoulder', 'hip') for side in ('left', 'right')},
    'centre_of_pelvis': 'mid_hip',
    'centre_of_neck': 'neck_base',
}  # fmt: skip
CORE = tuple(
    LANDMARKS.index(name)
    for name in ('left_shoulder', 'right_shoulder', 'left_hip', 'right_hip', 'mid_hip')
)
# Joints of our bodies that a keypoint without a scheme may be called.
OF_JOINTS = {'pelvis': 'mid_hip', 'neck': 'neck_base', 'head': 'centre_of_head'}
# Lengths of a person whose proportions are inputs; a rise of the shoulders has none.
PROPORTIONED = (
    'thigh', 'shin', 'foot', 'upper_arm', 'forearm', 'hand', 'hip_width', 'hip_drop',
    'shoulder_width', 'trunk', 'neck_to_head',
)  # fmt: skip
# A length counts as at least this share of the usual one.
SHORTEST = 0.3
# A keypoint of less confidence is not looked at; fewer landmarks are no person.
LEAST_CONFIDENCE, FEWEST = 0.02, 5
FURTHEST = 6.0  # from the middle of the trunk, in extents


@dataclass(frozen=True, eq=False)
class WindowInputs:
    """Inputs of N windows.

    Attributes:
        values: (N, p) inputs of the experts.
        axes: (N, 3, 3) axes of the cameras that look at the persons, in rows, camera frame.
        known: (N,) windows in which a person is seen now.
    """

    values: NDArray[np.float32]
    axes: Array
    known: NDArray[np.bool_]


def proportions(usual: Body, lengths: Mapping[str, float]) -> Array:
    """Proportions (P,) of a person: log lengths over the usual ones, less their mean.

    Args:
        usual: body with the usual lengths.
        lengths: of the person by name, m.
    """
    own = usual.segment_lengths
    weight = np.array([own[name] for name in PROPORTIONED])
    ratio = np.array([max(lengths[name] / own[name], SHORTEST) for name in PROPORTIONED])
    result: Array = np.log(ratio) - weight @ np.log(ratio) / weight.sum()
    return result


def places_of(keypoints: Keypoints, scheme: str = AUTO) -> list[int]:
    """The landmark (row of `LANDMARKS`) that each keypoint shows; -1: none.

    Args:
        keypoints: of a detector, or named for a body.
        scheme: of names that are a detector's, see `keypoint_schemes.scheme_of`.

    Raises:
        ValueError: there is no such scheme.
    """
    called = keypoints.landmarks
    if called is None:
        marks = landmarks_of(keypoints.names, (), scheme)
        called = tuple('' if mark is None else mark.name for mark in marks)
    result = []
    for name, landmark in zip(keypoints.names, called, strict=True):
        found = landmark or OF_JOINTS.get(name, name)
        found = INSTEAD.get(found, found)
        result.append(LANDMARKS.index(found) if found in LANDMARKS else -1)
    return result


def landmark_offsets(body: Body, names: Sequence[str] = LANDMARKS) -> tuple[list[str], Array]:
    """The joint that each of L landmarks is at, and its offset (L, 3) in the segment's frame, m."""
    size = body.stature / USUAL_STATURE
    marks = [landmarks()[name] for name in names]
    return [mark.joint for mark in marks], size * np.array([mark.offset for mark in marks])


def filled(
    stamps: Array, at: Array, *, causal: bool
) -> tuple[NDArray[np.intp], NDArray[np.bool_], Array]:
    """The images that fill windows.

    Args:
        stamps: (T,) times of the images, increasing, s.
        at: (N,) times of the windows, s.
        causal: whether images after those of the windows do not count.

    Returns:
        (N, S) rows of the images, (N, S) whether they are near enough, (N, S) their times relative
        to the windows, s.
    """
    wanted = at[:, None] + TIMES
    right = np.clip(np.searchsorted(stamps, wanted), 1, max(len(stamps) - 1, 1))
    left = right - 1
    right = np.minimum(right, len(stamps) - 1)
    nearer = np.abs(stamps[right] - wanted) < np.abs(stamps[left] - wanted)
    rows = np.where(nearer, right, left)
    times = stamps[rows] - at[:, None]
    there = np.abs(times - TIMES) <= NEAR
    if causal:
        there &= times <= 1e-6
    return rows, there, times


def window_inputs(
    rays: Array, confidences: Array, times: Array, ups: Array, persons: Array
) -> WindowInputs:
    """Inputs of N windows of S images with L landmarks.

    Args:
        rays: (N, S, L, 2) x / z and y / z of the rays of the landmarks; any where there is none.
        confidences: (N, S, L) from 0, not seen, to 1.
        times: (N, S) of the images relative to now, s.
        ups: (N, 3) unit vectors against gravity, camera frame; 0: unknown.
        persons: (N, len(PROPORTIONED)) proportions of the persons; 0: unknown.
    """
    n, s, count = confidences.shape
    f32 = np.float32
    sure = np.where(confidences >= LEAST_CONFIDENCE, confidences, 0.0).astype(f32)
    places = np.where(sure[..., None] > 0, rays, 0.0).astype(f32)
    now = sure[:, 0]
    core = np.zeros(count, dtype=f32)
    core[list(CORE)] = 1.0
    weight = now * core
    weight = np.where((weight > 0).sum(1, keepdims=True) >= 2, weight, now) + f32(1e-9)
    middle = (places[:, 0] * weight[..., None]).sum(1) / weight.sum(1)[:, None]
    ahead = np.concatenate([middle, np.ones((n, 1), dtype=f32)], axis=1)
    axes = ray_rotations(ahead.astype(np.float64)).transpose(0, 2, 1)
    turn = axes.astype(f32)
    homogeneous = np.concatenate([places, np.ones((n, s, count, 1), dtype=f32)], axis=3)
    seen = homogeneous.reshape(n, -1, 3) @ turn.transpose(0, 2, 1)
    q = (seen[..., :2] / np.maximum(seen[..., 2:], f32(0.1))).reshape(n, s, count, 2)
    q = np.where(sure[..., None] > 0, q, f32(0.0))
    square = (now[..., None] * q[:, 0] ** 2).sum((1, 2)) / np.maximum(now.sum(1), f32(0.1))
    extent = np.sqrt(square) + f32(1e-6)
    q = np.clip(q / extent[:, None, None, None], f32(-FURTHEST), f32(FURTHEST))
    there = (sure.max(2) > 0).astype(f32)
    late = (times - TIMES).astype(f32) * there * f32(20.0)
    up = np.einsum('nij,nj->ni', turn, ups.astype(f32))
    values = np.concatenate(
        [
            q.reshape(n, -1), sure.reshape(n, -1), there, late, np.log(extent)[:, None] + f32(2.0),
            up, (np.abs(up).sum(1) > 0)[:, None], f32(5.0) * persons.astype(f32),
            (np.abs(persons).sum(1) > 0)[:, None],
        ], axis=1,
    )  # fmt: skip
    return WindowInputs(values.astype(f32), axes, (now > 0).sum(1) >= FEWEST)
