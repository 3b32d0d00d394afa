"""What the predictor that ships says of the images of clips with known truth.

Masks are the true ones, and those of background subtraction with the empty scene. Nobody of the
clips was learned from.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.clips import Clip, find_clips, read_clip
from benchmarks.experts_motion import BEST_OF
from benchmarks.runs import in_processes
from benchmarks.tracking_means import GROUPS, group_of
from hmt_ros.evaluation.pose_scores import joint_mixtures, origin_joints, score
from hmt_ros.evaluation.track_scores import Truth
from hmt_ros.experts.descriptor.contour import NoSilhouetteError
from hmt_ros.experts.pose_predictor import ALONE, BY_DYNAMICS, PosePredictor, load_predictor
from hmt_ros.image.background import BackgroundModel
from hmt_ros.inference import GaussianMixture
from msg_tools.files.array_file import read_archive

Mask = NDArray[np.uint8]

WANTED_MM, WANTED_WORSE = 95.0, 1.15
STEP = 2  # interval of the images that are predicted without propagation
TRUE, SUBTRACTED = 'true', 'subtracted'
COLUMNS = (
    'best_mm', 'heaviest_mm', 'depth_error', 'coverage_90', 'joint_coverage_90',
    'propagated_best_mm', 'propagated_heaviest_mm',
)  # fmt: skip


def clips(*, quick: bool = False) -> dict[str, Any] | str:
    """Scores by clip and their means over groups of clips, or why there are none."""
    try:
        folders, _ = find_clips(None, moving=True)
    except ValueError as error:
        return f'skipped: {error}'
    work = [(folder, 8 if quick else None) for folder in (folders[:2] if quick else folders)]
    found = in_processes(of_clip, work, 0, 'experts: clips')
    by_clip = {folder.name: one for (folder, _), one in zip(work, found, strict=True) if one}
    means: dict[str, Any] = {}
    for group in GROUPS:
        for kind in (TRUE, SUBTRACTED):
            rows = [x[kind] for name, x in by_clip.items() if group_of(name) == group and kind in x]
            if rows:
                means.setdefault(group, {})[kind] = {
                    key: float(np.mean([row[key] for row in rows])) for key in rows[0]
                }
    return {'clips': by_clip, 'means': means, 'wanted': wanted(means)}


def of_clip(work: tuple[Path, int | None]) -> dict[str, dict[str, float]]:
    """Scores of a clip by kind of mask; empty: nothing shows silhouettes."""
    clip, predictor = read_clip(*work), load_predictor()
    masks: dict[str, list[Mask]] = {}
    if clip.background is not None:
        background = BackgroundModel.from_image(clip.background)
        masks[SUBTRACTED] = [background.silhouette(x).view(np.uint8) for x in clip.images]
    true = true_masks(clip)
    if true is not None:
        masks[TRUE] = true
    return {kind: of_masks(predictor, clip, which) for kind, which in masks.items()}


def wanted(means: dict[str, Any]) -> list[dict[str, Any]]:
    """Targets for the means over clips, and whether they are met."""
    result = []
    for group in GROUPS[:2]:
        found = means.get(group, {})
        if TRUE not in found:
            continue
        best = found[TRUE]['best_mm']
        result.append(
            {
                'what': f'{group}: best of {BEST_OF}, true masks, mm', 'value': best,
                'wanted': f'at most {WANTED_MM:.0f}', 'met': best <= WANTED_MM,
            }
        )  # fmt: skip
        if SUBTRACTED in found:
            worse = found[SUBTRACTED]['best_mm'] / best
            result.append(
                {
                    'what': f'{group}: subtracted over true masks', 'value': worse,
                    'wanted': f'at most {WANTED_WORSE:.2f}', 'met': worse <= WANTED_WORSE,
                }
            )  # fmt: skip
    return result


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
    rows = np.arange(0, len(masks), STEP)
    alone = predictions(predictor, clip, masks, rows)
    after = predictions(predictor, clip, masks, np.arange(len(masks)), BY_DYNAMICS)
    found = _scores(predictor, clip, alone, 200)
    followed = _scores(predictor, clip, after, 2)
    depth = true_depths(clip.truth, [clip.stamps[i] for i in alone])
    off = [abs(x.means[0, 2] - z) / z for x, z in zip(alone.values(), depth, strict=True)]
    return {
        'best_mm': found['best_mm'],
        'heaviest_mm': found['heaviest_mm'],
        'depth_error': float(np.mean(off)),
        'coverage_90': found['coverage_90'],
        'joint_coverage_90': found['joint_coverage_90'],
        'propagated_best_mm': followed['best_mm'],
        'propagated_heaviest_mm': followed['heaviest_mm'],
    }


def _scores(
    predictor: PosePredictor, clip: Clip, found: dict[int, GaussianMixture], samples: int
) -> dict[str, float]:
    names = clip.truth.joint_names
    scored, origin = clip.truth.evaluated_joints(), origin_joints(names)
    every = np.array([clip.truth.joints[clip.stamps[i]] for i in found])
    true = every[:, [names.index(x) for x in scored]]
    true = true - every[:, [names.index(x) for x in origin]].mean(1, keepdims=True)
    mixtures = joint_mixtures(predictor.body, [*found.values()], scored, origin=origin)
    return score(mixtures, true, scored, samples=samples).summary()


def predictions(
    predictor: PosePredictor, clip: Clip, masks: Sequence[Mask], rows: NDArray[np.intp],
    propagation: str = ALONE,
) -> dict[int, GaussianMixture]:  # fmt: skip
    """Mixtures over poses by the row of the image, of those that show somebody and have truth."""
    result: dict[int, GaussianMixture] = {}
    before: GaussianMixture | None = None
    last = 0
    for i in rows.tolist():
        interval = 1e-9 * (clip.stamps[i] - last)
        try:
            seen = predictor.observe(
                masks[i], clip.camera, before, interval, propagation=propagation,
                max_components=BEST_OF,
            )  # fmt: skip
        except NoSilhouetteError:
            continue
        before, last = seen.mixture, clip.stamps[i]
        if clip.stamps[i] in clip.truth.joints:
            result[i] = seen.mixture
    return result


def true_depths(truth: Truth, stamps: Sequence[int]) -> NDArray[np.float64]:
    """Depth of the hips or the pelvis (T,), m."""
    rows = [truth.joint_names.index(x) for x in origin_joints(truth.joint_names)]
    return np.array([truth.joints[stamp][rows, 2].mean() for stamp in stamps])


def as_rows(result: dict[str, Any]) -> list[list[str]]:
    """A table for people."""
    rows = [
        [
            'clip', 'masks', f'best of {BEST_OF}, mm', 'heaviest, mm', 'depth', '90 %',
            'joint 90 %', 'by rule (9): best', 'heaviest',
        ]
    ]  # fmt: skip
    for name, entry in [*result['clips'].items(), *result['means'].items()]:
        for kind, s in entry.items():
            cells = [
                f'{100 * s[x]:.0f} %' if 'coverage' in x
                else f'{100 * s[x]:.1f} %' if x == 'depth_error' else f'{s[x]:.0f}'
                for x in COLUMNS
            ]  # fmt: skip
            rows.append([name, kind, *cells])
    return rows
