"""Mixture density propagation: a mixture over poses, from observation to observation (KJS 4, 5)."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.kinematics import Frames, forward
from hmt_ros.image.observation import Observation
from hmt_ros.image.texture import Textures, capture_textures
from hmt_ros.inference.bounded_newton import Minimum, resting
from hmt_ros.inference.mixture import GaussianMixture
from hmt_ros.tracking.candidates import (
    Candidates,
    joined_candidates,
    joined_minima,
    relative_joints,
    some_minima,
)
from hmt_ros.tracking.dynamics import predict, update_velocities
from hmt_ros.tracking.flesh_fitting import FleshFit
from hmt_ros.tracking.kinematic_jumps import KinematicJumps
from hmt_ros.tracking.limb_votes import LimbVotes
from hmt_ros.tracking.misfit import unexplained_keypoints, unexplained_outline
from hmt_ros.tracking.mode_covariances import free_covariances
from hmt_ros.tracking.modes import Modes
from hmt_ros.tracking.pose_energy import PoseEnergy
from hmt_ros.tracking.proposals import covariance_scaled_samples, spherical_samples
from hmt_ros.tracking.pruning import choose_hypotheses, inherited_log_weights
from hmt_ros.tracking.tracker_settings import TrackerSettings

Array = NDArray[np.float64]
Index = NDArray[np.intp]

# How far the usual energy follows that of the last image.
USUAL_GAIN = 0.1


class MixtureFilter:
    """The posterior over the poses of one person, as a mixture that observations move on.

    Args:
        body: of the person.
        camera: that sees the person.
        settings: how.
        seed: of all randomness.

    Attributes:
        body: with the widths that have been estimated.
        misfit: share of the last observation that no mode explains.
        log_evidence: by how much less energy than 0 the best mode had, summed over observations,
            tempered.
    """

    def __init__(self, body: Body, camera: Camera, settings: TrackerSettings, seed: int) -> None:
        self.body = body
        self.camera = camera
        self.settings = settings
        self.misfit = 0.0
        self.log_evidence = 0.0
        self._seed = seed
        self._rng = np.random.default_rng(seed)
        self._limb_votes = LimbVotes(seed)
        self._modes: Modes | None = None
        self._flesh = FleshFit(body)
        self._usual_energy = np.inf
        self._outline_costs = np.empty((0, 0))
        self._bad_images = 0
        self._energy = PoseEnergy(body, camera, settings)
        self._use_body(body)

    @property
    def evaluations(self) -> int:
        """Of the likelihood, since the number was set last."""
        return self._energy.evaluations

    @evaluations.setter
    def evaluations(self, count: int) -> None:
        self._energy.evaluations = count

    @property
    def modes(self) -> Modes:
        """The present modes.

        Raises:
            ValueError: there is no track.
        """
        if self._modes is None:
            raise ValueError('there is no track yet')
        return self._modes

    @property
    def begun(self) -> bool:
        """Whether there are modes."""
        return self._modes is not None

    @property
    def lost(self) -> bool:
        """Whether the last observations were explained too badly."""
        return self._bad_images >= self.settings.lost_images

    def begin(
        self,
        body: Body,
        poses: Array,
        log_weights: Array,
        precisions: Array,
        observation: Observation,
    ) -> Minimum:
        """Modes from poses (N, d) that are expected; what became of each of them.

        Args:
            body: of the person; its widths are fitted.
            poses: (N, d).
            log_weights: (N,).
            precisions: (N, d, d) of the poses.
            observation: of the first image.
        """
        self._use_body(body)
        self._flesh = FleshFit(body)

        def settle(starts: Array, iterations: int) -> Minimum:
            energy = self._energy.around(observation, poses, precisions)
            solved = self._energy.minimise(energy, starts, iterations)
            self.keep_still(solved, log_weights, observation)
            return solved

        solved = settle(poses, 3 * self.settings.iterations)
        for _ in range(3):
            if not self._fit_flesh(observation):
                break
            solved = settle(solved.x, self.settings.iterations)
        return solved

    def begin_anew(self, poses: Array, observation: Observation) -> Minimum:
        """Modes from an observation and from poses (N, d) to search from; what became of each."""
        energy = self._energy.alone(observation)
        solved = self._energy.minimise(energy, poses, 3 * self.settings.iterations)
        self.keep_still(solved, np.zeros(len(poses)), observation)
        self._bad_images = 0
        return solved

    def keep_still(self, solved: Minimum, log_weights: Array, observation: Observation) -> None:
        """Makes modes that do not move from minima and the log weights (N,) they had before."""
        least = self._keep(solved, log_weights, np.zeros_like(solved.x), observation)
        self.log_evidence = -self.settings.temperature * least

    def twin(self) -> MixtureFilter:
        """Another filter of the same person, without modes, with random numbers of its own."""
        other = MixtureFilter(self.body, self.camera, self.settings, self._seed + 1)
        other._flesh = deepcopy(self._flesh)
        return other

    def join(self, other: MixtureFilter, log_shares: Array, observation: Observation) -> None:
        """Takes the heaviest modes of both, for the log probabilities (2,) of the two."""
        modes = self.modes.joined(other.modes, log_shares, self.settings.max_hypotheses)
        frames = forward(self.body.skeleton, modes.poses)
        self._modes = replace(modes, textures=self._textures(frames, observation))

    def propagate(
        self, observation: Observation, dt: float, expected: GaussianMixture | None
    ) -> None:
        """Moves the mixture on to the next image.

        Args:
            observation: of the image.
            dt: since the last one, s.
            expected: poses that something else expects, if any.
        """
        s, m, body = self.settings, self.modes, self.body
        predicted, covariances = predict(
            s.dynamics, self._rates, m.poses, m.filtered, m.velocities, dt
        )
        predicted = np.clip(predicted, body.lower, body.upper)
        precisions = _inverses(covariances)
        everyone = np.arange(len(m.poses))
        moved = self._energy.follow_motion(predicted, precisions, observation, m.textures)
        base = self._energy.minimise(
            self._energy.posterior(observation, everyone, moved, precisions, m.textures, everyone),
            moved,
            s.base_iterations,
        )
        still = np.zeros(moved.shape, dtype=np.bool_)
        sources = Candidates(moved, everyone, m.log_weights, moved, still, m.textures, everyone)
        if s.proposals == 'kjs':
            candidates = self._jumps.propose(base, sources, covariances, observation, self._rng)
        else:
            candidates = self._samples(base, sources, covariances, observation)
        if expected is not None:
            candidates = joined_candidates(self._expected_elsewhere(expected, moved), candidates)
        solved = self._solve(candidates, precisions, observation)
        for _ in range(s.rounds - 1 if s.proposals == 'kjs' else 0):
            if solved.value.min() < self._usual_energy + s.surprise:
                break
            base, sources = self._search_around(
                solved, candidates, covariances, precisions, observation
            )
            more = self._jumps.propose(
                base, sources, covariances, observation, self._rng, again=True
            )
            solved = joined_minima(solved, self._solve(more, precisions, observation))
            candidates = joined_candidates(candidates, more)
        self._learn_usual_energy(float(solved.value.min()))
        parents = candidates.parents
        velocities = update_velocities(
            s.dynamics, m.velocities[parents], m.poses[parents], solved.x, dt
        )
        # Where a chain has jumped, its displacement is no motion.
        velocities = np.where(candidates.jumped, 0.0, velocities)
        log_priors = candidates.log_priors
        predicted_mixture = None
        if s.reweighting == 'bhattacharyya':
            log_priors = np.zeros(len(solved.x))
            predicted_mixture = GaussianMixture(np.exp(m.log_weights), moved, covariances)
        least = self._keep(solved, log_priors, velocities, observation, predicted_mixture)
        self.log_evidence -= s.temperature * least
        self._fit_flesh(observation)

    def judge(self, observation: Observation) -> None:
        """Takes in how much of an image no mode explains, and whether the track is lost."""
        s = self.settings
        self.misfit = unexplained_outline(self._outline_costs, s.likelihood.coverage)
        if observation.keypoints is not None:
            of_keypoints = unexplained_keypoints(
                self.body, self.camera, self.modes.poses, observation.keypoints,
                s.likelihood.joints.sigma,
            )  # fmt: skip
            self.misfit = max(self.misfit, of_keypoints)
        self._bad_images = self._bad_images + 1 if self.misfit > s.lost_misfit else 0

    def likelihood_mixture(self, m: Modes, observation: Observation) -> GaussianMixture:
        """The modes of the likelihood alone, without what was known from the images before.

        Around each mode of the posterior the energy of the image and of the body's prior is a
        parabola; its minimum and curvature make a component, its depth the weight.
        """
        body = self.body
        value, gradient, hessian = self._energy.likelihood.energy(m.poses, observation, None, None)
        free = ~resting(m.poses, gradient, body.lower, body.upper)
        covariances = free_covariances(hessian, free)
        step = -np.einsum('kij,kj->ki', covariances, np.where(free, gradient, 0.0))
        limit = 3.0 * np.sqrt(np.einsum('kii->ki', m.covariances))
        step = np.clip(step, -limit, limit)
        means = np.clip(m.poses + step, body.lower, body.upper)
        if observation.shows_shape:
            frames = forward(body.skeleton, m.poses)
            covariances = self._honest_covariances(hessian, frames, free, observation)
        log_weights = -self.settings.temperature * value
        weights = np.exp(log_weights - log_weights.max())
        return GaussianMixture(weights / weights.sum(), means, covariances).sorted()

    def _use_body(self, body: Body) -> None:
        """Goes on with a body of the same degrees of freedom."""
        self.body = body
        energy = PoseEnergy(body, self.camera, self.settings)
        energy.count(self._energy.evaluations)
        self._energy = energy
        self._jumps = KinematicJumps(
            body, self.camera, self.settings, energy.values, energy.count, self._limb_votes
        )
        self._rates = self.settings.dynamics.rates(body.skeleton)

    def _fit_flesh(self, observation: Observation) -> bool:
        """Moves the widths of the flesh by what an image says; False where it says nothing more."""
        if self._flesh.images >= self.settings.flesh_images or observation.outline is None:
            return False
        m = self.modes
        poses, weights = m.poses[:4], np.exp(m.log_weights[:4])
        body = self._flesh.update(
            self._energy.likelihood,
            replace(observation, keypoints=None),
            poses,
            weights / weights.sum(),
        )
        self._energy.count(len(poses) * (2 * len(self._flesh.widths) + 1))
        self._use_body(body)
        return True

    def _expected_elsewhere(self, prediction: GaussianMixture, moved: Array) -> Candidates:
        """Candidates that the image suggests, and not the images before."""
        s, m, body = self.settings, self.modes, self.body
        poses = prediction.means
        apart = relative_joints(body, poses)[:, None] - relative_joints(body, moved)[None]
        parents = np.linalg.norm(apart, axis=3).mean(2).argmin(1)
        log_weights = np.log(s.prediction_probability * prediction.weights)
        return Candidates(
            poses,
            parents,
            m.log_weights[parents] + log_weights,
            poses,
            np.ones(poses.shape, dtype=np.bool_),
            m.textures,
            parents,
        )

    def _solve(
        self, candidates: Candidates, precisions: Array, observation: Observation
    ) -> Minimum:
        c = candidates
        energy = self._energy.posterior(
            observation, c.parents, c.centres, precisions, c.textures, c.texture_rows
        )
        solved = self._energy.minimise(energy, c.poses, self.settings.iterations)
        # The Student prior is as sharp as its covariance on average, not at its centre.
        own = precisions[c.parents]
        shrink = self._energy.student_shrinkage(solved.x - c.centres, own)
        return replace(solved, hessian=solved.hessian - (shrink - 1.0)[:, None, None] * own)

    def _search_around(
        self,
        solved: Minimum,
        candidates: Candidates,
        covariances: Array,
        precisions: Array,
        observation: Observation,
    ) -> tuple[Minimum, Candidates]:
        """What a further round of jumps starts from: the best optima, and what was sampled nearby.

        Jumps change limbs; a trunk that was predicted badly needs covariance-scaled samples.
        """
        s, c = self.settings, candidates
        order = np.argsort(solved.value, kind='stable')
        best = order[: max(s.max_hypotheses // 2, 1)]
        lead = best[:1]
        drawn = covariance_scaled_samples(
            self.body, solved.x[lead], covariances[c.parents[lead]], s.samples, s.sample_scale,
            self._rng,
        )[0]  # fmt: skip
        rows = np.full(len(drawn), c.texture_rows[lead[0]])
        value = self._energy.values(drawn, observation, c.textures, rows)
        drawn = drawn[np.argsort(value, kind='stable')[: s.max_hypotheses]]
        n = len(drawn)
        sampled = Candidates(
            drawn,
            np.full(n, c.parents[lead[0]]),
            np.full(n, c.log_priors[lead[0]] + np.log(s.jump_probability)),
            drawn,
            np.ones(drawn.shape, dtype=np.bool_),
            c.textures,
            rows[:n],
        )
        found = self._solve(sampled, precisions, observation)
        kept = Candidates(
            c.poses[best], c.parents[best], c.log_priors[best], c.centres[best], c.jumped[best],
            c.textures, c.texture_rows[best],
        )  # fmt: skip
        return joined_minima(some_minima(solved, best), found), joined_candidates(kept, sampled)

    def _learn_usual_energy(self, energy: float) -> None:
        usual = self._usual_energy
        if not np.isfinite(usual):
            self._usual_energy = energy
        else:
            # What is unusual is not learned at once.
            change = min(energy - usual, self.settings.surprise)
            self._usual_energy = usual + USUAL_GAIN * change

    def _samples(
        self, base: Minimum, sources: Candidates, covariances: Array, observation: Observation
    ) -> Candidates:
        """Candidates of covariance-scaled or spherical sampling."""
        s, m = self.settings, self.modes
        draw = covariance_scaled_samples if s.proposals == 'css' else spherical_samples
        moved = sources.poses
        k = len(moved)
        each = max(s.samples // k, 1)
        drawn = draw(self.body, moved, covariances, each, s.sample_scale, self._rng)
        poses = np.concatenate([base.x, drawn.reshape(-1, self.body.dimension)])
        parents = np.concatenate([np.arange(k), np.repeat(np.arange(k), each)])
        energies = self._energy.values(poses, observation, m.textures, parents)
        kept = choose_hypotheses(
            relative_joints(self.body, poses),
            m.log_weights[parents] - s.temperature * energies,
            s.candidates,
            same=s.hypothesis_merge_distance,
        ).chosen
        parents = parents[kept]
        return Candidates(
            poses[kept], parents, m.log_weights[parents], moved[parents],
            np.zeros((len(parents), self.body.dimension), dtype=np.bool_), m.textures, parents,
        )  # fmt: skip

    def _keep(
        self,
        solved: Minimum,
        log_priors: Array,
        velocities: Array,
        observation: Observation,
        predicted: GaussianMixture | None = None,
    ) -> float:
        """Makes the modes of the next mixture from optimised candidates; returns the least energy.

        A predicted mixture, where there is one, gives its weights to the modes nearest to it.
        """
        s = self.settings
        usable = np.flatnonzero(np.isfinite(solved.value))
        if len(usable) == 0:
            raise ValueError('no hypothesis has a finite energy')
        log_weights = log_priors[usable] - s.temperature * solved.value[usable]
        kept = choose_hypotheses(
            relative_joints(self.body, solved.x[usable]),
            log_weights,
            s.max_hypotheses,
            same=s.hypothesis_merge_distance,
        )
        weights = kept.log_weights - np.logaddexp.reduce(kept.log_weights)
        if predicted is not None:
            rows = usable[kept.chosen]
            weights = weights + inherited_log_weights(
                solved.x[rows], free_covariances(solved.hessian[rows], solved.free[rows]),
                np.argsort(-weights, kind='stable'), predicted,
            )  # fmt: skip
            weights -= np.logaddexp.reduce(weights)
        weights = np.maximum(weights, s.least_log_weight)
        weights -= np.logaddexp.reduce(weights)
        order = np.argsort(-weights, kind='stable')
        rows = usable[kept.chosen[order]]
        poses = solved.x[rows]
        frames = forward(self.body.skeleton, poses)
        textures = self._textures(frames, observation)
        image = self._energy.likelihood.image_energy(frames, observation, derivatives=False)
        filtered = free_covariances(solved.hessian[rows], solved.free[rows])
        covariances = filtered
        if observation.shows_shape:
            _, _, hessian = self._energy.likelihood.energy(poses, observation)
            covariances = self._honest_covariances(hessian, frames, solved.free[rows], observation)
        self._modes = Modes(
            poses, velocities[rows], covariances, filtered, weights[order], -image.value, textures
        )
        self._outline_costs = image.costs
        return float(solved.value[usable].min())

    def _textures(self, frames: Frames, observation: Observation) -> Textures | None:
        """What an image shows on the surfaces of poses."""
        if observation.intensity is None:
            return None
        return capture_textures(self.body, self.camera, frames, observation.intensity)

    def _honest_covariances(
        self, hessian: Array, frames: Frames, free: NDArray[np.bool_], observation: Observation
    ) -> Array:
        """Covariances that the Hessian of an image alone leaves, of which only a share is believed.

        Shapes, shadows and clothes differ from the model's in much the same way in image after
        image: such errors do not average out, over pixels or over time.
        """
        shape = self._energy.likelihood.image_energy(frames, replace(observation, keypoints=None))
        assert shape.hessian is not None
        return free_covariances(hessian - (1.0 - self.settings.image_trust) * shape.hessian, free)


def _inverses(matrices: Array) -> Array:
    return np.asarray(np.linalg.inv(matrices), dtype=np.float64)
