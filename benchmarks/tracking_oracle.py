"""Where the optimum of the likelihood lies when the search starts at the truth.

The best pose of the body is fitted to the true joints, then the likelihood of the image alone is
minimised from there: what is left is due to the likelihood and not to the search. With all terms
and with one at a time, with the subtracted and the true silhouette, with the segment lengths that a
subject file gives and with the true ones.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.clips import KEYPOINT_SIGMA, Clip, read_clip, table
from benchmarks.runs import JOINTS, in_processes, joints_of, true_joints
from benchmarks.tracking_scores import interval
from hmt_learning.motion.inverse_kinematics import solve_joint_positions
from hmt_learning.motion.retarget import hip_drop_share
from hmt_ros.body import Body, load_body
from hmt_ros.body.limb_angles import trunk_start
from hmt_ros.evaluation.pose_scores import HIPS, ORIGIN
from hmt_ros.image.background import BackgroundModel
from hmt_ros.image.likelihood import ImageLikelihood, LikelihoodSettings
from hmt_ros.image.observation import Observation, observe
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference.bounded_newton import minimise
from hmt_ros.tracking import read_subject

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

EVERY = 10  # images
# Poses from which the best pose of the body is fitted.
STARTS = 8
SHOULDERS = ('left_shoulder', 'right_shoulder')
SHAPE_TERMS = ('coverage', 'edges')
BEST_POSE, TOGETHER, TRUE_KEYPOINTS = 'best pose of the body', 'together', 'true keypoints'
OF_SUBJECT, TRUE = 'of the subject', 'true'
SUBTRACTED = 'subtracted'
SHOWN = ('error_mm', 'depth_percent', 'absolute_depth_percent')
LEFT_AND_RIGHT = ('left', 'right')
Ends = tuple[tuple[str, ...], tuple[str, ...]]


def _on_both_sides(first: str, second: str) -> list[Ends]:
    return [((f'{side}_{first}',), (f'{side}_{second}',)) for side in LEFT_AND_RIGHT]


# Between which joints, or middles of joints, a length is measured.
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


def oracle(
    folders: list[Path], limit: int | None = None, processes: int = 0, every: int = EVERY
) -> dict[str, Any]:
    """Errors by clip, and means over the clips in which both silhouettes are known.

    Args:
        folders: of the clips.
        limit: number of images of a clip; None: all.
        processes: number of processes; 0: one a core.
        every: one image of so many is taken.
    """
    work = partial(of_clip, limit=limit, every=every)
    clips = dict(
        zip(
            [x.name for x in folders], in_processes(work, folders, processes, 'oracle'), strict=True
        )
    )
    return {
        'every': every,
        'clips': clips,
        'mean_of': list(_complete(clips)),
        'means': means_of(clips),
    }


def means_of(clips: dict[str, list[dict[str, Any]]]) -> list[dict[str, Any]]:
    """Means of each case over the clips that have all cases, with intervals."""
    found = list(_complete(clips).values())
    return [
        {key: case[key] for key in ('lengths', 'silhouette', 'terms')}
        | {key: interval(np.array([[cases[i][key]] for cases in found])) for key in SHOWN}
        for i, case in enumerate(found[0])
    ]


def _complete(clips: dict[str, list[dict[str, Any]]]) -> dict[str, list[dict[str, Any]]]:
    """Clips in which as many silhouettes are known as in any."""
    longest = max(map(len, clips.values()))
    return {name: cases for name, cases in clips.items() if len(cases) == longest}


def of_clip(folder: Path, limit: int | None = None, every: int = EVERY) -> list[dict[str, Any]]:
    """Errors of the optima for each case that the clip allows.

    Raises:
        ValueError: the clip can not be read.
    """
    clip = read_clip(folder, limit)
    stamps, images = clip.stamps[::every], clip.images[::every]
    model = load_body('human37')
    # Here, so that the other parts need no inner module of the tracker.
    from hmt_ros.tracking.initialisation import start_from_keypoints

    begun = start_from_keypoints(model, clip.camera, read_subject(clip.subject, model))
    silhouettes = silhouettes_of(clip, every)
    shape, reference = _settings()
    result = []
    for lengths, body in ((OF_SUBJECT, begun.body), (TRUE, with_true_lengths(begun.body, clip))):
        best = best_poses(body, clip, stamps, begun.poses[:STARTS])
        known = [Observation(keypoints=true_keypoints(clip, stamp, body)) for stamp in stamps]
        found = [
            ('-', BEST_POSE, best),
            ('-', TRUE_KEYPOINTS, optima(body, clip, reference, known, best)),
        ]
        for name, masks in silhouettes.items():
            seen = [observe(*pair, wanted=SHAPE_TERMS) for pair in zip(images, masks, strict=True)]
            found += [
                (name, terms, optima(body, clip, x, seen, best)) for terms, x in shape.items()
            ]
        result += [
            {'lengths': lengths, 'silhouette': silhouette, 'terms': terms}
            | errors_of(body, clip, stamps, poses)
            for silhouette, terms, poses in found
        ]
    return result


def _settings() -> tuple[dict[str, LikelihoodSettings], LikelihoodSettings]:
    """Of all terms together and of one at a time; of keypoints."""
    usual, of_terms = LikelihoodSettings(), LikelihoodSettings.of_terms
    terms = {name: getattr(usual, name) for name in SHAPE_TERMS}
    alone = {name: of_terms(**{name: own}) for name, own in terms.items()}
    return {TOGETHER: of_terms(**terms), **alone}, of_terms(keypoints=usual.keypoints)


def optima(
    body: Body,
    clip: Clip,
    settings: LikelihoodSettings,
    observations: list[Observation],
    poses: Array,
) -> Array:
    """Poses (T, d) at the optimum of the likelihood of each image that is reached from a pose."""
    likelihood = ImageLikelihood(body, clip.camera, settings)
    step_scale = np.where(body.skeleton.dof_is_rotation, 0.3, 0.2)
    return np.concatenate(
        [
            minimise(
                likelihood.given(seen), pose[None], body.lower, body.upper,
                step_scale=step_scale, damping=1.0, max_iterations=60, tolerance=1e-3,
            ).x
            for seen, pose in zip(observations, poses, strict=True)
        ]
    )  # fmt: skip


def best_poses(body: Body, clip: Clip, stamps: list[int], starts: Array) -> Array:
    """Poses (T, d) of a body that come nearest to the true joints, each from several starts."""
    names = [name for name in JOINTS if name in clip.truth.joint_names]
    where = [clip.truth.joint_names.index(name) for name in names]
    true = np.array([clip.truth.joints[stamp][where] for stamp in stamps])
    targets, first = np.repeat(true, len(starts), axis=0), np.tile(starts, (len(true), 1))
    solved = solve_joint_positions(body, first, targets, names)
    best = solved.value.reshape(len(true), -1).argmin(1)
    result: Array = solved.x.reshape(len(true), len(starts), -1)[np.arange(len(true)), best]
    return result


def errors_of(body: Body, clip: Clip, stamps: list[int], poses: Array) -> dict[str, float]:
    """How far poses (T, d) are from the truth.

    Returns:
        `error_mm`, mean distance of the joints relative to the origin; `coordinate_mm`, root mean
        square of a coordinate; `depth_percent`, signed, and `absolute_depth_percent` of the origin.
    """
    joints, true = joints_of(body, poses, clip), true_joints(clip, stamps)
    missed = (joints[:, 1:] - joints[:, :1]) - (true[:, 1:] - true[:, :1])
    missed = missed[:, np.isfinite(missed).all((0, 2))]
    depth = 100.0 * (joints[:, 0, 2] / true[:, 0, 2] - 1.0)
    return {
        'error_mm': float(1e3 * np.linalg.norm(missed, axis=2).mean()),
        'coordinate_mm': float(1e3 * np.sqrt((missed**2).mean())),
        'depth_percent': float(depth.mean()),
        'absolute_depth_percent': float(np.abs(depth).mean()),
    }


def true_keypoints(clip: Clip, stamp: int, body: Body) -> Keypoints:
    """True image positions of the joints of a body, as sure as a detector's."""
    names = tuple(name for name in clip.truth.joint_names if name in body.joint_names)
    pixels = clip.pixels[stamp][[clip.truth.joint_names.index(name) for name in names]]
    n = len(names)
    return Keypoints(names, pixels, np.tile(KEYPOINT_SIGMA**2 * np.eye(2), (n, 1, 1)), np.ones(n))


