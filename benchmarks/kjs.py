"""kjs: kinematic jumps compared with random sampling in the search for minima, Table 1 of KJS."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.clips import table
from benchmarks.command import benchmark_parser, show
from benchmarks.machine import description, dgemm_rate
from hmt_learning.motion.self_intersection import self_intersection_energy
from hmt_ros.body import Body, Camera, load_body
from hmt_ros.flips import enumerate_flips
from hmt_ros.flips.interpretation_tree import distinct_poses
from hmt_ros.image.likelihood import ImageLikelihood, LikelihoodSettings
from hmt_ros.image.observation import Observation
from hmt_ros.image.pose_energy import PoseEnergy
from hmt_ros.image.terms.image_term import TermSettings
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference.bounded_newton import Minimum, Status, minimise
from hmt_ros.tracking.proposals.sampling import covariance_scaled_samples, spherical_samples

Array = NDArray[np.float64]

CAMERA = Camera(1000.0, 1000.0, 480.0, 360.0, 960, 720)
DISTANCE = 3.0  # distance of the pelvis, m
SIGMA = 1.0  # standard deviation of an image joint, px
# The soft prior only fixes what the image leaves open, like the stabilisers of the paper.
PRIOR_WEIGHT = 0.01
OUT_OF_PLANE = np.radians(10.0)
DRAWN = 20_000  # number of poses from which that of the table is chosen
SAMPLES, QUICK_SAMPLES = 2000, 20  # number of samples of each random row
APART = 0.01  # minimum difference of a joint between distinct minima, m
ALIKE = 10.0  # maximum energy above the start of a minimum that explains the image as well, nats
ITERATIONS = 200
RUNS = 3  # number of runs of each row, for the CPU time
COUNTS = ('samples', 'unconverged', 'minima', 'alike')
RATIOS = ('minima_per_sample', 'alike_per_sample', 'minima_per_cpu_s')
SCALES = (1.0, 4.0, 8.0, 16.0, 0.0)  # 0 selects Cauchy tails
PARTITIONS = {
    'both arms, left calf': ('left_arm', 'right_arm', 'left_leg'),
    'both calves, right arm': ('left_leg', 'right_leg', 'right_arm'),
    'four limbs and neck': ('left_arm', 'right_arm', 'left_leg', 'right_leg', 'neck'),
}
LINKS = (
    ('shoulder', 'elbow'), ('elbow', 'wrist'), ('wrist', 'hand'),
    ('hip', 'knee'), ('knee', 'ankle'), ('ankle', 'toe'),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Setting:
    """A person in front of a camera, image joints, and the minimum from which sampling starts.

    Attributes:
        body: body of the person.
        energy: energy term of the joints and the priors.
        start: minimum nearest to the true pose.
        covariance: (d, d) inverse Hessian at the start.
    """

    body: Body
    energy: Any
    start: Minimum
    covariance: Array

    @property
    def pose(self) -> Array:
        """Pose (d,) of the start."""
        result: Array = self.start.x[0]
        return result


@dataclass(frozen=True, eq=False)
class Samples:
    """Samples before and after optimisation.

    Attributes:
        sampler, scale: name of the sampler and its scale.
        raw: (N, d) poses as drawn.
        costs: (N,) energies of the raw poses above the start.
        optimised: minima reached from the raw poses.
        minima: indices of the distinct minima, best first.
        seconds: CPU time of drawing and optimising, s.
    """

    sampler: str
    scale: str
    raw: Array
    costs: Array
    optimised: Minimum
    minima: NDArray[np.intp]
    seconds: float


def main(argv: list[str]) -> int:
    """Runs the benchmark."""
    parser = benchmark_parser('kjs', __doc__, quick='few samples, each drawn once')
    parser.add_argument('--samples', type=int, default=SAMPLES, help='random samples a row')
    parser.add_argument('--seed', type=int, default=0, help='of the random samples')
    options = parser.parse_args(argv)
    amount = (QUICK_SAMPLES, 1) if options.quick else (options.samples, RUNS)
    result = measure(amount[0], options.seed, amount[1])
    return show(result, as_text, as_json=options.json)


def measure(count: int = SAMPLES, seed: int = 0, runs: int = RUNS) -> dict[str, Any]:
    """All rows of the table, each with the fastest of several runs."""
    body = load_body('human34')
    setting = setting_of(body, chosen_pose(body))
    # A warm-up loads compiled code before anything is timed.
    for found in all_samples(setting, 4, seed, 1):
        row(setting, found)
    rows = [row(setting, found) for found in all_samples(setting, count, seed, runs)]
    return {
        'machine': description(),
        'dgemm_gflops': dgemm_rate() / 1e9,
        'trees': {
            chain: int(leaf_counts(body, setting.start.x, chain)[0]) for chain in body.chains
        },
        'rows': rows,
        'ratios': ratios(rows),
    }


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """Human-readable tables."""
    head = [
        'sampler', 'scale', *COUNTS, 'distance', 'optimised', 'deviations', 'optimised',
        'cost', 'optimised', 'CPU s', 'minima / s',
    ]  # fmt: skip
    rows = [head]
    for r in result['rows']:
        pairs = [f'{r[name][i]:.{digits}f}' for name, digits in (('distance', 2), ('deviations', 1))
                 for i in (0, 1)]  # fmt: skip
        costs = [f'{abs(cost):.3f}' if cost < 10 else f'{cost:.0f}' for cost in r['cost']]
        rows.append(
            [r['sampler'], r['scale'], *(str(r[x]) for x in COUNTS), *pairs,
             *costs, f'{r["cpu_s"]:.2f}', f'{r["minima_per_cpu_s"]:.0f}']
        )  # fmt: skip
    ratios = [['kinematic jumps', 'minima per sample', 'alike', 'minima per CPU s', 'raw cost']]
    ratios += [
        [name, *(f'{r[x]:.1f}' for x in RATIOS), f'{r["cost"]:.2g}']
        for name, r in result['ratios'].items()
    ]
    trees = ', '.join(f'{chain} {count}' for chain, count in result['trees'].items())
    parts = [
        table(rows, left=2, markdown=markdown),
        'Against the best row of CSS; raw cost: of CSS and SS:',
        table(ratios, markdown=markdown),
        f'Leaves of the chains at the start: {trees}. dgemm: {result["dgemm_gflops"]:.1f} GF/s.',
    ]
    return '\n\n'.join(parts)


def all_samples(setting: Setting, count: int, seed: int, runs: int) -> Iterator[Samples]:
    """Kinematic jumps over all partitions, then random samples of all widths."""
    for name in PARTITIONS:
        yield kinematic_jumps(setting, name, runs)
    body, mean, covariance = setting.body, setting.start.x, setting.covariance[None]
    for sampler, draw in (('CSS', covariance_scaled_samples), ('SS', spherical_samples)):
        for scale in SCALES:
            drawing = partial(draw, body, mean, covariance, count, scale)
            yield sampled(
                setting, sampler, f'{scale:.0f}' if scale else 'Cauchy',
                lambda d=drawing: d(np.random.default_rng(seed))[0], runs,
            )  # fmt: skip


def kinematic_jumps(setting: Setting, name: str, runs: int = 1) -> Samples:
    """Samples from all leaves of the product of the trees of some chains.

    Only the limits prune leaves, because the optimiser decides what is a minimum.
    """
    draw = partial(enumerate_flips, setting.body, setting.pose, PARTITIONS[name])
    return sampled(setting, name, '', lambda: draw()[0], runs)


def sampled(
    setting: Setting, sampler: str, scale: str, draw: Callable[[], Array], runs: int
) -> Samples:
    """Draws samples and optimises them in several runs; the time is that of the fastest."""
    times = []
    for _ in range(runs):
        start = time.process_time()
        raw = draw()
        optimised = optimise(setting.body, setting.energy, raw)
        times.append(time.process_time() - start)
    costs = setting.energy.energy(raw, derivatives=False).value - setting.start.value[0]
    minima = minima_of(setting.body, optimised)
    return Samples(sampler, scale, raw, costs, optimised, minima, min(times))


def minima_of(body: Body, optimised: Minimum) -> NDArray[np.intp]:
    """The distinct minima among poses that have converged, best first."""
    order = np.argsort(optimised.value, kind='stable')
    order = order[optimised.status[order] == Status.CONVERGED]
    return order[distinct_poses(body.joint_positions(optimised.x[order]), APART).kept]


def row(setting: Setting, found: Samples) -> dict[str, Any]:
    """Table row of samples, with medians over raw and over optimised ones."""
    optimised = found.optimised.value - setting.start.value[0]
    converged = found.optimised.status == Status.CONVERGED
    distances = [distances_from(setting, x) for x in (found.raw, found.optimised.x[converged])]
    return {
        'sampler': found.sampler,
        'scale': found.scale,
        'samples': len(found.raw),
        'minima': len(found.minima),
        'alike': int((optimised[found.minima] < ALIKE).sum()),
        'unconverged': int((~converged).sum()),
        'distance': [float(np.median(d)) for d, _ in distances],
        'deviations': [float(np.median(m)) for _, m in distances],
        'cost': [float(np.median(found.costs)), float(np.median(optimised[converged]))],
        'cpu_s': found.seconds,
        'minima_per_sample': len(found.minima) / len(found.raw),
        'alike_per_sample': (optimised[found.minima] < ALIKE).sum() / len(found.raw),
        'minima_per_cpu_s': len(found.minima) / found.seconds,
    }


def distances_from(setting: Setting, poses: Array) -> tuple[Array, Array]:
    """Distances (N,) of poses from the start: m and rad together, and standard deviations."""
    offset = poses - setting.pose
    turns = setting.body.skeleton.dof_is_rotation
    offset[:, turns] -= 2 * np.pi * np.round(offset[:, turns] / (2 * np.pi))
    mahalanobis = np.einsum('ni,ij,nj->n', offset, setting.start.hessian[0], offset)
    return np.linalg.norm(offset, axis=1), np.sqrt(mahalanobis)


def ratios(rows: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Ratios of kinematic jumps to the best row of CSS by column; for the cost, of CSS and SS."""
    jumps = [r for r in rows if not r['scale']]
    spread = [r for r in rows if r['sampler'] == 'CSS']
    random = [r for r in rows if r['scale']]
    return {
        r['sampler']: {
            **{key: r[key] / max(max(x[key] for x in spread), 1e-9) for key in RATIOS},
            'cost': r['cost'][0] / min(x['cost'][0] for x in random),
        }
        for r in jumps
    }


