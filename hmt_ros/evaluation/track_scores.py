"""Scores of a track (one mixture at each of many times) against the true joint positions.

Estimates are scored in batches as they arrive, so that memory for mixtures stays bounded. An
estimate is compared with the truth of exactly its stamp.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.evaluation.ground_scores import GroundScores, TrueGround, ground_scores
from hmt_ros.evaluation.pose_scores import (
    BATCH_SIZE,
    EVALUATED_JOINTS,
    MODEL_SIGMA,
    JointMixture,
    Scores,
    joint_mixtures,
    marginal_regions,
    origin_joints,
    relative_positions,
    score,
)
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.mixture import GaussianMixture

# Minimum number of evaluated joints in the ground truth.
_MIN_JOINTS = 4
# Distance above which recorded joint positions contradict the kinematics of a body, m.
_POSITION_TOLERANCE = 1e-3


@dataclass(frozen=True, eq=False)
class Truth:
    """True positions of the joints of a person.

    Attributes:
        source: name of the source, for error messages.
        joint_names: (J,) names of the joints.
        joints: stamp in ns -> (J, 3) m, camera optical frame.
        frame_id: frame of the positions; '' if unknown.
        ground: the true floor by stamp in ns; empty: unknown.

    Raises:
        ValueError: there are no frames, or positions do not match the names or are not finite.
    """

    source: str
    joint_names: tuple[str, ...]
    joints: dict[int, Array]
    frame_id: str = ''
    ground: Mapping[int, TrueGround] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.joints:
            raise ValueError(f'{self.source} has no frames')
        wanted = (len(self.joint_names), 3)
        for stamp, positions in self.joints.items():
            if positions.shape != wanted:
                raise ValueError(
                    f'{self.source}: joints at {stamp} ns have shape {positions.shape}, '
                    f'wanted {wanted}'
                )
            if not np.isfinite(positions).all():
                raise ValueError(f'{self.source}: joints at {stamp} ns are not finite')

    def evaluated_joints(self) -> tuple[str, ...]:
        """Return the joints of `EVALUATED_JOINTS` that the truth has.

        Raises:
            ValueError: the truth has fewer than four of these joints.
        """
        known = tuple(name for name in EVALUATED_JOINTS if name in self.joint_names)
        if len(known) < _MIN_JOINTS:
            raise ValueError(
                f'{self.source} knows {list(known)} of the evaluated joints, wanted at least '
                f'{_MIN_JOINTS} of {list(EVALUATED_JOINTS)}'
            )
        return known


@dataclass(frozen=True, eq=False)
class Estimate:
    """A mixture over poses at one time; some parts may be unknown.

    Attributes:
        stamp_ns: time of the poses, ns.
        weights: (K,) weights; they sum to 1.
        mixture: mixture over poses (d,); None without covariances.
        positions: (K, J, 3) positions of the joints at the means, m; None if unknown.
        joint_names: (J,) names of the joints in `positions`.
        body: body of the poses; None if unknown.
    """

    stamp_ns: int
    weights: Array
    mixture: GaussianMixture | None
    positions: Array | None
    joint_names: tuple[str, ...]
    body: Body | None


@dataclass(frozen=True)
class TrackScores:
    """Scores of a track.

    Attributes:
        kind: kind of the mixtures, e.g. 'posterior'.
        scores: scores of the frames with ground truth.
        missing: number of frames of the ground truth without an estimate.
        without_truth: number of estimates at stamps without ground truth.
        note: reason why densities are missing; '' if they are not.
        ground: scores of the heaviest mode's feet against the true floor; None if unknown.
    """

    kind: str
    scores: Scores
    missing: int
    without_truth: int
    note: str
    ground: GroundScores | None = None


class TrackScorer:
    """Collects the estimates of a track and scores them in batches.

    Args:
        model_sigma: additional standard deviation of a coordinate, m.

    Attributes:
        kind: kind of the mixtures; set by the reader of the track.

    Raises:
        ValueError: the truth has neither a pelvis nor both hips, or too few joints.
    """

    def __init__(
        self, name: str, truth: Truth, *, model_sigma: float = MODEL_SIGMA, seed: int = 0
    ) -> None:
        self.name, self.truth, self.kind = name, truth, ''
        self._model_sigma, self._rng = model_sigma, np.random.default_rng(seed)
        self._rng_of_absolute = np.random.default_rng([seed, 1])
        self._origin = origin_joints(truth.joint_names, truth.source)
        self._joints = truth.evaluated_joints()
        self._note, self._without_truth = '', 0
        self._seen: set[int] = set()
        self._waiting: list[Estimate] = []
        self._window: dict[int, Estimate] = {}
        self._parts: list[Scores] = []
        self._heaviest: dict[int, Array] = {}
        self._names: tuple[str, ...] = ()

    def take(self, estimate: Estimate) -> None:
        """Adds a final estimate; later estimates with the same stamp are ignored.

        Raises:
            ValueError: the estimate lacks joints of the truth.
        """
        if estimate.stamp_ns in self._seen:
            return
        if estimate.stamp_ns not in self.truth.joints:
            self._without_truth += 1
            return
        self._seen.add(estimate.stamp_ns)
        if estimate.stamp_ns in self.truth.ground:
            self._keep_heaviest(estimate)
        if self._waiting and self._waiting[-1].body is not estimate.body:
            self._score_waiting()
        self._waiting.append(estimate)
        if len(self._waiting) == BATCH_SIZE:
            self._score_waiting()

    def take_window(self, estimates: Sequence[Estimate]) -> None:
        """Adds the estimates of a window, oldest first; earlier estimates become final.

        Raises:
            ValueError: see `take`.
        """
        for stamp in sorted(self._window):
            if stamp < estimates[0].stamp_ns:
                self.take(self._window.pop(stamp))
        self._window.update((estimate.stamp_ns, estimate) for estimate in estimates)

    def finish(self) -> TrackScores:
        """Return all scores.

        Raises:
            ValueError: no stamp of an estimate is in the ground truth; see also `take`.
        """
        for stamp in sorted(self._window):
            self.take(self._window[stamp])
        self._score_waiting()
        if not self._parts and not self._without_truth:
            self._parts.append(Scores.of_nobody(self._joints))
        if not self._parts:
            raise ValueError(
                f'no stamp of {self.name} is among those of {self.truth.source}, '
                f'{min(self.truth.joints)} to {max(self.truth.joints)} ns'
            )
        missing = len(self.truth.joints) - len(self._seen)
        return TrackScores(
            self.kind,
            Scores.concatenate(self._parts),
            missing,
            self._without_truth,
            self._note,
            ground_scores(self._heaviest, self._names, self.truth.ground),
        )

    def _keep_heaviest(self, estimate: Estimate) -> None:
        """Keeps the joint positions of the heaviest mode, for the scores of its feet."""
        rank = int(np.argmax(estimate.weights))
        if estimate.positions is not None:
            self._names = tuple(estimate.joint_names)
            self._heaviest[estimate.stamp_ns] = estimate.positions[rank]
        elif estimate.body is not None and estimate.mixture is not None:
            self._names = estimate.body.joint_names
            means = estimate.mixture.means[[rank]]
            self._heaviest[estimate.stamp_ns] = estimate.body.joint_positions(means)[0]

    def _score_waiting(self) -> None:
        """Scores the waiting estimates, which all have the same body."""
        estimates, self._waiting = self._waiting, []
        if not estimates:
            return
        body = estimates[0].body
        mixtures = [one.mixture for one in estimates if one.mixture is not None]
        if len(mixtures) < len(estimates) or body is None:
            why = 'its body is unknown' if len(mixtures) == len(estimates) else 'no covariances'
            self._note = self._note or why
            body = None
        elif _is_elsewhere(body, estimates[0]):
            self._note = f'joint positions are not those of the body {body.name} of the bag'
            body = None
        if body is None:
            found = [self._bare(one) for one in estimates]
        else:
            positions = [one.positions for one in estimates if one.positions is not None]
            found, absolute = (
                joint_mixtures(
                    body,
                    mixtures,
                    self._joints,
                    model_sigma=self._model_sigma,
                    positions=positions or None,
                    origin=origin,
                )
                for origin in (self._origin, ())
            )
        names, every = self.truth.joint_names, [self.truth.joints[x.stamp_ns] for x in estimates]
        true = relative_positions(np.array(every), names, self._joints, self._origin)
        scores = score(found, true, self._joints, seed=self._rng)
        if body is not None:
            true = np.array(every)[:, [names.index(name) for name in self._joints]]
            levels, _ = marginal_regions(absolute, true, seed=self._rng_of_absolute)
            scores = replace(scores, absolute_levels=levels)
        self._parts.append(scores)

    def _bare(self, estimate: Estimate) -> JointMixture:
        """Return a mixture of joint positions without covariances."""
        if estimate.positions is None:
            raise ValueError(f'{self.name}: trajectories need the body, and the bag has none')
        try:
            joints = relative_positions(
                estimate.positions, estimate.joint_names, self._joints, self._origin
            )
        except ValueError as error:
            raise ValueError(f'{self.name}: {error}') from error
        return JointMixture(estimate.weights, joints)


def _is_elsewhere(body: Body, estimate: Estimate) -> bool:
    """Whether recorded joint positions contradict the kinematics of the body."""
    if estimate.positions is None or estimate.mixture is None:
        return False
    if estimate.joint_names != body.joint_names:
        return True
    computed = body.joint_positions(estimate.mixture.means)
    return bool(np.abs(computed - estimate.positions).max() > _POSITION_TOLERANCE)


def mode_errors(
    joints: Mapping[int, Array], names: Sequence[str], truth: Truth
) -> dict[int, Array]:
    """Compute the mean joint error (K,) of the modes, m, for each stamp with known truth.

    Args:
        joints: stamp in ns -> (K, J, 3) joint positions of the modes, m.
        names: (J,) names of the joints.

    Returns:
        The errors by stamp, ns; empty if modes and truth share no evaluated joint or no origin
        joints.
    """
    shared = [x for x in EVALUATED_JOINTS if x in truth.joint_names and x in names]
    origin = origin_joints(truth.joint_names, truth.source)
    if not shared or not set(origin) <= set(names):
        return {}
    result = {}
    for stamp, modes in joints.items():
        if stamp in truth.joints:
            own = relative_positions(modes, names, shared, origin)
            true = relative_positions(truth.joints[stamp], truth.joint_names, shared, origin)
            result[stamp] = np.linalg.norm(own - true, axis=2).mean(1)
    return result
