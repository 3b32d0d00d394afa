"""Poses and lengths of a body fitted to the truth of a clip.

Fits of noise start from them, so that the remaining difference between model and clip is an error
of the cues and of the model, not of a search.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.clips import Clip, read_clip
from benchmarks.runs import JOINTS
from hmt_learning.motion.inverse_kinematics import solve_joint_positions
from hmt_learning.motion.retarget import hip_drop_share
from hmt_ros.body import Body, load_body
from hmt_ros.body.limb_angles import trunk_start
from hmt_ros.evaluation.pose_scores import HIPS, ORIGIN
from hmt_ros.image.background import BackgroundModel
from hmt_ros.tracking import read_subject
from hmt_ros.tracking.initialisation import start_from_keypoints

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Clips for the fits; number of clips, and of images of each, with --quick.
CLIPS = ('walk', 'charleston', 'wander', 'shoot', 'signals', 'scoop', 'kick', 'follow')
QUICK, QUICK_IMAGES = 1, 24
# Number of initial poses for the fit of a pose.
STARTS = 8
SHOULDERS = ('left_shoulder', 'right_shoulder')
SUBTRACTED, TRUE = 'subtracted', 'true'
Ends = tuple[tuple[str, ...], tuple[str, ...]]


class Fitted(NamedTuple):
    """A clip, the body with the true lengths, and initial poses (N, d)."""

    clip: Clip
    body: Body
    starts: Array


def fitted(folder: Path, limit: int | None = None) -> Fitted:
    """Reads a clip, or its first images.

    Raises:
        ValueError: the clip can not be read.
    """
    clip, model = read_clip(folder, limit), load_body('human37')
    begun = start_from_keypoints(model, clip.camera, read_subject(clip.subject, model))
    return Fitted(clip, with_true_lengths(begun.body, clip), begun.poses[:STARTS])


def _on_both_sides(first: str, second: str) -> list[Ends]:
    return [((f'{side}_{first}',), (f'{side}_{second}',)) for side in ('left', 'right')]


# Joints, or pairs of joints with a middle, between which each length is measured.
SPANS: dict[str, list[Ends]] = {
    'thigh': _on_both_sides('hip', 'knee'),
    'shin': _on_both_sides('knee', 'ankle'),
    'foot': _on_both_sides('ankle', 'toe'),
    'upper_arm': _on_both_sides('shoulder', 'elbow'),
    'forearm': _on_both_sides('elbow', 'wrist'),
    'hand': _on_both_sides('wrist', 'hand'),
    'hip_width': [(HIPS[:1], HIPS[1:])],
    'hip_drop': [((ORIGIN,), HIPS)],
    'shoulder_width': [(SHOULDERS[:1], SHOULDERS[1:])],
    'trunk': [((ORIGIN,), ('neck',))],
    'neck_to_head': [(('neck',), ('head',))],
}


def best_poses(body: Body, clip: Clip, stamps: list[int], starts: Array) -> Array:
    """Poses (T, d) of a body nearest to the true joints, each the best of several starts."""
    names = [name for name in JOINTS if name in clip.truth.joint_names]
    where = [clip.truth.joint_names.index(name) for name in names]
    true = np.array([clip.truth.joints[stamp][where] for stamp in stamps])
    targets, first = np.repeat(true, len(starts), axis=0), np.tile(starts, (len(true), 1))
    solved = solve_joint_positions(body, first, targets, names)
    best = solved.value.reshape(len(true), -1).argmin(1)
    result: Array = solved.x.reshape(len(true), len(starts), -1)[np.arange(len(true)), best]
    return result


def silhouettes_of(clip: Clip, every: int) -> dict[str, list[Mask]]:
    """Subtracted and true silhouettes, if known, in every `every`-th image."""
    result = {}
    if clip.background is not None:
        background = BackgroundModel.from_image(clip.background)
        result[SUBTRACTED] = [background.silhouette(image) for image in clip.images[::every]]
    with np.load(clip.folder / 'truth.npz') as content:
        if 'masks' in content:
            known = dict(zip(map(int, content['stamps']), content['masks'], strict=True))
            width = clip.camera.width
            result[TRUE] = [
                np.unpackbits(known[stamp], axis=1)[:, :width].astype(np.bool_)
                for stamp in clip.stamps[::every]
            ]
    return result


def with_true_lengths(body: Body, clip: Clip) -> Body:
    """A body with the lengths between the true joints, means over the images and both sides.

    Lengths whose joints have no truth are unchanged.
    """
    names, every = clip.truth.joint_names, np.array(list(clip.truth.joints.values()))

    def at(wanted: tuple[str, ...]) -> Array:
        middle: Array = every[:, [names.index(name) for name in wanted]].mean(1)
        return middle

    lengths = {
        name: float(np.mean([np.nanmean(np.linalg.norm(at(a) - at(b), axis=1)) for a, b in spans]))
        for name, spans in SPANS.items()
        if all(set(a) | set(b) <= set(names) for a, b in spans)
    }
    if 'hip_drop' in lengths:
        lengths['hip_drop'] *= hip_drop_share(body)
    if {ORIGIN, *HIPS, 'neck', *SHOULDERS} <= set(names):
        place = {name: at((name,)) for name in (ORIGIN, *HIPS)}
        up = at(('neck',)) - trunk_start(body.skeleton, place)
        lengths['trunk'] = float(np.linalg.norm(up, axis=1).mean())
        # Height of the shoulders above the end of the trunk, which may be negative.
        up /= np.linalg.norm(up, axis=1, keepdims=True)
        lengths['shoulder_rise'] = float(((at(SHOULDERS) - at(('neck',))) * up).sum(1).mean())
    return body.with_segment_lengths(lengths)