def setting_of(body: Body, pose: Array) -> Setting:
    """Setting with the projected joints of a pose, and the minimum nearest to it."""
    pixels = CAMERA.project(body.joint_positions(pose[None]))[0]
    n = len(pixels)
    keypoints = Keypoints(
        body.joint_names, pixels, np.tile(SIGMA**2 * np.eye(2), (n, 1, 1)), np.ones(n)
    )
    least_squares = LikelihoodSettings.of_terms(keypoints=TermSettings(1.0, 1.0, np.inf))
    settings = replace(least_squares, prior_weight=PRIOR_WEIGHT)
    likelihood = ImageLikelihood(body, CAMERA, settings)
    terms = (*likelihood.seen(Observation(keypoints=keypoints)), *likelihood.priors)
    energy = PoseEnergy(likelihood, terms)
    start = optimise(body, energy, pose[None])
    return Setting(body, energy, start, np.linalg.inv(start.hessian[0]))


def optimise(body: Body, energy: Any, poses: Array) -> Minimum:
    """Minima near poses (N, d), within the limits."""
    return minimise(
        energy, poses, body.lower, body.upper,
        step_scale=np.where(body.skeleton.dof_is_rotation, 0.4, 0.3),
        damping=1e-3, max_iterations=ITERATIONS, tolerance=1e-8,
    )  # fmt: skip


