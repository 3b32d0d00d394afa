"""Tracks that start from predictions, compared with tracks that start from a subject file.

A subject file has the joints in one image and the person's segment lengths. Predictions have
neither: their lengths are those of the training motions.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.clips import Clip, find_clips, read_clip
from benchmarks.experts_motion import BEST_OF
from benchmarks.runs import follow, new_tracker
from benchmarks.tracking_scores import scores_of
from hmt_ros.body import load_body
from hmt_ros.experts.pose_predictor import PosePredictor, load_predictor
from hmt_ros.image.background import BackgroundModel
from hmt_ros.tracking import PosePrediction, Tracker, TrackerSettings

NAMES = ('walk', 'exercise', 'charleston')  # of the clips
WANTED = 1.20  # ratio to the error of the track from a subject file
SHOWN = ('best_mm', 'heaviest_mm', 'kept', 'coverage_90', 'joint_coverage_90')


def starts(*, quick: bool = False) -> dict[str, Any] | str:
    """Scores by clip of both kinds of start, or the reason why there are none."""
    try:
        folders = [folder for folder in find_clips(None)[0] if folder.name in NAMES]
    except ValueError as error:
        return f'skipped: {error}'
    predictor, body, settings = load_predictor(), load_body('human37'), TrackerSettings()
    result: dict[str, Any] = {'clips': {}}
    for folder in folders[:1] if quick else folders:
        clip = read_clip(folder, 6 if quick else None)
        assert clip.background is not None
        background = BackgroundModel.from_image(clip.background)
        unstarted = Tracker(body, clip.camera, settings, background, 0)
        predict = Predicting(predictor, clip)
        found = {
            'subject': scores_of(follow(clip, new_tracker(clip, body, settings, 0), 0)),
            'prediction': scores_of(follow(clip, unstarted, 0, predict=predict)),
        }
        result['clips'][clip.name] = {
            what: {key: one[key] for key in SHOWN} for what, one in found.items()
        }
    result['wanted'] = []
    for key in ('best_mm', 'heaviest_mm'):
        by_start = {
            what: float(np.mean([clip[what][key] for clip in result['clips'].values()]))
            for what in ('subject', 'prediction')
        }
        ratio = by_start['prediction'] / by_start['subject']
        result['wanted'].append(
            {
                'what': f'{key.removesuffix("_mm")} from predictions over from a subject file',
                'value': ratio,
                'wanted': f'at most {WANTED:g}',
                'met': ratio <= WANTED,
            }
        )
    return result


class Predicting:
    """Predictions from the images of a clip.

    Args:
        predictor: Predictor that has learned.
        clip: Clip whose empty scene is the background.
    """

    def __init__(self, predictor: PosePredictor, clip: Clip) -> None:
        assert clip.background is not None
        self._predictor, self._camera = predictor, clip.camera
        self._background = BackgroundModel.from_image(clip.background)

    def __call__(self, image: NDArray[np.uint8]) -> PosePrediction:
        """Prediction from an image (H, W, 3)."""
        mask = self._background.silhouette(image)
        found = self._predictor.observe(mask, self._camera, max_components=BEST_OF)
        return PosePrediction(found.mixture, self._predictor.body)


def as_rows(found: dict[str, Any]) -> list[list[str]]:
    """A table."""
    head = ['clip', 'started from', 'best, mm', 'heaviest, mm', 'kept', '90 %', 'joint 90 %']
    rows = [head]
    for clip, both in found['clips'].items():
        for what, one in both.items():
            rows.append(
                [
                    clip, what, f'{one["best_mm"]:.0f}', f'{one["heaviest_mm"]:.0f}',
                    f'{100 * one["kept"]:.0f} %', f'{100 * one["coverage_90"]:.0f} %',
                    f'{100 * one["joint_coverage_90"]:.0f} %',
                ]
            )  # fmt: skip
    return rows
