"""symmetric: do two motions with one image and one prior both keep their weight?

A person 60 m from a camera of focal length 9,000 px, or 12 m from one of 1,800 px, moves a limb.
The flipped limb looks the same in every image. A case is a pair of a random pose and its flip: the
ends of the two limbs stay far apart while they move, and after both poses are fitted to the image
of the first; among such pairs, the priors of the two motions and these fits differ least. So both
are motions of the tracked model, and neither is better. The tracker gets only keypoints, with
correlated noise, and no experts. It starts from both poses with half the weight each, or by itself
from the keypoints of the first images. Each mode is assigned to the motion whose limb is nearer.
Shares are of the images with a track.

The filter is compared with its chain given the images of the next half second
(`backward_weights`), and with the delayed output of a `SmootherSession` with the node's defaults.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from benchmarks.clips import table
from benchmarks.command import benchmark_parser, run_benchmark
from benchmarks.machine import description
from benchmarks.runs import JOINTS, Seen, in_processes, keypoints_only
from benchmarks.smoothing import FILTER, LIVE, smoothed
from hmt_ros.body import Camera, load_body
from hmt_ros.flips.interpretation_tree import enumerate_flips
from hmt_ros.image.likelihood import ImageLikelihood
from hmt_ros.image.observation import Observation
from hmt_ros.image.pose_energy import PoseEnergy
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.energy import Derivatives
from hmt_ros.inference.mode_chain import Link, backward_weights
from hmt_ros.sessions.smoother_parameters import SmootherParameters
from hmt_ros.tracking import Tracker, TrackerSettings

ENDS = {'right_arm': 'wrist', 'left_arm': 'wrist', 'left_leg': 'ankle', 'right_leg': 'ankle'}
# Distances of the person, m; focal length per distance, px/m, so that all images have one size.
DISTANCES, FOCAL_LENGTH = (60.0, 12.0), 150.0
NOISES, SEEDS = (3.0, 6.0), 5  # px
SAID = 3.0  # standard deviation stated by the detector, px
RATE, LENGTH = 30.0, 40  # images per second, number of images
LASTING = 0.2  # correlation time of the keypoint noise, s
# Numbers of random poses and of tried motions; minimum distance of limb ends, m; initial deviation.
POSES, TRIED, APART, START_SIGMA = 4000, 100, 0.3, 0.05
LIKELY = 0.05  # weight of the prior energy, in addition to its difference
BOTH = 0.05  # minimum weight of each motion
# Range of weights of a motion that are even in the filter, and in the published output.
EVEN, KEPT_EVEN = (0.4, 0.6), (0.25, 0.75)
OWN, GIVEN = 'own start', 'both given'
CHAIN = 'chain'
WAYS = {FILTER: 'filter', CHAIN: 'filter, 0.5 s later', LIVE: 'published'}
BODY = load_body('human37')


@dataclass(frozen=True, eq=False)
class Case:
    """Two motions with one image.

    Attributes:
        limb: name of the chain that is flipped.
        distance: distance of the person, m.
        seed: seed of the motion, the noise and the tracker.
        noise: standard deviation of the keypoints, px.
        motions: (2, T, d) poses, the true motion and the flipped one.
        prior: prior energy of the flipped motion minus that of the true one, nats per image.
    """

    limb: str
    distance: float
    seed: int
    noise: float
    motions: Array
    prior: float

    @property
    def camera(self) -> Camera:
        """Camera of the case."""
        return camera_at(self.distance)

    def keypoints(self) -> Iterator[Keypoints]:
        """Keypoints of every image, with AR(1) noise."""
        rng, rho = np.random.default_rng(self.seed), np.exp(-1.0 / (RATE * LASTING))
        error = rng.normal(size=(len(JOINTS), 2))
        for joints in BODY.joint_positions(self.motions[0]):
            yield _keypoints(self.camera, joints, self.noise * error)
            error = rho * error + np.sqrt(1.0 - rho**2) * rng.normal(size=error.shape)


def cases(
    limbs: Sequence[str] = tuple(ENDS),
    seeds: Sequence[int] = range(SEEDS),
    distances: Sequence[float] = DISTANCES,
    noises: Sequence[float] = NOISES,
) -> Iterator[Case]:
    """All combinations; two noises share their motions."""
    for distance in distances:
        for limb in limbs:
            for seed in seeds:
                motions = _motions(limb, distance, seed)
                for noise in noises:
                    yield Case(limb, distance, seed, noise, *motions)


def _keypoints(camera: Camera, joints: Array, error: Array | float = 0.0) -> Keypoints:
    pixels = camera.project(joints[BODY.skeleton.joint_index(JOINTS)]) + error
    said = np.tile(SAID**2 * np.eye(2), (len(JOINTS), 1, 1))
    return Keypoints(JOINTS, pixels, said, np.ones(len(JOINTS)))


def camera_at(distance: float) -> Camera:
    """Camera that shows a person at this distance, m, at the usual size."""
    focal = FOCAL_LENGTH * distance
    return Camera(focal, focal, 319.5, 239.5, 640, 480)


def _motions(limb: str, distance: float, seed: int) -> tuple[Array, float]:
    """The pair of motions of a case with the least difference of priors.

    Raises:
        ValueError: the limb has no such pair, or the images of the pair differ.
    """
    body, camera, rng = BODY, camera_at(distance), np.random.default_rng(seed)
    likelihood = ImageLikelihood(body, camera)
    prior = PoseEnergy(likelihood, likelihood.priors)
    own = body.skeleton.chain_dofs[limb]
    end = body.joint_names.index(f'{limb.split("_")[0]}_{ENDS[limb]}')

    def energy(poses: Array) -> Array:
        return prior.energy(poses, derivatives=Derivatives.NONE).value

    def distances(one: Array, other: Array) -> Array:
        gap = body.relative_joints(one) - body.relative_joints(other)
        return np.linalg.norm(gap[:, end], axis=1)

    poses = np.tile(np.clip(body.prior_mean, body.lower, body.upper), (POSES, 1))
    poses[:, :3] = 0.0, 0.0, distance
    poses[:, own] += 1.2 * body.prior_sigma[own] * rng.normal(size=(POSES, len(own)))
    poses = np.clip(poses, body.lower, body.upper)
    flips, parents = enumerate_flips(body, poses, limb)
    before = energy(poses)[parents]
    cost = np.abs(energy(flips) - before) + LIKELY * before
    far = distances(poses[parents], flips) > APART
    found = []
    for i in np.argsort(np.where(far, cost, np.inf))[:TRIED]:
        pair = np.stack([poses[parents[i]], flips[i]])
        seen = Observation(keypoints=_keypoints(camera, body.joint_positions(pair)[0]))
        optima = PoseEnergy(likelihood, (*likelihood.seen(seen), *likelihood.priors)).minimise(pair)
        motions = _moved(*pair, limb)
        if motions is None or distances(*optima.x[:, None])[0] < APART:
            continue
        if distances(*motions).min() > APART:
            change = energy(motions[1]) - energy(motions[0])
            unequal = np.abs(change).mean() + abs(optima.value[1] - optima.value[0])
            found.append((unequal, change.mean(), motions))
    if not found:
        raise ValueError(f'no two motions of the {limb} for the seed {seed}')
    _, value, motions = min(found, key=lambda x: x[0])
    pixels = camera.project(body.joint_positions(motions.reshape(-1, body.dimension)))
    if np.abs(pixels[:LENGTH] - pixels[LENGTH:]).max() > 1.0:
        raise ValueError(f'the flip of the {limb} for the seed {seed} has another image')
    return motions, float(value)


def _moved(pose: Array, flip: Array, limb: str) -> Array | None:
    """Motions (2, T, d) from a pose and its flip; None if the flip leaves the limits."""
    own, times = BODY.skeleton.chain_dofs[limb], np.arange(LENGTH) / RATE
    path, other = np.tile(pose, (LENGTH, 1)), np.tile(flip, (LENGTH, 1))
    path[:, own] += 0.1 * np.sin(np.pi * times[:, None] + np.arange(len(own)))
    path[:, own] -= 0.1 * np.sin(np.arange(len(own)))
    path[:, 0] += 0.1 * times
    path = np.clip(path, BODY.lower, BODY.upper)
    flips, parents = enumerate_flips(BODY, path, limb)
    joints = BODY.relative_joints(flips)
    last = BODY.relative_joints(flip[None])[0]
    for t in range(LENGTH):
        (rows,) = np.nonzero(parents == t)
        gaps = np.linalg.norm(joints[rows] - last, axis=2).max(1)
        nearest = rows[gaps.argmin()]
        if gaps.min() > APART / 2:
            return None
        other[t], last = flips[nearest], joints[nearest]
    return np.stack([path, other])


def tracked(case: Case, *, given: bool, **changes: Any) -> Iterator[Seen]:
    """Results of the tracker for the images of a case.

    Args:
        case: case to track.
        given: whether the tracker starts from both poses, with half the weight each.
        changes: settings of the tracker.
    """
    settings = replace(keypoints_only(TrackerSettings(lifter='')), **changes)
    tracker = Tracker(BODY, case.camera, settings, None, case.seed)
    if given:
        covariance = START_SIGMA**2 * np.eye(BODY.dimension)
        means = case.motions[:, 0]
        tracker.reset(GaussianMixture(np.full(2, 0.5), means, np.tile(covariance, (2, 1, 1))))
    blank = np.zeros((case.camera.height, case.camera.width, 3), dtype=np.uint8)
    for t, keypoints in enumerate(case.keypoints()):
        stamp = round((t + 1) * 1e9 / RATE)
        posterior, likelihood = tracker.step(blank, stamp, keypoints)
        if posterior is not None and likelihood is not None:
            now = tracker.estimate
            yield Seen(stamp, now.body, posterior, now.likelihood, now.point_estimate)


def given_later(seen: Sequence[Seen]) -> dict[int, GaussianMixture]:
    """The filter's modes by timestamp, with chain weights at the delay of the smoother node."""
    lag = round(SmootherParameters().fixed_lag * RATE)
    result = {}
    for i, one in enumerate(seen):
        links = [Link(one.likelihood.posterior_weights, one.likelihood.origins)]
        for before, after in pairwise(seen[i : i + lag + 1]):
            if after.likelihood.ancestry_stamp != before.stamp:
                break  # another track
            links.append(Link(after.likelihood.posterior_weights, after.likelihood.origins))
        modes = one.posterior[one.likelihood.modes]
        result[one.stamp] = replace(modes, weights=backward_weights(links)[0])
    return result


