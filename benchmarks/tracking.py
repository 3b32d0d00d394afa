"""tracking: accuracy, calibration and speed of the tracker on clips with known truth.

Beside the tracker as it is stand the same tracker with samples of isotropic noise at the same
number of likelihood evaluations, and the tracker with nothing but 2D keypoints to go by: the true
image positions of the joints with noise of 3 px.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from benchmarks.clips import Clip, find_clips, read_clip, table
from benchmarks.command import benchmark_parser, show, told
from benchmarks.machine import description, forget_peak, peak_memory, resident_memory
from benchmarks.stages import StageClock
from hmt_ros.body import Body, load_body
from hmt_ros.body.inverse_kinematics import solve_joint_positions
from hmt_ros.evaluation.pose_scores import EVALUATED_JOINTS, ORIGIN, Scores, joint_mixtures, score
from hmt_ros.image.background import BackgroundModel
from hmt_ros.image.likelihood import OFF
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.image.terms.registry import TERMS
from hmt_ros.inference import GaussianMixture
from hmt_ros.tracking import PosePrediction, Tracker, TrackerSettings, read_subject
from hmt_ros.tracking.initialisation import start_from_keypoints

PARTS = ('accuracy', 'speed')
SEEDS = (0, 1, 2)
TRACKER, SPHERICAL, KEYPOINTS = 'tracker', 'SS samples', '2D keypoints'
KEYPOINT_SIGMA = 3.0  # px
OF_KEYPOINTS = 3  # stream of random numbers of a seed
CALIBRATION_FRAMES = 12

# Mean error of MediaPipe's 3D pose, which gives one answer a frame, as measured on the development
# clips; on `exercise` it swaps left and right.
MEDIAPIPE_MM = {'walk': 147.0, 'exercise': 380.0, 'charleston': 133.0}

OPENCV = 'MOG2 + Canny + distance transform'


def main(argv: list[str]) -> int:
    """Runs the benchmark; 1: there is nothing to run it on."""
    parser = benchmark_parser('tracking', __doc__, quick='20 images a clip, one seed')
    parser.add_argument('--markdown', action='store_true', help='tables for a Markdown page')
    parser.add_argument(
        '--clips', type=Path, metavar='DIR', help='their folder (the development clips, or bags/)'
    )
    parser.add_argument('--only', nargs='+', default=(), metavar='NAME', help='some of the clips')
    parser.add_argument('--seeds', type=int, nargs='+', default=SEEDS, metavar='N')
    parser.add_argument('--parts', nargs='+', choices=PARTS, default=PARTS)
    parser.add_argument(
        '--frames', type=int, default=0, metavar='N',
        help='follow memory over so many images of a clip that is played back and forth',
    )  # fmt: skip
    options = parser.parse_args(argv)
    try:
        result = measure(
            options.clips, options.only, options.seeds, options.parts, options.frames,
            quick=options.quick,
        )  # fmt: skip
    except ValueError as error:
        print(f'tracking: {error}', file=sys.stderr)
        return 1
    return show(result, partial(as_text, markdown=options.markdown), as_json=options.json)


def measure(
    clips: Path | None = None,
    only: Sequence[str] = (),
    seeds: Sequence[int] = SEEDS,
    parts: Sequence[str] = PARTS,
    frames: int = 0,
    *,
    quick: bool = False,
) -> dict[str, Any]:
    """Everything that was asked for.

    Args:
        clips: their folder; None: the development clips, or bags/.
        only: names of some of them; empty: all.
        seeds: of the tracker.
        parts: some of `PARTS`.
        frames: over so many images memory is followed.
        quick: 20 images a clip, one seed.

    Raises:
        ValueError: there is no such clip, or it can not be read.
    """
    folders, source = find_clips(clips)
    limit, seeds = (20, seeds[:1]) if quick else (None, seeds)
    if only:
        folders = [folder for folder in folders if folder.name in only]
    if not folders:
        raise ValueError(f'none of the clips {list(only)} is there')
    result: dict[str, Any] = {'machine': description(), 'clips': source, 'seeds': list(seeds)}
    if 'accuracy' in parts:
        result['model_residual_mm'] = {
            folder.name: 1e3 * model_residual(read_clip(folder, limit), load_body('human37'))
            for folder in folders
        }
        runs = len(folders) * len(seeds) * 3
        with tqdm(total=runs, unit='run', desc='tracking', disable=not sys.stderr.isatty()) as bar:
            result['accuracy'] = [
                entry
                for folder in told('tracking', folders, lambda folder: folder.name)
                for entry in _accuracies(folder, limit, seeds, bar)
            ]
    if 'speed' in parts:
        result['speed'] = speed(read_clip(folders[-1], 20 if quick else 60))
    if frames > 0:
        result['memory'] = memory(read_clip(folders[-1]), frames)
    return result


# Accuracy.


def _accuracies(
    folder: Path, limit: int | None, seeds: Sequence[int], bar: Any
) -> Iterator[dict[str, Any]]:
    clip = read_clip(folder, limit)
    body = load_body('human37')
    settings = TrackerSettings()
    found: dict[str, list[dict[str, Any]]] = {TRACKER: [], SPHERICAL: [], KEYPOINTS: []}
    for seed in seeds:
        own = accuracy(clip, body, settings, seed)
        found[TRACKER].append(own)
        bar.update()
        spherical = _with_evaluations(clip, body, own['evaluations'], seed)
        found[SPHERICAL].append(accuracy(clip, body, spherical, seed))
        bar.update()
        seen = keypoints_of(clip, body, seed)
        found[KEYPOINTS].append(accuracy(clip, body, keypoints_only(settings), seed, seen))
        bar.update()
    for name, entries in found.items():
        yield {'clip': clip.name, 'images': len(clip.images), 'what': name, **_over_seeds(entries)}
    if clip.name in MEDIAPIPE_MM and limit is None:
        yield {'clip': clip.name, 'what': 'MediaPipe', 'heaviest_mm': MEDIAPIPE_MM[clip.name]}


def accuracy(
    clip: Clip,
    body: Body,
    settings: TrackerSettings,
    seed: int,
    keypoints: dict[int, Keypoints] | None = None,
    predict: Callable[[NDArray[np.uint8]], PosePrediction] | None = None,
) -> dict[str, Any]:
    """Scores of one run over a clip, with evaluations and seconds an image.

    Args:
        clip: images and truth.
        body: model of the person.
        settings: of the tracker.
        seed: of the tracker.
        keypoints: by stamp; None: none are used.
        predict: from which the track starts, and which is used in every image; None: the subject.
    """
    tracker = new_tracker(clip, body, settings, seed)
    if predict is not None:
        background = BackgroundModel.from_image(clip.background)
        tracker = Tracker(body, clip.camera, settings, background, seed)
    bodies: list[Body] = []
    mixtures: list[GaussianMixture] = []
    stamps: list[int] = []
    evaluations: list[int] = []
    seconds: list[float] = []
    for stamp, image in zip(clip.stamps, clip.images, strict=True):
        start = time.perf_counter()
        posterior, _ = tracker.step(
            image,
            stamp,
            None if keypoints is None else keypoints[stamp],
            None if predict is None else predict(image),
        )
        seconds.append(time.perf_counter() - start)
        evaluations.append(tracker.evaluations)
        if posterior is not None and stamp in clip.truth.joints:
            bodies.append(tracker.body)
            mixtures.append(posterior)
            stamps.append(stamp)
    summary = scores(clip, bodies, mixtures, stamps).summary()
    summary.pop('by_joint')
    return {
        **summary,
        'evaluations': float(np.mean(evaluations[1:])),
        'ms_per_image': 1e3 * float(np.median(seconds[1:])),
    }


def scores(
    clip: Clip, bodies: list[Body], mixtures: list[GaussianMixture], stamps: list[int]
) -> Scores:
    """Scores of mixtures against the truth of a clip."""
    names = clip.truth.joint_names
    where = [names.index(name) for name in (ORIGIN, *EVALUATED_JOINTS)]
    true = np.array([clip.truth.joints[stamp][where] for stamp in stamps])
    # The body only changes while its flesh is fitted: its kinematics is computed in batches.
    joints = []
    first = 0
    for i in range(1, len(bodies) + 1):
        if i == len(bodies) or bodies[i] is not bodies[first]:
            joints += joint_mixtures(bodies[first], mixtures[first:i])
            first = i
    return score(joints, true[:, 1:] - true[:, :1])


def model_residual(clip: Clip, body: Body, every: int = 8) -> float:
    """Root mean square of what the best pose of a body misses, a coordinate of a joint, m.

    The body has the subject's lengths, as the tracker's; the pose is fitted to the true joints, and
    joints are compared relative to the pelvis, as everywhere.
    """
    start = start_from_keypoints(body, clip.camera, read_subject(clip.subject, body))
    names = [ORIGIN, *EVALUATED_JOINTS]
    where = [clip.truth.joint_names.index(name) for name in names]
    true = np.array([clip.truth.joints[stamp][where] for stamp in clip.stamps[::every]])
    firsts = start.poses[:8]
    targets = np.repeat(true, len(firsts), axis=0)
    solved = solve_joint_positions(start.body, np.tile(firsts, (len(true), 1)), targets, names)
    best = solved.value.reshape(len(true), -1).argmin(1)
    poses = solved.x.reshape(len(true), len(firsts), -1)[np.arange(len(true)), best]
    joints = start.body.joint_positions(poses)[:, start.body.skeleton.joint_index(names)]
    missed = (joints - joints[:, :1]) - (true - true[:, :1])
    return float(np.sqrt((missed[:, 1:] ** 2).mean()))


def new_tracker(clip: Clip, body: Body, settings: TrackerSettings, seed: int) -> Tracker:
    """A tracker that starts with the subject of a clip."""
    background = BackgroundModel.from_image(clip.background)
    tracker = Tracker(body, clip.camera, settings, background, seed)
    tracker.reset(read_subject(clip.subject, body))
    return tracker


def keypoints_only(settings: TrackerSettings) -> TrackerSettings:
    """The same tracker with the terms of the image off."""
    likelihood = replace(
        settings.likelihood,
        **{term.name: OFF for term in TERMS},
    )  # fmt: skip
    return replace(settings, likelihood=likelihood)


def keypoints_of(clip: Clip, body: Body, seed: int) -> dict[int, Keypoints]:
    """True image positions of the body's joints with noise, by stamp."""
    rng = np.random.default_rng([seed, OF_KEYPOINTS])
    names = tuple(name for name in clip.truth.joint_names if name in body.joint_names)
    where = [clip.truth.joint_names.index(name) for name in names]
    covariances = np.tile(KEYPOINT_SIGMA**2 * np.eye(2), (len(names), 1, 1))
    result = {}
    for stamp in clip.stamps:
        pixels = clip.pixels[stamp][where]
        noise = KEYPOINT_SIGMA * rng.normal(size=pixels.shape)
        result[stamp] = Keypoints(names, pixels + noise, covariances, np.ones(len(names)))
    return result


