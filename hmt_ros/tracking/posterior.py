"""Energy of a pose given one image and the expected pose (KJS 2).

    E(x) = E_image(x) + E_keypoints(x) + E_prior(x) + E_intersection(x) + E_motion(x)
           + E_ground(x) + E_extra(x)

E_motion is the energy of a Gaussian around the expected pose, E_ground the sum of the terms of
gravity, floor and feet (`body.ground_terms`), and E_extra the sum of the terms that a user adds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from hmt_ros import core
from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.ground_terms import GroundTerm, without_root_lean
from hmt_ros.body.pose_terms import FrameTerm
from hmt_ros.image.likelihood import ImageLikelihood
from hmt_ros.image.observation import Observation
from hmt_ros.image.pose_energy import CompiledTerm, PoseEnergy
from hmt_ros.inference.arrays import Array, Mask
from hmt_ros.inference.bounded_newton import Minimum, resting
from hmt_ros.inference.energy import Energy, Quadratic
from hmt_ros.inference.error_model import ERRORS
from hmt_ros.inference.linear_algebra import product
from hmt_ros.tracking.classes import known_exchanges
from hmt_ros.tracking.ground import GroundEstimator
from hmt_ros.tracking.settings import LIMIT_SIGMA, MAX_SIGMA, MINIMUM_TOLERANCE, TrackerSettings

# Weight of a Hessian that is not split by cue.
WHOLE_SHARE = np.ones(1)
# Precisions of a variable on a limit, and of an unknown variable.
PRECISIONS = 1.0 / LIMIT_SIGMA**2, 1.0 / MAX_SIGMA**2


@dataclass(frozen=True, eq=False)
class ImageFit:
    """Fit of poses (K, d) to an image, without the motion prior.

    Attributes:
        energy: energy of all terms, including the priors of the body.
        image_energy: (K,) energies of the image and the keypoints alone.
        hessians: (K, 3, d, d) Hessians of the image terms, of the keypoints, and of all other
            terms.
        outline_costs: (K, M) energies of the samples of the silhouette's outline.
        free: (K, d) False for variables that rest on a limit.
        covariances: (K, d, d) inverse Hessians of the energy on the free variables; see
            `free_covariances`.
        log_determinants: (K,) log determinants of the covariances.
    """

    energy: Energy
    image_energy: Array
    hessians: Array
    outline_costs: Array
    free: Mask
    covariances: Array
    log_determinants: Array

    @cached_property
    def free_response(self) -> tuple[Array, Array]:
        """Gradients (K, d) and inverse Hessians (K, d, d) of the energy on the free variables.

        Both are 0 for variables that are not free.
        """
        gradient = self.energy.derivatives()[0]
        moving = self.free[:, :, None] & self.free[:, None, :]
        return gradient * self.free, self.covariances * moving

    def persistent_covariances(self, free: Mask, dt: float) -> Array:
        """Covariances (K, d, d) given one image alone, for errors that persist over images.

        Args:
            free: (K, d) whether each variable is free, see `ImageFit`.
            dt: time since the previous image, s.
        """
        shares = np.array([ERRORS['image'].share(dt), ERRORS['keypoints'].share(dt), 1.0])
        return free_covariances(self.hessians, free, shares)[0]


class Posterior:
    """Energies of the poses of a body in front of a camera, and minima of these energies.

    Args:
        body, camera: body of the person, and camera.
        settings: settings of the tracker.
        extra: further energy terms.
        ground: gravity and floor; None: not used.
        spent: list to which numbers of evaluations of the likelihood are appended; None: a new
            list.

    Attributes:
        person: body with its prior on the root's lean.
        body: body without the prior on the root's lean if the ground terms replace it.
        camera, settings, extra, ground, spent: the arguments.
    """

    def __init__(
        self,
        body: Body,
        camera: Camera,
        settings: TrackerSettings,
        extra: tuple[FrameTerm, ...] = (),
        ground: GroundEstimator | None = None,
        spent: list[int] | None = None,
    ) -> None:
        self.ground = ground if settings.ground.on else None
        self.spent = [] if spent is None else spent
        self.person = body
        if self.ground is not None and settings.ground.upright_weight > 0:
            body = without_root_lean(body)
        self.body, self.camera, self.settings, self.extra = body, camera, settings, extra
        self._ground_term: GroundTerm | None = None
        self._step_scale = step_scale(body)
        self._last_fit: tuple[Array, Observation, float, ImageFit] | None = None

    @cached_property
    def likelihood(self) -> ImageLikelihood:
        """Likelihood of images."""
        s = self.settings
        return ImageLikelihood(self.body, self.camera, s.likelihood, threads=s.threads)

    @cached_property
    def divided(self) -> dict[str, tuple[ImageLikelihood, ImageLikelihood]]:
        """For each limb, the likelihood of its flesh, and the likelihood of all other flesh."""
        chains, parts = self.body.skeleton.chains, self.body.flesh.parts
        result = {}
        for chain in (chain for pair in self.body.chain_pairs for chain in pair):
            own = tuple(i for i, part in enumerate(parts) if part.segment in chains[chain])
            rest = tuple(i for i in range(len(parts)) if i not in own)
            of_limb = replace(self.likelihood, parts=own)
            result[chain] = of_limb, replace(self.likelihood, parts=rest, occluders=rest)
        return result

    def of_image(
        self,
        observation: Observation,
        exchanges: Array | None = None,
        motion: Quadratic | None = None,
    ) -> PoseEnergy:
        """The energy given an image; counts its evaluations.

        Args:
            observation: observation of the image.
            exchanges: log probabilities (N, E) that the detector exchanges sides, given earlier
                images, NaN where unknown; None: all unknown.
            motion: motion prior; None: no motion prior.
        """
        terms = self._terms(observation, exchanges)
        return PoseEnergy(self.likelihood, terms, motion, counted=self.spent.append)

    def _terms(
        self,
        observation: Observation,
        exchanges: Array | None = None,
        share: float = 1.0,
        lifted_share: float = 1.0,
    ) -> tuple[CompiledTerm | FrameTerm, ...]:
        """All energy terms; arguments as in `of_image` and `ImageLikelihood.keypoint_term`."""
        exchanges = (
            None
            if exchanges is None or observation.keypoints is None
            else known_exchanges(exchanges)
        )
        seen = self.likelihood.seen(observation, exchanges, share, lifted_share)
        return (*seen, *self.likelihood.priors, *self.known(observation))

    def known(self, observation: Observation) -> tuple[FrameTerm | GroundTerm, ...]:
        """Extra terms, and terms of gravity and floor, but no terms of image and body."""
        if self.ground is None:
            return self.extra
        plane, last = self.ground.plane, self._ground_term
        hidden = (
            () if observation.hidden is None else tuple(observation.hidden.nonzero()[0].tolist())
        )
        if last is None or (last.plane is not plane or last.hidden != hidden):
            self._ground_term = GroundTerm(self.person, self.settings.ground, plane, hidden)
        assert self._ground_term is not None
        return (*self.extra, self._ground_term)

    def given(
        self,
        observation: Observation,
        centres: Array,
        precisions: Array,
        exchanges: Array | None = None,
    ) -> PoseEnergy:
        """The energy with a Gaussian prior of precisions (N, d, d) around centres (N, d)."""
        return self.of_image(observation, exchanges, Quadratic(centres, precisions))

    def placing(self, observation: Observation) -> PoseEnergy | None:
        """Energy of the prior and of squared distances to keypoints; None without keypoints.

        A robust kernel would not attract limbs that are far from their keypoints.
        """
        if observation.keypoints is None or self.settings.likelihood.keypoints.weight == 0:
            return None
        robust = self.likelihood.keypoint_term(observation, None)
        squares = replace(robust, settings=replace(robust.settings, scale=np.inf))
        return PoseEnergy(self.likelihood, (squares, self.likelihood.pose_prior))

    def minimise(self, term: PoseEnergy, poses: Array, iterations: int) -> Minimum:
        """Minimises the energy from poses (N, d) within the limits of the body."""
        return term.minimise(
            poses,
            step_scale=self._step_scale,
            damping=1.0,
            max_iterations=iterations,
            tolerance=MINIMUM_TOLERANCE,
        )

    def fit(self, poses: Array, observation: Observation, lifted_share: float = 1.0) -> ImageFit:
        """Evaluates the fit of poses (K, d) to an image; `lifted_share` as in `keypoint_term`."""
        seen = observation.keypoints
        share = 1.0 if seen is None or seen.lifted is None else lifted_share
        last = self._last_fit
        if last is not None and last[0] is poses and last[1] is observation and last[2] == share:
            return last[3]
        terms = self._terms(observation, lifted_share=share)
        found = PoseEnergy(self.likelihood, terms).by_cue(poses)
        gradient, hessian = found.energy.derivatives()
        free = ~resting(poses, gradient, self.body.lower, self.body.upper)
        fit = ImageFit(
            found.energy,
            found.values[:, :2].sum(1),
            found.hessians,
            found.outline_costs,
            free,
            *free_covariances(hessian[:, None], free),
        )
        self._last_fit = (poses, observation, share, fit)
        return fit

    def evidence(
        self, poses: Array, observation: Observation, exchanges: Array, dt: float
    ) -> Array:
        """Energies (N,) of an image, nats, to subtract from the log weights of poses (N, d).

        Exchanges of sides form a Markov chain (`classes`), so their prior is not discounted, while
        energies are weighted by their shares.

        Args:
            poses: (N, d) poses.
            observation: observation of the image.
            exchanges: (N, E) log probabilities that the detector exchanges sides, NaN where
                unknown.
            dt: time since the previous image, s.
        """
        self.spent.append(len(poses))
        share = {name: errors.share(dt) for name, errors in ERRORS.items()}
        terms = self._terms(observation, exchanges, share['keypoints'], share['lifted'])
        values = PoseEnergy(self.likelihood, terms).by_cue(poses, derivatives=False).values
        return np.asarray(product(values, np.array([share['image'], 1.0, share['prior']])))


def step_scale(body: Body) -> Array:
    """Typical step (d,) of each variable in the optimisation, rad or m."""
    return np.where(body.skeleton.dof_is_rotation, 0.3, 0.2)


def free_covariances(
    hessians: Array, free: Mask, shares: Array = WHOLE_SHARE
) -> tuple[Array, Array]:
    """Inverses (K, d, d) of sums of Hessians on the free variables, and log determinants (K,).

    A variable on its limit has the standard deviation `LIMIT_SIGMA`; the maximum is `MAX_SIGMA`.

    Args:
        hessians: (K, C, d, d) Hessians of the C cues.
        free: (K, d) whether each variable is free, see `ImageFit`.
        shares: (C,) weights of the cues.
    """
    result, log_determinants = np.empty_like(hessians[:, 0]), np.empty(len(hessians))
    hessians = np.ascontiguousarray(hessians, dtype=np.float64)
    core.free_covariances(hessians, shares, free, *PRECISIONS, result, log_determinants)
    return result, log_determinants
