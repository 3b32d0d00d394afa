"""votes: which chain of the body to flip, or to search, by the vote that chooses it (KJS figure 5).

New minima: from the optimum of the joints' likelihood at a random pose, a mode that is known, a
chain by vote, a covariance-scaled sample and all leaves of its tree, each optimised; again, until
the budget is spent. Two optima are one when no joint, seen from the pelvis, differs by more than
5 cm.

Tracking: procedural motions, rendered; one limb, chosen at random, is searched an image, where the
tracker searches all four.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.chain_votes import VOTES, chain_votes
from benchmarks.clips import table
from benchmarks.command import benchmark_parser, show
from benchmarks.flips import random_poses
from benchmarks.machine import description
from benchmarks.runs import keypoints_only
from hmt_ros.app.progress import show_progress
from hmt_ros.body import Body, Camera, load_body
from hmt_ros.body.camera import Viewpoint
from hmt_ros.evaluation.pose_scores import EVALUATED_JOINTS, ORIGIN, joint_mixtures, score
from hmt_ros.flips.interpretation_tree import enumerate_flips
from hmt_ros.image.background import BackgroundModel
from hmt_ros.image.likelihood import ImageLikelihood
from hmt_ros.image.observation import Observation
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference.bounded_newton import Minimum, minimise
from hmt_ros.motion.procedural_motion import PROCEDURAL_MOTIONS, procedural_motion
from hmt_ros.rendering.renderer import render_frames
from hmt_ros.rendering.scene import Scene
from hmt_ros.tracking import Subject, Tracker, TrackerSettings
from hmt_ros.tracking.proposals.sampling import covariance_scaled_samples
from hmt_ros.tracking.settings import ACCURATE_BUDGET

Array = NDArray[np.float64]

PARTS = ('minima', 'tracking')
SEEDS, POSES, BUDGET = 6, 32, 12  # and samples a pose
FILMS, IMAGES = 3, 16  # of each motion, of each film
QUICK = {'seeds': 1, 'poses': 4, 'budget': 12, 'films': 1, 'images': 4}
BODIES = ('human34', 'human37')
CHAINS = ('left_arm', 'right_arm', 'left_leg', 'right_leg')
ONLY_JOINTS = keypoints_only(TrackerSettings()).likelihood
SIGMA = 2.0  # px, of the joints
SAME = 0.05  # m
PLAUSIBLE = 4.6  # of energy above the best, ln 100: a hundredth of its probability
WIDEST = 1.0  # standard deviation of what the joints do not determine, rad or m
SEARCHED = {'one': 1, 'all four': len(CHAINS)}
# Streams of random numbers of a seed.
OF_POSES, OF_JUMPS, OF_CLICKS = 1, 2, 3


def main(argv: list[str]) -> int:
    """Runs the benchmark."""
    parser = benchmark_parser('votes', __doc__, quick='one seed, few poses and images')
    parser.add_argument('--seeds', type=int, default=SEEDS, metavar='N', help='of random poses')
    parser.add_argument('--poses', type=int, default=POSES, metavar='N', help='a seed and body')
    parser.add_argument('--budget', type=int, default=BUDGET, metavar='N', help='samples a pose')
    parser.add_argument(
        '--films', type=int, default=FILMS, metavar='N', help='a motion; their seeds'
    )
    parser.add_argument('--images', type=int, default=IMAGES, metavar='N', help='a film, at 10 Hz')
    parser.add_argument('--parts', nargs='+', choices=PARTS, default=PARTS)
    options = parser.parse_args(argv)
    amount = QUICK if options.quick else {name: getattr(options, name) for name in QUICK}
    return show(measure(parts=options.parts, **amount), as_text, as_json=options.json)


def measure(
    *,
    seeds: int = SEEDS,
    poses: int = POSES,
    budget: int = BUDGET,
    films: int = FILMS,
    images: int = IMAGES,
    parts: Sequence[str] = PARTS,
) -> dict[str, Any]:
    """Everything that was asked for."""
    result: dict[str, Any] = {'machine': description(), 'films': films, 'seeds': seeds}
    if 'minima' in parts:
        with show_progress('minima', 'runs', len(BODIES) * len(VOTES) * seeds) as bar:
            result['minima'] = {}
            for name in BODIES:
                found: dict[str, Any] = {}
                for vote in VOTES:
                    runs = []
                    for seed in range(seeds):
                        runs.append(new_minima(name, vote, seed, poses, budget))
                        bar.update()
                    found[vote] = summary_of(runs)
                result['minima'][name] = found
    if 'tracking' in parts:
        runs_of: dict[str, dict[str, list[dict[str, float]]]] = {}
        total = len(PROCEDURAL_MOTIONS) * films * len(SEARCHED)
        with show_progress('tracking', 'runs', total) as bar:
            for motion in PROCEDURAL_MOTIONS:
                for seed in range(films):
                    film = filmed(motion, seed, images)
                    for name, count in SEARCHED.items():
                        one = tracked(film, count, seed)
                        runs_of.setdefault(motion, {}).setdefault(name, []).append(one)
                        bar.update()
        result['tracking'] = {
            motion: {name: summary_of(runs) for name, runs in found.items()}
            for motion, found in runs_of.items()
        }
        result['tracking']['together'] = {
            name: summary_of([run for found in runs_of.values() for run in found[name]])
            for name in SEARCHED
        }
    return result


def summary_of(runs: list[dict[str, float]]) -> dict[str, float]:
    """Means over runs, and standard errors of the means."""
    result: dict[str, float] = {}
    for key in runs[0]:
        values = np.array([run[key] for run in runs])
        result[key] = float(values.mean())
        result[f'{key}_error'] = (
            float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else 0.0
        )
    return result


# New minima.


@dataclass(eq=False)
class _Known:
    """Minima that are known of one pose, and samples that were spent."""

    poses: list[Array]
    covariances: list[Array]
    joints: list[Array]
    energies: list[float]
    samples: int = 0


def new_minima(name: str, vote: str, seed: int, count: int, budget: int) -> dict[str, float]:
    """New minima per optimised sample, and new ones that are plausible, over random poses.

    Args:
        name: of the body.
        vote: that chooses the chain.
        seed: of poses and samples; every vote has the same poses.
        count: of the poses.
        budget: samples a pose.
    """
    body = load_body(name)
    camera = Camera(550.0, 550.0, 319.5, 239.5, 640, 480)
    poses = random_poses(
        body, count, seed=int(np.random.default_rng([seed, OF_POSES]).integers(2**31))
    )
    rng = np.random.default_rng([seed, OF_JUMPS])
    likelihood = ImageLikelihood(body, camera, ONLY_JOINTS)
    pixels = camera.project(body.joint_positions(poses))
    joints = len(body.joint_names)
    seen = [
        Observation(
            keypoints=Keypoints(
                body.joint_names,
                own,
                np.tile(SIGMA**2 * np.eye(2), (joints, 1, 1)),
                np.ones(joints),
            )
        )
        for own in pixels
    ]
    known = []
    for pose, observation in zip(poses, seen, strict=True):
        solved = _optimised(likelihood, pose[None], observation)
        known.append(_Known([], [], [], []))
        _add(known[-1], body, solved)
    for own, observation in zip(known, seen, strict=True):
        while own.samples < budget:
            k = int(rng.integers(len(own.poses)))
            pose, covariance = own.poses[k][None], own.covariances[k][None]
            votes = chain_votes(body, covariance, CHAINS, vote, pose, np.array(own.poses))[0]
            chain = CHAINS[int(rng.choice(len(CHAINS), p=votes))]
            drawn = covariance_scaled_samples(body, pose, covariance, 1, 1.0, rng)[0]
            leaves, _ = enumerate_flips(body, drawn, chain)
            _add(own, body, _optimised(likelihood, leaves, observation))
            own.samples += len(leaves)
    samples = sum(own.samples for own in known)
    minima = sum(len(own.poses) - 1 for own in known)
    plausible = sum(
        int((np.array(own.energies) < min(own.energies) + PLAUSIBLE).sum()) - 1 for own in known
    )
    return {'minima_per_sample': minima / samples, 'plausible_per_sample': plausible / samples}


def _optimised(likelihood: ImageLikelihood, poses: Array, observation: Observation) -> Minimum:
    body = likelihood.body
    return minimise(
        likelihood.given(observation),
        poses, body.lower, body.upper, step_scale=0.3, max_iterations=40, tolerance=1e-3,
    )  # fmt: skip


def _add(known: _Known, body: Body, solved: Minimum) -> None:
    """Adds the optima that are new."""
    joints = body.joint_positions(solved.x)
    joints -= joints[:, :1]
    for i in np.argsort(solved.value, kind='stable'):
        if not np.isfinite(solved.value[i]):
            continue
        gaps = [np.linalg.norm(joints[i] - own, axis=1).max() for own in known.joints]
        if gaps and min(gaps) < SAME:
            continue
        hessian = solved.hessian[i].copy()
        resting = ~solved.free[i]
        hessian[resting] = hessian[:, resting] = 0.0
        hessian[resting, resting] = 1e4
        known.poses.append(solved.x[i])
        known.covariances.append(np.linalg.inv(hessian + WIDEST**-2.0 * np.eye(len(hessian))))
        known.joints.append(joints[i])
        known.energies.append(float(solved.value[i]))


# Tracking.


@dataclass(frozen=True, eq=False)
class Film:
    """A rendered motion: body, camera, (T, d) poses, images, the empty scene, and the start."""

    body: Body
    camera: Camera
    poses: Array
    images: list[NDArray[np.uint8]]
    empty: NDArray[np.uint8]
    subject: Subject


def filmed(motion: str, seed: int, images: int) -> Film:
    """A procedural motion, rendered at 10 Hz."""
    body = load_body('human37')
    camera = Camera(330.0, 330.0, 159.5, 119.5, 320, 240)
    view = Viewpoint(distance=4.0)
    poses = procedural_motion(motion, body, images / 10.0, 10.0, 100 + seed, viewpoint=view)
    scene = Scene(viewpoint=view, seed=100 + seed)
    shown = [frame.image for frame in render_frames(body, poses, camera, scene)]
    pixels = camera.project(body.joint_positions(poses[:1]))[0]
    rng = np.random.default_rng([seed, OF_CLICKS])
    clicks = pixels + rng.normal(size=pixels.shape)
    n = len(pixels)
    keypoints = Keypoints(body.joint_names, clicks, np.tile(np.eye(2), (n, 1, 1)), np.ones(n))
    return Film(
        body, camera, poses, shown, np.rint(scene.background(camera)).astype(np.uint8),
        Subject(0, keypoints, dict(body.segment_lengths)),
    )  # fmt: skip


def tracked(film: Film, count: int, seed: int) -> dict[str, float]:
    """Errors of a track in which so many limbs are searched an image."""
    settings = TrackerSettings(searched_chains=count, evaluation_budget=4 * ACCURATE_BUDGET)
    background = BackgroundModel.from_image(film.empty)
    tracker = Tracker(film.body, film.camera, settings, background, seed)
    tracker.reset(film.subject)
    mixtures, evaluations = [], []
    for i, image in enumerate(film.images):
        posterior, _ = tracker.step(image, i * 100_000_000)
        assert posterior is not None
        mixtures.append(posterior)
        evaluations.append(tracker.estimate.evaluations)
    where = film.body.skeleton.joint_index((ORIGIN, *EVALUATED_JOINTS))
    true = film.body.joint_positions(film.poses)[:, where]
    summary = score(
        joint_mixtures(tracker.estimate.body, mixtures), true[:, 1:] - true[:, :1]
    ).summary()
    return {
        'best_mm': summary['best_mm'],
        'heaviest_mm': summary['heaviest_mm'],
        'evaluations': float(np.mean(evaluations[1:])),
    }


# Reports.


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """Tables for people."""
    parts = [
        f'{result["seeds"]} seeds of random poses, {result["films"]} films of each motion; '
        'mean and its standard error.'
    ]
    if 'minima' in result:
        rows = [['body', 'vote', 'new minima per sample', 'of them plausible']]
        for name, found in result['minima'].items():
            for vote, one in found.items():
                rows.append(
                    [name, vote]
                    + [_with_error(one, f'{key}_per_sample', 3) for key in ('minima', 'plausible')]
                )
        parts.append(table(rows, left=2, markdown=markdown))
    if 'tracking' in result:
        rows = [['motion', 'searched', 'best of 8, mm', 'heaviest, mm', 'evaluations']]
        for motion, found in result['tracking'].items():
            for searched, one in found.items():
                rows.append(
                    [motion, searched]
                    + [_with_error(one, f'{key}_mm', 1) for key in ('best', 'heaviest')]
                    + [f'{one["evaluations"]:.0f}']
                )
        parts.append(table(rows, left=2, markdown=markdown))
    return '\n\n'.join(parts)


def _with_error(one: dict[str, float], key: str, digits: int) -> str:
    return f'{one[key]:.{digits}f} +- {one[f"{key}_error"]:.{digits}f}'