def _with_evaluations(clip: Clip, body: Body, wanted: float, seed: int) -> TrackerSettings:
    """Settings of spherical sampling that evaluate the likelihood as often as wanted, an image."""
    settings = TrackerSettings(proposals='ss')
    tracker = new_tracker(clip, body, settings, seed)
    counts = []
    for stamp, image in islice(zip(clip.stamps, clip.images, strict=True), CALIBRATION_FRAMES):
        tracker.step(image, stamp)
        counts.append(tracker.evaluations)
    samples = settings.samples + wanted - np.mean(counts[1:])
    k = settings.max_hypotheses
    return replace(settings, samples=max(round(samples / k), 1) * k)


def _over_seeds(entries: list[dict[str, Any]]) -> dict[str, Any]:
    """Means over the seeds; of maxima the largest, of lost frames the sum."""
    result: dict[str, Any] = {}
    for key in entries[0]:
        values = [entry[key] for entry in entries]
        if key.endswith('_max_mm'):
            result[key] = max(values)
        elif key in ('frames_lost', 'frames'):
            result[key] = sum(values)
        else:
            result[key] = float(np.mean(values))
    result['by_seed'] = [
        {key: entry[key] for key in ('best_mm', 'heaviest_mm', 'frames_lost', 'coverage_90')}
        for entry in entries
    ]
    return result


