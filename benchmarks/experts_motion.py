"""Poses from silhouettes of motions and people that were not in training.

Recorded motions are seen from a few headings with a random build of the person, and drawn as
silhouettes with an uneven outline. Postures are compared on the body of the predictor: the angles
of all rotations of root and joints, and the joints relative to the pelvis. All models learn from
the same pairs and are calibrated alike.
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.clips import ROOT
from hmt_learning.training.predictor_learning import (
    KINDS,
    Described,
    described,
    kinds,
    learned_predictor,
    new_model,
    target_basis,
)
from hmt_learning.training.training_set import (
    PoseSequence,
    TrainingSettings,
    motion_files,
    random_build,
    recorded_sequence,
    seen_from,
    training_set,
    typical_body,
)
from hmt_ros.body import Body, load_body
from hmt_ros.evaluation.pose_scores import EVALUATED_JOINTS, ORIGIN, joint_mixtures, score
from hmt_ros.experts.descriptor.silhouette_descriptor import silhouette_parts
from hmt_ros.experts.pose_encoding import PoseEncoding
from hmt_ros.experts.pose_predictor import (
    ALONE,
    BY_DYNAMICS,
    BY_EXPERTS,
    JITTER,
    PosePredictor,
)
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.calibration import coverage
from hmt_ros.inference.clustering import k_means, squared_distances

Array = NDArray[np.float64]

COLUMNS = {
    'network': 'network',
    'nearest': 'nearest neighbours',
    'relevance-vector': 'one regression',
    'conditional': 'conditional experts',
    'joint': 'joint experts',
    'local': 'local experts',
}
BASELINES = ('nearest', 'relevance-vector')
EXPERTS = ('conditional', 'joint')
BEST_OF = 5
# Heading and elevation of each view of a test motion, degrees; start as a share of the motion.
VIEWS = ((20.0, 5.0, 0.15), (140.0, 10.0, 0.5), (-100.0, 0.0, 0.85))
FRAMES = 40  # consecutive frames of each view
SAMPLES = 200  # of a density, for the estimate of a level
# Of the frames of an ambiguous activity, more than AMBIGUOUS_SHARE are ambiguous: among the
# NEIGHBOURS training silhouettes most alike there are two groups of postures, each with MINORITY
# of them or more, whose means are further apart than APART times the spread within them.
NEIGHBOURS, MINORITY, APART, AMBIGUOUS_SHARE = 30, 0.15, 2.0, 0.25
# Targets for experts over one regression, and for the coverage of regions.
BEST_SHARE = 0.60
COVERED = (0.80, 0.97)


@dataclass(frozen=True, eq=False)
class Learned:
    """Training data of all models.

    Attributes:
        body: Body with typical lengths.
        sequences: Motions.
        training: Descriptors and targets.
    """

    body: Body
    sequences: list[PoseSequence]
    training: Described


@dataclass(frozen=True, eq=False)
class SeenMotion:
    """One view of a test motion.

    Attributes:
        activity: Activity of the motion.
        poses: (n, d) true poses.
        descriptors: (n, p) of the silhouettes.
    """

    activity: str
    poses: Array
    descriptors: Array


def mocap_folder(part: str) -> Path:
    """Folder of recorded motions, `train` or `dev`.

    Raises:
        ValueError: the folder is absent.
    """
    folder = Path(os.environ.get('HMT_SHARED', ROOT / '..' / 'shared')) / 'mocap' / part
    if not folder.is_dir():
        raise ValueError(f'no recorded motions: {folder.resolve()} is absent')
    return folder


def recorded(part: str, without: Sequence[str] = ()) -> list[PoseSequence]:
    """Motions of a folder, without the named files."""
    body = load_body('human37')
    files = [path for path in motion_files(mocap_folder(part)) if path.stem not in without]
    return [recorded_sequence(path, body) for path in files]


def learn_from(sequences: list[PoseSequence], samples: int, seed: int = 0) -> Learned:
    """Descriptors and targets of the silhouettes of motions."""
    body = typical_body(load_body('human37'), sequences)
    pairs = training_set(body, sequences, TrainingSettings(samples=samples, seed=seed))
    return Learned(body, sequences, described(body, pairs))


def predictor_of(
    learned: Learned, name: str, *, dynamics: bool = True
) -> tuple[PosePredictor, float]:
    """A predictor with a model by name, and the time of learning, s."""
    kind = KINDS[name]
    training = learned.training.with_components(kind.components)
    count = len(training.targets)
    begin = time.perf_counter()
    predictor = learned_predictor(
        learned.body, training, new_model(name, samples=count),
        new_model(name, kind.dynamics_experts, samples=count) if dynamics else None,
    )  # fmt: skip
    return predictor, time.perf_counter() - begin


def seen_motions(
    learned: Learned, sequences: Sequence[PoseSequence], frames: int = FRAMES, seed: int = 5
) -> list[SeenMotion]:
    """Test motions from all views, with persons of random build and uneven outlines."""
    rng = np.random.default_rng(seed)
    descriptor = learned.training.descriptor
    result = []
    for sequence in sequences:
        count = min(frames, len(sequence.poses))
        for heading, elevation, at in VIEWS:
            first = int(at * (len(sequence.poses) - count))
            person = random_build(learned.body, TrainingSettings(), rng)
            poses, masks = seen_from(
                person, sequence, heading, elevation, frames=slice(first, first + count),
                boundary_noise=1.0, seed=int(rng.integers(2**31)),
            )  # fmt: skip
            parts = [silhouette_parts(mask, descriptor.points) for mask in masks]
            result.append(SeenMotion(sequence.activity, poses, descriptor.describe(parts)))
    return result


def ambiguous_share(learned: Learned, motions: Sequence[SeenMotion]) -> dict[str, float]:
    """Share of the frames of each activity whose silhouette is ambiguous; see `AMBIGUOUS_SHARE`."""
    training = learned.training
    basis = target_basis(PoseEncoding(learned.body), training.targets)
    states = training.targets @ basis
    shares: dict[str, list[float]] = {}
    for motion in motions:
        away = squared_distances(motion.descriptors, training.descriptors)
        near = np.argpartition(away, NEIGHBOURS, axis=1)[:, :NEIGHBOURS]
        shares.setdefault(motion.activity, []).extend(float(two_groups(states[i])) for i in near)
    return {activity: float(np.mean(values)) for activity, values in shares.items()}


def two_groups(states: Array) -> bool:
    """Whether states (n, D) fall into two groups that are apart."""
    centres, own = k_means(states, 2, np.random.default_rng(0))
    if min(np.bincount(own, minlength=2)) < MINORITY * len(states):
        return False
    spread = np.sqrt(((states - centres[own]) ** 2).sum(1).mean())
    return bool(np.linalg.norm(centres[0] - centres[1]) > APART * spread)


def compared(
    learned: Learned,
    motions: Sequence[SeenMotion],
    names: Sequence[str] | None = None,
    *,
    propagated: Sequence[str] = (),
) -> dict[str, Any]:
    """Scores of models by activity, of some also propagated, and verdicts.

    Args:
        learned: what they learn from.
        motions: of other people.
        names: of models; None: all that can learn here.
        propagated: of those that learn dynamics, too.
    """
    names = [x for x in COLUMNS if x in kinds()] if names is None else names
    shares = ambiguous_share(learned, motions)
    result: dict[str, Any] = {
        'samples': len(learned.training.targets),
        'motions': len(learned.sequences),
        'frames': sum(len(motion.poses) for motion in motions),
        'ambiguous_share': shares,
        'ambiguous': sorted(name for name, share in shares.items() if share > AMBIGUOUS_SHARE),
    }  # fmt: skip
    for name in names:
        predictor, seconds = predictor_of(learned, name, dynamics=name in propagated)
        entry: dict[str, Any] = {'learning_s': seconds}
        entry['alone'] = scores(predictor, motions)
        followed = followed_views(motions)
        entry['not_propagated'] = scores(predictor, followed)
        if name in propagated:
            entry['propagated'] = scores(predictor, followed, BY_EXPERTS)
        entry['by_dynamics'] = scores(predictor, followed, BY_DYNAMICS)
        result[name] = entry
    result['wanted'] = verdicts(result, [name for name in names if name not in BASELINES])
    return result


def followed_views(motions: Sequence[SeenMotion]) -> list[SeenMotion]:
    """One view of each motion, in rotation."""
    count = len(VIEWS)
    return [motions[i + (i // count) % count] for i in range(0, len(motions), count)]


def scores(
    predictor: PosePredictor, motions: Sequence[SeenMotion], propagation: str = ALONE
) -> dict[str, Any]:
    """Errors and calibration by activity, and over all frames ('all')."""
    rows: dict[str, list[dict[str, Array]]] = {}
    for motion in motions:
        mixtures = sequence_mixtures(predictor, motion, propagation)
        rows.setdefault(motion.activity, []).append(frame_scores(predictor.body, mixtures, motion))
    rows['all'] = [one for parts in list(rows.values()) for one in parts]
    return {activity: summary(parts) for activity, parts in rows.items()}


def sequence_mixtures(
    predictor: PosePredictor, motion: SeenMotion, propagation: str = ALONE,
    components: int = BEST_OF,
) -> list[GaussianMixture]:  # fmt: skip
    """Mixtures over poses (d,) with at most so many components; the root is the true one."""
    encoding = predictor.encoding
    inputs = motion.descriptors[:, : predictor.descriptor.size]
    found: list[GaussianMixture] = []
    for pose, row in zip(motion.poses, inputs, strict=True):
        targets = predictor.targets_after(
            row, found[-1] if found else None, propagation=propagation, max_components=components
        )
        roots = np.repeat(pose[None, :3], len(targets), axis=0)
        by_target, _ = encoding.jacobians(targets.means, roots)
        covariances = by_target @ targets.covariances @ by_target.transpose(0, 2, 1)
        covariances += JITTER * np.eye(encoding.size)
        covariances = 0.5 * (covariances + covariances.transpose(0, 2, 1))
        means = encoding.decode(targets.means, roots)
        found.append(GaussianMixture(targets.weights, means, covariances))
    return found


def frame_scores(
    body: Body, mixtures: Sequence[GaussianMixture], motion: SeenMotion
) -> dict[str, Array]:
    """Scores of each frame: errors (n,) in degrees and mm, log densities, levels."""
    which = body.skeleton.joint_index((ORIGIN, *EVALUATED_JOINTS))
    true = body.joint_positions(motion.poses)[:, which]
    found = score(joint_mixtures(body, mixtures), true[:, 1:] - true[:, :1], samples=SAMPLES)
    turning = body.skeleton.dof_is_rotation
    angles = [
        np.degrees(np.abs(wrapped(mixture.means - pose)[:, turning]).mean(1))
        for mixture, pose in zip(mixtures, motion.poses, strict=True)
    ]
    assert found.levels is not None
    assert found.joint_levels is not None
    assert found.log_densities is not None
    return {
        'mm': 1e3 * found.heaviest.mean(1),
        'best_mm': 1e3 * found.best.mean(1),
        'degrees': np.array([x[0] for x in angles]),
        'best_degrees': np.array([x.min() for x in angles]),
        'log_density': found.log_densities,
        'level': found.levels,
        'joint_levels': found.joint_levels,
    }


def wrapped(angles: Array) -> Array:
    """Angles between -pi and pi."""
    result: Array = (angles + np.pi) % (2.0 * np.pi) - np.pi
    return result


def summary(parts: Sequence[dict[str, Array]]) -> dict[str, float]:
    """Means and maxima over frames."""
    whole = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    result: dict[str, float] = {'frames': len(whole['mm'])}
    for name in ('mm', 'best_mm', 'degrees', 'best_degrees'):
        result[name] = float(whole[name].mean())
        result[f'max_{name}'] = float(whole[name].max())
    result['log_density'] = float(whole['log_density'].mean())
    for percent in (50, 90):
        for name, levels in (('', whole['level']), ('joint_', whole['joint_levels'])):
            result[f'{name}coverage_{percent}'] = coverage(levels, percent / 100)
    return result


def verdicts(result: dict[str, Any], names: Sequence[str]) -> list[dict[str, Any]]:
    """Targets, the numbers found, whether they are met, and the activities that miss them."""
    found = []
    both = [name for name in BASELINES if name in result]
    for name in names:
        mine = result[name]['alone']
        if len(both) == len(BASELINES):
            regression = result['relevance-vector']['alone']
            for unit in ('degrees', 'mm'):
                ratio = {
                    a: mine[a][unit] / min(result[b]['alone'][a][unit] for b in both)
                    for a in result['ambiguous']
                }
                found.append(verdict_of(name, f'mean {unit} over the better baseline', ratio, 1.0))
                ratio = {
                    a: mine[a][f'max_{unit}'] / regression[a][f'max_{unit}']
                    for a in result['ambiguous']
                }
                found.append(verdict_of(name, f'maximum {unit} over one regression', ratio, 1.0))
            for unit in ('best_degrees', 'best_mm'):
                ratio = {a: mine[a][unit] / regression[a][unit] for a in result['ambiguous']}
                what = f'{unit.removeprefix("best_")} of the best of {BEST_OF} over one regression'
                found.append(verdict_of(name, what, ratio, BEST_SHARE))
        for kind in ('coverage_90', 'joint_coverage_90'):
            low, high = COVERED
            value = mine['all'][kind]
            found.append(
                {
                    'model': name, 'what': kind, 'value': value,
                    'wanted': f'{low:.2f} to {high:.2f}', 'met': low <= value <= high, 'missed': [],
                }
            )  # fmt: skip
    return found


def verdict_of(name: str, what: str, ratio: dict[str, float], wanted: float) -> dict[str, Any]:
    """Whether a ratio is at most the wanted one for every activity."""
    missed = sorted(activity for activity, value in ratio.items() if value > wanted)
    return {
        'model': name,
        'what': what,
        'value': max(ratio.values(), default=0.0),
        'mean': float(np.mean(list(ratio.values()))) if ratio else 0.0,
        'wanted': f'at most {wanted:.2f}',
        'met': not missed,
        'missed': missed,
    }
