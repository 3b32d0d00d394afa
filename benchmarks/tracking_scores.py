"""What the record of a run says: errors, calibration and motion, against the truth of its clip.

Joints are compared relative to the origin, as in `hmt_ros.evaluation.pose_scores`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.clips import read_detections
from benchmarks.runs import JOINTS, Record
from hmt_ros.app.truth import read_truth
from hmt_ros.evaluation.pose_scores import EVALUATED_JOINTS, HIPS, LOST
from hmt_ros.inference.calibration import coverage

Array = NDArray[np.float64]

ANKLES = ('left_ankle', 'right_ankle')
# Images are consecutive when no more time passes than this, in usual intervals.
LONGEST_INTERVAL = 1.5
DRAWS = 2000
# Shortest true path of the root that is scored, m, and the steps that paths are measured in, s.
LEAST_PATH, PATH_STEP = 1.0, 0.5


def scores_of(record: Record) -> dict[str, Any]:
    """Means over the images of a run.

    Returns:
        Mean distances of the joints in mm: `heaviest_mm` of the heaviest mode, `expected_mm` of the
        weighted mean of the modes, `point_mm` of the point estimate, `best_mm` of the best mode,
        `blind_mm` of the blind control, `aligned_mm` of the point estimate after the similarity
        that fits best. Of the point estimate also `root_percent`, distance of the origin from its
        true position, and `depth_percent`, signed, both in % of the true distance and depth;
        `path_percent`, the same distance in the world in % of the length of the true path, and
        `path_length_percent`, by how much the estimated path is longer, where the true one has
        `LEAST_PATH`;
        `acceleration` over that of the truth; `feet`, the speed of standing ankles, m/s. `kept` is
        the share of all images whose heaviest mode errs by less than 150 mm. Of the density:
        `coverage_50`, `coverage_90` of the region of all joints, `joint_coverage_50`,
        `joint_coverage_90` of those of single joints, `by_joint_90` (J,) of the evaluated joints,
        `negative_log_likelihood`. `weights` is the mean of log(K w), w the weight of the nearest of
        K modes: 0 if weights are uniform. `evaluations` and `ms` count an image. What is unknown
        is NaN.
    """
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
        'expected_mm': 1e3 * _distances(expected, true).mean(),
        'point_mm': 1e3 * _distances(point, true).mean(),
        'best_mm': 1e3 * error[rows, nearest].mean(),
        'blind_mm': 1e3 * record.blind.mean(),
        'aligned_mm': 1e3 * _distances(procrustes_aligned(point, true), true).mean(),
        'root_percent': 100.0
        * (np.linalg.norm(root - true_root, axis=1) / np.linalg.norm(true_root, axis=1)).mean(),
        'depth_percent': 100.0 * (root[:, 2] / true_root[:, 2] - 1.0).mean(),
        **path_scores(record),
        'kept': (heaviest < LOST).sum() / record.images[0],
        'weights': np.log(weights[rows, nearest] * present.sum(1)).mean(),
        'coverage_50': coverage(record.levels, 0.5),
        'coverage_90': coverage(record.levels, 0.9),
        'joint_coverage_50': coverage(record.joint_levels, 0.5),
        'joint_coverage_90': coverage(record.joint_levels, 0.9),
        'by_joint_90': by_joint,
        'negative_log_likelihood': -record.log_densities.mean(),
        'acceleration': acceleration_ratio(record.stamps, point, true),
        'feet': standing_speed(record),
        'evaluations': record.evaluations.mean(),
        'ms': 1e3 * np.median(record.seconds),
    }


def detector_scores(folder: Path, limit: int | None = None) -> dict[str, Any]:
    """The same of a detector's own 3D poses, where it has them: twelve joints, aligned at the hips.

    Args:
        folder: of the clip.
        limit: number of images; None: all.

    Raises:
        ValueError: the clip has no keypoints of a detector.
    """
    found, truth = read_detections(folder), read_truth(folder / 'truth.npz')
    names = [x for x in EVALUATED_JOINTS if x in found.names and x in truth.joint_names]
    hips = [names.index(name) for name in HIPS]
    images = sorted(truth.joints)[:limit]
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
        'kept': (errors < LOST).sum() / len(images),
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
    """Mean second difference of joints (T, J, 3) over that of the truth; NaN: there is none."""
    pairs = _consecutive(stamps)
    three = pairs[1:] & pairs[:-1]
    if not three.any():
        return float('nan')
    own, theirs = (
        np.linalg.norm(np.diff(x, 2, axis=0)[three], axis=2).mean() for x in (joints, true)
    )
    return float(own / theirs) if theirs > 0 else float('nan')


def path_scores(record: Record) -> dict[str, float]:
    """Scores of the path of the point estimate's origin in the world; NaN: nobody goes anywhere."""
    own, true = (in_world(record, joints[:, :1])[:, 0] for joints in (record.point, record.true))
    # Steps in which nobody's trembling adds to the length.
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
    """Joints (T, J, 3) of the camera frames of a record in the world, m."""
    rotations, positions = record.views[:, :, :3], record.views[:, None, :, 3]
    result: Array = joints @ rotations.transpose(0, 2, 1) + positions
    return result


def standing_speed(record: Record) -> float:
    """Speed of the point estimate's ankles in the world while the feet stand, m/s; NaN: unknown."""
    if len(record.contact) == 0:
        return float('nan')
    placed = in_world(record, record.point[:, [JOINTS.index(name) for name in ANKLES]])
    speeds = np.linalg.norm(np.diff(placed, axis=0), axis=2)
    speeds /= 1e-9 * np.diff(record.stamps)[:, None]
    standing = record.contact[1:] & record.contact[:-1] & _consecutive(record.stamps)[:, None]
    return float(speeds[standing].mean()) if standing.any() else float('nan')


def interval(
    values: Array, *, draws: int = DRAWS, seed: int = 0
) -> tuple[float | None, float | None, float | None]:
    """Mean over clips with the interval that holds it with a probability of 95 %, by bootstrap.

    Clips are drawn with replacement, and of each drawn clip its seeds. Clips without values are
    left out.

    Args:
        values: (clips, seeds); NaN: unknown.
        draws: number of draws.
        seed: of the draws.

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


def _distances(joints: Array, true: Array) -> Array:
    """Mean distances of joints (..., J, 3)."""
    result: Array = np.linalg.norm(joints - true, axis=-1).mean(-1)
    return result


def _consecutive(stamps: NDArray[np.int64]) -> NDArray[np.bool_]:
    """(T - 1,) whether an image follows on the one before it without a gap."""
    gaps = np.diff(stamps)
    usual = np.median(gaps) if len(gaps) else 0.0
    return np.asarray(gaps <= LONGEST_INTERVAL * usual, dtype=np.bool_)