# Speed and memory.


def speed(clip: Clip) -> dict[str, Any]:
    """Time of a step and of its stages, and of OpenCV's work on the same images, in turn."""
    forget_peak()
    tracker = new_tracker(clip, load_body('human37'), TrackerSettings(), 0)
    subtractor = cv2.createBackgroundSubtractorMOG2()
    for _ in range(10):
        subtractor.apply(clip.background)
    # Compile, or load what was compiled, before anything is timed.
    for stamp, image in islice(zip(clip.stamps, clip.images, strict=True), 3):
        tracker.step(image, stamp)
    tracker = new_tracker(clip, load_body('human37'), TrackerSettings(), 0)
    clock = StageClock()
    steps, reference = [], []
    with clock.running():
        for i, (stamp, image) in enumerate(zip(clip.stamps, clip.images, strict=True)):
            clock.begin_step()
            start = time.perf_counter()
            tracker.step(image, stamp)
            middle = time.perf_counter()
            opencv_work(subtractor, image)
            reference.append(time.perf_counter() - middle)
            steps.append(middle - start)
            if i == 0:  # the start of a track is told apart
                begin = clock.seconds.copy()
                clock.seconds.clear()
    count = len(steps) - 1
    mean = float(np.mean(steps[1:]))
    stages = {name: 1e3 * spent / count for name, spent in clock.seconds.items()}
    stages['other'] = 1e3 * mean - sum(stages.values())
    height, width = clip.images[0].shape[:2]
    return {
        'clip': clip.name,
        'size': f'{width}x{height}',
        'images': count,
        'steps_per_second': 1.0 / mean,
        'step_ms': 1e3 * mean,
        'step_median_ms': 1e3 * float(np.median(steps[1:])),
        'start_ms': 1e3 * sum(begin.values()),
        'opencv_ms': 1e3 * float(np.mean(reference[1:])),
        'ratio': mean / float(np.mean(reference[1:])),
        'ratio_of_medians': float(np.median(steps[1:]) / np.median(reference[1:])),
        'stages_ms': dict(sorted(stages.items(), key=lambda item: -item[1])),
        'peak_memory_mb': peak_memory() / 1e6,
    }


