"""keep_out: how often a true joint is outside the keep-out space of a robot.

The tracker follows all clips with known truth, with given gravity, at several image rates. A joint
is missed if it lies in none of `keep_out_capsules` of an answered image. Misses and volumes are
given as functions of the requested probability; volumes are relative to the capsules of the
heaviest mode without uncertainty, widened by 0.1 m. The same is measured in each second after a
second without images.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.clips import at_rate, find_clips, read_clip, table
from benchmarks.command import benchmark_parser, run_benchmark
from benchmarks.machine import description
from benchmarks.runs import BOTH, GIVEN, IMAGES, in_processes, tracked, true_joints
from benchmarks.tracking_means import GROUPS, group_of
from hmt_ros.body.keep_out import MARGIN, Capsules, keep_out_capsules
from msg_tools.messages.headers import SECOND_NS

PROBABILITIES = (0.9, 0.95, 0.99, 0.997)
AFTER_GAPS = 0.0  # stands for a rate
RATES = (30.0, 8.0, 3.0, AFTER_GAPS)
GAP = SECOND_NS  # duration of alternating images and gaps
# Maximum number of scored images per second.
LOOKS = 5.0
# Margin of the capsules used as the unit of volume, m; number of random points for a volume.
WIDER, SAMPLES = 0.1, 4_000
QUICK = 12  # number of images with --quick


class Work(NamedTuple):
    """A clip and its conditions; see `smoothing.Work`."""

    folder: Path
    inputs: str
    rate: float
    limit: int | None


def of_clip(work: Work) -> dict[str, list[float]]:
    """Shares of images with a missed joint, and median volumes, by probability."""
    clip = read_clip(work.folder, work.limit)
    if work.rate == AFTER_GAPS:
        start = clip.stamps[0]
        kept = [i for i, stamp in enumerate(clip.stamps) if (stamp - start) // GAP % 2 == 0]
        stamps, images = ([x[i] for i in kept] for x in (clip.stamps, clip.images))
        clip = replace(clip, stamps=stamps, images=images)
        answered = tracked(clip, work.inputs, GIVEN)
        seen = [x for x in answered if x.stamp - start >= GAP and x.stamp in clip.truth.joints]
    else:
        clip = at_rate(clip, work.rate)
        answered = tracked(clip, work.inputs, GIVEN)
        seen = [x for x in answered if x.stamp in clip.truth.joints]
    seen = seen[:: max(round((work.rate or 30.0) / LOOKS), 1)]
    missed: list[list[bool]] = [[] for _ in PROBABILITIES]
    volumes: list[list[float]] = [[] for _ in PROBABILITIES]
    for one, joints in zip(seen, true_joints(clip, [x.stamp for x in seen]), strict=True):
        known = joints[np.isfinite(joints).all(1)]
        heaviest = one.posterior[[int(one.posterior.weights.argmax())]].normalised()
        exact = replace(heaviest, covariances=1e-12 * np.eye(heaviest.dimension)[None])
        own = keep_out_capsules(one.body, exact)
        usual = Capsules(own.starts, own.ends, own.radii - MARGIN + WIDER)
        for i, probability in enumerate(PROBABILITIES):
            capsules = keep_out_capsules(one.body, one.posterior, probability)
            missed[i].append(not capsules.contain(known).all())
            volumes[i].append(volume(capsules) / volume(usual))
    return {
        'missed': [float(np.mean(x)) if x else np.nan for x in missed],
        'volume': [float(np.median(x)) if x else np.nan for x in volumes],
    }


def volume(capsules: Capsules) -> float:
    """Volume of the union of capsules, m^3, by random points in its bounding box."""
    reach = capsules.radii[:, None]
    low = (np.minimum(capsules.starts, capsules.ends) - reach).min(0)
    high = (np.maximum(capsules.starts, capsules.ends) + reach).max(0)
    points = np.random.default_rng(0).uniform(low, high, size=(SAMPLES, 3))
    return float(capsules.contain(points).mean() * np.prod(high - low))


def measure(clips: Path | None = None, *, quick: bool = False) -> dict[str, Any]:
    """Scores of `of_clip` for all clips, as means over groups of clips.

    Raises:
        ValueError: there are no clips, or one can not be read.
    """
    folders = find_clips(clips, moving=True, quick=quick)[0]
    folders = [
        x for x in folders if quick or clips is not None or (x / 'keypoints_mediapipe.npz').exists()
    ]
    inputs, rates, limit = (IMAGES, BOTH), RATES, None
    if quick:
        folders, inputs, rates, limit = folders[:1], (IMAGES,), RATES[:1], QUICK
    work = [Work(x, given, rate, limit) for rate in rates for given in inputs for x in folders]
    found = in_processes(of_clip, work, 1 if quick else 0, 'keep_out')
    means = []
    for group in GROUPS:
        for rate in rates:
            for given in inputs:
                own = [
                    scores for one, scores in zip(work, found, strict=True)
                    if (one.rate, one.inputs) == (rate, given)
                    and group_of(one.folder.name) == group
                ]  # fmt: skip
                if own:
                    means.append(
                        {
                            'clips': group, 'rate': rate, 'inputs': given,
                            **{
                                name: np.nanmean([x[name] for x in own], axis=0).tolist()
                                for name in ('missed', 'volume')
                            },
                        }
                    )  # fmt: skip
    return {'machine': description(), 'probabilities': list(PROBABILITIES), 'means': means}


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """Human-readable table."""
    rows = [
        ['inputs', 'images a second', *(f'{p:g}: missed, volume' for p in result['probabilities'])]
    ]
    for group in dict.fromkeys(x['clips'] for x in result['means']):
        rows.append([group, *[''] * (len(rows[0]) - 1)])
        rows += [
            [
                one['inputs'],
                f'{one["rate"]:g}' if one['rate'] else '30, after a gap',
                *(
                    f'{100 * missed:.1f} %, {volume:.1f}'
                    for missed, volume in zip(one['missed'], one['volume'], strict=True)
                ),
            ]
            for one in result['means']
            if one['clips'] == group
        ]
    return table(rows, markdown=markdown)


def main(argv: list[str]) -> int:
    """Runs the benchmark."""
    parser = benchmark_parser('keep_out', __doc__, quick=f'{QUICK} images of one clip')
    parser.add_argument('--clips', type=Path, help='folder of clips')
    options = parser.parse_args(argv)
    return run_benchmark(
        'keep_out',
        lambda: measure(options.clips, quick=options.quick),
        as_text,
        as_json=options.json,
    )
