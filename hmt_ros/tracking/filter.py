"""Mixture density propagation: the five steps from image to image (KJS figure 4).

predict     x_k | ancestor       motion prior, optical flow                       prediction
propose     x_k^0                jumps, samples, predictions of others            proposals
optimise    x_k = argmin E(x)    bounded Newton from x_k^0                        optimisation
weigh       log w_k = log sum_j w_j p(x_k | x_j) - sum_g a_g E_g(x_k)             weighting
select      K of N hypotheses    the least expected distance to one that is kept  selection
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.mirror import faces_back
from hmt_ros.body.pose_terms import FrameTerm
from hmt_ros.body.postures import postures_of
from hmt_ros.image.observation import Observation
from hmt_ros.image.sampling import ImageMap
from hmt_ros.image.surface_points import SurfacePoints
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.image.unseen_limbs import UnseenLimbs
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.error_model import ERRORS
from hmt_ros.inference.linear_gaussian_dynamics import LinearGaussianDynamics
from hmt_ros.inference.mixture import GaussianMixture
from hmt_ros.tracking.camera_motion import CameraMotion
from hmt_ros.tracking.classes import Facing
from hmt_ros.tracking.contact import FootContacts
from hmt_ros.tracking.evaluation_plan import is_surprising
from hmt_ros.tracking.ground import GroundEstimator
from hmt_ros.tracking.hypotheses import (
    Hypotheses,
    Identities,
    Modes,
    Optimised,
    new_hypotheses,
)
from hmt_ros.tracking.laplace_approximation import (
    Likelihood,
    likelihood_modes,
    posterior_modes,
)
from hmt_ros.tracking.misfit import (
    KEYPOINTS,
    OUTLINE,
    SILHOUETTE,
    Misfit,
    of_depth_at_best,
    of_keypoints,
    of_silhouette,
)
from hmt_ros.tracking.motion_states import PredictedStates
from hmt_ros.tracking.optimisation import Search
from hmt_ros.tracking.posterior import Posterior
from hmt_ros.tracking.prediction import dynamics_of, follow_flow, predict
from hmt_ros.tracking.proposals import PROPOSALS, PosePrediction, PredictedPoses, Proposal
from hmt_ros.tracking.proposals.keypoint_poses import KeypointHistory, KeypointPoses
from hmt_ros.tracking.proposals.reversals import Reversals
from hmt_ros.tracking.selection import choose_hypotheses, distinct_hypotheses
from hmt_ros.tracking.settings import TrackerSettings
from hmt_ros.tracking.shape_estimation import ShapeEstimate
from hmt_ros.tracking.validity import DEPTH, ENOUGH, Validity
from hmt_ros.tracking.weighting import Continuity, at_least, normalised, pooled_origins

# How often the shape is fitted to the first image.
FIRST_FITS = 3
# Number of the heaviest modes that the shape is estimated from.
SHAPED = 4
# Bits of an identity below the number of the posture of unseen limbs.
OF_POSTURE = 20


class MixtureFilter:
    """The posterior over the poses of one person, a mixture that is updated image by image.

    Args:
        body: of the person.
        camera: that sees the person.
        settings: how.
        seed: of all randomness.
        extra: further energy terms.
        ground: gravity and floor; None: not used.

    Attributes:
        contacts: of the feet of the modes.
        body: with the lengths and the flesh that have been estimated.
        shape: the estimate of them.
        misfit: share of the last image that no mode explains.
        validity: probabilities that its cues, and the track, are valid.
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
        self._rng = np.random.default_rng(seed)
        self._modes: Modes | None = None
        # The modes that are published, and the mode that each comes from.
        self._shown: Modes | None = None
        self._sources: Index = np.empty(0, dtype=np.intp)
        self.limbs = UnseenLimbs(body)
        self._identities = Identities()
        self.shape = ShapeEstimate(body)
        self.validity = Validity()
        self._observed: tuple[Observation, Observation] | None = None
        self._outline_costs = np.empty((0, 0))
        self._points: SurfacePoints | None = None
        self._by_keypoints = KeypointHistory()
        self._dt = np.inf
        self._posterior = Posterior(body, camera, settings, extra, ground)
        self.contacts = FootContacts()
        self._facing = Facing()
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
    def published(self) -> Modes:
        """The present modes, where limbs that no image shows are as people hold them.

        Raises:
            ValueError: there is no track.
        """
        return self._shown or self.modes

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
        """Whether the modes more likely are elsewhere than the person."""
        return self.validity.lost

    # The start.

    def begin(
        self,
        body: Body,
        start: GaussianMixture | Array,
        observation: Observation,
        clicked: Keypoints | None = None,
    ) -> None:
        """Starts a track.

        Args:
            body: of the person; its shape is estimated.
            start: expected poses, or poses (N, d) that all count the same.
            observation: of the first image.
            clicked: keypoints that the start is fitted to, in place of those of the image.
        """
        self.evaluations = 0
        if isinstance(start, GaussianMixture):
            poses = start.means
            with np.errstate(divide='ignore'):
                log_weights = np.log(start.normalised().weights)
            precisions = np.asarray(np.linalg.inv(start.covariances), dtype=np.float64)
        else:
            poses, log_weights = start, np.zeros(len(start))
            precisions = np.zeros((len(poses), body.dimension, body.dimension))
        seen = observation if clicked is None else replace(observation, keypoints=clicked)
        self._use_body(body)
        self.shape = ShapeEstimate(body)

        def settle(starts: Array, iterations: int) -> Array:
            self._identities.restart()
            term = self._posterior.around(seen, poses, precisions)
            solved = self._posterior.minimise(term, starts, iterations)
            self._hold(Optimised(new_hypotheses(solved.x, log_weights), solved), seen)
            return solved.x

        found = settle(poses, 3 * self.settings.iterations)
        for _ in range(FIRST_FITS):
            if not self._fit_shape(seen, ERRORS['shape'].independent / FIRST_FITS):
                break
            found = settle(found, self.settings.iterations)
        self.assess(observation)

    def begin_anew(self, poses: Array, observation: Observation, dt: float) -> None:
        """Starts from an image, the present modes and poses (N, d) to search from.

        Args:
            poses: to search from.
            observation: of the image.
            dt: since the last image, s.
        """
        self.evaluations = 0
        self.validity.predict(dt)
        self._believed(observation)  # as it was before
        self.validity.search()
        poses = np.concatenate([self.modes.poses, poses])
        term = self._posterior.of_image(observation)
        solved = self._posterior.minimise(term, poses, 3 * self.settings.iterations)
        self._hold(Optimised(new_hypotheses(solved.x, np.zeros(len(poses))), solved), observation)
        self.assess(observation)

    def _hold(self, optimised: Optimised, observation: Observation) -> None:
        """Makes modes at rest."""
        self._by_keypoints = KeypointHistory()
        self._posterior.exchanges.forget()
        self._dt = np.inf
        optimised = _finite(optimised)
        log_weights = optimised.hypotheses.log_weights
        log_weights = log_weights - ERRORS['image'].independent * optimised.minima.value
        rows = self._distinct(optimised, log_weights)
        optimised, log_weights = optimised[rows], log_weights[rows]
        self._facing.start(self.body, optimised.minima.x, log_weights)
        self._select(optimised, log_weights, np.empty((0, len(rows))), None, observation)
        self._stand(None)

    # One image after another.

    def carry(self, motion: CameraMotion) -> None:
        """Takes everything that has a place into the camera frame of the next image."""
        self._modes = motion.modes(self.body, self.modes)
        self._shown = motion.modes(self.body, self.published)
        self._facing.carry(self.body, self._modes.poses)
        if self._by_keypoints.pose is not None:
            self._by_keypoints.pose = motion.poses(self.body, self._by_keypoints.pose)
        self.contacts.carry(motion)

    def propagate(
        self, observation: Observation, dt: float, expected: PosePrediction | None
    ) -> None:
        """Moves the mixture on to the next image.

        Args:
            observation: of the image.
            dt: since the last image, s.
            expected: pose hypotheses from an external predictor, if any.
        """
        s, modes, posterior = self.settings, self.modes, self._posterior
        self.evaluations = 0
        self._dt = dt
        self.validity.predict(dt)
        seen = self._believed(observation)
        posterior.exchanges.predict(dt)
        predicted, states = predict(modes, self.body, self.dynamics, dt)
        precisions = np.asarray(np.linalg.inv(states.pose_covariances), dtype=np.float64)
        continuity = Continuity(self.body, predicted.poses, modes.log_weights, dt)
        predicted = follow_flow(predicted, precisions, self._points, seen, posterior)
        base = posterior.minimise(
            posterior.given(seen, predicted, precisions), predicted.poses, s.plan.iterations
        )
        moved = base.x[0] - continuity.predicted[0]
        surprising = is_surprising(moved, precisions[0], base.hessian[0])
        plan = s.thorough_plan if surprising else s.plan
        search = Search(posterior, seen, states, precisions, continuity, plan)
        proposals: list[Proposal] = [self._proposal]
        if self._facing.lacks_a_way(search.rated(base.x, base.value)):
            proposals.insert(0, Reversals())
        if self._by_keypoints.contradicted and posterior.placing(seen) is not None:
            proposals.insert(0, KeypointPoses())
        if expected is not None:
            proposals.insert(0, PredictedPoses(self.body, expected.seen_as(self.body)))
        candidates, *others = (x.propose(search, base, predicted, self._rng) for x in proposals)
        for more in others:
            candidates = candidates.joined(more)
        self._select(*self._weigh(search, search.optimise(candidates)), states, seen)
        self._stand(dt)
        self._fit_shape(seen, ERRORS['shape'].share(dt))
        self.assess(seen, search)

    def assess(self, observation: Observation, search: Search | None = None) -> None:
        """Takes in the share of each cue of an image that no mode explains.

        Args:
            observation: of the image.
            search: that led to the modes; None: they begin.
        """
        body, modes, s = self.body, self.modes, self.settings.likelihood
        alone = None
        found = of_silhouette(
            body,
            self.camera,
            modes.poses,
            observation,
            s.coverage,
            self._outline_costs,
            self._points,
        )
        self.misfit = 0.0
        if OUTLINE in found and observation.outline is not None:
            self.misfit = found[OUTLINE].share
        if observation.keypoints is not None and s.keypoints.weight > 0:
            term = self._posterior.likelihood.keypoint_term(observation, None)
            found[KEYPOINTS] = missed = of_keypoints(term, modes.poses)
            self.misfit = max(self.misfit, missed.share)
            if search is not None and SILHOUETTE in found:
                alone = self._by_keypoints.follow(search, modes.poses[0], term, missed)
        self.validity.update(found, self._dt, alone)
        self.check_depths(body, modes.poses[0], observation.depths, self._dt)

    def check_depths(self, body: Body, pose: Array, depths: ImageMap | None, dt: float) -> None:
        """Takes in the misfit of depths, if there are some, to a body at a pose (d,).

        Args:
            body, pose: of the best mode.
            depths: of the image.
            dt: time since the image before, s; infinite: there is none.
        """
        if depths is not None:
            share = of_depth_at_best(body, self.camera, pose, depths)
            whole = Misfit(np.array([share]), np.array([ENOUGH]))
            self.validity.update({DEPTH: whole}, dt)

    def likelihood(self, observation: Observation) -> Likelihood:
        """See `likelihood_modes`."""
        return likelihood_modes(
            self.modes, self._posterior, self._believed(observation), self.shape
        )

    # The steps.

    def _distinct(self, optimised: Optimised, log_weights: Array) -> Index:
        """Hypotheses that have come to optima of their own; see `distinct_hypotheses`."""
        joints = self.body.relative_joints(optimised.minima.x)
        return distinct_hypotheses(joints, log_weights, self.settings.hypothesis_merge_distance)

    def _weigh(self, search: Search, optimised: Optimised) -> tuple[Optimised, Array, Array]:
        """N hypotheses that are distinct, their log weights, and log w_k p(x_n | x_k), (K, N)."""
        optimised = _finite(optimised)
        evidence = search.evidence(optimised)
        # Where hypotheses meet, one that has moved there is kept before one that has jumped.
        followed = np.asarray(~optimised.hypotheses.jumped.any(1))
        order = np.lexsort((evidence, ~followed))
        optimised, evidence = optimised[order], evidence[order]
        rows = self._distinct(optimised, -np.arange(len(order), dtype=np.float64))
        optimised, evidence = optimised[rows], evidence[rows]
        poses = optimised.minima.x
        transitions = search.continuity.log_transitions(poses)
        histories = search.continuity.log_histories(transitions)
        log_weights = self._facing.weigh(
            self.body,
            poses,
            transitions,
            np.logaddexp.reduce(histories, axis=0) - evidence,
            evidence,
            np.asarray(~optimised.hypotheses.jumped.all(1)),
            search.dt,
            search.continuity.predicted,
        )
        return optimised, log_weights, histories

    def _select(
        self,
        optimised: Optimised,
        log_weights: Array,
        histories: Array,
        states: PredictedStates | None,
        observation: Observation,
    ) -> None:
        """Makes the modes of this image.

        Args:
            optimised: hypotheses at their optima.
            log_weights: (N,) of the hypotheses.
            histories: (K, N) log w_k p(x_n | x_k), of K modes before; K is 0 where modes begin.
            states: of the ancestors, predicted; None: the modes begin.
            observation: of the image.
        """
        s = self.settings
        poses = optimised.minima.x
        best = poses[int(np.argmax(log_weights))]
        self.limbs.look(self.body, self.camera, observation, best, self._dt)
        joints = self.body.relative_joints(poses)[:, self.limbs.shown_joints(self.body)]
        kept = choose_hypotheses(
            joints,
            log_weights,
            s.plan.hypotheses,
            same=s.hypothesis_merge_distance,
            first=self._best_of_the_other_way(poses, log_weights),
        )
        weights = at_least(normalised(kept.log_weights), s.least_log_weight)
        order = np.argsort(-weights, kind='stable')
        selected, posterior = optimised[kept.chosen[order]], self._posterior
        origins = pooled_origins(histories, log_weights, kept.owner)[order]
        self._modes = modes = posterior_modes(
            selected,
            weights[order],
            origins,
            posterior,
            observation,
            self.shape,
            self.dynamics,
            states,
            self._identities_of(selected.hypotheses, anew=states is None),
            self._dt,
        )
        posterior.exchanges.update(
            posterior.likelihood,
            observation,
            modes.poses,
            posterior.exchanges_of(selected.hypotheses),
        )
        self._publish(modes)
        self._outline_costs = posterior.fit(modes.poses, observation).outline_costs
        self._points = None
        seen = observation.foreground is not None and s.likelihood.coverage.weight > 0
        if s.flow_weight > 0 or seen:
            self._points = posterior.seen_points(modes.poses, observation)
        self._facing.lead(self.body, modes.poses)

    def _publish(self, modes: Modes) -> None:
        """Makes the modes that are published, and what they come from in the image before."""
        before, self._sources = self._sources, np.arange(len(modes))
        weights = np.exp(self._shown.log_weights) if self._shown else np.ones(len(before))
        unseen = self.limbs.of_dofs(self.body)
        if unseen.any():
            spread, self._sources, postures = postures_of(self.body).spread(modes.mixture, unseen)
            modes = replace(
                modes[self._sources],
                poses=spread.means,
                covariances=spread.covariances,
                log_weights=np.log(spread.weights),
                identities=modes.identities[self._sources] + (postures << OF_POSTURE),
            )
        if modes.origins.shape[1]:
            share = weights / np.bincount(before, weights)[before]
            modes = replace(modes, origins=modes.origins[:, before] * share)
        self._shown = modes

    def _best_of_the_other_way(self, poses: Array, log_weights: Array) -> list[int]:
        """The heaviest of poses (N, d) that faces the other way than the heaviest of all, if any.

        It is kept as long as its way has any mass: small steps do not lead back to it.
        """
        if not self.body.trunk_pairs:
            return []
        best = int(np.argmax(log_weights))
        back = np.flatnonzero(faces_back(self.body, poses, poses[best]))
        least = log_weights[best] + self.settings.least_log_weight
        back = back[log_weights[back] >= least]
        return [int(back[np.argmax(log_weights[back])])] if len(back) else []

    def _identities_of(self, selected: Hypotheses, *, anew: bool) -> Index:
        """Identities of hypotheses that become modes, heaviest first."""
        if anew:
            return self._identities.new(len(selected))
        before = self.modes.identities
        return self._identities.inherited(before, selected.ancestors, selected.jumped)

    def _stand(self, dt: float | None) -> None:
        """Updates the contacts of the feet, dt s after the ancestors; None: there are none."""
        ground = self._posterior.ground
        if ground is None:
            return
        body, modes, plane = self._posterior.body, self.modes, ground.plane
        if dt is None:
            self.contacts.begin(body, plane, modes)
        else:
            self.contacts.update(body, plane, modes, dt, still=ground.still)

    # Learning.

    def _believed(self, observation: Observation) -> Observation:
        """An observation with the beliefs in its cues that this track has learned."""
        if self._observed is None or self._observed[0] is not observation:
            believed = replace(observation, beliefs=self.validity.beliefs)
            self._observed = observation, believed
        return self._observed[1]

    def _fit_shape(self, observation: Observation, trust: float) -> bool:
        """Moves the shape by the evidence of an image; False if there is none."""
        if not self.settings.estimate_shape:
            return False
        if observation.outline is None and observation.keypoints is None:
            return False
        best = slice(SHAPED)
        poses, weights = self.modes.poses, np.exp(self.modes.log_weights[best])
        gradients, covariances = self._posterior.given_way(poses, observation)
        body = self.shape.update(
            self._posterior.likelihood,
            observation,
            poses[best],
            weights / weights.sum(),
            gradients[best],
            covariances[best],
            trust=trust,
        )
        self._posterior.evaluations += len(weights)
        self._use_body(body)
        return True

    def _use_body(self, body: Body) -> None:
        """Goes on with a body of the same degrees of freedom."""
        if body is self.body:
            return
        self.body = body
        before = self._posterior
        self._posterior = Posterior(body, self.camera, self.settings, before.extra, before.ground)
        self._posterior.evaluations = before.evaluations
        self._posterior.exchanges = before.exchanges
        self._proposal = PROPOSALS[self.settings.proposals](self._posterior)


def _finite(optimised: Optimised) -> Optimised:
    """Hypotheses of finite energy.

    Raises:
        ValueError: there is none.
    """
    usable = np.flatnonzero(np.isfinite(optimised.minima.value))
    if len(usable) == 0:
        raise ValueError('no hypothesis has a finite energy')
    return optimised[usable]