def opencv_work(subtractor: Any, image: Any) -> Any:
    """What OpenCV does for a silhouette, edges and distances to them."""
    mask = subtractor.apply(image)
    edges = cv2.Canny(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), 40, 100)
    return mask, cv2.distanceTransform(255 - edges, cv2.DIST_L2, 5)


def memory(clip: Clip, frames: int) -> dict[str, Any]:
    """Resident memory while a clip is played back and forth."""
    forget_peak()
    tracker = new_tracker(clip, load_body('human37'), TrackerSettings(), 0)
    every = max(frames // 50, 1)
    seen: list[tuple[int, float]] = []
    images = clip.back_and_forth(frames)
    for i, (stamp, image) in enumerate(
        tqdm(images, total=frames, unit='image', desc='memory', disable=not sys.stderr.isatty())
    ):
        tracker.step(image, stamp)
        if i % every == every - 1:
            seen.append((i + 1, resident_memory()))
    # What grows at the beginning are caches and arenas that fill once.
    late = np.array(seen[len(seen) // 5 :])
    slope = float(np.polyfit(late[:, 0], late[:, 1], 1)[0]) if len(late) > 1 else 0.0
    return {
        'clip': clip.name,
        'images': frames,
        'resident_mb': [[count, size / 1e6] for count, size in seen],
        'growth_kb_per_1000_images': slope,
        'peak_memory_mb': peak_memory() / 1e6,
    }


# What is printed.


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """Tables for people."""
    parts = [f'{result["clips"]}; seeds {", ".join(map(str, result["seeds"]))}']
    if 'accuracy' in result:
        rows = [
            [
                'clip', '', 'best of 8, mm', 'worst', 'heaviest, mm', 'lost', '50 %', '90 %',
                'joint 50 %', 'joint 90 %', '-log p', 'evaluations',
            ]
        ]  # fmt: skip
        rows += [_row(entry) for entry in result['accuracy']]
        parts.append(table(rows, left=2, markdown=markdown))
        residuals = [f'{x} {mm:.0f} mm' for x, mm in result.get('model_residual_mm', {}).items()]
        parts.append(f'Best pose of the body, a coordinate of a joint: {", ".join(residuals)}.')
    if 'speed' in result:
        s = result['speed']
        parts.append(
            f'{s["clip"]} {s["size"]}, {s["images"]} images, {result["machine"]["cores"]} cores: '
            f'{s["steps_per_second"]:.1f} steps/s; a step {s["step_ms"]:.1f} ms, {OPENCV} '
            f'{s["opencv_ms"]:.1f} ms, ratio {s["ratio"]:.1f} (of medians '
            f'{s["ratio_of_medians"]:.1f}); start of the track {s["start_ms"]:.0f} ms; peak memory '
            f'{s["peak_memory_mb"]:.0f} MB'
        )
        rows = [['stage', 'ms']]
        rows += [[name, f'{value:.1f}'] for name, value in s['stages_ms'].items()]
        parts.append(table(rows, markdown=markdown))
    if 'memory' in result:
        m = result['memory']
        first, last = m['resident_mb'][len(m['resident_mb']) // 5], m['resident_mb'][-1]
        parts.append(
            f'memory: {first[1]:.1f} MB after {first[0]} images, {last[1]:.1f} MB after {last[0]}; '
            f'{m["growth_kb_per_1000_images"]:+.0f} kB per 1000 images'
        )
    return '\n\n'.join(parts)


def _row(entry: dict[str, Any]) -> list[str]:
    if 'best_mm' not in entry:
        return [entry['clip'], entry['what'], '-', '-', f'{entry["heaviest_mm"]:.0f}', *'-------']
    return [
        entry['clip'],
        entry['what'],
        f'{entry["best_mm"]:.0f}',
        f'{entry["best_max_mm"]:.0f}',
        f'{entry["heaviest_mm"]:.0f}',
        f'{entry["frames_lost"]}/{entry["frames"]}',
        *(f'{100 * entry[key]:.0f} %' for key in ('coverage_50', 'coverage_90')),
        *(f'{100 * entry[key]:.0f} %' for key in ('joint_coverage_50', 'joint_coverage_90')),
        f'{entry["negative_log_likelihood"]:.1f}',
        f'{entry["evaluations"]:.0f}',
    ]