def share(poses: GaussianMixture, case: Case, t: int) -> float:
    """Weight of the true motion at image t."""
    own = BODY.skeleton.chain_joints[case.limb]
    joints = BODY.relative_joints(poses.means)[:, None, own]
    motions = BODY.relative_joints(case.motions[:, t])[:, own]
    nearer = np.linalg.norm(joints - motions, axis=3).mean(2).argmin(1)
    return float(poses.weights[nearer == 0].sum() / poses.weights.sum())


def of_case(case: Case, **changes: Any) -> list[dict[str, Any]]:
    """Weights (T,) of the true motion by way, for both starts; `changes` as for `tracked`."""
    result = []
    for start, given in ((GIVEN, True), (OWN, False)):
        seen = list(tracked(case, given=given, **changes))
        published, _ = smoothed(seen)
        found = {
            FILTER: {x.stamp: x.posterior for x in seen},
            CHAIN: given_later(seen),
            LIVE: published[LIVE],
        }
        weights = {
            way: [share(found[way][x.stamp], case, round(1e-9 * RATE * x.stamp) - 1) for x in seen]
            for way in WAYS
        }
        names = ('limb', 'distance', 'seed', 'noise', 'prior')
        result.append({'start': start, **{x: getattr(case, x) for x in names}, **weights})
    return result


