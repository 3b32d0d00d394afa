"""Mixture density propagation: the five steps from image to image (KJS figure 4).

predict     x_k | ancestor       motion prior, optical flow                       prediction
propose     x_k^0                jumps, samples, predictions of others            proposals
optimise    x_k = argmin E(x)    bounded Newton from x_k^0                        optimisation
weigh       log w_k = log p(ancestor) + log p(jumps) - beta E(x_k)                weighting
select      K of N hypotheses    the least expected distance to one that is kept  selection
"""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.pose_terms import FrameTerm
from hmt_ros.image.observation import Observation
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.bounded_newton import Minimum
from hmt_ros.inference.linear_gaussian_dynamics import LinearGaussianDynamics
from hmt_ros.inference.mixture import GaussianMixture
from hmt_ros.tracking.ambiguities import ambiguity_classes
from hmt_ros.tracking.camera_motion import CameraMotion
from hmt_ros.tracking.contact import FootContacts
from hmt_ros.tracking.facing_odds import FacingOdds
from hmt_ros.tracking.ground import GroundEstimator
from hmt_ros.tracking.hypotheses import (
    Hypotheses,
    Identities,
    Modes,
    Optimised,
    new_hypotheses,
    relative_joints,
)
from hmt_ros.tracking.laplace_approximation import likelihood_modes, posterior_modes
from hmt_ros.tracking.loss import unexplained_share
from hmt_ros.tracking.motion_states import PredictedStates
from hmt_ros.tracking.optimisation import Search, UsualEnergy
from hmt_ros.tracking.posterior import Posterior, free_covariances
from hmt_ros.tracking.prediction import dynamics_of, follow_flow, predict
from hmt_ros.tracking.proposals import PROPOSALS, PredictedPoses, Proposal
from hmt_ros.tracking.proposals.headings import Headings
from hmt_ros.tracking.proposals.reversals import Reversals
from hmt_ros.tracking.reliability import SilhouetteRecall
from hmt_ros.tracking.selection import choose_hypotheses, heads_of_classes
from hmt_ros.tracking.settings import TrackerSettings
from hmt_ros.tracking.shape_estimation import ShapeEstimate
from hmt_ros.tracking.weighting import (
    at_least,
    inherited_log_weights,
    lasting_errors,
    normalised,
    weigh,
)

# Number of images from one reversal that is proposed to the next.
REVERSED_EVERY = 3
# How often the shape is fitted to the first image.
FIRST_FITS = 3
# Number of the heaviest modes that the shape is estimated from.
SHAPED = 4


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
        self._identities = Identities()
        self.shape = ShapeEstimate(body)
        self.recall = SilhouetteRecall(len(body.skeleton.parents))
        self._observed: tuple[Observation, Observation] | None = None
        self._usual = UsualEnergy(settings.energy_rise)
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
            self._identities.restart()
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
        other._identities = self._identities
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
            if base.value.min() > self._usual.value + 2.0 * s.energy_rise:
                proposals.insert(0, Headings(posterior, 1e-3))
        if expected is not None:
            elsewhere = PredictedPoses(self.body, expected, s.prediction_probability)
            proposals.insert(0, elsewhere)
        candidates, *others = (
            x.propose(base, predicted, searched, observation, self._rng) for x in proposals
        )
        for more in others:
            candidates = candidates.joined(more)
        search = Search(posterior, observation, states, precisions)
        optimised = search.optimise(candidates)
        if self._proposal.iterated:
            optimised = search.search_again(optimised, self._proposal, self._usual.value, self._rng)
        self._usual.update(float(optimised.minima.value.min()))
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

    def likelihood_mixture(
        self, modes: Modes, observation: Observation
    ) -> tuple[GaussianMixture, Array]:
        """See `likelihood_modes`."""
        return likelihood_modes(modes, self._posterior, self._believed(observation))

    # The steps.

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
        s = self.settings
        optimised = optimised[np.flatnonzero(np.isfinite(optimised.minima.value))]
        h, solved = optimised.hypotheses, optimised.minima
        if len(h) == 0:
            raise ValueError('no hypothesis has a finite energy')
        log_weights = weigh(h.log_weights, solved.value, self.beta)
        if excess is not None:
            log_weights += lasting_errors(
                solved.value, excess[h.ancestors], self.beta, s.error_correlation
            )
        if before is None and self.body.trunk_pairs:
            followed = np.asarray(~h.jumped.all(1), dtype=np.bool_)
            gamma = s.facing_gain * self.beta
            log_weights = self._facing.weigh(
                self.body, solved.x, solved.value, log_weights, followed, gamma
            )
        classes = ambiguity_classes(self.body, solved.x, solved.x[np.argmax(log_weights)])
        kept = choose_hypotheses(
            relative_joints(self.body, solved.x),
            log_weights,
            s.max_hypotheses,
            same=s.hypothesis_merge_distance,
            first=heads_of_classes(classes, log_weights, s.reach, s.max_hypotheses // 2),
        )
        rows, weights = kept.chosen, normalised(kept.log_weights)
        if before is not None:
            covariances = free_covariances(solved.hessian[rows], solved.free[rows])
            order = np.argsort(-weights, kind='stable')
            weights = normalised(
                weights + inherited_log_weights(solved.x[rows], covariances, order, before)
            )
        weights = at_least(weights, s.least_log_weight)
        order = np.argsort(-weights, kind='stable')
        selected, posterior = optimised[rows[order]], self._posterior
        self._modes = modes = posterior_modes(
            selected, weights[order], posterior, observation, self.shape, self.dynamics, states,
            self._identities_of(selected.hypotheses, anew=states is None),
        )  # fmt: skip
        posterior.exchanges.update(
            posterior.likelihood, observation, modes.poses,
            posterior.exchanges_of(selected.hypotheses),
        )  # fmt: skip
        self._outline_costs = posterior.fit(modes.poses, observation).outline_costs
        return float(solved.value.min())

    def _identities_of(self, selected: Hypotheses, *, anew: bool) -> Index:
        """Identities of hypotheses that become modes, heaviest first."""
        if anew:
            return self._identities.new(len(selected))
        before = self.modes.identities
        return self._identities.inherited(before, selected.ancestors, selected.jumped)

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
