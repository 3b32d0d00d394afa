"""experts: accuracy of the bundled predictor on images of clips with truth, and its speed.

Masks are the true ones, those of background subtraction with the empty scene, and for real people
those of a detector, if installed. If the truth has no hips, joints are compared relative to the
middle of the shoulders. No person of the clips is in the training data.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.clips import Clip, find_clips, read_clip, table, with_file
from benchmarks.command import benchmark_parser, run_benchmark
from benchmarks.machine import best_time, description
from benchmarks.real_clips import BEAM, DESKS
from benchmarks.runs import in_processes
from benchmarks.tracking_means import GROUPS, group_of
from benchmarks.truth_fits import SHOULDERS
from hmt_ros.detectors.registry import DETECTORS, USUAL_DETECTOR
from hmt_ros.evaluation.pose_scores import joint_mixtures, origin_joints, score
from hmt_ros.evaluation.track_scores import Truth
from hmt_ros.experts.descriptor.contour import NoSilhouetteError, person_blob
from hmt_ros.experts.pose_predictor import PosePredictor, load_predictor
from hmt_ros.image.background import BackgroundModel
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.arrays import Image
from msg_tools.files.array_file import read_archive

Mask = NDArray[np.uint8]

BEST_OF = 5
QUICK = 8  # number of images with --quick
STEP = 2  # interval of the images
TRUE, SUBTRACTED, DETECTED = 'true', 'subtracted', 'detected'
# Clips of real people.
REAL = (BEAM, DESKS[0])
COLUMNS = 'best_mm', 'heaviest_mm', 'depth_error', 'coverage_90', 'joint_coverage_90'


def main(argv: list[str]) -> int:
    """Runs the benchmark."""
    parser = benchmark_parser('experts', __doc__, quick=f'{QUICK} images of one clip')
    parser.add_argument('--clips', type=Path, help='folder of the clips')
    options = parser.parse_args(argv)
    return run_benchmark(
        'experts',
        lambda: measure(options.clips, quick=options.quick),
        as_text,
        as_json=options.json,
    )


def measure(clips: Path | None = None, *, quick: bool = False) -> dict[str, Any]:
    """Scores by clip, their means over groups of clips, and times of a prediction, ms.

    Raises:
        ValueError: there are no clips, or one can not be read.
    """
    folders, _ = find_clips(clips, moving=True, quick=quick)
    if not clips and not quick and folders[0].parent.joinpath(DESKS[0]).is_dir():
        folders = [*folders, *with_file(DESKS[:1], None, 'truth.npz')]
    work = [(folder, QUICK if quick else None) for folder in folders]
    found = in_processes(of_clip, work, 1 if quick else 0, 'experts')
    by_clip = {folder.name: one for (folder, _), one in zip(work, found, strict=True) if one}
    means: dict[str, Any] = {}
    for group in GROUPS:
        for kind in (TRUE, SUBTRACTED):
            rows = [x[kind] for name, x in by_clip.items() if group_of(name) == group and kind in x]
            if rows:
                means.setdefault(group, {})[kind] = {
                    key: float(np.mean([row[key] for row in rows])) for key in rows[0]
                }
    masked = next((x for x in folders if (x / 'background.png').is_file()), None)
    return {
        'machine': description(),
        'clips': by_clip,
        'means': means,
        'ms': None if masked is None else speed(masked, 0.1 if quick else 1.0),
    }


def speed(folder: Path, seconds: float) -> dict[str, float]:
    """Times on the first image of a clip, ms: of the descriptor, and of the whole prediction."""
    clip, predictor = read_clip(folder, 1), load_predictor()
    assert clip.background is not None
    image = clip.images[0]
    silhouette = BackgroundModel.from_image(clip.background).silhouette(image)
    mask = silhouette.view(np.uint8)
    return {
        'descriptor': 1e3
        * best_time(
            lambda: predictor.described(person_blob(mask), clip.camera, image), seconds=seconds
        ),
        'whole': 1e3
        * best_time(lambda: predictor.predict(mask, clip.camera, image), seconds=seconds),
    }


def of_clip(work: tuple[Path, int | None]) -> dict[str, dict[str, float]]:
    """Scores of a clip by kind of mask; empty if there are no masks."""
    clip, predictor = read_clip(*work), load_predictor()
    masks: dict[str, list[Mask]] = {}
    if clip.background is not None:
        background = BackgroundModel.from_image(clip.background)
        masks[SUBTRACTED] = [background.silhouette(x).view(np.uint8) for x in clip.images]
    true = true_masks(clip)
    if true is not None:
        masks[TRUE] = true
    if clip.folder.name in REAL and DETECTORS[USUAL_DETECTOR].is_installed():
        masks[DETECTED] = detected_masks(clip.images, clip.stamps)
    return {kind: of_masks(predictor, clip, which) for kind, which in masks.items()}


def true_masks(clip: Clip) -> list[Mask] | None:
    """The true silhouettes of a clip; None if its truth has none."""
    content = read_archive(clip.folder / 'truth.npz')
    if 'masks' not in content:
        return None
    width = clip.images[0].shape[1]
    packed = dict(zip(content['stamps'].tolist(), content['masks'], strict=True))
    return [np.unpackbits(packed[stamp], axis=1)[:, :width] for stamp in clip.stamps]


def detected_masks(images: Sequence[Image], stamps: Sequence[int]) -> list[Mask]:
    """The masks that the default detector finds in images; empty if it finds nobody."""
    detector = DETECTORS[USUAL_DETECTOR].make(with_mask=True)
    result = []
    for image, stamp in zip(images, stamps, strict=True):
        detector.detect(image, stamp)
        mask = np.zeros(image.shape[:2]) if detector.mask is None else detector.mask
        result.append(np.asarray(mask, dtype=np.uint8))
    return result


def of_masks(predictor: PosePredictor, clip: Clip, masks: Sequence[Mask]) -> dict[str, float]:
    """Errors of predictions, mm, and coverage."""
    alone = predictions(predictor, clip, masks, np.arange(0, len(masks), STEP))
    found = _scores(predictor, clip, alone, 200)
    depth = true_depths(clip.truth, [clip.stamps[i] for i in alone])
    off = [abs(x.means[0, 2] - z) / z for x, z in zip(alone.values(), depth, strict=True)]
    return {
        'best_mm': found['best_mm'],
        'heaviest_mm': found['heaviest_mm'],
        'depth_error': float(np.mean(off)),
        'coverage_90': found['coverage_90'],
        'joint_coverage_90': found['joint_coverage_90'],
    }


def _scores(
    predictor: PosePredictor, clip: Clip, found: dict[int, GaussianMixture], samples: int
) -> dict[str, float]:
    names = clip.truth.joint_names
    origin = _origin(clip.truth)
    every = np.array([clip.truth.joints[clip.stamps[i]] for i in found])
    known = np.isfinite(every).all((0, 2))
    scored = tuple(x for x in clip.truth.evaluated_joints() if known[names.index(x)])
    true = every[:, [names.index(x) for x in scored]]
    true = true - every[:, [names.index(x) for x in origin]].mean(1, keepdims=True)
    mixtures = joint_mixtures(predictor.body, [*found.values()], scored, origin=origin)
    return score(mixtures, true, scored, samples=samples).summary()


def _origin(truth: Truth) -> tuple[str, ...]:
    seen = np.isfinite(np.array([*truth.joints.values()])).all((0, 2))
    try:
        return origin_joints([x for x, known in zip(truth.joint_names, seen) if known])
    except ValueError:
        return SHOULDERS


def predictions(
    predictor: PosePredictor, clip: Clip, masks: Sequence[Mask], rows: NDArray[np.intp]
) -> dict[int, GaussianMixture]:
    """Mixtures over poses by image index, for images with a silhouette and with truth."""
    result: dict[int, GaussianMixture] = {}
    for i in rows.tolist():
        if clip.stamps[i] in clip.truth.joints:
            with contextlib.suppress(NoSilhouetteError):
                seen = predictor.observe(
                    masks[i], clip.camera, max_components=BEST_OF, image=clip.images[i]
                )
                result[i] = seen.mixture
    return result


def true_depths(truth: Truth, stamps: Sequence[int]) -> NDArray[np.float64]:
    """Depth of the hips or the pelvis (T,), m."""
    rows = [truth.joint_names.index(x) for x in _origin(truth)]
    return np.array([truth.joints[stamp][rows, 2].mean() for stamp in stamps])


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """Human-readable table."""
    head = [
        'clip',
        'masks',
        f'best of {BEST_OF}, mm',
        'heaviest, mm',
        'depth',
        '90 %',
        'joint 90 %',
    ]
    rows = [head]
    for name, entry in [*result['clips'].items(), *result['means'].items()]:
        for kind, s in entry.items():
            cells = [_cell(x, s[x]) for x in COLUMNS]
            rows.append([name, kind, *cells])
    text = table(rows, left=2, markdown=markdown)
    spent = result['ms']
    if spent is None:
        return text
    return (
        f'{text}\n\nA silhouette is described in {spent["descriptor"]:.1f} ms; from mask to '
        f'mixture over poses it takes {spent["whole"]:.1f} ms.'
    )


def _cell(name: str, value: float) -> str:
    if 'coverage' in name:
        return f'{100 * value:.0f} %'
    return f'{100 * value:.1f} %' if name == 'depth_error' else f'{value:.0f}'
