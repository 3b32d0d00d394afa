"""Mixture density propagation: the five steps from image to image (KJS figure 4).

predict     x_k | ancestor       motion prior, optical flow                       prediction
propose     x_k^0                jumps, samples, external predictions             proposals
optimise    x_k = argmin E(x)    bounded Newton from x_k^0                        optimisation
weigh       log w_k = log sum_j w_j p(x_k | x_j) - sum_g a_g E_g(x_k)             weighting
select      K of N hypotheses    least expected distance to the nearest kept one  selection
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.kinematics import forward
from hmt_ros.body.pose_terms import FrameTerm
from hmt_ros.body.postures import postures_of
from hmt_ros.core import elementary
from hmt_ros.image.observation import Observation
from hmt_ros.image.surface_points import SurfacePoints, seen_points
from hmt_ros.image.unseen_limbs import UnseenLimbs
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.error_model import ERRORS
from hmt_ros.inference.linear_algebra import inverse, log_sum_exp
from hmt_ros.tracking.camera_motion import CameraMotion
from hmt_ros.tracking.classes import (
    best_of_other_facing,
    first_facing,
    seen_exchanges,
    ways,
    weigh_ways,
)
from hmt_ros.tracking.ground import GroundEstimator
from hmt_ros.tracking.hypotheses import (
    Identities,
    Modes,
    Optimised,
    PosePrediction,
    joined,
    new_hypotheses,
)
from hmt_ros.tracking.initialisation import Start
from hmt_ros.tracking.laplace_approximation import posterior_modes
from hmt_ros.tracking.misfit import (
    KEYPOINTS,
    OUTLINE,
    SILHOUETTE,
    Misfit,
    of_keypoints,
    of_silhouette,
)
from hmt_ros.tracking.optimisation import Search, is_surprising
from hmt_ros.tracking.posterior import Posterior
from hmt_ros.tracking.prediction import dynamics_of, follow_flow, predict
from hmt_ros.tracking.proposals import proposals_of, propose
from hmt_ros.tracking.proposals.whole_poses import PoseByKeypoints, keypoint_poses
from hmt_ros.tracking.selection import choose_hypotheses, distinct_hypotheses
from hmt_ros.tracking.settings import (
    FIRST_SHAPE_FITS,
    MAX_SHAPE_MODES,
    POSTURE_BITS,
    TrackerSettings,
)
from hmt_ros.tracking.shape_estimation import ShapeEstimate
from hmt_ros.tracking.validity import ByKeypoints
from hmt_ros.tracking.weighting import TransitionPrior, at_least, normalised, pooled_origins


class CueMisfits(NamedTuple):
    """Misfits of the modes to the cues of an image.

    Attributes:
        by_cue: misfits by cue name, including the silhouette's outline.
        alone: pose fitted to keypoints alone; None: not needed.
    """

    by_cue: dict[str, Misfit]
    alone: ByKeypoints | None


class MixtureFilter:
    """Posterior over the poses of one person: a mixture, updated image by image.

    Args:
        body: body of the person.
        camera: camera that sees the person.
        settings: settings of the tracker.
        seed: random seed.
        extra: further energy terms.
        ground: gravity and floor; None: not used.

    Attributes:
        body: body with the estimated lengths and flesh.
        dynamics: motion prior of the modes.
        modes: present modes, heaviest first; empty before the start.
        published: the modes, with unseen limbs spread over usual postures.
        shape: estimate of lengths and flesh.
        limbs: visibility of the limbs in the images.
        misfit: share of the last image that no mode explains.
        spent: numbers of evaluations of the likelihood in the last image.
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
        self.camera = camera
        self.settings = settings
        self.modes = self.published = Modes.blank(0, body.dimension)
        # For each published mode, the row of its source in `modes`.
        self._sources = np.empty(0, dtype=np.intp)
        self.limbs = UnseenLimbs(body)
        self.shape = ShapeEstimate(body)
        self.misfit = 0.0
        self.spent: list[int] = []
        self._rng = np.random.default_rng(seed)
        self._extra = extra
        self._ground = ground
        self._identities = Identities()
        self._outline_costs = np.empty((0, 0))
        self._points: SurfacePoints | None = None
        self._by_keypoints = PoseByKeypoints()
        self._proposals = proposals_of(settings.proposals)
        self._replace_body(body)

    @property
    def person(self) -> Body:
        """Body in which the joints of unseen limbs have larger standard deviations."""
        return self.limbs.with_larger_errors(self.body)

    # The start.

    def begin(self, start: Start, observation: Observation) -> CueMisfits:
        """Starts a track from an observation of its first image."""
        self.spent.clear()
        poses = start.poses
        log_weights, precisions = np.zeros(len(poses)), np.zeros((*poses.shape, poses.shape[1]))
        if start.expected is not None:
            with np.errstate(divide='ignore'):
                log_weights = elementary.log(start.expected.normalised().weights)
            precisions = inverse(start.expected.covariances)
        seen = observation
        if start.clicked is not None:
            seen = replace(observation, keypoints=start.clicked)
        if start.body is not self.body:
            self._replace_body(start.body)
        self.shape = ShapeEstimate(start.body)

        def settle(starts: Array, iterations: int) -> Array:
            self._identities = Identities()
            term = self.posterior.given(seen, poses, precisions)
            solved = self.posterior.minimise(term, starts, iterations)
            self._initialise(Optimised(new_hypotheses(solved.x, log_weights), solved), seen)
            return solved.x

        found = settle(poses, 3 * self.settings.iterations)
        for _ in range(FIRST_SHAPE_FITS):
            if not self._fit_shape(seen, ERRORS['shape'].independent / FIRST_SHAPE_FITS):
                break
            found = settle(found, self.settings.iterations)
        return self._cue_misfits(observation)

    def restart(self, poses: Array, observation: Observation) -> CueMisfits:
        """Restarts the track in an image, from the present modes and from poses (N, d)."""
        self.spent.clear()
        poses = np.concatenate([self.modes.poses, poses])
        term = self.posterior.of_image(observation)
        solved = self.posterior.minimise(term, poses, 3 * self.settings.iterations)
        start = new_hypotheses(solved.x, np.zeros(len(poses)))
        self._initialise(Optimised(start, solved), observation)
        return self._cue_misfits(observation)

    def _initialise(self, optimised: Optimised, observation: Observation) -> None:
        """Sets the modes of a new track, at zero velocity."""
        self._by_keypoints = PoseByKeypoints()
        optimised = _finite(optimised)
        log_weights = optimised.hypotheses.log_weights
        log_weights = log_weights - ERRORS['image'].independent * optimised.minima.value
        joints = self.body.joint_positions(optimised.minima.x)
        same = self.settings.hypothesis_merge_distance
        rows = distinct_hypotheses(joints - joints[:, :1], log_weights, same)
        log_weights, joints = log_weights[rows], joints[rows]
        facing = first_facing(self.body, joints, log_weights)
        nothing = np.empty((0, len(rows)))
        self._select(optimised[rows], joints, log_weights, facing, nothing, observation, None)

    # One image after another.

    def carry(self, motion: CameraMotion) -> None:
        """Transforms modes and poses to the camera frame of the next image."""
        self.modes = motion.modes(self.body, self.modes)
        self.published = motion.modes(self.body, self.published)
        if self._by_keypoints.pose is not None:
            self._by_keypoints.pose = motion.poses(self.body, self._by_keypoints.pose)

    def propagate(
        self, observation: Observation, dt: float, prediction: PosePrediction | None
    ) -> CueMisfits:
        """Propagates the mixture to the next image.

        Args:
            observation: observation of the image.
            dt: time since the previous image, s.
            prediction: pose hypotheses from an external predictor, if any.
        """
        s, modes, posterior = self.settings, self.modes, self.posterior
        self.spent.clear()
        predicted, states = predict(modes, self.body, self.dynamics, dt)
        precisions = inverse(states.pose_covariances)
        transition_prior = TransitionPrior(self.body, predicted.poses, modes.log_weights, dt)
        predicted = follow_flow(predicted, precisions, self._points, observation, posterior)
        term = posterior.given(observation, predicted.expected, precisions, predicted.exchanges)
        base = posterior.minimise(term, predicted.poses, s.plan.iterations)
        moved = base.x[0] - transition_prior.predicted[0]
        surprising = is_surprising(moved, precisions[0], base.hessian[0])
        search = Search(
            posterior,
            observation,
            states,
            precisions,
            transition_prior,
            s.thorough_plan if surprising else s.plan,
            modes,
            prediction,
            base,
        )
        placed = keypoint_poses(search, predicted)
        if len(placed.poses):
            base = base.joined(search.optimise(placed).minima)
            search, predicted = replace(search, base=base), joined([predicted, placed])
        candidates = propose(self._proposals, search, predicted, self._rng)
        # Every mode also continues without a jump.
        found = search.optimise(candidates).joined(Optimised(predicted, base))
        self._select(*self._weigh(search, found), observation, search)
        self._fit_shape(observation, ERRORS['shape'].share(dt))
        return self._cue_misfits(observation, search)

    # The steps.

    def _weigh(
        self, search: Search, optimised: Optimised
    ) -> tuple[Optimised, Array, Array, Array, Array]:
        """Weighs distinct hypotheses; returns the first five arguments of `_select`."""
        optimised = _finite(optimised)
        evidence = search.evidence(optimised)
        # If two hypotheses are equal, the one without a jump comes first.
        followed = np.asarray(~optimised.hypotheses.jumped.any(1))
        order = np.lexsort((evidence, ~followed))
        joints = self.body.joint_positions(optimised.minima.x)
        ranks = -np.arange(len(order), dtype=np.float64)
        same = self.settings.hypothesis_merge_distance
        rows = order[distinct_hypotheses((joints - joints[:, :1])[order], ranks, same)]
        optimised, joints, evidence = optimised[rows], joints[rows], evidence[rows]
        transitions = search.transition_prior.log_transitions(joints)
        histories = search.transition_prior.log_histories(joints, transitions)
        log_weights, facing, turned = weigh_ways(
            search.modes,
            search.transition_prior,
            joints,
            transitions,
            log_sum_exp(histories, axis=0) - evidence,
            evidence,
            np.asarray(~optimised.hypotheses.jumped.all(1)),
        )
        return optimised, joints, log_weights, facing, histories + turned

    def _select(
        self,
        optimised: Optimised,
        joints: Array,
        log_weights: Array,
        facing: Array,
        histories: Array,
        observation: Observation,
        search: Search | None,
    ) -> None:
        """Selects the modes of an image.

        Args:
            optimised: N distinct hypotheses at their optima.
            joints: (N, J, 3) joints of the hypotheses, m.
            log_weights: (N,) log weights.
            facing: (N,) log odds of the facing direction of each hypothesis.
            histories: (K, N) log w_k p(x_n | x_k) from the K previous modes; K is 0 at a start.
            observation: observation of the image.
            search: search that found the hypotheses; None: the track starts.
        """
        s, posterior, poses = self.settings, self.posterior, optimised.minima.x
        before = None if search is None else search.modes
        dt = np.inf if search is None else search.dt
        best = poses[int(np.argmax(log_weights))]
        self.limbs.update(self.body, self.camera, observation, best, dt)
        kept = choose_hypotheses(
            (joints - joints[:, :1])[:, self.limbs.shown_joints(self.body)],
            log_weights,
            s.plan.hypotheses,
            same=s.hypothesis_merge_distance,
            first=best_of_other_facing(self.body, joints, log_weights, s.least_log_weight),
        )
        weights = at_least(normalised(kept.log_weights), s.least_log_weight)
        order = np.argsort(-weights, kind='stable')
        rows = kept.chosen[order]
        selected = optimised[rows]
        modes = posterior_modes(
            selected,
            weights[order],
            pooled_origins(histories, log_weights, kept.owner)[order],
            posterior,
            observation,
            self.shape,
            self.dynamics,
            None if search is None else search.states,
            dt,
        )
        modes = replace(
            modes,
            facing=facing[rows],
            back=ways(self.body, joints[rows], joints[rows[0]]),
            exchanges=seen_exchanges(
                posterior.likelihood, observation, modes.poses, selected.hypotheses.exchanges
            ),
            identities=self._identities.of(selected.hypotheses, before),
        )
        if posterior.ground is not None:
            modes = posterior.ground.with_contacts(posterior.body, modes, before, dt)
        self.modes = modes
        self._publish(modes)
        self._outline_costs = posterior.fit(modes.poses, observation).outline_costs
        self._points = None
        seen = observation.foreground is not None and s.likelihood.coverage.weight > 0
        if s.flow_weight > 0 or seen:
            frames = forward(posterior.body.skeleton, modes.poses)
            self._points = seen_points(posterior.body, self.camera, frames, observation.others)

    def _publish(self, modes: Modes) -> None:
        """Sets the published modes, and the probabilities of their origins."""
        before, self._sources = self._sources, np.arange(len(modes))
        weights = elementary.exp(self.published.log_weights)
        unseen = self.limbs.of_dofs(self.body)
        if unseen.any():
            spread, self._sources, postures = postures_of(self.body).spread(modes.mixture, unseen)
            modes = replace(
                modes[self._sources],
                poses=spread.means,
                covariances=spread.covariances,
                log_weights=elementary.log(spread.weights),
                identities=modes.identities[self._sources] + (postures << POSTURE_BITS),
            )
        if modes.origins.shape[1]:
            share = weights / np.bincount(before, weights)[before]
            modes = replace(modes, origins=modes.origins[:, before] * share)
        self.published = modes

    # Learning.

    def _cue_misfits(self, observation: Observation, search: Search | None = None) -> CueMisfits:
        """Computes the misfits of the modes to an image.

        Args:
            observation: observation of the image.
            search: search that found the modes; None: the track starts.
        """
        modes, s, alone = self.modes, self.settings.likelihood, None
        found = of_silhouette(
            self.body,
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
            term = self.posterior.likelihood.keypoint_term(observation, None)
            found[KEYPOINTS] = missed = of_keypoints(term, modes.poses)
            self.misfit = max(self.misfit, missed.share)
            if search is not None and SILHOUETTE in found:
                alone = self._by_keypoints.follow(search, modes.poses[0], term, missed)
        return CueMisfits(found, alone)

    def _fit_shape(self, observation: Observation, image_share: float) -> bool:
        """Updates the shape from an image; returns whether the image was used."""
        if not self.settings.estimate_shape:
            return False
        if observation.outline is None and observation.keypoints is None:
            return False
        best = slice(MAX_SHAPE_MODES)
        poses, weights = self.modes.poses, elementary.exp(self.modes.log_weights[best])
        gradients, covariances = self.posterior.fit(poses, observation).free_response
        body = self.shape.update(
            self.posterior.likelihood,
            observation,
            poses[best],
            weights / weights.sum(),
            gradients[best],
            covariances[best],
            image_share=image_share,
        )
        self.spent.append(len(weights))
        if body is not self.body:
            self._replace_body(body)
        return True

    def _replace_body(self, body: Body) -> None:
        """Replaces the body by a body with the same degrees of freedom."""
        self.body = body
        self.dynamics = dynamics_of(body, self.settings.motion)
        self.posterior = Posterior(
            body, self.camera, self.settings, self._extra, self._ground, self.spent
        )


def _finite(optimised: Optimised) -> Optimised:
    """Returns the hypotheses with a finite energy.

    Raises:
        ValueError: no hypothesis has a finite energy.
    """
    usable = np.isfinite(optimised.minima.value)
    if not usable.any():
        raise ValueError('no hypothesis has a finite energy')
    return optimised if usable.all() else optimised[np.flatnonzero(usable)]
