"""The energy of a pose given one image and where it was expected (KJS 2).

    E(x) = E_image(x) + E_keypoints(x) + E_prior(x) + E_intersection(x) + E_motion(x)
           + E_ground(x) + E_extra(x)

E_motion is a Gaussian around the expected pose.
E_ground are the terms of gravity, floor and feet (`body.ground_terms`), E_extra are terms that the
user of a tracker adds.

Exchange of left and right by the detector, in each mode from image to image:

    p(e_t | m) = sum_e' p(e_t | e') p(e' | ancestor of m),     p(e_t | e') = [exp(Q dt)]_e'e
    p(e_t | m, keypoints) ~ p(e_t | m) exp(-E_e(x_m))

Q are the rates at which detectors begin and cease to exchange sides (`image.keypoint_schemes`). A
person who is turned about and whose sides are exchanged looks the same to the keypoints as one who
is not: the two differ in that people turn slowly and detectors change their mind at once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import expm

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.ground_terms import GroundTerm, without_root_lean
from hmt_ros.body.kinematics import forward
from hmt_ros.body.pose_terms import FrameTerm
from hmt_ros.image.keypoint_schemes import exchange_rates, usual_exchanges
from hmt_ros.image.likelihood import ImageLikelihood
from hmt_ros.image.observation import Observation
from hmt_ros.image.pose_energy import PoseEnergy
from hmt_ros.image.surface_points import SurfacePoints, seen_points
from hmt_ros.inference.arrays import Array, Index, Mask
from hmt_ros.inference.bounded_newton import Minimum, resting
from hmt_ros.inference.energy import Derivatives, Energy, Quadratic
from hmt_ros.inference.error_model import ERRORS
from hmt_ros.tracking.hypotheses import Hypotheses

# Least probability of an exchange.
LEAST = 1e-6


class SideExchanges:
    """Probabilities of the exchanges, of each mode of a track.

    Attributes:
        prior: (K, E) log probabilities in the next image, by mode of the last one; None: usual.
    """

    def __init__(self) -> None:
        self.prior: Array | None = None
        self._posterior: Array | None = None

    def predict(self, dt: float) -> None:
        """Goes on by dt seconds."""
        if self._posterior is None:
            self.prior = None
            return
        moved = np.exp(self._posterior) @ expm(exchange_rates() * dt)
        self.prior = np.log(np.maximum(moved, LEAST))

    def of(self, ancestors: Index, anew: Mask) -> Array:
        """Log probabilities (N, E) before the image, of hypotheses with ancestors (N,).

        Args:
            ancestors: modes of the image before.
            anew: (N,) hypotheses that the track was wrong: its exchanges were wrong as well.
        """
        usual = np.repeat(usual_exchanges(), len(ancestors), axis=0)
        if self.prior is None:
            return usual
        return np.where(anew[:, None], usual, self.prior[ancestors])

    def update(
        self, likelihood: ImageLikelihood, observation: Observation, poses: Array, prior: Array
    ) -> None:
        """Takes in an image.

        Args:
            likelihood: of the body.
            observation: of the image.
            poses: (K, d) modes.
            prior: (K, E) of the modes, log probabilities before the image.
        """
        seen = observation.keypoints is not None and likelihood.settings.keypoints.weight > 0
        if seen or self._posterior is not None:
            self._posterior = prior
        if seen:
            term = likelihood.keypoint_term(observation, prior)
            frames = forward(likelihood.body.skeleton, poses)
            self._posterior = term.exchanged(frames, np.arange(len(poses)))

    def forget(self) -> None:
        """Knows nothing, as at the start."""
        self.prior = self._posterior = None

    @property
    def probabilities(self) -> Array | None:
        """(K, E) of the modes after the last image; None: nothing is known."""
        return None if self._posterior is None else np.exp(self._posterior)


if TYPE_CHECKING:
    from hmt_ros.tracking.ground import GroundEstimator
    from hmt_ros.tracking.settings import TrackerSettings


# Gain by a step below which a minimum is found, nats.
TOLERANCE = 0.02
# Largest standard deviation of a mode: where an image shows nothing, rad or m.
WIDEST = 2.0
# Standard deviation of a variable that rests on its limit, rad or m: 3 degrees.
AT_LIMIT = 0.05


@dataclass(frozen=True, eq=False)
class ImageFit:
    """Fit of poses (K, d) to an image, without the motion prior.

    Attributes:
        energy: with the priors of the body.
        image_energy: (K,) of the image and the keypoints alone.
        image_hessian: (K, d, d) of the image terms alone, keypoints apart.
        keypoint_hessian: (K, d, d) of the keypoints alone.
        outline_costs: (K, M) of the samples of the silhouette's outline.
        free: (K, d) variables that do not rest on a limit, where only the image moves them.
        covariances: (K, d, d) inverse Hessians of the energy on these; see `free_covariances`.
    """

    energy: Energy
    image_energy: Array
    image_hessian: Array
    keypoint_hessian: Array
    outline_costs: Array
    free: Mask
    covariances: Array


class Posterior:
    """Energies of poses of one body before one camera, and their minima.

    Args:
        body, camera: the person, and the camera that sees the person.
        settings: of the tracker.
        extra: further terms.
        ground: gravity and floor; None: not used.

    Attributes:
        evaluations: of the likelihood, so far.
    """

    def __init__(
        self,
        body: Body,
        camera: Camera,
        settings: TrackerSettings,
        extra: tuple[FrameTerm, ...] = (),
        ground: GroundEstimator | None = None,
    ) -> None:
        self.ground = ground if settings.ground.on else None
        self._person = body
        if self.ground is not None and settings.ground.upright_weight > 0:
            body = without_root_lean(body)
        self.body, self.camera, self.settings, self.extra = body, camera, settings, extra
        self.exchanges = SideExchanges()
        self._ground_term: GroundTerm | None = None
        self.evaluations = 0
        self._step_scale = step_scale(body)
        self._last_fit: tuple[Array, Observation, float, ImageFit] | None = None

    @cached_property
    def likelihood(self) -> ImageLikelihood:
        """The likelihood of images."""
        s = self.settings
        return ImageLikelihood(self.body, self.camera, s.likelihood, threads=s.threads)

    def of_image(self, observation: Observation, exchanges: Array | None = None) -> PoseEnergy:
        """The energy without the motion prior; its evaluations are counted.

        Args:
            observation: of the image.
            exchanges: log probabilities (N, E) of exchanges of sides before it; None: usual ones.
        """
        seen = self.likelihood.seen(observation, exchanges=exchanges)
        return PoseEnergy(
            self.likelihood, (*seen, *self.likelihood.priors, *self.known), counted=self._count
        )

    def _count(self, evaluations: int) -> None:
        self.evaluations += evaluations

    @property
    def known(self) -> tuple[FrameTerm | GroundTerm, ...]:
        """Terms besides those of image and body: those that were added, gravity and floor."""
        if self.ground is None:
            return self.extra
        plane = self.ground.plane
        if self._ground_term is None or self._ground_term.plane is not plane:
            self._ground_term = GroundTerm(self._person, self.settings.ground, plane)
        return (*self.extra, self._ground_term)

    def around(self, observation: Observation, centres: Array, precisions: Array) -> PoseEnergy:
        """With a Gaussian prior of precisions (N, d, d) around centres (N, d)."""
        return replace(self.of_image(observation), motion=Quadratic(centres, precisions))

    def given(
        self, observation: Observation, hypotheses: Hypotheses, precisions: Array
    ) -> PoseEnergy:
        """With the motion prior of N hypotheses, of precisions (N, d, d)."""
        image = self.of_image(observation, self.exchanges_of(hypotheses))
        return replace(image, motion=Quadratic(hypotheses.expected, precisions))

    def exchanges_of(self, hypotheses: Hypotheses) -> Array:
        """Log probabilities (N, E) of exchanges of sides before the image, of hypotheses."""
        anew = np.asarray(hypotheses.jumped.all(1), dtype=np.bool_)
        return self.exchanges.of(hypotheses.ancestors, anew)

    def placing(self, observation: Observation) -> PoseEnergy | None:
        """The prior and the squares of the distances from keypoints; None: there are none.

        A limb or a person far from the keypoints is not drawn to them by a robust kernel.
        """
        if observation.keypoints is None or self.settings.likelihood.keypoints.weight == 0:
            return None
        robust = self.likelihood.keypoint_term(observation, None)
        squares = replace(robust, settings=replace(robust.settings, scale=np.inf))
        return PoseEnergy(self.likelihood, (squares, self.likelihood.pose_prior))

    def values(self, poses: Array, observation: Observation) -> Array:
        """Energies (N,) of poses (N, d), by image alone."""
        image = self.of_image(observation)
        return image.energy(poses, np.arange(len(poses)), derivatives=Derivatives.NONE).value

    def minimise(self, term: PoseEnergy, poses: Array, iterations: int) -> Minimum:
        """Minima from poses (N, d) within the limits of the body."""
        return term.minimise(
            poses,
            step_scale=self._step_scale,
            damping=1.0,
            max_iterations=iterations,
            tolerance=TOLERANCE,
        )

    def fit(self, poses: Array, observation: Observation, lifted_share: float = 1.0) -> ImageFit:
        """Fit of poses (K, d) to an image; `lifted_share` as for `keypoint_term`."""
        seen = observation.keypoints
        share = 1.0 if seen is None or seen.lifted is None else lifted_share
        last = self._last_fit
        if last is not None and last[0] is poses and last[1] is observation and last[2] == share:
            return last[3]
        image, *keypoints = self.likelihood.seen(observation)
        if keypoints:
            keypoints = [self.likelihood.keypoint_term(observation, None, lifted_share=share)]
        terms = (image, *keypoints, *self.likelihood.priors, *self.known)
        found = PoseEnergy(self.likelihood, terms).by_cue(poses)
        gradient, hessian = found.energy.derivatives()
        free = ~resting(poses, gradient, self.body.lower, self.body.upper)
        fit = ImageFit(
            found.energy,
            found.values[:, :2].sum(1),
            found.hessians[:, 0],
            found.hessians[:, 1],
            found.outline_costs,
            free,
            free_covariances(hessian, free),
        )
        self._last_fit = (poses, observation, share, fit)
        return fit

    def log_likelihoods(self, poses: Array, observation: Observation) -> Array:
        """log p(image | pose) of poses (K, d), (K,), nats up to a constant of the image."""
        seen = PoseEnergy(self.likelihood, self.likelihood.seen(observation))
        energies = seen.energy(poses, derivatives=Derivatives.NONE).value
        return -energies

    def given_way(self, poses: Array, observation: Observation) -> tuple[Array, Array]:
        """Response of poses (K, d) to other changes, without the motion prior.

        Returns:
            Gradients (K, d) of the energy of the image and of the prior of the body, 0 for
            variables that rest on a limit, and inverse Hessians (K, d, d), in which they do not
            move.
        """
        fit = self.fit(poses, observation)
        gradient, free = fit.energy.derivatives()[0], fit.free
        return gradient * free, fit.covariances * (free[:, :, None] & free[:, None, :])

    def covariances(self, fit: ImageFit, free: Mask, dt: float) -> Array:
        """Covariances (K, d, d) that an image alone leaves, on the free variables (K, d).

        Args:
            fit: of the poses.
            free: (K, d) variables that do not rest on a limit.
            dt: time since the image before, s.
        """
        _, hessian = fit.energy.derivatives()
        lasting = (1.0 - ERRORS['image'].share(dt)) * fit.image_hessian
        lasting = lasting + (1.0 - ERRORS['keypoints'].share(dt)) * fit.keypoint_hessian
        return free_covariances(hessian - lasting, free)

    def evidence(
        self, poses: Array, observation: Observation, exchanges: Array, dt: float
    ) -> Array:
        """Energies (N,), nats, that an image adds to minus the log weights of poses (N, d).

        The exchange of sides is a chain (`SideExchanges`): its prior counts whole, the energies by
        their share.

        Args:
            poses: (N, d).
            observation: of the image.
            exchanges: (N, E) log probabilities of exchanges of sides.
            dt: time since the image before, s.
        """
        self.evaluations += len(poses)
        share = {name: errors.share(dt) for name, errors in ERRORS.items()}

        image, *keypoints = self.likelihood.seen(observation)
        if keypoints:
            keypoints = [
                self.likelihood.keypoint_term(
                    observation, exchanges, share['keypoints'], share['lifted']
                )
            ]
        terms = (image, *keypoints, *self.likelihood.priors, *self.known)
        values = PoseEnergy(self.likelihood, terms).by_cue(poses, derivatives=False).values
        return np.asarray(values @ [share['image'], 1.0, share['prior']])

    def seen_points(self, poses: Array, observation: Observation) -> SurfacePoints:
        """Points that an image sees of the surfaces of poses (K, d)."""
        frames = forward(self.body.skeleton, poses)
        return seen_points(self.body, self.camera, frames, observation.others)


def step_scale(body: Body) -> Array:
    """Length (d,) of a moderate step of each variable, rad or m."""
    return np.where(body.skeleton.dof_is_rotation, 0.3, 0.2)


def free_covariances(hessians: Array, free: Mask) -> Array:
    """Inverses (K, d, d) of Hessians (K, d, d) on the free variables (K, d).

    A variable at its limit has the deviation `AT_LIMIT`, and none one above `WIDEST`.
    """
    h = hessians.copy()
    rows, dofs = np.nonzero(~free)
    h[rows, dofs, :] = 0.0
    h[rows, :, dofs] = 0.0
    h[rows, dofs, dofs] = AT_LIMIT**-2.0
    diagonal = np.arange(h.shape[1])
    h[:, diagonal, diagonal] += WIDEST**-2.0
    result = np.linalg.inv(0.5 * (h + h.transpose(0, 2, 1)))
    return 0.5 * (result + result.transpose(0, 2, 1))