def silhouettes_of(clip: Clip, every: int) -> dict[str, list[Mask]]:
    """Silhouettes of each of so many images: subtracted and true, where they are known."""
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

    Lengths whose joints have no truth stay as they are.
    """
    names, every = clip.truth.joint_names, np.array(list(clip.truth.joints.values()))

    def at(wanted: tuple[str, ...]) -> Array:
        middle: Array = every[:, [names.index(name) for name in wanted]].mean(1)
        return middle

    lengths = {
        name: float(np.mean([np.linalg.norm(at(a) - at(b), axis=1).mean() for a, b in spans]))
        for name, spans in SPANS.items()
        if all(set(a) | set(b) <= set(names) for a, b in spans)
    }
    if 'hip_drop' in lengths:
        lengths['hip_drop'] *= hip_drop_share(body)
    if {ORIGIN, *HIPS, 'neck', *SHOULDERS} <= set(names):
        place = {name: at((name,)) for name in (ORIGIN, *HIPS)}
        up = at(('neck',)) - trunk_start(body.skeleton, place)
        lengths['trunk'] = float(np.linalg.norm(up, axis=1).mean())
        # How far the shoulders are above the end of the trunk, which may be less than nothing.
        up /= np.linalg.norm(up, axis=1, keepdims=True)
        lengths['shoulder_rise'] = float(((at(SHOULDERS) - at(('neck',))) * up).sum(1).mean())
    return body.with_segment_lengths(lengths)


def as_text(found: dict[str, Any], *, markdown: bool = False) -> str:
    """Tables for people."""
    head = ['lengths', 'silhouette', 'terms', 'error, mm', '95 %', 'depth, %', 'absolute, %']
    rows = [head]
    for case in found['means']:
        (error, low, high), depth, absolute = (case[key] for key in SHOWN)
        ends = '-' if low is None else f'{low:.0f} to {high:.0f}'
        rows.append(
            [
                case['lengths'], case['silhouette'], case['terms'], f'{error:.0f}',
                ends, f'{depth[0]:+.1f}', f'{absolute[0]:.1f}',
            ]
        )  # fmt: skip
    residuals = [
        f'{name} {cases[0]["coordinate_mm"]:.0f} mm' for name, cases in found['clips'].items()
    ]
    return '\n\n'.join(
        [
            f'From the truth to the optimum, every {found["every"]}th image; mean over '
            f'{", ".join(found["mean_of"])}.',
            table(rows, left=3, markdown=markdown),
            'By clip, error in mm and depth in %: the best pose, the three terms together, then '
            'with the true silhouette, with true lengths, and with both.',
            table(_by_clip(found['clips']), markdown=markdown),
            f'Best pose of the body, a coordinate of a joint: {", ".join(residuals)}.',
        ]
    )


def _by_clip(clips: dict[str, list[dict[str, Any]]]) -> list[list[str]]:
    columns = {
        'best pose': (OF_SUBJECT, '-', BEST_POSE),
        'optimum': (OF_SUBJECT, SUBTRACTED, TOGETHER),
        'true silhouette': (OF_SUBJECT, TRUE, TOGETHER),
        'true lengths': (TRUE, SUBTRACTED, TOGETHER),
        'both true': (TRUE, TRUE, TOGETHER),
    }
    rows = [['clip', *columns]]
    for name, cases in clips.items():
        of = {(case['lengths'], case['silhouette'], case['terms']): case for case in cases}
        rows.append([name, *(_cell(of.get(key)) for key in columns.values())])
    return rows


def _cell(case: dict[str, Any] | None) -> str:
    return '-' if case is None else f'{case["error_mm"]:.0f}, {case["depth_percent"]:+.1f} %'
