"""Scores of a run's record against the truth of its clip: errors, calibration and motion.

Joints are compared relative to the origin, as in `hmt_ros.evaluation.pose_scores`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from benchmarks.clips import read_detections, rows_at_rate
from benchmarks.runs import JOINTS, Record
from hmt_ros.app.truth import read_truth
from hmt_ros.evaluation.pose_scores import EVALUATED_JOINTS, HIPS, LOST_ERROR
from hmt_ros.inference.calibration import coverage
from hmt_ros.tracking import Status

Array = NDArray[np.float64]

ANKLES = ('left_ankle', 'right_ankle')
# Maximum interval between consecutive images, in usual intervals.
LONGEST_INTERVAL = 1.5
DRAWS = 2000
# Keys of what `scores_of` returns besides `by_joint_90`.
SCORES = (
    'heaviest_mm', 'lagged_mm', 'hips_mm', 'expected_mm', 'point_mm', 'best_mm', 'blind_mm',
    'aligned_mm', 'root_percent', 'depth_percent', 'path_percent', 'path_length_percent', 'kept',
    'weights', 'coverage_50', 'coverage_90', 'joint_coverage_50', 'joint_coverage_90',
    'absolute_coverage_50', 'absolute_coverage_90', 'volume', 'negative_log_likelihood',
    'acceleration', 'feet', 'wrong_way', 'wrong_way_images', 'wrong_sign', 'nobody',
    'evaluations', 'evaluations_99', 'ms', 'cpu_ms',
)  # fmt: skip
# Segments of limbs whose depth sign is scored, and the minimum angle to the image plane, rad.
LIMBS = tuple(
    (f'{side}_{near}', f'{side}_{far}')
    for near, far in (
        ('shoulder', 'elbow'), ('elbow', 'wrist'), ('hip', 'knee'), ('knee', 'ankle'),
    )
    for side in ('left', 'right')
)  # fmt: skip
SLANTED = np.radians(15.0)
# Minimum length of a true path for its scores, m, and time step of path lengths, s.
LEAST_PATH, PATH_STEP = 1.0, 0.5


def scores_of(record: Record) -> dict[str, Any]:
    """Means over the images of a run.

    Returns:
        Mean distances of the joints in mm: `heaviest_mm` of the heaviest mode, `lagged_mm` of the
        heaviest one given the next `LAG` images, `expected_mm` of the
        weighted mean of the modes, `point_mm` of the point estimate, `best_mm` of the best mode,
        `blind_mm` of the blind control, `aligned_mm` of the point estimate after the similarity
        that fits best. Of the point estimate also `root_percent`, distance of the origin from its
        true position, and `depth_percent`, signed, both in % of the true distance and depth;
        `path_percent`, the same distance in the world in % of the length of the true path, and
        `path_length_percent`, the excess length of the estimated path, if the true one has
        `LEAST_PATH`;
        `acceleration` over that of the truth; `feet`, the speed of standing ankles, m/s. `kept` is
        the share of all images whose heaviest mode errs by less than 150 mm. Of the density:
        `coverage_50`, `coverage_90` of the region of all joints, `joint_coverage_50`,
        `joint_coverage_90` of those of single joints, `by_joint_90` (J,) of the evaluated joints,
        `absolute_coverage_50`, `absolute_coverage_90` of single joints in the frame of the camera,
        `volume`, the mean volume of the latter, l, `negative_log_likelihood`. `weights` is the mean
        of log(K w), w the weight of the nearest of K modes: 0 if weights are uniform. Of the
        heaviest mode `hips_mm`, its error relative to the middle of the hips; `wrong_way`, the
        share of images in which it faces the wrong way, and `wrong_way_images`, their number;
        `wrong_sign`, the share of slanted limbs whose slope in depth has the wrong sign. `nobody`
        is the share of all images in which the track had ended. `evaluations` is the mean number in
        an image, `evaluations_99` the 99th percentile; `ms` the median time of a step, `cpu_ms` its
        mean processor time. Unknown scores are NaN; of
        a run that found nobody, only `kept` is known.
    """
    if len(record.stamps) == 0:
        return scores_of_nobody()
    known: NDArray[np.bool_] = np.asarray(np.isfinite(record.true).all((0, 2)))
    known[0] = False
    true = record.true[:, known] - record.true[:, :1]
    modes = record.joints[:, :, known] - record.joints[:, :, :1]
    point = record.point[:, known] - record.point[:, :1]
    present = record.weights > 0
    weights = record.weights / record.weights.sum(1, keepdims=True)
    expected = np.einsum('tk,tkjc->tjc', weights, np.where(present[..., None, None], modes, 0.0))
    error = np.where(present, _distances(modes, true[:, None]), np.inf)
    rows = np.arange(len(error))
    heaviest, nearest = error[rows, weights.argmax(1)], error.argmin(1)
    root, true_root = record.point[:, 0], record.true[:, 0]
    by_joint = np.full(len(EVALUATED_JOINTS), np.nan)
    by_joint[known[1:]] = [coverage(levels, 0.9) for levels in record.joint_levels.T]
    return {
        'heaviest_mm': 1e3 * heaviest.mean(),
        'lagged_mm': lagged_error(record, error),
        'hips_mm': hips_error(record, known[1:]),
        'expected_mm': 1e3 * _distances(expected, true).mean(),
        'point_mm': 1e3 * _distances(point, true).mean(),
        'best_mm': 1e3 * error[rows, nearest].mean(),
        'blind_mm': 1e3 * record.blind.mean(),
        'aligned_mm': 1e3 * _distances(procrustes_aligned(point, true), true).mean(),
        'root_percent': 100.0
        * (np.linalg.norm(root - true_root, axis=1) / np.linalg.norm(true_root, axis=1)).mean(),
        'depth_percent': 100.0 * (root[:, 2] / true_root[:, 2] - 1.0).mean(),
        **path_scores(record),
        'kept': (heaviest < LOST_ERROR).sum() / record.images[0],
        'weights': np.log(weights[rows, nearest] * present.sum(1)).mean(),
        'coverage_50': coverage(record.levels, 0.5),
        'coverage_90': coverage(record.levels, 0.9),
        'joint_coverage_50': coverage(record.joint_levels, 0.5),
        'joint_coverage_90': coverage(record.joint_levels, 0.9),
        'by_joint_90': by_joint,
        **absolute_scores(record),
        'negative_log_likelihood': -record.log_densities.mean(),
        'acceleration': acceleration_ratio(record.stamps, point, true),
        'feet': standing_speed(record),
        **facing_scores(record),
        'wrong_sign': wrong_sign(record),
        'nobody': absent_share(record),
        'evaluations': record.evaluations.mean(),
        'evaluations_99': np.percentile(record.evaluations, 99),
        'ms': 1e3 * np.median(record.seconds),
        'cpu_ms': 1e3 * record.cpu_seconds.mean() if len(record.cpu_seconds) else np.nan,
    }


def absolute_scores(record: Record) -> dict[str, float]:
    """Coverage and volume of regions of single joints in the camera frame; NaN if unknown."""
    levels, volumes = record.absolute_levels, record.volumes
    known = levels.size > 0
    return {
        'absolute_coverage_50': coverage(levels, 0.5) if known else np.nan,
        'absolute_coverage_90': coverage(levels, 0.9) if known else np.nan,
        'volume': 1e3 * float(volumes.mean()) if known else np.nan,
    }


def scores_of_nobody() -> dict[str, Any]:
    """Scores of a run without any posterior: `kept` is 0, the others are unknown."""
    return {
        **dict.fromkeys(SCORES, np.nan),
        'kept': 0.0,
        'by_joint_90': np.full(len(EVALUATED_JOINTS), np.nan),
    }


def lagged_error(record: Record, errors: Array) -> float:
    """Mean error of the mode that is heaviest given later images, mm; NaN if unknown.

    Args:
        record: record of a run.
        errors: (T, K) errors of the modes, m.
    """
    if record.lagged.shape != errors.shape:
        return float('nan')
    return float(1e3 * errors[np.arange(len(errors)), record.lagged.argmax(1)].mean())


def heaviest_joints(record: Record) -> Array:
    """Joints (T, J, 3) of the heaviest mode, m, camera frame."""
    result: Array = record.joints[np.arange(len(record.joints)), record.weights.argmax(1)]
    return result


def hips_error(record: Record, known: NDArray[np.bool_]) -> float:
    """Mean error of the heaviest mode's joints relative to the middle of the hips, mm.

    Args:
        record: record of a run.
        known: (J - 1,) whether each scored joint has a truth.
    """
    hips = [JOINTS.index(name) for name in HIPS]
    both = (heaviest_joints(record), record.true)
    own, true = ((x - x[:, hips].mean(1, keepdims=True))[:, 1:][:, known] for x in both)
    return float(1e3 * _distances(own, true).mean())


def facing_scores(record: Record) -> dict[str, float]:
    """Share and number of images in which the heaviest mode faces the wrong way.

    Wrong means by more than 90 degrees. NaN if the truth lacks hips or shoulders.
    """
    own, true = (facing(joints) for joints in (heaviest_joints(record), record.true))
    agreement = (own * true).sum(1)
    wrong = agreement[np.isfinite(agreement)] < 0
    if len(wrong) == 0:
        return {'wrong_way': np.nan, 'wrong_way_images': np.nan}
    return {'wrong_way': float(wrong.mean()), 'wrong_way_images': float(wrong.sum())}


def facing(joints: Array) -> Array:
    """Directions (T, 3) in which people face, not normalised, from joints (T, J, 3).

        (left - right) x (shoulders - hips),    left - right of hips and shoulders together

    They point forwards in right-handed frames.
    """
    left_hip, right_hip, left_shoulder, right_shoulder = (
        joints[:, JOINTS.index(f'{side}_{name}')]
        for name in ('hip', 'shoulder')
        for side in ('left', 'right')
    )
    across = (left_hip - right_hip) + (left_shoulder - right_shoulder)
    up = (left_shoulder + right_shoulder) - (left_hip + right_hip)
    return np.asarray(np.cross(across, up), dtype=np.float64)


def wrong_sign(record: Record) -> float:
    """Share of slanted limbs of the heaviest mode that lean the wrong way in depth.

    Limbs are upper and lower arms and legs; a limb is slanted if its true angle to the image plane
    is more than `SLANTED`. NaN if none is.
    """
    near, far = ([JOINTS.index(ends[i]) for ends in LIMBS] for i in (0, 1))
    own, true = (x[:, far] - x[:, near] for x in (heaviest_joints(record), record.true))
    lengths = np.linalg.norm(true, axis=2)
    slanted = np.abs(true[..., 2]) > np.sin(SLANTED) * lengths  # false without truth
    if not slanted.any():
        return float('nan')
    return float((own[..., 2] * true[..., 2] < 0)[slanted].mean())


def absent_share(record: Record) -> float:
    """Share of the images of a run in which its track had ended; NaN if unknown.

    These are images after the first tracked one in which the tracker reports nobody in view, or
    waits for a person to start a new track.
    """
    without = np.isin(record.statuses, [Status.NOBODY.value, Status.WAITING.value])
    if without.all():
        return float('nan')
    return float(without[np.argmin(without) :].sum() / len(without))


def detector_scores(folder: Path, limit: int | None = None, rate: float = 0.0) -> dict[str, Any]:
    """The same scores of a detector's own 3D poses, if any: twelve joints, aligned at the hips.

    Args:
        folder: folder of the clip.
        limit: maximum number of images; None means all.
        rate: maximum number of images per second; 0 means all.

    Raises:
        ValueError: the clip has no keypoints of a detector.
    """
    found, truth = read_detections(folder), read_truth(folder / 'truth.npz')
    names = [x for x in EVALUATED_JOINTS if x in found.names and x in truth.joint_names]
    hips = [names.index(name) for name in HIPS]
    images = sorted(truth.joints)[:limit]
    images = [images[i] for i in rows_at_rate(images, rate)]
    stamps = [stamp for stamp in images if stamp in found.joints]
    own = np.array([found.joints[stamp] for stamp in stamps])
    own = own.reshape(-1, len(found.names), 3)[:, [found.names.index(x) for x in names]]
    true = np.array([truth.joints[stamp] for stamp in images if stamp in found.joints])
    true = true.reshape(-1, len(truth.joint_names), 3)
    true = true[:, [truth.joint_names.index(x) for x in names]]
    own, true = (x - x[:, hips].mean(1, keepdims=True) for x in (own, true))
    errors = _distances(own, true)
    some = len(stamps) > 0
    return {
        'point_mm': 1e3 * errors.mean() if some else np.nan,
        'aligned_mm': 1e3 * _distances(procrustes_aligned(own, true), true).mean()
        if some
        else np.nan,
        'kept': (errors < LOST_ERROR).sum() / len(images),
        'acceleration': acceleration_ratio(np.array(stamps), own, true),
    }


def procrustes_aligned(points: Array, targets: Array) -> Array:
    """Points (N, J, 3), each set rotated, scaled and moved to fit its targets (N, J, 3) best.

    The least squares solution of Umeyama, "Least-squares estimation of transformation parameters
    between two point patterns" (1991).
    """
    a, b = (x - x.mean(1, keepdims=True) for x in (points, targets))
    u, s, v = np.linalg.svd(a.transpose(0, 2, 1) @ b)
    # No reflection.
    sign = np.sign(np.linalg.det(u @ v))
    s[:, 2] *= sign
    u[:, :, 2] *= sign[:, None]
    scale = s.sum(1) / np.maximum((a * a).sum((1, 2)), 1e-12)
    result: Array = scale[:, None, None] * (a @ (u @ v)) + targets.mean(1, keepdims=True)
    return result


def acceleration_ratio(stamps: NDArray[np.int64], joints: Array, true: Array) -> float:
    """Mean second difference of joints (T, J, 3) over the true one; NaN if that is unknown."""
    pairs = _consecutive(stamps)
    three = pairs[1:] & pairs[:-1]
    if not three.any():
        return float('nan')
    own, theirs = (
        np.linalg.norm(np.diff(x, 2, axis=0)[three], axis=2).mean() for x in (joints, true)
    )
    return float(own / theirs) if theirs > 0 else float('nan')


def path_scores(record: Record) -> dict[str, float]:
    """Scores of the path of the point estimate's origin in the world; NaN if it is too short."""
    own, true = (in_world(record, joints[:, :1])[:, 0] for joints in (record.point, record.true))
    # Steps are long, so that jitter does not add to the length.
    usual = np.median(np.diff(record.stamps)) if len(own) > 1 else 1e9
    step = max(round(PATH_STEP * 1e9 / usual), 1)
    lengths = [np.linalg.norm(np.diff(x[::step], axis=0), axis=1).sum() for x in (own, true)]
    if not lengths[1] >= LEAST_PATH:
        return {'path_percent': np.nan, 'path_length_percent': np.nan}
    apart = np.linalg.norm(own - true, axis=1).mean()
    return {
        'path_percent': float(100.0 * apart / lengths[1]),
        'path_length_percent': float(100.0 * (lengths[0] / lengths[1] - 1.0)),
    }


