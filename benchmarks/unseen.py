"""unseen: estimates of limbs that no image shows, on clips with a part cut off.

    waist, knees   the images end there, and keypoints below are missing
    pillar         a grey band, also in the empty scene, covers one side of the person

The tracker starts with the keypoints of a detector. Scores of the hidden joints, relative to the
pelvis and in the camera frame: errors of the weighted mean, published deviation (the root of the
trace of the covariance of all modes together), share within 90 % regions, and log density of the
truth; and their share in the keep-out space of robots at 0.99. The error of the visible joints is
also given.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.clips import Clip, at_rate, read_clip, read_detections, table, with_file
from benchmarks.command import benchmark_parser, run_benchmark
from benchmarks.machine import description
from benchmarks.runs import BOTH, KEYPOINTS, begun, in_processes
from hmt_ros.body.keep_out import keep_out_capsules
from hmt_ros.evaluation.pose_scores import EVALUATED_JOINTS, joint_mixtures
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference.calibration import (
    levels_of,
    marginal_log_densities,
    stratified_samples,
)

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

CLIPS = ('walk', 'signals', 'wander', 'laugh', 'window')
WAIST, KNEES, PILLAR = 'waist', 'knees', 'pillar'
CUTS = (WAIST, KNEES, PILLAR)
JOINTS_AT = {WAIST: ('left_hip', 'right_hip'), KNEES: ('left_knee', 'right_knee')}
RATE, SEED, SAMPLES, HELD = 8.0, 0, 200, 0.9
# Number of images after the start that are not scored; half width of the pillar relative to the
# height of the person; grey level of the pillar.
SETTLING, HALF, GREY = 2, 0.12, 120
QUICK = 6  # number of images with --quick
SCORES = ('off', 'ankle', 'deviation', 'held', 'held_absolute', 'density', 'kept', 'seen')


class Work(NamedTuple):
    """A clip, its cut, the inputs of the tracker, and the number of images; None means all."""

    folder: Path
    cut: str
    inputs: str
    limit: int | None


def hidden_area(clip: Clip, cut: str) -> Mask:
    """Mask (H, W) of the pixels that a cut clip hides: below a row, or in a band of columns."""
    height, width = clip.images[0].shape[:2]
    area = np.zeros((height, width), dtype=np.bool_)
    names = clip.truth.joint_names
    every = np.array([clip.pixels[x] for x in clip.stamps if x in clip.pixels])
    if cut == PILLAR:
        extent = float(np.median(np.ptp(every[:, :, 1], axis=1)))
        side = every[:, [names.index(f'left_{x}') for x in ('hip', 'shoulder', 'wrist')], 0]
        middle = float(np.median(side))
        first, last = (int(middle + s * HALF * extent) for s in (-1, 1))
        area[:, max(first, 0) : max(last, 0)] = True
    else:
        rows = every[:, [names.index(x) for x in JOINTS_AT[cut]], 1]
        area[max(int(np.median(rows)), 0) :] = True
    return area


def cut_clip(clip: Clip, cut: str) -> tuple[Clip, Mask]:
    """The clip with a part cut off, and its `hidden_area`."""
    area = hidden_area(clip, cut)
    kept = slice(None)
    camera = clip.camera
    if cut in JOINTS_AT:
        kept = slice(0, int(np.argmax(area[:, 0])))
        camera = replace(camera, height=kept.stop)

    def seen(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        result = image.copy()
        result[area] = GREY
        return np.ascontiguousarray(result[kept])

    background = None if clip.background is None else seen(clip.background)
    images = [seen(image) for image in clip.images]
    return replace(clip, camera=camera, images=images, background=background), area


def is_hidden(area: Mask, pixels: Array) -> Mask:
    """Whether pixels (N, 2) lie in an area or outside the image."""
    height, width = area.shape
    column, row = np.nan_to_num(pixels, nan=-1.0).round().astype(np.intp).T
    inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
    result = ~inside
    result[inside] = area[row[inside], column[inside]]
    return result


def shown(keypoints: Keypoints, area: Mask, hidden: set[str]) -> Keypoints:
    """Keypoints without those that lie in an area or belong to a hidden joint."""
    gone = is_hidden(area, keypoints.pixels) | [name in hidden for name in keypoints.names]
    return replace(
        keypoints,
        pixels=np.where(gone[:, None], np.nan, keypoints.pixels),
        confidences=np.where(gone, 0.0, keypoints.confidences),
    )


def of_clip(work: Work) -> dict[str, Any]:
    """Scores of the hidden joints, and the error of the others; see above."""
    whole = at_rate(read_clip(work.folder, work.limit), 0.0 if work.limit else RATE)
    clip, area = cut_clip(whole, work.cut)
    tracker, _ = begun(clip, work.inputs, SEED, with_subject=False)
    detections = read_detections(work.folder, lifted=False).keypoints
    names = [x for x in EVALUATED_JOINTS if x in clip.truth.joint_names]
    rows = [clip.truth.joint_names.index(x) for x in names]
    rng = np.random.default_rng(SEED)
    found: dict[str, list[float]] = {name: [] for name in SCORES}
    answered = 0
    for stamp, image in zip(clip.stamps, clip.images, strict=True):
        if stamp not in clip.truth.joints or stamp not in clip.pixels:
            continue
        hidden = is_hidden(area, clip.pixels[stamp][rows])
        keypoints = detections.get(stamp)
        if keypoints is not None:
            of = {name for name, gone in zip(names, hidden, strict=True) if gone}
            of |= {x.replace('ankle', 'toe') for x in of if x.endswith('ankle')}
            keypoints = shown(keypoints, area, of)
        if stamp in clip.views:
            rotation, position = clip.views[stamp]
            tracker.set_camera(position, rotation)
        posterior, _ = tracker.step(image, stamp, keypoints)
        if posterior is None:
            continue
        answered += 1
        if answered <= SETTLING:
            continue
        true = clip.truth.joints[stamp]
        at, centre = true[rows], true[clip.truth.joint_names.index('pelvis')]
        capsules = keep_out_capsules(tracker.estimate.body, posterior, 0.99)
        for origin, key in ((('pelvis',), 'held'), ((), 'held_absolute')):
            (joints,) = joint_mixtures(tracker.estimate.body, [posterior], names, origin=origin)
            wanted = at - centre if origin else at
            density = joints.density()
            drawn = stratified_samples(density, SAMPLES, rng)
            both = np.concatenate([wanted.reshape(1, -1), drawn])
            alone = marginal_log_densities(density, both, 3)
            levels = levels_of(alone[:1], alone[1:])[0]
            found[key] += (levels[hidden] <= HELD).tolist()
            if not origin:
                continue
            mean = np.tensordot(joints.weights, joints.joints, axes=1)
            off = 1e3 * np.linalg.norm(mean - wanted, axis=1)
            spread = np.sqrt(np.diag(density.covariance()).reshape(-1, 3).sum(1))
            found['off'] += off[hidden].tolist()
            ankles = hidden & np.array(['ankle' in x for x in names])
            found['ankle'] += off[ankles].tolist()
            found['deviation'] += (1e2 * spread[ankles]).tolist()
            found['density'] += alone[0][hidden].tolist()
            heaviest = joints.joints[int(np.argmax(joints.weights))]
            found['seen'] += (1e3 * np.linalg.norm(heaviest - wanted, axis=1))[~hidden].tolist()
        found['kept'] += capsules.contain(at[hidden]).tolist()
    return {
        'images': len(clip.images), 'answered': answered,
        **{key: float(np.mean(x)) if x else np.nan for key, x in found.items()},
    }  # fmt: skip


def measure(
    clips: Path | None = None, *, quick: bool = False, names: tuple[str, ...] = CLIPS,
    cuts: tuple[str, ...] = CUTS, inputs: tuple[str, ...] = (BOTH, KEYPOINTS),
) -> dict[str, Any]:  # fmt: skip
    """Scores of `of_clip` for all clips, cuts and inputs.

    Raises:
        FileNotFoundError: there are no clips.
        ValueError: one can not be read.
    """
    folders = with_file(names, clips, 'keypoints_mediapipe.npz')
    limit = None
    if quick:
        folders, cuts, inputs, limit = folders[:1], cuts[:1], inputs[:1], QUICK
    work = [Work(x, cut, given, limit) for given in inputs for cut in cuts for x in folders]
    found = in_processes(of_clip, work, 1 if quick else 0, 'unseen')
    rows = [
        {'clip': x.folder.name, 'cut': x.cut, 'inputs': x.inputs, **scores}
        for x, scores in zip(work, found, strict=True)
    ]
    return {'machine': description(), 'rows': rows}


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """Human-readable table."""
    head = [
        'inputs', 'cut', 'clip', 'answered', 'off, mm', 'ankles, mm', 'said, cm', 'in 90 %',
        'absolute', 'log density', 'kept out', 'others, mm',
    ]  # fmt: skip
    rows = [
        [
            x['inputs'], x['cut'], x['clip'], f'{x["answered"]} of {x["images"]}',
            *(f'{x[key]:.0f}' for key in ('off', 'ankle', 'deviation')),
            *(f'{x[key]:.0%}' for key in ('held', 'held_absolute')),
            f'{x["density"]:.2f}', f'{x["kept"]:.0%}', f'{x["seen"]:.1f}',
        ]
        for x in result['rows']
    ]  # fmt: skip
    return table([head, *rows], left=3, markdown=markdown)


def main(argv: list[str]) -> int:
    """Runs the benchmark."""
    parser = benchmark_parser('unseen', __doc__, quick=f'{QUICK} images of one clip, cut once')
    parser.add_argument('--clips', type=Path, help='folder of clips')
    parser.add_argument('--names', nargs='+', default=CLIPS, help='of the clips')
    parser.add_argument('--cuts', nargs='+', default=CUTS, choices=CUTS, help='how they are cut')
    parser.add_argument(
        '--inputs', nargs='+', default=(BOTH, KEYPOINTS), choices=(BOTH, KEYPOINTS),
        help='what the tracker is given',
    )  # fmt: skip
    options = parser.parse_args(argv)
    return run_benchmark(
        'unseen',
        lambda: measure(
            options.clips,
            quick=options.quick,
            names=tuple(options.names),
            cuts=tuple(options.cuts),
            inputs=tuple(options.inputs),
        ),
        as_text,
        as_json=options.json,
    )
