"""contenders: models of p(pose | image) with the same pairs and the same processor time (BME 3).

Every model gets the same inputs, targets, pairs and processor time. Training is repeated with twice
as many pairs, or for a network with twice as many steps, as long as the time suffices; the last one
is scored. All are calibrated on held-out motions, within that time.

keypoints      windows of keypoints with detector errors, the input of `experts.lifter`
features       the units of the last layer of the bundled lifter, on such windows
silhouettes    descriptors of silhouettes as uneven as those of background subtraction
targets        joints in the axes of a camera turned towards the person

All are reduced to principal components. No person of the tested motions is in the training data.
Distances are those of the joints from the truth, relative to the pelvis, for the heaviest component
and for the best of the five heaviest. The log density is that of the reduced targets, nats per
number; regions are those of single joint coordinates. The bundled models were trained for hours,
with more data, which includes the seated people. Numbers of experts were chosen on these people.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from benchmarks.clips import development_folder, table
from benchmarks.command import benchmark_parser, run_benchmark
from benchmarks.machine import best_time, description
from benchmarks.runs import in_processes
from hmt_learning.training.calibration_learning import LearningCalibration
from hmt_learning.training.keypoint_tracks import JOINTS, keypoint_tracks
from hmt_learning.training.keypoint_training import WindowSettings, training_windows
from hmt_learning.training.lifter_learning import PELVIS, SCORED
from hmt_learning.training.network_learning import LearningNetwork, tools_are_there
from hmt_learning.training.predictor_learning import KINDS, SAMPLES_PER_EXPERT, described
from hmt_learning.training.training_set import (
    PoseSequence,
    TrainingSettings,
    motion_files,
    procedural_sequence,
    recorded_sequence,
    training_set,
)
from hmt_ros.body import load_body
from hmt_ros.experts.conditional_density import ConditionalDensity
from hmt_ros.experts.lifter import load_lifter
from hmt_ros.experts.pose_encoding import ray_rotations
from hmt_ros.experts.pose_predictor import load_predictor
from hmt_ros.image.lifted_poses import HIPS

Array = NDArray[np.float64]

BUDGET = 60.0  # s of processor time for each model
KEYPOINTS, FEATURES, SILHOUETTES = 'keypoints', 'features', 'silhouettes'
CUES = (KEYPOINTS, FEATURES, SILHOUETTES)
PAIRS = {KEYPOINTS: 24_000, FEATURES: 24_000, SILHOUETTES: 12_000}
TESTED = 250  # number of test pairs per activity
INPUTS, TARGETS = 40, 24  # principal components
FIRST, FIRST_STEPS = 400, 250  # number of pairs, and of steps, in the first training
QUICK = 60  # number of pairs with --quick
GROWTH = 2.6  # maximum growth of the time with twice as many pairs
BEST_OF = 5
SHARES = (0.5, 0.9)

# Tested motions by activity, and the people of UI-PRMD left out of the training for sitting.
ACTIVITIES = {
    'walking': ('cmu_06_01_walk', 'cmu_15_wander'),
    'running': ('cmu_run_c',),
    'turning': ('cmu_06_10_turns',),
    'conversation': ('cmu_14_19_laugh', 'cmu_14_traffic', 'cmu_signals_b'),
    'dance': ('cmu_93_charleston1', 'fair_dab'),
    'other': ('cmu_03_01_uneven', 'cmu_06_15_shoot', 'cmu_14_washwindow'),
    'sitting': ('prmd_s07_m05_sittostand', 'prmd_s08_m05_sittostand'),
}
LEFT_OUT = ('prmd_s07', 'prmd_s08')
# With --quick.
PROCEDURAL = {'walking': 'walk', 'dance': 'dance'}


# Models.

Maker = Callable[[int], ConditionalDensity]


def _of_kind(name: str, experts: int = BEST_OF, **changes: Any) -> Maker:
    """Maker of a model of `KINDS` without calibration, with optional parameters."""

    def make(count: int) -> ConditionalDensity:
        kind = KINDS[name]
        few = max(min(experts, count // SAMPLES_PER_EXPERT), 1) if kind.few else experts
        return kind.make(few, 0, count).set_params(**changes)

    return make


MODELS: dict[str, Maker] = {
    'nearest neighbours': _of_kind('nearest'),
    'one RVM': _of_kind('relevance-vector'),
    'conditional, linear': _of_kind('conditional', 8),
    'conditional, RBF': _of_kind('conditional', 8, basis='rbf'),
    'joint, linear': _of_kind('joint', 30),
    'joint, RBF': _of_kind('joint', 8, basis='rbf'),
    'local experts': _of_kind('local'),
}
NETWORK, SHIPPED = 'network', 'what ships'


# Pairs.


@dataclass(frozen=True, eq=False)
class Pairs:
    """Training pairs and test pairs.

    Attributes:
        inputs, targets: (N, `INPUTS`), (N, `TARGETS`) training pairs.
        groups: (N,) index of the motion of each pair.
        tested: test inputs, targets and true joints (n, J, 3) by activity.
        middle, basis: mean (3 J,) and principal components (`TARGETS`, 3 J) of joints.
        residual: (3 J,) variances of joints outside the principal components.
    """

    inputs: Array
    targets: Array
    groups: NDArray[np.intp]
    tested: Mapping[str, tuple[Array, Array, Array]]
    middle: Array
    basis: Array
    residual: Array


def _motions(quick: bool) -> tuple[list[PoseSequence], dict[str, list[PoseSequence]]]:
    """Training motions, and test motions by activity."""
    body = load_body('human37')
    if quick:
        learned = [procedural_sequence(x, body, 4.0, 1) for x in PROCEDURAL.values()]
        return learned, {k: [procedural_sequence(x, body, 2.0, 9)] for k, x in PROCEDURAL.items()}
    mocap = development_folder().parent / 'mocap'
    if not (mocap / 'dev').is_dir():
        raise FileNotFoundError(f'{mocap} lacks dev and train (set HMT_SHARED)')
    folders = [mocap / x for x in ('dev', 'train', 'train_more', 'train_wide')]
    paths = {path.stem: path for folder in folders for path in motion_files(folder)}
    of_tested = {name for names in ACTIVITIES.values() for name in names}
    sits = {x for x in paths if x.startswith('prmd') and 'sittostand' in x}
    mirrored = {'cmu_13_traffic', 'cmu_12_0x_walk', 'cmu_signals_a1', 'cmu_signals_a2', 'cmu_run_a'}
    left = {x for x, path in paths.items() if path.parent.name == 'dev' or x.startswith(LEFT_OUT)}
    chosen = {x for x in paths if x.startswith('cmu') or x in sits} - left - mirrored
    motions = {x: recorded_sequence(paths[x], body) for x in sorted(chosen | of_tested)}
    tested = {k: [motions[x] for x in names] for k, names in ACTIVITIES.items()}
    return [motions[x] for x in sorted(chosen)], tested


def pairs_of(cue: str, *, quick: bool = False) -> tuple[Pairs, dict[str, Any]]:
    """Pairs of a cue, and scores of the bundled model on the test pairs by activity."""
    learned, tested = _motions(quick)
    count, few = (QUICK, 12) if quick else (PAIRS[cue], TESTED)
    if cue != SILHOUETTES:
        seen, joints, groups = _windows(learned, count, 0)
        of_tests = {k: _windows(x, few, 1)[:2] for k, x in tested.items()}
        shipped = {k: _lifted(x) for k, (x, _) in of_tests.items()}
        if cue == FEATURES:
            seen = _features(seen)
            of_tests = {k: (_features(x), y) for k, (x, y) in of_tests.items()}
    else:
        seen, joints, groups, of_tests, shipped = _silhouettes(learned, tested, count, few)
    centre, scale = seen.mean(0), seen.std(0) + 1e-6
    _, _, rows = np.linalg.svd((seen - centre)[:4000] / scale, full_matrices=False)
    axes = rows[: min(INPUTS, len(rows))].T
    flat = joints.reshape(len(joints), -1).astype(np.float64)
    middle = flat.mean(0)
    _, _, rows = np.linalg.svd((flat - middle)[:4000], full_matrices=False)
    basis = rows[:TARGETS]
    targets = (flat - middle) @ basis.T
    residual = np.square(flat - middle - targets @ basis).mean(0)

    def reduced(x: Array) -> Array:
        return np.asarray((x - centre) / scale @ axes, dtype=np.float64)

    tests = {
        k: (reduced(x), (y.reshape(len(y), -1) - middle) @ basis.T, y)
        for k, (x, y) in of_tests.items()
    }
    pairs = Pairs(reduced(seen), targets, groups, tests, middle, basis, residual)
    scored = {
        k: _scores(found, tests[k], pairs)
        for k, found in shipped.items()
        # The bundled model was trained on the seated people.
        if k != 'sitting'
    }
    return pairs, scored


def _windows(
    motions: Sequence[PoseSequence], count: int, seed: int
) -> tuple[Array, Array, NDArray[np.intp]]:
    """Inputs of windows, joints (N, J, 3) and motion indices, with equal numbers per motion."""
    settings = replace(
        WindowSettings(), causal=1.0, cut=0.0, near=0.0, recombined=0.0, asynchronous=0.0,
        seated=0.0, lengths=1.0,
    )  # fmt: skip
    each = -(-count // len(motions))
    drawn, body = [], load_body('human37')
    for i, one in enumerate(motions):
        tracks = keypoint_tracks(body, [one], [1.0], variants=1, seated=0, seed=seed)
        rng = np.random.default_rng([seed, i])
        drawn.append(training_windows(tracks, each, rng, settings, 0))
    inputs, joints = (np.concatenate(x).astype(np.float64) for x in zip(*drawn, strict=True))
    return inputs, joints, np.repeat(np.arange(len(motions)), each)


def _lifted(inputs: Array) -> tuple[Array, Array, Array]:
    """Log weights (n, K), means (n, K, J, 3) and variances (n, K, 3 J) of the bundled lifter."""
    gates, means, deviations = load_lifter().network(inputs.astype(np.float32))
    return gates, means, np.square(deviations).reshape(*gates.shape, -1)


def _features(inputs: Array) -> Array:
    """Units (n, H) of the last layer of the bundled lifter."""
    network = load_lifter().network
    return network.features(network.whitened(inputs.astype(np.float32))).astype(np.float64)


def _silhouettes(
    learned: list[PoseSequence], tested: dict[str, list[PoseSequence]], count: int, few: int
) -> Any:
    body = load_body('human37')
    sets = training_set(body, learned, TrainingSettings(samples=count, seed=0))
    training = described(body, sets)
    of_tests, shipped = {}, {}
    predictor = load_predictor()
    for activity, motions in tested.items():
        some = training_set(body, motions, TrainingSettings(samples=few, seed=1))
        parts = [some.parts(i, training.descriptor.points) for i in range(len(some))]
        of_tests[activity] = training.descriptor.describe(parts), _joints(some.poses)
        found = []
        for row, pose in zip(predictor.descriptor.describe(parts), some.poses, strict=True):
            poses, shares = predictor.poses_at(row, pose[:3], BEST_OF)
            joints, more = _joints(poses, pose), BEST_OF - len(poses)
            weights = np.log(np.append(shares, np.full(more, 1e-12)))
            found.append((weights, np.concatenate([joints, np.repeat(joints[:1], more, axis=0)])))
        weights, means = (np.array(x) for x in zip(*found, strict=True))
        shipped[activity] = weights, means, None
    return training.descriptors, _joints(sets.poses), training.motions, of_tests, shipped


def _joints(poses: Array, before: Array | None = None) -> Array:
    """Joints (N, J, 3) relative to the hips, in axes turned towards each pose or `before`."""
    body = load_body('human37')

    def places(x: Array) -> tuple[Array, Array]:
        every = body.joint_positions(x)
        return every, every[:, body.skeleton.joint_index(HIPS)].mean(1)

    joints, hips = places(poses)
    _, seen = (joints, hips) if before is None else places(before[None])
    turns = np.broadcast_to(ray_rotations(seen), (len(poses), 3, 3))
    which = body.skeleton.joint_index(JOINTS)
    return np.asarray((joints[:, which] - hips[:, None]) @ turns)


# Learning and scores.


def learned_in_time(
    name: str, pairs: Pairs, budget: float
) -> tuple[ConditionalDensity, int, float] | None:
    """Trained model, number of pairs and processor time, s; None if the time was too short.

    For a network the number of steps replaces that of pairs.
    """
    order = np.random.default_rng(0).permutation(len(pairs.inputs))
    size = FIRST_STEPS if name == NETWORK else min(FIRST, len(order))
    spent, found = 0.0, None
    while True:
        rows = np.sort(order if name == NETWORK else order[:size])
        model = LearningNetwork(BEST_OF, steps=size) if name == NETWORK else MODELS[name](size)
        calibrated = LearningCalibration(model, 2)
        begun = time.process_time()
        calibrated.fit(pairs.inputs[rows], pairs.targets[rows], groups=pairs.groups[rows])
        used = time.process_time() - begun
        spent += used
        if spent > budget:
            return found
        found = calibrated, size, spent
        if spent + GROWTH * used > budget or (name != NETWORK and size >= len(order)):
            return found
        size = 2 * size if name == NETWORK else min(2 * size, len(order))


def _scores(found: Any, test: tuple[Array, Array, Array], pairs: Pairs) -> dict[str, float]:
    """Scores of log weights (n, K), means (n, K, J, 3) and variances (n, K, 3 J) or None."""
    logs, means, variances = found
    true = test[2]
    order = np.argsort(-logs, axis=1, kind='stable')[:, :BEST_OF]
    rows = np.arange(len(true))[:, None]
    off = means[rows, order] - true[:, None]
    off = off[:, :, SCORED] - off[:, :, [PELVIS]]
    away = np.linalg.norm(off, axis=3).mean(2)
    result = {'heaviest_mm': 1e3 * away[:, 0].mean(), 'best_mm': 1e3 * away.min(1).mean()}
    if variances is not None:
        flat = means.reshape(*logs.shape, -1)
        z = (true.reshape(len(true), 1, -1) - flat) / np.sqrt(variances)
        below = np.einsum('nk,nkj->nj', np.exp(logs), ndtr(z))
        wanted = [i for j in SCORED for i in range(3 * j, 3 * j + 3)]
        for share in SHARES:
            inside = np.abs(below[:, wanted] - 0.5) <= 0.5 * share
            result[f'within_{100 * share:.0f}'] = inside.mean()
        result['log_density'] = _projected_density(logs, means, variances, test[1], pairs)
    return {name: float(value) for name, value in result.items()}


def _projected_density(
    logs: Array, means: Array, variances: Array, targets: Array, pairs: Pairs
) -> float:
    """Mean log density of targets (n, D) under a mixture over joints, nats per number."""
    basis = pairs.basis
    centres = (means.reshape(*logs.shape, -1) - pairs.middle) @ basis.T
    spread = np.einsum('di,nki,ei->nkde', basis, variances, basis, optimize=True)
    off = targets[:, None] - centres
    squares = np.einsum('nkd,nkd->nk', off, np.linalg.solve(spread, off[..., None])[..., 0])
    each = logs - 0.5 * (squares + np.linalg.slogdet(2.0 * np.pi * spread)[1])
    return float(np.logaddexp.reduce(each, axis=1).mean() / targets.shape[1])


def _scored(model: ConditionalDensity, pairs: Pairs) -> dict[str, dict[str, float]]:
    result = {}
    for activity, test in pairs.tested.items():
        found = model.components(test[0])
        flat = found.means @ pairs.basis + pairs.middle
        spread = np.einsum('di,mde,ei->mi', pairs.basis, found.noise, pairs.basis, optimize=True)
        variances = found.inflation[..., None] * spread + pairs.residual
        means = flat.reshape(*found.log_weights.shape, len(JOINTS), 3)
        scores = _scores((found.log_weights, means, variances), test, pairs)
        density = found.log_density(test[1]).mean() / test[1].shape[1]
        result[activity] = {**scores, 'log_density': float(density)}
    return result


@lru_cache(maxsize=1)
def _read(path: Path) -> Pairs:
    with np.load(path, allow_pickle=True) as content:
        values = {name: content[name] for name in content.files}
    return Pairs(**{**values, 'tested': values['tested'].item()})


def of_model(work: tuple[Path, str, float]) -> dict[str, Any]:
    """Trains a model within the time, and returns its scores by activity."""
    path, name, budget = work
    pairs = _read(path)
    found = learned_in_time(name, pairs, budget)
    if found is None:
        return {'pairs': 0, 'seconds': budget, 'activities': {}}
    model, size, seconds = found
    one = next(iter(pairs.tested.values()))[0][:1]
    arrays = model.to_arrays().values()
    return {
        'pairs': size,
        'seconds': seconds,
        'megabytes': 1e-6 * sum(np.asarray(x).nbytes for x in arrays),
        'ms': 1e3 * best_time(lambda: model.components(one), seconds=0.2),
        'activities': _scored(model, pairs),
    }


def measure(
    cues: Sequence[str] = CUES,
    models: Sequence[str] = (),
    budget: float = BUDGET,
    processes: int = 0,
    *,
    quick: bool = False,
) -> dict[str, Any]:
    """Scores by cue and model.

    Raises:
        ValueError: the budget is not above 0.
        FileNotFoundError: the motion capture data are missing.
    """
    if not budget > 0.0:
        raise ValueError(f'--budget {budget:g}: wanted some seconds of processor time, above 0')
    known = [*MODELS, *([NETWORK] if tools_are_there() else [])]
    names = [x for x in known if not models or x in models]
    budget, processes = (1.0, 1) if quick else (budget, processes)
    if quick:
        names = [x for x in names if x != NETWORK]
    rows = []
    with tempfile.TemporaryDirectory() as made:
        work = []
        for cue in cues:
            pairs, shipped = pairs_of(cue, quick=quick)
            path = Path(made) / f'{cue}.npz'
            np.savez(path, **vars(pairs))
            rows.append({'cue': cue, 'model': SHIPPED, 'activities': shipped})
            work += [(cue, (path, name, budget)) for name in names]
        found = in_processes(of_model, [x for _, x in work], processes, 'contenders')
    for (cue, (_, name, _)), one in zip(work, found, strict=True):
        rows.append({'cue': cue, 'model': name, **one})
    return {'machine': description(), 'budget': budget, 'rows': rows}


# Tables.


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """Human-readable tables by cue: means over activities, then each activity."""
    parts = [f'{result["budget"]:g} s of processor time each; mm unless said']
    for cue in dict.fromkeys(x['cue'] for x in result['rows']):
        own = [x for x in result['rows'] if x['cue'] == cue]
        head = [
            cue, 'pairs or steps', 'heaviest', f'best of {BEST_OF}', 'log density, nats', '50 %',
            '90 %', 'MB', 'ms',
        ]  # fmt: skip
        parts.append(table([head, *map(_summary, own)], markdown=markdown))
        activities = list(dict.fromkeys(k for x in own for k in x['activities']))
        rows = [[f'{cue}: heaviest / best of {BEST_OF}', *activities]]
        for one in own:
            each = [one['activities'].get(k) for k in activities]
            cells = [f'{x["heaviest_mm"]:.0f} / {x["best_mm"]:.0f}' if x else '-' for x in each]
            rows.append([one['model'], *cells])
        parts.append(table(rows, markdown=markdown))
    return '\n\n'.join(parts)


def _summary(one: dict[str, Any]) -> list[str]:
    def mean(name: str, form: str, factor: float = 1.0) -> str:
        values = [x[name] for x in one['activities'].values() if name in x]
        return format(factor * float(np.mean(values)), form) if values else '-'

    def plain(name: str, form: str) -> str:
        return format(one[name], form) if name in one else '-'

    return [
        one['model'], plain('pairs', 'd'), mean('heaviest_mm', '.0f'), mean('best_mm', '.0f'),
        mean('log_density', '.2f'), mean('within_50', '.0f', 100), mean('within_90', '.0f', 100),
        plain('megabytes', '.1f'), plain('ms', '.2f'),
    ]  # fmt: skip


def main(argv: list[str]) -> int:
    """Runs the benchmark."""
    parser = benchmark_parser('contenders', __doc__, quick='procedural motions, a second each')
    parser.add_argument(
        '--budget', type=float, default=BUDGET,
        help=f'processor time of each model, s (default: {BUDGET:g})',
    )  # fmt: skip
    parser.add_argument('--cues', nargs='+', choices=CUES, default=CUES, help='some of them')
    parser.add_argument('--models', nargs='+', default=[], metavar='MODEL', help='some of them')
    options = parser.parse_args(argv)
    return run_benchmark(
        'contenders',
        lambda: measure(tuple(options.cues), options.models, options.budget, quick=options.quick),
        as_text,
        as_json=options.json,
    )