def in_world(record: Record, joints: Array) -> Array:
    """Joints (T, J, 3) of a record, transformed from camera frames to the world, m."""
    rotations, positions = record.views[:, :, :3], record.views[:, None, :, 3]
    result: Array = joints @ rotations.transpose(0, 2, 1) + positions
    return result


def standing_speed(record: Record) -> float:
    """World speed of the point estimate's ankles while the feet stand, m/s; NaN if unknown."""
    if len(record.contact) == 0:
        return float('nan')
    placed = in_world(record, record.point[:, [JOINTS.index(name) for name in ANKLES]])
    speeds = np.linalg.norm(np.diff(placed, axis=0), axis=2)
    speeds /= 1e-9 * np.diff(record.stamps)[:, None]
    standing = record.contact[1:] & _consecutive(record.stamps)[:, None]
    return float(speeds[standing].mean()) if standing.any() else float('nan')


def interval(
    values: Array, *, draws: int = DRAWS, seed: int = 0
) -> tuple[float | None, float | None, float | None]:
    """Mean over clips with its 95 % interval, by bootstrap.

    Clips are drawn with replacement, then seeds within each drawn clip. Clips without values are
    left out.

    Args:
        values: (clips, seeds) scores; NaN if unknown.
        draws: number of draws.
        seed: seed of the draws.

    Returns:
        Mean, lower and upper end; None without values. One clip has no interval.
    """
    values = values[np.isfinite(values).all(1)]
    clips, seeds = values.shape
    if clips == 0 or seeds == 0:
        return None, None, None
    mean = float(values.mean())
    if clips == 1:
        return mean, None, None
    rng = np.random.default_rng(seed)
    drawn = rng.integers(clips, size=(draws, clips, 1))
    means = values[drawn, rng.integers(seeds, size=(draws, clips, seeds))].mean((1, 2))
    low, high = np.quantile(means, [0.025, 0.975])
    return mean, float(low), float(high)


def interval_over_seeds(differences: Array) -> tuple[float, float] | None:
    """The 95 % interval of the mean of paired differences (seeds,) of one clip, by Student's t.

    A few seeds are too few for a bootstrap, whose interval would be too narrow.

    Returns:
        Lower and upper end; None for fewer than two seeds or unknown values.
    """
    n = len(differences)
    if n < 2 or not np.isfinite(differences).all():
        return None
    half = student.ppf(0.975, n - 1) * differences.std(ddof=1) / np.sqrt(n)
    return float(differences.mean() - half), float(differences.mean() + half)


def _distances(joints: Array, true: Array) -> Array:
    """Mean distances of joints (..., J, 3)."""
    result: Array = np.linalg.norm(joints - true, axis=-1).mean(-1)
    return result


def _consecutive(stamps: NDArray[np.int64]) -> NDArray[np.bool_]:
    """(T - 1,) whether an image follows the previous one without a gap."""
    gaps = np.diff(stamps)
    usual = np.median(gaps) if len(gaps) else 0.0
    return np.asarray(gaps <= LONGEST_INTERVAL * usual, dtype=np.bool_)
