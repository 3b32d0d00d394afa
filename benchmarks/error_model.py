"""error_model: how far the errors of a cue are independent, in an image and in time.

At the pose of the body, with the true lengths, that comes nearest to the true joints, a cue has the
gradient u_t and the Gauss-Newton Hessian H_t. If its energy was minus a log density of independent
errors, u_t would have the covariance H_t. What it has instead says how many times too often the
energy counts what it measures [Varin, Reid and Firth 2011, on composite likelihoods]:

    s      = sum_t tr(W_t H_t) / sum_t u_t' W_t u_t,    W_t = (H_t + P_t)^-1                     (1)
    rho(k) = sum_t u_t' W_t u_(t+k) / sum_t u_t' W_t u_t                                        (2)

P_t is the Hessian of the body's prior, so that what a cue does not measure does not count; the
prior itself is judged with P_t = 0. Errors that last have rho = exp(-k dt / tau); tau is fitted to
the lags up to a second. What was made of it stands in `hmt_ros/inference/error_model.py`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from benchmarks.clips import read_detections, table, with_file
from benchmarks.command import benchmark_parser, run_benchmark, told
from benchmarks.machine import description
from benchmarks.truth_fits import CLIPS, QUICK, QUICK_IMAGES, best_poses, fitted
from hmt_ros.body.kinematics import forward
from hmt_ros.image.background import BackgroundModel
from hmt_ros.image.likelihood import ImageLikelihood
from hmt_ros.image.observation import Observation, observe
from hmt_ros.inference.energy import Energy, add_energies

Array = NDArray[np.float64]

IMAGE, KEYPOINTS, PRIOR = CUES = ('image', 'keypoints', 'prior')
LAGS = (1, 2, 3, 5, 10, 20, 30)  # images
# Added to W^-1: a degree of freedom that nothing speaks of, rad^-2 or m^-2.
LEAST = 1e-3
LONGEST = 10.0  # s, of a fitted tau


class Sums(NamedTuple):
    """What the images of a clip add to equations (1) and (2) for one cue.

    Attributes:
        expected, found: numerator and denominator of s.
        products, squares: (L,) numerators and denominators of rho at the lags.
    """

    expected: float
    found: float
    products: Array
    squares: Array


def of_clip(folder: Path, limit: int | None = None) -> tuple[dict[str, Sums], float]:
    """The sums of each cue, and the time from image to image, s.

    Raises:
        ValueError: the clip can not be read.
    """
    clip, body, starts = fitted(folder, limit)
    detections, stamps = read_detections(folder).keypoints, list(clip.stamps)
    poses = best_poses(body, clip, stamps, starts)
    likelihood = ImageLikelihood(body, clip.camera)
    scene = None if clip.background is None else BackgroundModel.from_image(clip.background)
    rows = np.arange(1)
    energies: dict[str, list[Energy | None]] = {name: [] for name in CUES}
    for stamp, image, pose in zip(stamps, clip.images, poses, strict=True):
        frames = forward(body.skeleton, pose[None])
        silhouette = None if scene is None else scene.silhouette(image)
        seen = observe(image, silhouette, wanted=('coverage', 'edges'))
        one = likelihood.energies(frames, seen)
        energies[IMAGE].append(Energy(one.value, one.gradient, one.hessian))
        energies[PRIOR].append(add_energies([x.energy(frames, rows) for x in likelihood.priors]))
        found = detections.get(stamp)
        term = None
        if found is not None and found.seen.any():
            term = likelihood.keypoint_term(Observation(keypoints=found), None)
        energies[KEYPOINTS].append(None if term is None else term.energy(frames, rows))
    priors = [x for x in energies[PRIOR] if x is not None]
    result = {
        name: _sums(own, [x.derivatives()[1][0] * (name != PRIOR) for x in priors])
        for name, own in energies.items()
    }
    return result, float(np.median(np.diff(stamps))) * 1e-9


def _sums(energies: list[Energy | None], priors: list[Array]) -> Sums:
    """The sums over energies of T images, None where there is none; priors are Hessians (d, d)."""
    u = [None if x is None else x.derivatives()[0][0] for x in energies]
    expected = found = 0.0
    products, squares = np.zeros(len(LAGS)), np.zeros(len(LAGS))
    for t, (energy, prior) in enumerate(zip(energies, priors, strict=True)):
        own = u[t]
        if energy is None or own is None:
            continue
        hessian = energy.derivatives()[1][0]
        w = np.linalg.inv(hessian + prior + LEAST * np.eye(len(own)))
        expected += float(np.trace(w @ hessian))
        square = float(own @ w @ own)
        found += square
        for i, lag in enumerate(LAGS):
            later = u[t + lag] if t + lag < len(u) else None
            if later is not None:
                products[i] += own @ w @ later
                squares[i] += square
    return Sums(expected, found, products, squares)


def lasting(correlations: Array, apart: Array) -> float:
    """tau, s: the exponential that comes nearest to correlations (L,) at times apart (L,), s."""
    fit = minimize_scalar(
        lambda log: float(((np.exp(-apart * np.exp(-log)) - correlations) ** 2).sum()),
        bounds=(np.log(1e-3), np.log(LONGEST)), method='bounded',
    )  # fmt: skip
    return float(np.exp(fit.x))


def measure(clips: Path | None = None, *, quick: bool = False) -> dict[str, Any]:
    """Shares and times of the cues over clips.

    Args:
        clips: folder of the clips; None: the development clips.
        quick: a few images of two clips.

    Raises:
        FileNotFoundError: a clip is not there.
        ValueError: a clip that can not be used.
    """
    wanted = CLIPS[:QUICK] if quick else CLIPS
    folders = with_file(wanted, clips, 'keypoints_mediapipe.npz')
    limit = QUICK_IMAGES if quick else None
    found = [of_clip(folder, limit) for folder in told('error_model', folders)]
    dt = float(np.median([dt for _, dt in found]))
    cues = {}
    for name in CUES:
        own = [sums[name] for sums, _ in found]
        products, squares = (
            np.sum([getattr(x, part) for x in own], axis=0) for part in ('products', 'squares')
        )
        reached = squares > 0.0
        correlations = products[reached] / squares[reached]
        apart = dt * np.array(LAGS)[reached]
        cues[name] = {
            'share': sum(x.expected for x in own) / sum(x.found for x in own),
            'shares': [x.expected / x.found for x in own],
            'time': lasting(correlations, apart),
            'correlations': dict(zip(np.array(LAGS)[reached].tolist(), correlations, strict=True)),
        }
    return {'machine': description(), 'clips': list(wanted), 'cues': cues}


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """The numbers as tables."""
    cues = result['cues']
    rows = [['cue', 'share s', 's by clip', 'tau, s']]
    rows += [
        [
            name, f'{x["share"]:.2f}', ', '.join(f'{s:.2f}' for s in sorted(x['shares'])),
            f'{x["time"]:.2f}',
        ]
        for name, x in cues.items()
    ]  # fmt: skip
    apart = [['rho of images apart', *map(str, next(iter(cues.values()))['correlations'])]]
    apart += [
        [name, *(f'{x:.2f}' for x in row['correlations'].values())] for name, row in cues.items()
    ]
    return '\n\n'.join(table(part, markdown=markdown) for part in (rows, apart))


def main(arguments: list[str]) -> int:
    """Runs the command; returns its exit code."""
    parser = benchmark_parser('error_model', __doc__, quick='a few images of two clips')
    parser.add_argument('--clips', type=Path, help='folder of the clips')
    options = parser.parse_args(arguments)
    return run_benchmark(
        'error_model',
        lambda: measure(options.clips, quick=options.quick),
        as_text,
        as_json=options.json,
    )