def measure(*, quick: bool = False) -> dict[str, Any]:
    """Results of `of_case` for all cases, or for one if quick."""
    chosen = list(cases(['right_arm'], [0], DISTANCES[:1], NOISES[:1]) if quick else cases())
    found = in_processes(of_case, chosen, 1 if quick else 0, 'symmetric')
    return {'machine': description(), 'cases': [one for case in found for one in case]}


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """Means by start, distance, limb and noise, and over all cases of a start."""
    said = (
        f'Both motions above {100 * BOTH:.0f} %, by start; "even" are the images in which the '
        f'filter gives a motion {EVEN[0]:g} to {EVEN[1]:g}, and of these those in which '
        f'{KEPT_EVEN[0]:g} to {KEPT_EVEN[1]:g} is published.'
    )
    rows = [['start', 'limb', 'distance, m', 'noise, px', 'priors differ, nats']]
    rows[0] += ['weight of the true motion', *WAYS.values(), 'even', 'published as even']
    groups: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    for start in (GIVEN, OWN):
        own = [x for x in result['cases'] if x['start'] == start]
        for one in own:
            name = one['limb'].replace('_', ' '), f'{one["distance"]:g}', f'{one["noise"]:g}'
            groups.setdefault((start, *name), []).append(one)
        groups[start, 'all', '', ''] = own
    for name, own in groups.items():
        true = [np.mean(x[FILTER]) for x in own]
        means = [f'{np.mean(true):.2f}'] if name[1] == 'all' else [f'{x:.2f}' for x in true]
        rows.append([*name, f'{np.mean([abs(x["prior"]) for x in own]):.2f}', ' '.join(means)])
        of_way = {way: np.concatenate([x[way] for x in own]) for way in WAYS}
        shown = [np.minimum(x, 1.0 - x) > BOTH for x in of_way.values()]
        even = _within(of_way[FILTER], EVEN)
        kept = _within(of_way[LIVE][even], KEPT_EVEN)
        rows[-1] += [f'{100 * x.mean():.0f} %' if len(x) else '-' for x in (*shown, even, kept)]
    return f'{said}\n\n{table(rows, left=2, markdown=markdown)}'


def _within(values: Array, ends: tuple[float, float]) -> Array:
    return (ends[0] <= values) & (values <= ends[1])


def main(arguments: list[str]) -> int:
    """Runs the command; returns its exit code."""
    parser = benchmark_parser('symmetric', __doc__, quick='one case')
    options = parser.parse_args(arguments)
    measured = partial(measure, quick=options.quick)
    return run_benchmark('symmetric', measured, as_text, as_json=options.json)