def drawn_poses(body: Body, count: int = DRAWN) -> Array:
    """Poses (n, d) drawn from the prior that face the camera, without self-intersection."""
    rng = np.random.default_rng(0)
    sigma = np.where(np.isfinite(body.prior_sigma), body.prior_sigma, 0.0)
    poses = body.prior_mean + sigma * rng.normal(size=(count, body.dimension))
    poses = np.clip(poses, body.lower, body.upper)
    poses[:, body.skeleton.dof_index(['root_tx', 'root_ty', 'root_tz'])] = 0.0, 0.1, DISTANCE
    poses[:, body.dof_names.index('root_z')] = 0.0
    overlap = self_intersection_energy(body, poses)
    return poses[overlap == 0.0]


def chosen_pose(body: Body) -> Array:
    """The pose of the table.

    It has the most leaves of the drawn poses whose links all leave the image plane.
    """
    poses = drawn_poses(body)
    poses = poses[out_of_plane(body, poses) > OUT_OF_PLANE]
    leaves = np.prod([leaf_counts(body, poses, chain) for chain in body.chains], axis=0)
    result: Array = poses[np.argmax(leaves)]
    return result


def leaf_counts(body: Body, poses: Array, chain: str) -> Array:
    """Number of leaves (N,) that the tree of one chain has at each pose."""
    return np.bincount(enumerate_flips(body, poses, chain)[1], minlength=len(poses))


def out_of_plane(body: Body, poses: Array) -> Array:
    """Minimum angle (N,) between a limb's link and the plane perpendicular to its ray, rad."""
    joints = body.joint_positions(poses)
    angles = []
    for side in ('left', 'right'):
        for names in LINKS:
            a, b = body.skeleton.joint_index([f'{side}_{name}' for name in names])
            link, ray = joints[:, b] - joints[:, a], joints[:, b]
            sine = (link * ray).sum(1) / np.linalg.norm(link, axis=1) / np.linalg.norm(ray, axis=1)
            angles.append(np.abs(np.arcsin(sine)))
    least: Array = np.min(angles, axis=0)
    return least
