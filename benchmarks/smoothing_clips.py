"""What smoothing makes of the mixtures that the tracker finds in clips with known truth.

Windows of images are smoothed offline, of each the middle is taken. Errors are those of `evaluate`:
joints relative to the pelvis, the best of K and the heaviest; smoothed marginals have a component
for every trajectory and are reduced to K by the tracker's own rule, so that no more guesses count.
Coverage is that of the whole marginals.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from benchmarks.clips import Clip, find_clips, read_clip
from benchmarks.runs import GIVEN, GRAVITIES, UNKNOWN, new_tracker
from hmt_ros.body import Body, load_body
from hmt_ros.evaluation.pose_scores import (
    EVALUATED_JOINTS,
    ORIGIN,
    JointMixture,
    joint_mixtures,
    score,
)
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.error_model import CueErrors
from hmt_ros.smoothing import LinearGaussianDynamics, MixtureSmoother
from hmt_ros.smoothing.likelihood import counted
from hmt_ros.tracking import TrackerSettings
from hmt_ros.tracking.selection import choose_hypotheses

Array = NDArray[np.float64]

NAMES = ('walk', 'exercise', 'charleston')
# Images that are smoothed together, and how many of them, in the middle, are taken.
WINDOW, TAKEN = 16, 8
TRAJECTORIES = 48
# Kernels, in images, that the modes nearest to the truth are smoothed with.
KERNELS = (1.0, 2.0, 4.0)


def clips(quick: bool = False) -> dict[str, Any] | str:
    """Scores of the filter and of the smoother by clip and gravity, or why there are none."""
    try:
        folders, source = find_clips(None)
    except ValueError as error:
        return f'skipped: {error}'
    folders = [folder for folder in folders if folder.name in NAMES]
    if not folders:
        return f'skipped: {source} has none of {", ".join(NAMES)}'
    if quick:
        folders = folders[:1]
    found: dict[str, Any] = {}
    for folder in folders:
        clip = read_clip(folder, 12 if quick else None)
        known = GRAVITIES if clip.ups else (UNKNOWN,)
        found[folder.name] = {gravity: of_clip(clip, gravity) for gravity in known}
    return found


def of_clip(clip: Clip, gravity: str = UNKNOWN) -> dict[str, Any]:
    """Scores of one clip: filter, and smoothed likelihoods; gravity is one of `GRAVITIES`."""
    tracker = new_tracker(clip, load_body('human37'), TrackerSettings(), 0)
    posteriors, likelihoods, errors = [], [], []
    for stamp, image in zip(clip.stamps, clip.images, strict=True):
        if gravity == GIVEN:
            tracker.set_gravity(clip.ups[stamp])
        posterior, likelihood = tracker.step(image, stamp)
        if posterior is None or likelihood is None:
            raise ValueError(f'{clip.folder.name}: nobody at {stamp} ns')
        posteriors.append(posterior)
        likelihoods.append(likelihood)
        errors.append(tracker.likelihood_errors)
    truth = true_joints(clip)
    return compared(tracker.body, clip.stamps, posteriors, likelihoods, errors, truth)


def compared(
    body: Body,
    stamps: Sequence[int],
    posteriors: Sequence[GaussianMixture],
    likelihoods: Sequence[GaussianMixture],
    errors: Sequence[CueErrors],
    truth: Array,
) -> dict[str, Any]:
    """Scores of the filter, of what smoothing makes of it, and how much averaging could gain."""
    count = max(len(mixture) for mixture in posteriors)
    filtered = joint_mixtures(body, posteriors)
    found = smoothed_marginals(body, stamps, likelihoods, errors)
    few = [reduced(body, mixture, count) for mixture in found]
    return {
        'filter': scores(filtered, filtered, truth),
        'likelihoods': scores(joint_mixtures(body, few), joint_mixtures(body, found), truth),
        'oracle': oracle(filtered, truth),
    }


def scores(few: list[JointMixture], whole: list[JointMixture], truth: Array) -> dict[str, float]:
    """Errors of reduced mixtures in mm, coverage of whole ones."""
    error, density = score(few, truth, samples=2).summary(), score(whole, truth).summary()
    return {
        **{key: error[key] for key in ('best_mm', 'heaviest_mm', 'expected_mm', 'modes')},
        **{key: density[key] for key in ('coverage_90', 'joint_coverage_90')},
        'negative_log_likelihood': density['negative_log_likelihood'],
    }


def smoothed_marginals(
    body: Body,
    stamps: Sequence[int],
    likelihoods: Sequence[GaussianMixture],
    errors: Sequence[CueErrors],
) -> list[GaussianMixture]:
    """Marginals at all times, from overlapping windows; the motion as the tracker expects it."""
    smoother = MixtureSmoother(
        LinearGaussianDynamics.random_walk(body.rates), body.lower, body.upper,
        max_trajectories=TRAJECTORIES, adapt=(), through_modes=True,
    )  # fmt: skip
    intervals = np.diff(stamps, prepend=-np.inf) * 1e-9
    mixtures = [
        counted(likelihood, one.share(dt))
        for likelihood, one, dt in zip(likelihoods, errors, intervals, strict=True)
    ]
    margin = (WINDOW - TAKEN) // 2
    result: list[GaussianMixture] = []
    for first in range(0, len(mixtures), TAKEN):
        low, high = max(first - margin, 0), min(first + TAKEN + margin, len(mixtures))
        found = smoother.smooth(mixtures[low:high], stamps_ns=stamps[low:high])
        last = min(first + TAKEN, len(mixtures))
        result += [found.marginal(t - low) for t in range(first, last)]
    return result


def reduced(body: Body, mixture: GaussianMixture, count: int) -> GaussianMixture:
    """At most `count` components that stand for all, as the tracker chooses its modes."""
    mixture = mixture[mixture.weights > 0].normalised()
    joints = body.joint_positions(mixture.means)
    same = TrackerSettings().hypothesis_merge_distance
    kept = choose_hypotheses(joints - joints[:, :1], np.log(mixture.weights), count, same=same)
    weights = np.exp(kept.log_weights - np.logaddexp.reduce(kept.log_weights))
    return GaussianMixture(weights, mixture.means[kept.chosen], mixture.covariances[kept.chosen])


def oracle(filtered: list[JointMixture], truth: Array) -> dict[str, Any]:
    """How far averaging over time may come at best.

    The mode nearest to the truth is taken in every image, which no smoother knows, and its joints
    are averaged with the Gaussian kernel that helps most; and the autocorrelation of its errors.
    """
    near = np.array(
        [
            mixture.joints[np.linalg.norm(mixture.joints - true, axis=2).mean(1).argmin()]
            for mixture, true in zip(filtered, truth, strict=True)
        ]
    )

    def mean_error(joints: Array) -> float:
        return float(1e3 * np.linalg.norm(joints - truth, axis=2).mean())

    error = near - truth - (near - truth).mean(0)
    power = (error * error).mean()
    lags = [lag for lag in (1, 3, 6, 12) if lag < len(truth)]
    return {
        'best_mm': mean_error(near),
        'averaged_mm': min(mean_error(gaussian_filter1d(near, s, axis=0)) for s in KERNELS),
        'constant_mm': float(1e3 * np.linalg.norm((near - truth).mean(0), axis=1).mean()),
        'autocorrelation': {
            str(lag): float((error[:-lag] * error[lag:]).mean() / power) for lag in lags
        },
    }


def true_joints(clip: Clip) -> Array:
    """Relative to the pelvis, (T, J, 3) m."""
    names = [clip.truth.joint_names.index(name) for name in (ORIGIN, *EVALUATED_JOINTS)]
    joints = np.array([clip.truth.joints[stamp][names] for stamp in clip.stamps])
    return np.asarray(joints[:, 1:] - joints[:, :1], dtype=np.float64)


def as_rows(result: dict[str, Any]) -> list[list[str]]:
    """A table for people."""
    head = ['clip', 'gravity', '', 'best of 8, mm', 'heaviest, mm', '90 %', 'joint 90 %', '-log p']
    rows = [head]
    entries = [(name, gravity, x) for name, mine in result.items() for gravity, x in mine.items()]
    for name, gravity, entry in entries:
        for what, label in (('filter', 'filter'), ('likelihoods', 'smoothed')):
            s = entry[what]
            rows.append(
                [
                    name, gravity, label, f'{s["best_mm"]:.0f}', f'{s["heaviest_mm"]:.0f}',
                    f'{100 * s["coverage_90"]:.0f} %', f'{100 * s["joint_coverage_90"]:.0f} %',
                    f'{s["negative_log_likelihood"]:.1f}',
                ]
            )  # fmt: skip
        averaged = f'{entry["oracle"]["averaged_mm"]:.0f}'
        rows.append([name, gravity, 'nearest mode, averaged', averaged, '-', '-', '-', '-'])
    return rows
