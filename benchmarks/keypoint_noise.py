"""keypoint_noise: positions of a detector's landmarks on the body, and their errors.

The body, with the true lengths, is fitted to the true joints of rendered clips. For every landmark
this gives the offset from its joint, in the frame of the joint's segment, that explains the
detector's pixels best (robust least squares, both sides mirrored onto the right); the remaining
deviations, in m at the person, by confidence and from image to image, and their correlation in
time; errors of the depths that the detector estimates; and how often it exchanges left and right.
`hmt_ros/image/keypoint_schemes.yaml` contains the results.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from benchmarks.clips import SCHEME, Clip, read_detections, table, with_file
from benchmarks.command import benchmark_parser, run_benchmark, told
from benchmarks.machine import description
from benchmarks.truth_fits import CLIPS, QUICK, QUICK_IMAGES, best_poses, fitted
from hmt_ros.body import Body
from hmt_ros.body.kinematics import forward
from hmt_ros.body.skeleton import other_side
from hmt_ros.experts.lifter import lifted_positions
from hmt_ros.image.keypoint_schemes import MIRROR, noise_of, schemes
from hmt_ros.image.lifted_poses import HIPS
from hmt_ros.image.terms.keypoints import EXCHANGED, Keypoints, KeypointTerm

Array = NDArray[np.float64]

# Scale of the robust kernel of offsets, m, and number of its iterations.
KERNEL, ITERATIONS = 0.06, 30
# Bins of the confidence, and of the number of images from one deviation to another.
BINS = (0.0, 0.2, 0.4, 0.6, 0.8, 0.95, 1.0001)
# Bins of the distance from the landmark of the other side, m, and the landmarks of limbs.
APART = (0.0, 0.05, 0.1, 0.15, 0.2, 0.3, np.inf)
LIMBS = {
    'arms': ('elbow', 'wrist', 'pinky', 'index', 'thumb'),
    'legs': ('knee', 'ankle', 'heel', 'foot_index'),
}
IMAGES_APART = (1, 2, 5, 10, 20)
# Bound to which deviations are clipped for correlations, m.
FURTHEST = 0.1
# Frame rate of the clips, Hz; median absolute value of a Gaussian, in standard deviations.
RATE, MEDIAN = 30.0, 0.6745
KINDS = ('none', 'all', 'arms', 'legs')
# Minimum number of errors in a bin.
FEWEST = 20


@dataclass(frozen=True, eq=False)
class Seen:
    """One landmark in the images of one clip, M of them.

    Attributes:
        name: name of the landmark; left ones are mirrored to the right.
        by_offset: (M, 2, 3) derivative of the pixel by the offset, over the magnification.
        errors: (M, 2) pixel minus that of the joint, over the magnification, m.
        confidences: (M,) confidences of the detector.
        images: (M,) image numbers, increasing.
        apart: (M,) distance from the other side's landmark, m on the person; NaN for the nose.
    """

    name: str
    by_offset: Array
    errors: Array
    confidences: Array
    images: NDArray[np.intp]
    apart: Array


@dataclass(frozen=True, eq=False)
class Clips:
    """Results for clips: landmarks, exchange in each image, errors of depths by joint."""

    seen: list[Seen]
    exchanges: list[NDArray[np.intp]]
    depths: list[tuple[str, Array]]


def measured(folder: Path, limit: int | None = None) -> Clips:
    """Compares a detector's keypoints of one clip with the truth.

    Raises:
        ValueError: the clip can not be read or has no keypoints.
    """
    clip, body, starts = fitted(folder, limit)
    detections = read_detections(folder).keypoints
    stamps = [s for s in clip.stamps if s in detections and detections[s].seen.any()]
    poses = best_poses(body, clip, stamps, starts)
    found = [detections[stamp] for stamp in stamps]
    exchanges = np.array(
        [_exchange(body, clip, x, pose) for x, pose in zip(found, poses, strict=True)]
    )
    return Clips(
        _landmarks(body, clip, stamps, poses, found, exchanges), [exchanges],
        _depths(body, clip, found, poses, exchanges),
    )  # fmt: skip


def _term(body: Body, clip: Clip, keypoints: Keypoints, pose: Array) -> KeypointTerm:
    even = np.log(np.full((1, len(EXCHANGED)), 1.0 / len(EXCHANGED)))
    return KeypointTerm(
        body.skeleton, clip.camera, keypoints,
        magnification=clip.camera.magnification(float(pose[2])), exchanges=even,
    )  # fmt: skip


def _exchange(body: Body, clip: Clip, keypoints: Keypoints, pose: Array) -> int:
    """The exchange of sides that explains keypoints best at the true pose."""
    frames = forward(body.skeleton, pose[None])
    found = _term(body, clip, keypoints, pose).exchanged(frames, np.zeros(1, dtype=np.intp))
    return int(np.argmax(found[0]))


def _landmarks(
    body: Body,
    clip: Clip,
    stamps: Sequence[int],
    poses: Array,
    found: Sequence[Keypoints],
    exchanges: NDArray[np.intp],
) -> list[Seen]:
    """Landmarks in images without an exchange of sides; left ones are mirrored to the right."""
    frames = forward(body.skeleton, poses)
    columns, _ = frames.by_pose()
    truth = {name: i for i, name in enumerate(clip.truth.joint_names)}
    true = np.array([clip.truth.joints[stamp] for stamp in stamps])
    own = frames.joints().transpose(2, 0, 1)
    raw = read_raw(clip.folder, stamps)
    result = []
    for name, mark in zip(schemes()[SCHEME].names, schemes()[SCHEME].landmarks, strict=True):
        if not mark.joint:
            continue
        joint = body.joint_names.index(mark.joint)
        places = true[:, truth[mark.joint]] if mark.joint in truth else own[:, joint]
        pixels, confidences = (x[name] for x in raw)
        centre, projection = clip.camera.project_with_derivative(places.T)
        magnification = np.array([clip.camera.magnification(float(z)) for z in places[:, 2]])
        segment = int(body.skeleton.joint_segments[joint])
        by_offset = np.einsum('abn,ncb->nac', projection, columns[:, segment])
        left = name.startswith('left_')
        by_offset = by_offset * (MIRROR if left else 1.0)
        other = other_side(name)
        apart = np.linalg.norm(pixels - raw[0][other], axis=1) if other != name else np.nan
        apart = apart / magnification
        errors = pixels - centre.T
        use = np.flatnonzero(np.isfinite(errors).all(1) & (exchanges == 0))
        scale = magnification[use, None]
        result.append(
            Seen(
                name.replace('left_', 'right_'),
                by_offset[use] / scale[..., None],
                errors[use] / scale,
                confidences[use],
                use,
                apart[use],
            )
        )
    return result


def read_raw(folder: Path, stamps: Sequence[int]) -> tuple[dict[str, Array], dict[str, Array]]:
    """Pixels (T, 2) and confidences (T,) of every landmark of a clip, by name."""
    with np.load(folder / 'keypoints_mediapipe.npz') as content:
        rows = {int(stamp): t for t, stamp in enumerate(content['stamps'])}
        which = [rows[stamp] for stamp in stamps]
        names = [str(name) for name in content['landmark_names']]
        pixels, confidences = content['pixels'][which], content['visibility'][which]
    return (
        {name: pixels[:, i].astype(float) for i, name in enumerate(names)},
        {name: confidences[:, i].astype(float) for i, name in enumerate(names)},
    )


def _depths(
    body: Body,
    clip: Clip,
    found: Sequence[Keypoints],
    poses: Array,
    exchanges: NDArray[np.intp],
) -> list[tuple[str, Array]]:
    """Estimated minus true depths of lifted joints relative to the hips, by joint, m."""
    skeleton, result = body.skeleton, []
    hips = skeleton.joint_index(HIPS)
    for keypoints, pose, exchange in zip(found, poses, exchanges, strict=True):
        lifted = lifted_positions(clip.camera, keypoints) if exchange == 0 else None
        if lifted is None:
            continue
        joints = body.joint_positions(pose[None])[0]
        true = (joints[skeleton.joint_index(lifted.joints)] - joints[hips].mean(0)) @ lifted.axes[2]
        errors = lifted.sized(skeleton)[0, :, 2] - true
        names = [name.rpartition('_')[2] for name in lifted.joints]
        result += [(name, np.array([error])) for name, error in zip(names, errors, strict=True)]
    return result


def robust_offset(by_offset: Array, errors: Array) -> Array:
    """The offset (3,) that explains errors (M, 2) best, by reweighted least squares."""
    offset = np.zeros(3)
    for _ in range(ITERATIONS):
        left = errors - by_offset @ offset
        weights = 1.0 / (1.0 + (left**2).sum(1) / KERNEL**2) ** 2
        hessian = np.einsum('nab,nac,n->bc', by_offset, by_offset, weights)
        hessian += 1e-3 * weights.sum() * np.eye(3)
        offset = np.linalg.solve(hessian, np.einsum('nab,na,n->b', by_offset, errors, weights))
    return offset


def correlation(errors: Sequence[Array], images: Sequence[NDArray[np.intp]], apart: int) -> float:
    """Correlation of errors (M, 2) of the same landmark, `apart` images apart."""
    product, square = 0.0, 0.0
    for own, when in zip(errors, images, strict=True):
        clipped = np.clip(own, -FURTHEST, FURTHEST)
        later = {int(i): row for row, i in enumerate(when)}
        pairs = [(r, later[int(i) + apart]) for r, i in enumerate(when) if int(i) + apart in later]
        if pairs:
            first, second = (clipped[[pair[i] for pair in pairs]] for i in range(2))
            product += float((first * second).sum())
            square += float((first * first).sum())
    return product / square if square > 0 else float('nan')


def summary(found: Sequence[Clips]) -> dict[str, Any]:
    """Offsets, deviations, correlations, depths and exchanges of clips."""
    every = [seen for clip in found for seen in clip.seen]
    landmarks, left, ordered, names = {}, [], [], []
    for name in dict.fromkeys(seen.name for seen in every):
        own = [seen for seen in every if seen.name == name]
        by_offset, errors = (
            np.concatenate([getattr(x, field) for x in own]) for field in ('by_offset', 'errors')
        )
        offset = robust_offset(by_offset, errors)
        rest = [x.errors - x.by_offset @ offset for x in own]
        left += rest
        ordered += own
        names += [name] * len(own)
        landmarks[name.removeprefix('right_')] = {
            'offset': offset.tolist(),
            'before': robust_sigma(errors),
            'after': robust_sigma(np.concatenate(rest)),
        }
    whole, sure = np.concatenate(left), np.concatenate([x.confidences for x in ordered])
    kinds = [name.removeprefix('right_') for name, x in zip(names, left, strict=True) for _ in x]
    apart = np.concatenate([seen.apart for seen in ordered])
    pairs = {
        limb: _by_bin((whole / noise_of(sure)[:, None])[rows], apart[rows], APART)
        for limb, marks in LIMBS.items()
        for rows in [np.isin(kinds, marks)]
    }
    depths: dict[str, list[float]] = {}
    for clip in found:
        for name, error in clip.depths:
            depths.setdefault(name, []).append(float(error[0]))
    moves = np.zeros((len(KINDS), len(KINDS)))
    for clip in found:
        for kinds in clip.exchanges:
            np.add.at(moves, (kinds[:-1], kinds[1:]), 1.0)
    correlations = {str(n): correlation(left, [x.images for x in ordered], n) for n in IMAGES_APART}
    return {
        'landmarks': landmarks,
        'noise': _by_bin(whole, sure, BINS),
        'pairs': pairs,
        'correlations': correlations,
        'lasting': lasting_shares(correlations),
        'depths': {name: float(np.median(np.abs(x)) / MEDIAN) for name, x in depths.items()},
        'exchanges': {
            name: {
                'share': float(row.sum() / moves.sum()),
                'next': (row / max(row.sum(), 1.0)).tolist(),
            }
            for name, row in zip(KINDS, moves, strict=True)
        },
    }


def _by_bin(errors: Array, by: Array, bins: Sequence[float]) -> list[dict[str, Any]]:
    """Standard deviations of errors (M, 2) by bins of another quantity (M,)."""
    result = []
    for low, high in pairwise(bins):
        inside = errors[(by >= low) & (by < high)]
        if len(inside) >= FEWEST:
            result.append({
                'from': low, 'to': high, 'points': len(inside), 'median': robust_sigma(inside),
                'rms': float(np.sqrt((inside**2).mean())),
            })  # fmt: skip
    return result


def lasting_shares(correlations: dict[str, float]) -> dict[str, float]:
    """Shares of the variance that are white, last for the time `time`, s, and are constant.

    Non-negative least squares for the shares, at the time that fits best.
    """
    gaps = np.array([int(n) for n in correlations]) / RATE
    wanted = np.array(list(correlations.values()))
    best: tuple[float, dict[str, float]] = (np.inf, {})
    for time in np.arange(0.05, 1.01, 0.05):
        basis = np.stack([np.exp(-gaps / time), np.ones(len(gaps))], axis=1)
        shares, misfit = nnls(basis, wanted)
        if misfit < best[0]:
            lasting, constant = shares.tolist()
            white = max(1.0 - lasting - constant, 0.0)
            found = {'white': white, 'lasting': lasting, 'constant': constant, 'time': float(time)}
            best = misfit, found
    return best[1]


def robust_sigma(errors: Array) -> float:
    """Standard deviation of a coordinate from the median norm of errors (M, 2), if Gaussian."""
    return float(np.median(np.linalg.norm(errors, axis=1)) / np.sqrt(2.0 * np.log(2.0)))


def measure(clips: Path | None = None, *, quick: bool = False) -> dict[str, Any]:
    """Offsets and errors of the landmarks over clips.

    Args:
        clips: folder of the clips; None means the development clips.
        quick: a few images of one clip.

    Raises:
        FileNotFoundError: a clip is missing.
        ValueError: a clip can not be used.
    """
    wanted = CLIPS[:QUICK] if quick else CLIPS
    folders = with_file(wanted, clips, 'keypoints_mediapipe.npz')
    limit = QUICK_IMAGES if quick else None
    found = [measured(folder, limit) for folder in told('keypoint_noise', folders)]
    return {'machine': description(), 'clips': list(wanted), **summary(found)}


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """The numbers as tables."""

    def mm(value: float) -> str:
        return f'{1e3 * value:.0f}'

    def bin_cells(x: dict[str, Any], unit: float, form: str) -> list[str]:
        ends = f' to {min(x["to"], 1):g}' if np.isfinite(x['to']) else ' or more'
        numbers = (format(unit * x[name], form) for name in ('median', 'rms'))
        return [f'{x["from"]:g}{ends}', str(x['points']), *numbers]

    landmarks = [['landmark', 'offset x, y, z, mm', 'error at the joint, mm', 'at the offset, mm']]
    landmarks += [
        [name, ', '.join(map(mm, row['offset'])), mm(row['before']), mm(row['after'])]
        for name, row in result['landmarks'].items()
    ]
    heads = ['keypoints', 'deviation by the median', 'rms']
    noise = [['confidence', heads[0], *(f'{x}, mm' for x in heads[1:])]]
    noise += [bin_cells(x, 1e3, '.0f') for x in result['noise']]
    pairs = [
        [[f'{limb}: m from the other side', heads[0], *(f'{x}, of the usual' for x in heads[1:])]]
        + [bin_cells(x, 1.0, '.1f') for x in rows]
        for limb, rows in result['pairs'].items()
    ]
    lasting = [['images apart', *result['correlations']]]
    lasting += [['correlation', *(f'{x:.2f}' for x in result['correlations'].values())]]
    shares = [['errors', *result['lasting']]]
    shares += [['share; s', *(f'{x:.2f}' for x in result['lasting'].values())]]
    depths = [['joint', 'deviation of the depth by the median, mm']]
    depths += [[name, mm(x)] for name, x in result['depths'].items()]
    exchanges = [['exchanged', 'share', *(f'then {name}' for name in KINDS)]]
    exchanges += [
        [name, f'{row["share"]:.3f}', *(f'{x:.3f}' for x in row['next'])]
        for name, row in result['exchanges'].items()
    ]
    parts = (landmarks, noise, *pairs, lasting, shares, depths, exchanges)
    return '\n\n'.join(table(rows, markdown=markdown) for rows in parts)


def main(arguments: list[str]) -> int:
    """Runs the command; returns its exit code."""
    parser = benchmark_parser('keypoint_noise', __doc__, quick='a few images of one clip')
    parser.add_argument('--clips', type=Path, help='folder of the clips')
    options = parser.parse_args(arguments)
    return run_benchmark(
        'keypoint_noise',
        lambda: measure(options.clips, quick=options.quick),
        as_text,
        as_json=options.json,
    )
