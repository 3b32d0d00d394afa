"""Mixture density propagation: the five steps from image to image (KJS figure 4).

predict     x_k | ancestor       motion prior, optical flow                       prediction
propose     x_k^0                jumps, samples, predictions of others            proposals
optimise    x_k = argmin E(x)    bounded Newton from x_k^0                        posterior
weigh       log w_k = log p(ancestor) + log p(jumps) - beta E(x_k)                weighting, trust
select      K of N hypotheses    the least expected distance to one that is kept  selection
"""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass, replace

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.pose_terms import FrameTerm
from hmt_ros.image.observation import Observation
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.bounded_newton import Minimum, resting
from hmt_ros.inference.linear_gaussian_dynamics import LinearGaussianDynamics
from hmt_ros.inference.mixture import GaussianMixture
from hmt_ros.tracking.ambiguities import ambiguity_classes
from hmt_ros.tracking.camera_motion import CameraMotion
from hmt_ros.tracking.contact import FootContacts
from hmt_ros.tracking.facing_odds import FacingOdds
from hmt_ros.tracking.ground import GroundEstimator
from hmt_ros.tracking.hypotheses import Hypotheses, Modes, new_hypotheses, relative_joints
from hmt_ros.tracking.loss import unexplained_share
from hmt_ros.tracking.motion_states import PredictedStates, fused
from hmt_ros.tracking.posterior import Posterior, free_covariances
from hmt_ros.tracking.prediction import dynamics_of, follow_flow, predict
from hmt_ros.tracking.proposals import PROPOSALS, PredictedPoses, Proposal
from hmt_ros.tracking.proposals.headings import Headings
from hmt_ros.tracking.proposals.reversals import Reversals
from hmt_ros.tracking.proposals.sampling import covariance_scaled_samples
from hmt_ros.tracking.reliability import SilhouetteRecall
from hmt_ros.tracking.selection import choose_hypotheses, heads_of_classes
from hmt_ros.tracking.settings import TrackerSettings
from hmt_ros.tracking.shape_estimation import ShapeEstimate
from hmt_ros.tracking.weighting import (
    at_least,
    cost_of_room,
    inherited_log_weights,
    normalised,
    weigh,
)

# How far the usual energy follows that of the last image.
USUAL_GAIN = 0.1
# Number of images from one reversal that is proposed to the next.
REVERSED_EVERY = 3
# How often the shape is fitted to the first image.
FIRST_FITS = 3
# Number of the heaviest modes that the shape is estimated from.
SHAPED = 4


@dataclass(frozen=True, eq=False)
class Optimised:
    """Hypotheses at their optima.

    Attributes:
        hypotheses: N of them; their poses are where they started from.
        minima: N rows; Hessians are those of the Gaussian posterior.
    """

    hypotheses: Hypotheses
    minima: Minimum

    def __getitem__(self, rows: Index) -> Optimised:
        return Optimised(self.hypotheses[rows], self.minima[rows])

    def joined(self, other: Optimised) -> Optimised:
        """These and others."""
        return Optimised(self.hypotheses.joined(other.hypotheses), self.minima.joined(other.minima))


