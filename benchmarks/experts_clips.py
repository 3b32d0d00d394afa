"""Predictions for the images of clips with known truth.

Masks are the true ones, and those of background subtraction with the empty scene. A second
predictor has not learned from the motions that the clips were made from.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.clips import Clip, find_clips, read_clip
from benchmarks.experts_motion import BEST_OF, learn_from, predictor_of, recorded
from benchmarks.smoothing_clips import NAMES, true_joints
from hmt_ros.evaluation.pose_scores import ORIGIN, joint_mixtures, score
from hmt_ros.evaluation.track_scores import Truth
from hmt_ros.experts.descriptor.contour import NoSilhouetteError
from hmt_ros.experts.pose_predictor import PosePredictor
from hmt_ros.image.background import BackgroundModel
from hmt_ros.inference import GaussianMixture
from msg_tools.files.array_file import read_archive

Mask = NDArray[np.uint8]

# Recorded motions that the clips were made from.
SOURCES = ('cmu_07_05_slowwalk', 'cmu_13_29_exercise')
WANTED_MM, WANTED_WORSE = 110.0, 1.15
STEP = 2  # interval of the images that are predicted without propagation


def clips(name: str = 'local', samples: int = 6000, *, quick: bool = False) -> dict[str, Any] | str:
    """Scores by clip, with and without the clips' motions in training, or why there are none."""
    try:
        folders, source = find_clips(None)
        folders = [folder for folder in folders if folder.name in NAMES]
        if not folders:
            return f'skipped: {source} has none of {", ".join(NAMES)}'
        trained = {
            'all motions': recorded('train'),
            'without the clips': recorded('train', without=SOURCES),
        }
    except ValueError as error:
        return f'skipped: {error}'
    if quick:
        folders = folders[:1]
    seen = [read_clip(folder, 8 if quick else None) for folder in folders]
    result: dict[str, Any] = {'model': name, 'samples': samples}
    for what, sequences in trained.items():
        predictor, _ = predictor_of(learn_from(sequences, samples), name)
        result[what] = of_predictor(predictor, seen)
    return result


def of_predictor(predictor: PosePredictor, seen: Sequence[Clip]) -> dict[str, Any]:
    """Scores of a predictor by clip and kind of mask, and their means over clips."""
    result: dict[str, Any] = {'clips': {}}
    for clip in seen:
        background = BackgroundModel.from_image(clip.background)
        masks: dict[str, list[Mask]] = {
            'subtracted': [background.silhouette(image).view(np.uint8) for image in clip.images]
        }
        true = true_masks(clip)
        if true is not None:
            masks['true'] = true
        result['clips'][clip.name] = {
            kind: of_masks(predictor, clip, which) for kind, which in masks.items()
        }
    for kind in ('true', 'subtracted'):
        rows = [entry[kind] for entry in result['clips'].values() if kind in entry]
        result[kind] = {
            key: float(np.mean([row[key] for row in rows])) for key in (rows[0] if rows else {})
        }
    result['wanted'] = wanted(result)
    return result


def wanted(result: dict[str, Any]) -> list[dict[str, Any]]:
    """Targets for the means over clips, and whether they are met."""
    if not result['true']:
        return []
    best = result['true']['best_mm']
    worse = result['subtracted']['best_mm'] / best
    return [
        {
            'what': f'best of {BEST_OF}, true masks, mm', 'value': best,
            'wanted': f'at most {WANTED_MM:.0f}', 'met': best <= WANTED_MM,
        },
        {
            'what': 'subtracted over true masks', 'value': worse,
            'wanted': f'at most {WANTED_WORSE:.2f}', 'met': worse <= WANTED_WORSE,
        },
    ]  # fmt: skip


def true_masks(clip: Clip) -> list[Mask] | None:
    """The true silhouettes of a clip; None if its truth has none."""
    content = read_archive(clip.folder / 'truth.npz')
    if 'masks' not in content:
        return None
    width = clip.images[0].shape[1]
    packed = dict(zip(content['stamps'].tolist(), content['masks'], strict=True))
    return [np.unpackbits(packed[stamp], axis=1)[:, :width] for stamp in clip.stamps]


def of_masks(predictor: PosePredictor, clip: Clip, masks: Sequence[Mask]) -> dict[str, float]:
    """Errors of single predictions and of propagated ones, mm, and coverage."""
    truth, depth = true_joints(clip), true_depths(clip.truth, clip.stamps)
    rows = np.arange(0, len(masks), STEP)
    alone = predictions(predictor, clip, [masks[i] for i in rows], propagated=False)
    found = score(joint_mixtures(predictor.body, alone), truth[rows], samples=200).summary()
    after = predictions(predictor, clip, masks, propagated=True)
    followed = score(joint_mixtures(predictor.body, after), truth, samples=2).summary()
    off = [abs(x.means[0, 2] - z) / z for x, z in zip(alone, depth[rows], strict=True)]
    return {
        'best_mm': found['best_mm'],
        'heaviest_mm': found['heaviest_mm'],
        'depth_error': float(np.mean(off)),
        'coverage_90': found['coverage_90'],
        'joint_coverage_90': found['joint_coverage_90'],
        'propagated_best_mm': followed['best_mm'],
        'propagated_heaviest_mm': followed['heaviest_mm'],
    }


def predictions(
    predictor: PosePredictor, clip: Clip, masks: Sequence[Mask], *, propagated: bool
) -> list[GaussianMixture]:
    """Mixtures over poses; where nobody is seen, the previous one."""
    result: list[GaussianMixture] = []
    for number, mask in enumerate(masks):
        before = result[-1] if result and propagated else None
        try:
            seen = predictor.observe(mask, clip.camera, before, max_components=BEST_OF)
        except NoSilhouetteError as error:
            if not result:
                raise ValueError(f'{clip.name}: image {number}: {error}') from error
            result.append(result[-1])
        else:
            result.append(seen.mixture)
    return result


def true_depths(truth: Truth, stamps: Sequence[int]) -> NDArray[np.float64]:
    """Depth of the pelvis (T,), m."""
    pelvis = truth.joint_names.index(ORIGIN)
    return np.array([truth.joints[stamp][pelvis, 2] for stamp in stamps])


def as_rows(result: dict[str, Any]) -> list[list[str]]:
    """A table for people."""
    rows = [
        [
            'learned from', 'clip', 'masks', 'best of 5, mm', 'heaviest, mm', 'depth', '90 %',
            'joint 90 %', 'propagated, best of 5', 'heaviest',
        ]
    ]  # fmt: skip
    for what in ('all motions', 'without the clips'):
        entries = dict(result[what]['clips'])
        entries['mean'] = {kind: result[what][kind] for kind in ('true', 'subtracted')}
        for name, entry in entries.items():
            for kind, s in entry.items():
                if not s:
                    continue
                rows.append(
                    [
                        what, name, kind, f'{s["best_mm"]:.0f}', f'{s["heaviest_mm"]:.0f}',
                        f'{100 * s["depth_error"]:.1f} %', f'{100 * s["coverage_90"]:.0f} %',
                        f'{100 * s["joint_coverage_90"]:.0f} %',
                        f'{s["propagated_best_mm"]:.0f}', f'{s["propagated_heaviest_mm"]:.0f}',
                    ]
                )  # fmt: skip
    return rows
