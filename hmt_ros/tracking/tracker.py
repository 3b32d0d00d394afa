"""Mixture density propagation with kinematic jumps and covariance-scaled sampling (KJS 4, 5)."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.kinematics import Frames, forward
from hmt_ros.image.background import BackgroundModel
from hmt_ros.image.likelihood import ImageLikelihood, TermSettings
from hmt_ros.image.observation import Keypoints, Observation, observe
from hmt_ros.image.texture import Textures, capture_textures
from hmt_ros.inference.bounded_newton import Minimum, minimise
from hmt_ros.inference.mixture import GaussianMixture
from hmt_ros.tracking.candidates import (
    Candidates,
    joined_candidates,
    joined_minima,
    relative_joints,
    some_minima,
)
from hmt_ros.tracking.dynamics import predict, update_velocities
from hmt_ros.tracking.facing_trial import DECIDED, faces_like, log_shares
from hmt_ros.tracking.flesh_fitting import FleshFit
from hmt_ros.tracking.initialisation import (
    poses_from_keypoints,
    poses_from_outline,
    start_from_keypoints,
)
from hmt_ros.tracking.kinematic_jumps import KinematicJumps
from hmt_ros.tracking.limb_votes import LimbVotes
from hmt_ros.tracking.misfit import unexplained_keypoints, unexplained_outline
from hmt_ros.tracking.mode_covariances import free_covariances, resting
from hmt_ros.tracking.pose_prediction import PosePrediction
from hmt_ros.tracking.proposals import covariance_scaled_samples, spherical_samples
from hmt_ros.tracking.pruning import choose_hypotheses, inherited_log_weights
from hmt_ros.tracking.subject import Subject
from hmt_ros.tracking.tracker_settings import TrackerSettings

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Image = NDArray[np.uint8]

# Keypoints from which a lost track starts anew.
FEWEST_KEYPOINTS = 6
# Around all joints of all modes, as a fraction of their extent: where the silhouette may be.
REGION_MARGIN = 0.3
# How far the usual energy follows that of the last image.
USUAL_GAIN = 0.1


class Status(Enum):
    """What the tracker is doing."""

    WAITING = 'waiting'  # for the image that the subject's joints were seen in
    TRACKING = 'tracking'
    LOST = 'lost'


@dataclass(frozen=True, eq=False)
class Modes:
    """The mixture that is propagated: K modes, heaviest first.

    Attributes:
        poses, velocities: (K, d), velocities per second.
        covariances: (K, d, d) of the posterior.
        filtered: (K, d, d) covariances that are propagated, as if errors were independent from
            image to image.
        log_weights: (K,) normalised.
        log_likelihoods: (K,) of the image at the poses.
        textures: of the image at the poses, or None.
    """

    poses: Array
    velocities: Array
    covariances: Array
    filtered: Array
    log_weights: Array
    log_likelihoods: Array
    textures: Textures | None

    def joined(self, other: Modes, log_shares: Array, count: int) -> Modes:
        """The heaviest modes of both, for the log probabilities (2,) of the two."""
        log_weights = np.concatenate(
            [self.log_weights + log_shares[0], other.log_weights + log_shares[1]]
        )
        kept = np.argsort(-log_weights, kind='stable')[:count]
        parts = {
            name: np.concatenate([getattr(self, name), getattr(other, name)])[kept]
            for name in ('poses', 'velocities', 'covariances', 'filtered', 'log_likelihoods')
        }
        log_weights = log_weights[kept]
        return Modes(
            log_weights=log_weights - np.logaddexp.reduce(log_weights), textures=None, **parts
        )


class Tracker:
    """Follows one person through images; the posterior over poses is a mixture.

    Args:
        body: model of the person; a subject's lengths replace the model's when a track starts.
        camera: calibrated.
        settings: how.
        background: the empty scene; None: learned from images before the track starts, and if there
            are none the silhouette is not used.
        seed: of all randomness. The same images, settings and seed give the same numbers.
    """

    def __init__(
        self,
        body: Body,
        camera: Camera,
        settings: TrackerSettings | None = None,
        background: BackgroundModel | None = None,
        seed: int = 0,
    ) -> None:
        self.settings = settings or TrackerSettings()
        self.model = body
        self.body = body
        self.camera = camera
        self.background = background or BackgroundModel()
        self._learning = background is None
        self._seed = seed
        self._rng = np.random.default_rng(seed)
        self._start: Subject | GaussianMixture | None = None
        self._modes: Modes | None = None
        self._last_image: Image | None = None
        self._last_stamp: int | None = None
        self._bad_images = 0
        self._flesh = FleshFit(body)
        self._usual_energy = np.inf
        self._least_energy = 0.0
        self._other_way: Tracker | None = None
        self._evidence = 0.0
        self._undecided_until = 0
        self._limb_votes = LimbVotes(seed)
        self.status = Status.WAITING
        self.misfit = 0.0
        self.evaluations = 0

    def reset(self, start: Subject | GaussianMixture | None = None) -> None:
        """Drops the track; the next image starts a new one.

        Args:
            start: a subject, whose track starts at the first image at or after its stamp, or a
                mixture over poses of the present body, or None: the start that was given last.
        """
        if isinstance(start, GaussianMixture) and start.dimension != self.body.dimension:
            raise ValueError(
                f'a start for {self.body.name} has {self.body.dimension} dimensions, '
                f'saw {start.dimension}'
            )
        if start is not None:
            self._start = start
        self._rng = np.random.default_rng(self._seed)
        self._modes = None
        self._last_image, self._last_stamp = None, None
        self._bad_images = 0
        self._flesh = FleshFit(self.body)
        self._usual_energy = np.inf
        self._other_way = None
        self._limb_votes = LimbVotes(self._seed)
        self.__dict__.pop('_jumps', None)
        self.status = Status.WAITING

    def step(
        self,
        image: Image,
        stamp: int,
        keypoints: Keypoints | None = None,
        prediction: PosePrediction | None = None,
    ) -> tuple[GaussianMixture, GaussianMixture] | tuple[None, None]:
        """Takes the next image.

        Args:
            image: (H, W, 3) BGR uint8, of the camera's size.
            stamp: of the image, ns; later than the one before.
            keypoints: joints seen in this image, if any.
            prediction: poses that a regression expects by this image, if any. They start a track
                that has no other start, with the lengths that they assume, are among the hypotheses
                of every image, and of a lost track; they are no evidence, which would count the
                image twice.

        Returns:
            The posterior p(x_t | R_t) and the likelihood p(r_t | x_t) as mixtures over poses,
            heaviest first with weights that sum to 1; (None, None) while there is no track.

        Raises:
            ValueError: an image of another size, a stamp that does not increase, or a prediction
                of a body with other degrees of freedom.
        """
        if prediction is not None:
            prediction.seen_as(self.body)
        size = (self.camera.height, self.camera.width)
        if image.shape[:2] != size:
            raise ValueError(f'the camera gives images of {size}, saw {image.shape[:2]}')
        if self._last_stamp is not None and stamp <= self._last_stamp:
            raise ValueError(f'stamps must increase, saw {stamp} after {self._last_stamp} ns')
        self.evaluations = 0
        if self._modes is None:
            start = self._start_at(stamp, prediction)
            if start is None:
                if self._learning:
                    self.background.learn(image)
                return None, None
            observation = self._observe(image, keypoints)
            self._begin(observation, start, stamp)
        else:
            assert self._last_stamp is not None
            observation = self._observe(image, keypoints)
            self._follow(observation, stamp, prediction)
        self._last_image, self._last_stamp = image, stamp
        self._judge(observation)
        if self._other_way is not None:
            self._other_way._judge(observation)
            self._decide_facing(observation, stamp)
        return self.posterior, self.likelihood_mixture(observation)

    @property
    def modes(self) -> Modes:
        """The present modes; those of both ways to face while that is not decided.

        Raises:
            ValueError: there is no track.
        """
        other = self._other_way
        if other is None:
            return self._own
        shares = log_shares([self._evidence, other._evidence])
        return self._own.joined(other._own, shares, self.settings.max_hypotheses)

    @property
    def _own(self) -> Modes:
        """The modes that this tracker follows itself."""
        if self._modes is None:
            raise ValueError('there is no track yet')
        return self._modes

    @property
    def posterior(self) -> GaussianMixture:
        """The present posterior."""
        m = self.modes
        return GaussianMixture(np.exp(m.log_weights), m.poses, m.covariances)

    def likelihood_mixture(self, observation: Observation) -> GaussianMixture:
        """The modes of the likelihood alone, without what was known from the images before.

        Around each mode of the posterior the energy of the image and of the body's prior is a
        parabola; its minimum and curvature make a component, its depth the weight.
        """
        m, body = self.modes, self.body
        value, gradient, hessian = self._likelihood.energy(m.poses, observation, None, None)
        free = ~resting(m.poses, gradient, body)
        covariances = free_covariances(hessian, free)
        step = -np.einsum('kij,kj->ki', covariances, np.where(free, gradient, 0.0))
        limit = 3.0 * np.sqrt(np.einsum('kii->ki', m.covariances))
        step = np.clip(step, -limit, limit)
        means = np.clip(m.poses + step, body.lower, body.upper)
        if _shows_shape(observation):
            frames = forward(body.skeleton, m.poses)
            covariances = self._honest_covariances(m.poses, frames, free, observation)
        log_weights = -self.settings.temperature * value
        weights = np.exp(log_weights - log_weights.max())
        return GaussianMixture(weights / weights.sum(), means, covariances).sorted()

    # The start of a track.

    def _start_at(
        self, stamp: int, prediction: PosePrediction | None
    ) -> Subject | GaussianMixture | PosePrediction | None:
        """What a track starts from at an image; None: it does not start there."""
        start = self._start
        if start is None:
            return prediction
        return None if isinstance(start, Subject) and stamp < start.stamp_ns else start

    def _begin(
        self,
        observation: Observation,
        start: Subject | GaussianMixture | PosePrediction,
        stamp: int,
    ) -> None:
        s = self.settings
        known = not isinstance(start, PosePrediction) or observation.keypoints is not None
        if isinstance(start, Subject):
            begun = start_from_keypoints(self.model, self.camera, start)
            self._use_body(begun.body)
            self._flesh = FleshFit(self.body)
            observation = replace(observation, keypoints=start.keypoints)
            poses, log_weights = begun.poses, np.zeros(len(begun.poses))
            precisions = np.zeros((len(poses), self.body.dimension, self.body.dimension))
        else:
            if isinstance(start, PosePrediction):
                self._use_body(start.body)
                self._flesh = FleshFit(self.body)
                start = start.both_ways(self.body)
            poses = start.means
            with np.errstate(divide='ignore'):
                log_weights = np.log(start.normalised().weights)
            precisions = _inverses(start.covariances)

        def energy(x: Array, index: Index) -> tuple[Array, Array, Array]:
            value, gradient, hessian = self._energy(x, observation, None, None)
            offset = x - poses[index]
            pulled = np.einsum('nij,nj->ni', precisions[index], offset)
            return (
                value + 0.5 * (offset * pulled).sum(1),
                gradient + pulled,
                hessian + precisions[index],
            )

        solved = self._minimise(energy, poses, 3 * s.iterations)
        still = np.zeros_like(solved.x)
        self._keep(solved, log_weights, still, observation)
        for _ in range(3):
            if not self._fit_flesh(observation):
                break
            solved = self._minimise(energy, solved.x, s.iterations)
            self._keep(solved, log_weights, still, observation)
        if not known:
            self._follow_both_ways(solved, log_weights, observation, stamp)

    def _recover(
        self, observation: Observation, prediction: PosePrediction | None, stamp: int
    ) -> bool:
        """Starts anew from what an image alone shows; False where that is not enough.

        The body keeps its lengths and widths. From keypoints come all poses that explain them, from
        a silhouette mean poses of several headings at its place; what is predicted and the present
        modes stay in the race.
        """
        s, poses = self.settings, None
        if observation.keypoints is not None:
            seen = np.isfinite(observation.keypoints.pixels).all(1)
            if seen.sum() >= FEWEST_KEYPOINTS:
                poses = poses_from_keypoints(self.body, self.camera, observation.keypoints)
        if poses is None and observation.outline is not None:
            poses = poses_from_outline(self.body, self.camera, observation.outline)
        if poses is None and prediction is None:
            return False
        found = [poses] if poses is not None else []
        if prediction is not None:
            found.append(prediction.both_ways(self.body).means)
        poses = np.concatenate([self._own.poses, *found])

        def energy(x: Array, _: Index) -> tuple[Array, Array, Array]:
            return self._energy(x, observation, None, None)

        solved = self._minimise(energy, poses, 3 * s.iterations)
        self._keep(solved, np.zeros(len(poses)), np.zeros_like(poses), observation)
        if observation.keypoints is None:
            self._follow_both_ways(solved, np.zeros(len(poses)), observation, stamp)
        return True

    # Which way the person faces.

    def _follow_both_ways(
        self, solved: Minimum, log_weights: Array, observation: Observation, stamp: int
    ) -> None:
        """Follows those that face like the best, and beside them those that face otherwise."""
        s = self.settings
        self._other_way, self._evidence = None, 0.0
        if s.facing_trial == 0:
            return
        usable = np.flatnonzero(np.isfinite(solved.value))
        best = usable[np.argmax(log_weights[usable] - s.temperature * solved.value[usable])]
        alike = faces_like(self.body, solved.x, solved.x[best])
        ways = usable[alike[usable]], usable[~alike[usable]]
        if len(ways[1]) == 0:
            return
        other = Tracker(self.model, self.camera, s, self.background, self._seed + 1)
        other._use_body(self.body)
        other._flesh = deepcopy(self._flesh)
        for tracker, rows in zip((self, other), ways, strict=True):
            tracker._keep(
                some_minima(solved, rows), log_weights[rows], np.zeros_like(solved.x[rows]),
                observation,
            )  # fmt: skip
            tracker._evidence = -s.temperature * tracker._least_energy
        self._other_way = other
        self._undecided_until = stamp + round(s.facing_trial * 1e9)

    def _decide_facing(self, observation: Observation, stamp: int) -> None:
        """Gives one way to face up where the images speak against it.

        When time is over and they do not, both become one mixture.
        """
        other = self._other_way
        assert other is not None
        ahead = self._evidence - other._evidence
        lost = self.status is Status.LOST, other.status is Status.LOST
        decided = abs(ahead) >= DECIDED or lost[0] != lost[1]
        if not decided and stamp < self._undecided_until:
            return
        shares = log_shares([self._evidence, other._evidence])
        modes = self._own.joined(other._own, shares, self.settings.max_hypotheses)
        if lost[0] > lost[1] or (lost[0] == lost[1] and ahead < 0):
            for name in (
                '_modes', '_flesh', '_usual_energy', '_least_energy', '_bad_images',
                '_outline_costs', '_limb_votes', '_rng', 'misfit', 'status',
            ):  # fmt: skip
                setattr(self, name, getattr(other, name))
            self._use_body(other.body)
        if not decided:
            frames = forward(self.body.skeleton, modes.poses)
            self._modes = replace(modes, textures=self._textures(frames, observation))
        self._other_way = None

    def _fit_flesh(self, observation: Observation) -> bool:
        """Moves the widths of the flesh by what an image says; False where it says nothing more."""
        if self._flesh.images >= self.settings.flesh_images or observation.outline is None:
            return False
        m = self._own
        poses, weights = m.poses[:4], np.exp(m.log_weights[:4])
        body = self._flesh.update(
            self._likelihood, replace(observation, keypoints=None), poses, weights / weights.sum()
        )
        self.evaluations += len(poses) * (2 * len(self._flesh.widths) + 1)
        self._use_body(body)
        return True

    def _use_body(self, body: Body) -> None:
        self.body = body
        for name in ('_likelihood', '_motion_likelihood', '_jumps'):
            self.__dict__.pop(name, None)

    # One image after another.

    def _follow(
        self, observation: Observation, stamp: int, prediction: PosePrediction | None
    ) -> None:
        """Takes the next image of a track."""
        assert self._last_stamp is not None
        dt = (stamp - self._last_stamp) * 1e-9
        if self.status is Status.LOST and self._recover(observation, prediction, stamp):
            self._bad_images = 0
            return
        other = self._other_way
        if other is None:
            expected = None if prediction is None else prediction.seen_as(self.body)
            self._propagate(observation, dt, expected)
            return
        other.evaluations = 0
        for tracker in (self, other):
            expected = None
            if prediction is not None:
                # Neither is offered the way that the other faces.
                both = prediction.both_ways(tracker.body)
                own = both[faces_like(tracker.body, both.means, tracker._own.poses[0])]
                expected = own.normalised() if len(own) else None
            tracker._propagate(observation, dt, expected)
            tracker._evidence -= self.settings.temperature * tracker._least_energy
        self.evaluations += other.evaluations

    def _propagate(
        self, observation: Observation, dt: float, expected: GaussianMixture | None
    ) -> None:
        s, m, body = self.settings, self._own, self.body
        predicted, covariances = predict(
            s.dynamics, self._rates, m.poses, m.filtered, m.velocities, dt
        )
        predicted = np.clip(predicted, body.lower, body.upper)
        precisions = _inverses(covariances)
        everyone = np.arange(len(m.poses))
        moved = self._follow_motion(predicted, precisions, observation)
        base = self._minimise(
            self._posterior_energy(observation, everyone, moved, precisions, m.textures, everyone),
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
        self._keep(solved, log_priors, velocities, observation, predicted_mixture)
        self._fit_flesh(observation)

    def _expected_elsewhere(self, prediction: GaussianMixture, moved: Array) -> Candidates:
        """Candidates that the image suggests, and not the images before."""
        s, m, body = self.settings, self._own, self.body
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
        energy = self._posterior_energy(
            observation, c.parents, c.centres, precisions, c.textures, c.texture_rows
        )
        solved = self._minimise(energy, c.poses, self.settings.iterations)
        # The Student prior is as sharp as its covariance on average, not at its centre.
        own = precisions[c.parents]
        shrink = self._student_shrinkage(solved.x - c.centres, own)
        return replace(solved, hessian=solved.hessian - (shrink - 1.0)[:, None, None] * own)

    def _student_shrinkage(self, offset: Array, precisions: Array) -> Array:
        """Curvature of the Student prior over that of the Gaussian with the same covariance."""
        nu, d = self.settings.tails, self.body.dimension
        distance = np.einsum('ni,nij,nj->n', offset, precisions, offset)
        return np.asarray((nu + d) / (nu + distance), dtype=np.float64)

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
        value = self._value(drawn, observation, c.textures, rows)
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

    def _follow_motion(
        self, predicted: Array, precisions: Array, observation: Observation
    ) -> Array:
        """Predictions corrected by the optical flow, before shapes are compared."""
        if observation.flow is None or self.settings.likelihood.motion.weight == 0:
            return predicted
        textures, everyone = self._own.textures, np.arange(len(predicted))

        def energy(x: Array, index: Index) -> tuple[Array, Array, Array]:
            image = self._motion_likelihood.image_energy(
                forward(self.body.skeleton, x), observation, textures, everyone[index]
            )
            assert image.gradient is not None
            assert image.hessian is not None
            offset = x - predicted[index]
            pulled = np.einsum('nij,nj->ni', precisions[index], offset)
            soft = self._likelihood.prior(x)
            return (
                image.value + soft[0] + 0.5 * (offset * pulled).sum(1),
                image.gradient + soft[1] + pulled,
                image.hessian + soft[2] + precisions[index],
            )

        return self._minimise(energy, predicted, 5).x

    def _samples(
        self, base: Minimum, sources: Candidates, covariances: Array, observation: Observation
    ) -> Candidates:
        """Candidates of covariance-scaled or spherical sampling."""
        s, m = self.settings, self._own
        draw = covariance_scaled_samples if s.proposals == 'css' else spherical_samples
        moved = sources.poses
        k = len(moved)
        each = max(s.samples // k, 1)
        drawn = draw(self.body, moved, covariances, each, s.sample_scale, self._rng)
        poses = np.concatenate([base.x, drawn.reshape(-1, self.body.dimension)])
        parents = np.concatenate([np.arange(k), np.repeat(np.arange(k), each)])
        energies = self._value(poses, observation, m.textures, parents)
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
    ) -> None:
        """Makes the modes of the next mixture from optimised candidates.

        A predicted mixture, where there is one, gives its weights to the modes nearest to it.
        """
        s = self.settings
        usable = np.flatnonzero(np.isfinite(solved.value))
        if len(usable) == 0:
            raise ValueError('no hypothesis has a finite energy')
        self._least_energy = float(solved.value[usable].min())
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
        image = self._likelihood.image_energy(frames, observation, derivatives=False)
        filtered = free_covariances(solved.hessian[rows], solved.free[rows])
        covariances = filtered
        if _shows_shape(observation):
            covariances = self._honest_covariances(poses, frames, solved.free[rows], observation)
        self._modes = Modes(
            poses, velocities[rows], covariances, filtered, weights[order], -image.value, textures
        )
        self._outline_costs = image.costs

    def _textures(self, frames: Frames, observation: Observation) -> Textures | None:
        """What an image shows on the surfaces of poses."""
        if observation.intensity is None:
            return None
        return capture_textures(self.body, self.camera, frames, observation.intensity)

    def _honest_covariances(
        self, poses: Array, frames: Frames, free: NDArray[np.bool_], observation: Observation
    ) -> Array:
        """Covariances that an image alone leaves, of which only a share is believed.

        Shapes, shadows and clothes differ from the model's in much the same way in image after
        image: such errors do not average out, over pixels or over time.
        """
        _, _, hessian = self._likelihood.energy(poses, observation)
        shape = self._likelihood.image_energy(frames, replace(observation, keypoints=None))
        assert shape.hessian is not None
        return free_covariances(hessian - (1.0 - self.settings.image_trust) * shape.hessian, free)

    def _judge(self, observation: Observation) -> None:
        """Whether the track is lost: how much of the image no mode explains."""
        s = self.settings
        self.misfit = unexplained_outline(self._outline_costs, s.likelihood.coverage)
        if observation.keypoints is not None:
            of_keypoints = unexplained_keypoints(
                self.body, self.camera, self._own.poses, observation.keypoints,
                s.likelihood.joints.sigma,
            )  # fmt: skip
            self.misfit = max(self.misfit, of_keypoints)
        self._bad_images = self._bad_images + 1 if self.misfit > s.lost_misfit else 0
        self.status = Status.LOST if self._bad_images >= s.lost_images else Status.TRACKING

    # Energies.

    @cached_property
    def _likelihood(self) -> ImageLikelihood:
        return ImageLikelihood(self.body, self.camera, self.settings.likelihood)

    @cached_property
    def _motion_likelihood(self) -> ImageLikelihood:
        off = TermSettings(0.0, 1.0, 1.0)
        only_motion = replace(
            self.settings.likelihood,
            joints=off, containment=off, coverage=off, edges=off, intensity=off,
        )  # fmt: skip
        return ImageLikelihood(self.body, self.camera, only_motion)

    @cached_property
    def _jumps(self) -> KinematicJumps:
        return KinematicJumps(
            self.body, self.camera, self.settings, self._value, self._count, self._limb_votes
        )

    def _count(self, evaluations: int) -> None:
        self.evaluations += evaluations

    @cached_property
    def _rates(self) -> Array:
        return self.settings.dynamics.rates(self.body.skeleton)

    @cached_property
    def _step_scale(self) -> Array:
        return np.where(self.body.skeleton.dof_is_rotation, 0.3, 0.2)

    def _observe(self, image: Image, keypoints: Keypoints | None) -> Observation:
        t = self.settings.likelihood
        shape = t.containment.weight > 0 or t.coverage.weight > 0
        textured = t.intensity.weight > 0 or t.motion.weight > 0
        wanted = [
            name
            for name, needed in (
                ('edges', t.edges.weight > 0),
                ('intensity', textured),
                ('flow', t.motion.weight > 0),
            )
            if needed
        ]
        silhouette = None
        if shape and self.background.frames:
            silhouette = self.background.silhouette(image, self._region())
        return observe(
            image, silhouette, keypoints, self.settings.observation,
            last_image=self._last_image, wanted=wanted,
        )  # fmt: skip

    def _region(self) -> tuple[int, int, int, int] | None:
        """Where the person can be in the next image; None: anywhere."""
        if self._modes is None or self.status is Status.LOST:
            return None
        pixels = self.camera.project(self.body.joint_positions(self.modes.poses)).reshape(-1, 2)
        pixels = pixels[np.isfinite(pixels).all(1)]
        if len(pixels) == 0:
            return None
        low, high = pixels.min(0), pixels.max(0)
        margin = REGION_MARGIN * max(float((high - low).max()), 1.0)
        size = (self.camera.width, self.camera.height)
        left, top = (int(x) for x in np.clip(np.floor(low - margin), 0, size))
        right, bottom = (int(x) for x in np.clip(np.ceil(high + margin), 0, size))
        if right - left < 2 or bottom - top < 2:
            return None
        return left, top, right, bottom

    def _energy(
        self, poses: Array, observation: Observation, textures: Textures | None, which: Index | None
    ) -> tuple[Array, Array, Array]:
        self.evaluations += len(poses)
        return self._likelihood.energy(poses, observation, textures, which)

    def _value(
        self, poses: Array, observation: Observation, textures: Textures | None, which: Index
    ) -> Array:
        self.evaluations += len(poses)
        frames = forward(self.body.skeleton, poses)
        image = self._likelihood.image_energy(
            frames, observation, textures, which, derivatives=False
        )
        soft, overlap = self._likelihood.prior(poses)[0], self._likelihood.intersection(frames)[0]
        return image.value + soft + overlap

    def _posterior_energy(
        self,
        observation: Observation,
        parents: Index,
        centres: Array,
        precisions: Array,
        textures: Textures | None,
        texture_rows: Index,
    ) -> Callable[[Array, Index], tuple[Array, Array, Array]]:
        """Energy of candidates: image, body, and a Student prior around where each is expected."""
        nu, d = self.settings.tails, self.body.dimension

        def energy(x: Array, index: Index) -> tuple[Array, Array, Array]:
            own = parents[index]
            value, gradient, hessian = self._energy(x, observation, textures, texture_rows[index])
            offset = x - centres[index]
            pulled = np.einsum('nij,nj->ni', precisions[own], offset)
            distance = (offset * pulled).sum(1)
            shrink = (nu + d) / (nu + distance)
            value = value + 0.5 * (nu + d) * np.log1p(distance / nu)
            gradient += shrink[:, None] * pulled
            hessian += shrink[:, None, None] * precisions[own]
            return value, gradient, hessian

        return energy

    def _minimise(
        self,
        energy: Callable[[Array, Index], tuple[Array, Array, Array]],
        poses: Array,
        iterations: int,
    ) -> Minimum:
        return minimise(
            energy, poses, self.body.lower, self.body.upper, step_scale=self._step_scale,
            damping=1.0, max_iterations=iterations, tolerance=0.02,
        )  # fmt: skip


def _shows_shape(observation: Observation) -> bool:
    maps = (observation.distance, observation.edges, observation.flow, observation.intensity)
    return any(m is not None for m in maps)


def _inverses(matrices: Array) -> Array:
    return np.asarray(np.linalg.inv(matrices), dtype=np.float64)