class MixtureFilter:
    """The posterior over the poses of one person, as a mixture that images move on.

    Args:
        body: of the person.
        camera: that sees the person.
        settings: how.
        seed: of all randomness.
        extra: further energy terms.
        ground: gravity and floor; None: nothing is made of them.

    Attributes:
        contacts: of the feet of the modes.
        body: with the lengths and the flesh that have been estimated.
        shape: the estimate of them.
        misfit: share of the last image that no mode explains.
        recall: how far silhouettes are believed.
        log_evidence: sum over images of -beta times the least energy, for comparison with another
            filter of the same images.
    """

    def __init__(
        self,
        body: Body,
        camera: Camera,
        settings: TrackerSettings,
        seed: int,
        extra: tuple[FrameTerm, ...] = (),
        ground: GroundEstimator | None = None,
    ) -> None:
        self.body = body
        self.camera = camera
        self.settings = settings
        self.misfit = 0.0
        self.log_evidence = 0.0
        self._seed = seed
        self._rng = np.random.default_rng(seed)
        self._modes: Modes | None = None
        self.shape = ShapeEstimate(body)
        self.recall = SilhouetteRecall(len(body.skeleton.parents))
        self._observed: tuple[Observation, Observation] | None = None
        self._usual_energy = np.inf
        self._outline_costs = np.empty((0, 0))
        self._bad_images = 0
        self._images = 0
        self._shape_age = 0.0
        self._facing = FacingOdds()
        self._posterior = Posterior(body, camera, settings, extra, ground)
        self.contacts = FootContacts()
        self._proposal = PROPOSALS[settings.proposals](self._posterior)

    @property
    def evaluations(self) -> int:
        """Number of evaluations of the likelihood since it was last set."""
        return self._posterior.evaluations

    @evaluations.setter
    def evaluations(self, count: int) -> None:
        self._posterior.evaluations = count

    @property
    def modes(self) -> Modes:
        """The present modes, heaviest first.

        Raises:
            ValueError: there is no track.
        """
        if self._modes is None:
            raise ValueError('there is no track yet')
        return self._modes

    @property
    def beta(self) -> float:
        """Factor on the energies in the weights; see `trust`."""
        return self._posterior.trust.inverse_temperature

    @property
    def dynamics(self) -> LinearGaussianDynamics:
        """How modes move by themselves."""
        return dynamics_of(self.body, self.settings.motion)

    @property
    def begun(self) -> bool:
        """Whether there are modes."""
        return self._modes is not None

    @property
    def lost(self) -> bool:
        """Whether the last images were explained too badly."""
        return self._bad_images >= self.settings.lost_images

    # The start.

    def begin(
        self,
        body: Body,
        poses: Array,
        log_weights: Array,
        precisions: Array,
        observation: Observation,
    ) -> Minimum:
        """Starts from expected poses (N, d); returns the minimum that each of them led to.

        Args:
            body: of the person; its shape is estimated.
            poses: (N, d).
            log_weights: (N,).
            precisions: (N, d, d) of the poses.
            observation: of the first image.
        """
        self._use_body(body)
        self.shape = ShapeEstimate(body)

        def settle(starts: Array, iterations: int) -> Minimum:
            term = self._posterior.around(observation, poses, precisions)
            solved = self._posterior.minimise(term, starts, iterations)
            self.hold(solved, log_weights, observation)
            return solved

        solved = settle(poses, 3 * self.settings.iterations)
        for _ in range(FIRST_FITS):
            if not self._fit_shape(observation, self.settings.trust / FIRST_FITS):
                break
            solved = settle(solved.x, self.settings.iterations)
        self._learn_recall(observation)
        return solved

    def begin_anew(self, poses: Array, observation: Observation) -> Minimum:
        """Starts from an image and poses (N, d) to search from; returns the minima."""
        term = self._posterior.of_image(observation)
        solved = self._posterior.minimise(term, poses, 3 * self.settings.iterations)
        self.hold(solved, np.zeros(len(poses)), observation)
        self._bad_images = 0
        return solved

    def hold(self, solved: Minimum, log_weights: Array, observation: Observation) -> None:
        """Makes modes at rest from minima and their log prior weights (N,)."""
        optimised = Optimised(new_hypotheses(solved.x, log_weights), solved)
        self._posterior.stance = None
        self._posterior.exchanges.forget()
        least = self._weigh_and_select(optimised, None, observation)
        self._stand(None)
        self.log_evidence = -self.beta * least

    def twin(self) -> MixtureFilter:
        """Another filter of the same person, without modes, with random numbers of its own."""
        extra, ground = self._posterior.extra, self._posterior.ground
        other = MixtureFilter(self.body, self.camera, self.settings, self._seed + 1, extra, ground)
        other.shape = deepcopy(self.shape)
        return other

    def absorb(self, modes: Modes, observation: Observation) -> None:
        """Takes over modes; their textures are taken from the image anew."""
        textures = self._posterior.textures(modes.poses, observation)
        self._modes = replace(modes, textures=textures, texture_rows=np.arange(len(modes)))
        self._posterior.exchanges.forget()
        self._stand(None)

    # One image after another.

    def carry(self, motion: CameraMotion) -> None:
        """Takes everything that has a place into the camera frame of the next image."""
        self._modes = motion.modes(self.body, self.modes)
        self._facing.carry(self.body, motion)
        self.contacts.carry(motion)
        self._posterior.stance = self.contacts.stance

    def propagate(
        self, observation: Observation, dt: float, expected: GaussianMixture | None
    ) -> None:
        """Moves the mixture on to the next image.

        Args:
            observation: of the image.
            dt: since the last image, s.
            expected: pose hypotheses from an external predictor, if any.
        """
        s, modes, posterior = self.settings, self.modes, self._posterior
        observation = self._believed(observation)
        posterior.exchanges.predict(dt)
        predicted, states = predict(modes, self.body, self.dynamics, dt)
        covariances, searched = states.pose_covariances, states.searched
        precisions = np.asarray(np.linalg.inv(covariances), dtype=np.float64)
        beta = self.beta
        predicted = follow_flow(predicted, precisions, observation, posterior)
        base = posterior.minimise(
            posterior.given(observation, predicted, precisions), predicted.poses, s.base_iterations
        )
        proposals: list[Proposal] = [self._proposal]
        self._images += 1
        if s.reversal_probability > 0:
            if self._images % REVERSED_EVERY == 0:
                proposals.insert(0, Reversals(posterior, s.reversal_probability))
            if base.value.min() > self._usual_energy + 2.0 * s.energy_rise:
                proposals.insert(0, Headings(posterior, 1e-3))
        if expected is not None:
            elsewhere = PredictedPoses(self.body, expected, s.prediction_probability)
            proposals.insert(0, elsewhere)
        candidates, *others = (
            x.propose(base, predicted, searched, observation, self._rng) for x in proposals
        )
        for more in others:
            candidates = candidates.joined(more)
        optimised = self._optimise(candidates, states, precisions, observation)
        if self._proposal.iterated:
            optimised = self._search_again(optimised, states, precisions, observation)
        self._learn_usual_energy(float(optimised.minima.value.min()))
        hypotheses, solved = optimised.hypotheses, optimised.minima
        before = None
        if s.reweighting == 'bhattacharyya':
            hypotheses = replace(hypotheses, log_weights=np.zeros(len(hypotheses)))
            before = GaussianMixture(np.exp(modes.log_weights), predicted.poses, covariances)
        least = self._weigh_and_select(
            Optimised(hypotheses, solved), states, observation, before,
            modes.energies - modes.energies.min(),
        )  # fmt: skip
        # Of the error of an energy only what is new counts.
        self.log_evidence -= beta * (least - s.error_correlation * float(modes.energies.min()))
        posterior.trust.update(least)
        self._stand(dt)
        self._shape_age += dt
        if self._images < s.shape_images or (
            s.shape_interval > 0 and self._images % s.shape_interval == 0
        ):
            self._fit_shape(observation, s.trust)
        self._learn_recall(observation)

    def assess(self, observation: Observation) -> None:
        """Takes in how much of an image no mode explains, and whether the track is lost."""
        self.misfit = unexplained_share(
            self.body, self.camera, self.modes.poses, observation, self._outline_costs,
            self.settings.likelihood,
        )  # fmt: skip
        self._bad_images = self._bad_images + 1 if self.misfit > self.settings.lost_misfit else 0

    def likelihood_mixture(self, modes: Modes, observation: Observation) -> GaussianMixture:
        """The modes of the likelihood alone, without what was known from the images before.

        Around each mode of the posterior the energy of the image and of the body's prior is a
        parabola; its minimum and curvature make a component, its depth the weight.
        """
        body, poses = self.body, modes.poses
        observation = self._believed(observation)
        fit = self._posterior.fit(poses, observation)
        gradient, hessian = fit.energy.derivatives()
        free = ~resting(poses, gradient, body.lower, body.upper)
        covariances = free_covariances(hessian, free)
        step = -np.einsum('kij,kj->ki', covariances, np.where(free, gradient, 0.0))
        limit = 3.0 * np.sqrt(np.einsum('kii->ki', modes.covariances))
        step = np.clip(step, -limit, limit)
        means = np.clip(poses + step, body.lower, body.upper)
        if observation.evidence:
            covariances = self._posterior.covariances(fit, free)
        nothing = np.zeros(len(poses))
        weights = np.exp(normalised(weigh(nothing, fit.energy.value, self.beta)))
        return GaussianMixture(weights, means, covariances).sorted()

    # The steps.

    def _optimise(
        self,
        hypotheses: Hypotheses,
        states: PredictedStates,
        precisions: Array,
        observation: Observation,
    ) -> Optimised:
        # Each has a precision of its own, where it jumped a lower one.
        own = states.precisions_of(hypotheses.ancestors, hypotheses.jumped, precisions)
        term = self._posterior.given(observation, hypotheses, own)
        solved = self._posterior.minimise(term, hypotheses.poses, self.settings.iterations)
        hessian = self._posterior.gaussian_hessians(solved, hypotheses, own)
        room = cost_of_room(hessian, own, precisions[hypotheses.ancestors], hypotheses.jumped)
        return Optimised(hypotheses, replace(solved, value=solved.value + room, hessian=hessian))

    def _search_again(
        self,
        optimised: Optimised,
        states: PredictedStates,
        precisions: Array,
        observation: Observation,
    ) -> Optimised:
        """Further rounds of jumps, while the least energy is unusually high."""
        for _ in range(self.settings.rounds - 1):
            if optimised.minima.value.min() < self._usual_energy + self.settings.energy_rise:
                break
            around = self._sources_around(optimised, states, precisions, observation)
            more = self._proposal.propose(
                around.minima, around.hypotheses, states.searched, observation, self._rng
            )
            optimised = optimised.joined(self._optimise(more, states, precisions, observation))
        return optimised

    def _sources_around(
        self,
        optimised: Optimised,
        states: PredictedStates,
        precisions: Array,
        observation: Observation,
    ) -> Optimised:
        """What a further round of jumps starts from: the best optima, and samples near the best.

        Jumps change limbs; a trunk that was predicted badly needs covariance-scaled samples.
        """
        s, h = self.settings, optimised.hypotheses
        order = np.argsort(optimised.minima.value, kind='stable')
        best = order[: max(s.max_hypotheses // 2, 1)]
        lead = best[:1]
        drawn = covariance_scaled_samples(
            self.body, optimised.minima.x[lead], states.searched[h.ancestors[lead]], s.samples,
            s.sample_scale, self._rng,
        )[0]  # fmt: skip
        rows = np.full(len(drawn), h.texture_rows[lead[0]])
        value = self._posterior.values(drawn, observation, h.textures, rows)
        drawn = drawn[np.argsort(value, kind='stable')[: s.max_hypotheses]]
        n = len(drawn)
        sampled = Hypotheses(
            drawn,
            np.full(n, h.log_weights[lead[0]] + np.log(s.jump_probability)),
            np.full(n, h.ancestors[lead[0]]),
            drawn,
            np.ones(drawn.shape, dtype=np.bool_),
            h.textures,
            rows[:n],
        )
        return optimised[best].joined(self._optimise(sampled, states, precisions, observation))

    def _weigh_and_select(
        self,
        optimised: Optimised,
        states: PredictedStates | None,
        observation: Observation,
        before: GaussianMixture | None = None,
        excess: Array | None = None,
    ) -> float:
        """Makes the modes of this image; returns the least energy.

        Args:
            optimised: hypotheses at their optima.
            states: of the ancestors, predicted; None: the modes begin.
            observation: of the image.
            before: the prediction that modes inherit their weights from; None: from ancestors.
            excess: (K,) of the ancestors' energies over the least in the image before.
        """
        s, solved = self.settings, optimised.minima
        usable = np.flatnonzero(np.isfinite(solved.value))
        if len(usable) == 0:
            raise ValueError('no hypothesis has a finite energy')
        log_weights = weigh(
            optimised.hypotheses.log_weights[usable], solved.value[usable], self.beta
        )
        if excess is not None:
            # What a pose cost more than the best before, it costs for the same reason again.
            lasting = excess[optimised.hypotheses.ancestors[usable]]
            over = solved.value[usable] - solved.value[usable].min()
            log_weights += self.beta * s.error_correlation * np.minimum(over, lasting)
        if before is None and self.body.trunk_pairs:
            log_weights = self._with_facing(optimised, usable, log_weights)
        reference = solved.x[usable[np.argmax(log_weights)]]
        classes = ambiguity_classes(self.body, solved.x[usable], reference)
        kept = choose_hypotheses(
            relative_joints(self.body, solved.x[usable]),
            log_weights,
            s.max_hypotheses,
            same=s.hypothesis_merge_distance,
            first=heads_of_classes(classes, log_weights, s.reach, s.max_hypotheses // 2),
        )
        rows = usable[kept.chosen]
        weights = normalised(kept.log_weights)
        filtered = free_covariances(solved.hessian[rows], solved.free[rows])
        if before is not None:
            order = np.argsort(-weights, kind='stable')
            weights = normalised(
                weights + inherited_log_weights(solved.x[rows], filtered, order, before)
            )
        weights = at_least(weights, s.least_log_weight)
        order = np.argsort(-weights, kind='stable')
        rows, filtered = rows[order], filtered[order]
        poses = solved.x[rows]
        fit = self._posterior.fit(poses, observation)
        covariances = alone = filtered
        if observation.evidence:
            alone = covariances = self._posterior.covariances(fit, solved.free[rows])
        if observation.evidence or observation.keypoints is not None:
            covariances = covariances + self.shape.considered(
                self._posterior.likelihood, observation, poses,
                self._posterior.given_way(poses, observation)[1],
            )  # fmt: skip
        h = optimised.hypotheses[rows]
        exchanges = self._posterior.exchanges
        exchanges.update(
            self._posterior.likelihood, observation, poses, self._posterior.exchanges_of(h)
        )
        if states is None:
            velocities = np.zeros_like(poses)
            state_covariances = self.dynamics.states(filtered)
        else:
            found = filtered
            if states.wandered.any() and observation.evidence:
                # Errors of images last: what is propagated believes a share of them, too.
                found = fused(states.covariances_of(h.ancestors, h.jumped), alone)
            velocities, state_covariances = states.given(h.ancestors, h.jumped, poses, found)
        self._modes = Modes(
            poses=poses,
            log_weights=weights[order],
            ancestors=h.ancestors,
            expected=h.expected,
            jumped=h.jumped,
            textures=self._posterior.textures(poses, observation),
            texture_rows=np.arange(len(rows)),
            velocities=velocities,
            covariances=covariances,
            filtered=filtered,
            log_likelihoods=-fit.image_energy,
            energies=solved.value[rows],
            state_covariances=state_covariances,
        )
        self._outline_costs = fit.outline_costs
        return float(solved.value[usable].min())

    def _with_facing(self, optimised: Optimised, usable: Index, log_weights: Array) -> Array:
        """Log weights (N,) of usable hypotheses with the odds of the two ways to face."""
        odds, solved = self._facing, optimised.minima
        poses = solved.x[usable]
        back = odds.back(self.body, poses)
        known = np.asarray(~optimised.hypotheses.jumped[usable].all(1), dtype=np.bool_)
        gamma = self.settings.facing_gain * self._posterior.trust.inverse_temperature
        odds.update(back, solved.value[usable], known, poses[0, :3], gamma)
        log_weights = odds.shared(back, log_weights)
        odds.follow(self.body, poses, log_weights, back)
        return log_weights

    def _stand(self, dt: float | None) -> None:
        """Takes in how the modes stand, dt after their ancestors, s; None: they have none."""
        ground = self._posterior.ground
        if ground is None:
            return
        body, modes, plane = self._posterior.body, self.modes, ground.plane
        if dt is None:
            self.contacts.begin(body, plane, modes)
        else:
            self.contacts.update(body, plane, modes, dt, still=ground.still)
        self._posterior.stance = self.contacts.stance

    # What is learned.

    def _learn_usual_energy(self, energy: float) -> None:
        usual = self._usual_energy
        if not np.isfinite(usual):
            self._usual_energy = energy
        else:
            # What is unusual is not learned at once.
            change = min(energy - usual, self.settings.energy_rise)
            self._usual_energy = usual + USUAL_GAIN * change

    def _believed(self, observation: Observation) -> Observation:
        """An observation with what this track has learned of its cues."""
        if self._observed is None or self._observed[0] is not observation:
            believed = replace(observation, beliefs=self.recall.beliefs)
            self._observed = observation, believed
        return self._observed[1]

    def _learn_recall(self, observation: Observation) -> None:
        textures = self.modes.textures
        # An empty silhouette says that nobody is there, and nothing of the clothes.
        foreground = observation.foreground
        if textures is not None and foreground is not None and foreground.any():
            row = int(self.modes.texture_rows[0])
            self.recall.update(textures, row, foreground)

    def _fit_shape(self, observation: Observation, trust: float) -> bool:
        """Moves the shape by what an image says of it; False where that is nothing."""
        if self.settings.shape_images == 0:
            return False
        if observation.outline is None and observation.keypoints is None:
            return False
        best = slice(SHAPED)
        poses, weights = self.modes.poses, np.exp(self.modes.log_weights[best])
        gradients, covariances = self._posterior.given_way(poses, observation)
        body = self.shape.update(
            self._posterior.likelihood, observation, poses[best], weights / weights.sum(),
            gradients[best], covariances[best], trust=trust, dt=self._shape_age,
        )  # fmt: skip
        self._shape_age = 0.0
        self._posterior.evaluations += len(weights)
        self._use_body(body)
        return True

    def _use_body(self, body: Body) -> None:
        """Goes on with a body of the same degrees of freedom."""
        self.body = body
        before = self._posterior
        self._posterior = Posterior(body, self.camera, self.settings, before.extra, before.ground)
        self._posterior.evaluations = before.evaluations
        self._posterior.trust = before.trust
        self._posterior.stance = before.stance
        self._posterior.exchanges = before.exchanges
        self._proposal = PROPOSALS[self.settings.proposals](self._posterior)
