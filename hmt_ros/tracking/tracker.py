"""Mixture density propagation with kinematic jumps and covariance-scaled sampling (KJS 4, 5)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from enum import Enum
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.interpretation_tree import enumerate_flips, rehang_chain
from hmt_ros.body.kinematics import Frames, forward
from hmt_ros.body.torso_flips import flip_torso
from hmt_ros.image.background import BackgroundModel
from hmt_ros.image.likelihood import ImageLikelihood, LikelihoodSettings, TermSettings
from hmt_ros.image.observation import Keypoints, Observation, ObservationSettings, observe
from hmt_ros.image.texture import Textures, capture_textures, with_swapped_sides
from hmt_ros.inference.bounded_newton import Minimum, minimise
from hmt_ros.inference.mixture import GaussianMixture
from hmt_ros.tracking.chain_product import (
    Alternatives,
    best_combinations,
    distinct_alternatives,
)
from hmt_ros.tracking.chain_search import ChainSearch, ChainSearchSettings
from hmt_ros.tracking.dynamics import DynamicsSettings, predict, update_velocities
from hmt_ros.tracking.flesh_fitting import FleshFit
from hmt_ros.tracking.initialisation import (
    poses_from_keypoints,
    poses_from_outline,
    start_from_keypoints,
)
from hmt_ros.tracking.proposals import (
    PROPOSALS,
    VOTES,
    chain_dofs,
    chain_votes,
    covariance_scaled_samples,
    spherical_samples,
)
from hmt_ros.tracking.pruning import choose_hypotheses, inherited_log_weights
from hmt_ros.tracking.subject import Subject

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Image = NDArray[np.uint8]

# Groups of modes with a trunk of their own whose products are rated.
MOST_GROUPS = 3
REWEIGHTINGS = ('ancestry', 'bhattacharyya')
# An outline or a keypoint further away than this from where it should be is unexplained, in sigmas.
UNEXPLAINED = 4.0
# Keypoints from which a lost track starts anew.
FEWEST_KEYPOINTS = 6
# Largest standard deviation of a mode: where an image shows nothing, rad or m.
WIDEST = 2.0
# Around all joints of all modes, as a fraction of their extent: where the silhouette may be.
REGION_MARGIN = 0.3
# How far the usual energy follows that of the last image.
USUAL_GAIN = 0.1
PAIRS = (('left_arm', 'right_arm'), ('left_leg', 'right_leg'))
SIBLINGS = {a: b for pair in PAIRS for a, b in (pair, pair[::-1])}
TRUNK = ('pelvis', 'neck', 'left_hip', 'right_hip', 'left_shoulder', 'right_shoulder')
CHAINS = ('left_arm', 'right_arm', 'left_leg', 'right_leg', 'neck')


class Status(Enum):
    """What the tracker is doing."""

    WAITING = 'waiting'  # for the image that the subject's joints were seen in
    TRACKING = 'tracking'
    LOST = 'lost'


@dataclass(frozen=True)
class TrackerSettings:
    """How poses are tracked.

    Attributes:
        max_hypotheses: modes that are kept, K.
        hypothesis_merge_distance: mean distance of the joints below which two modes are one, m.
        proposals: 'kjs' (covariance-scaled samples and kinematic jumps), 'css' or 'ss' (samples
            alone).
        candidates: hypotheses that are optimised fully an image.
        combinations: combinations of chain alternatives that are rated an image.
        alternatives: configurations of a chain that are rated.
        samples: samples an image of 'css' and 'ss'.
        sample_scale: their stretch; 0: Cauchy tails.
        reweighting: what the images before say of a new mode: 'ancestry', the weight of the mode it
            comes from and of its jumps, or 'bhattacharyya', the weight of the nearest mode before
            (KJS 5.1).
        exploration: power of the weights when candidates are chosen; below 1 favours unlikely ones.
        vote: how chains are chosen for search: 'trace', 'eigenvalue' or 'uniform'.
        searched_chains: chains searched in an image.
        surprise: an image whose least energy exceeds the usual one by this is searched again.
        rounds: of search in such an image at most.
        jump_probability: of a flip of one chain from one image to the next.
        base_iterations, iterations: Newton steps on the predictions and on the candidates.
        temperature: factor on the image's energy in a mode's weight; below 1 because neighbouring
            measurements err together.
        image_trust: factor on the curvature of the image's energy, keypoints apart, in a mode's
            covariance; below 1 because shapes, shadows and clothes are not the model's.
        tails: degrees of freedom of the Student distribution around a prediction.
        least_log_weight: no kept mode's weight falls below this.
        flesh_images: images from which the widths of the flesh are estimated; 0: the model's.
        lost_misfit: share of the outline, or of the keypoints, that no mode explains, above which
            an image counts as lost.
        lost_images: so many in a row start the track anew.
        dynamics, likelihood, observation, search: settings of the parts.
    """

    max_hypotheses: int = 8
    hypothesis_merge_distance: float = 0.02
    proposals: str = 'kjs'
    candidates: int = 16
    combinations: int = 96
    alternatives: int = 10
    samples: int = 256
    sample_scale: float = 2.0
    reweighting: str = 'ancestry'
    exploration: float = 0.5
    vote: str = 'trace'
    searched_chains: int = 4
    surprise: float = 6.0
    rounds: int = 3
    jump_probability: float = 0.1
    base_iterations: int = 6
    iterations: int = 6
    temperature: float = 0.3
    image_trust: float = 0.05
    tails: float = 8.0
    least_log_weight: float = -10.0
    flesh_images: int = 15
    lost_misfit: float = 0.35
    lost_images: int = 5
    dynamics: DynamicsSettings = field(default_factory=DynamicsSettings)
    likelihood: LikelihoodSettings = field(default_factory=LikelihoodSettings)
    observation: ObservationSettings = field(default_factory=ObservationSettings)
    search: ChainSearchSettings = field(default_factory=ChainSearchSettings)

    def __post_init__(self) -> None:
        if self.proposals not in PROPOSALS:
            raise ValueError(f'proposals must be one of {PROPOSALS}, saw {self.proposals!r}')
        if self.reweighting not in REWEIGHTINGS:
            raise ValueError(f'reweighting must be one of {REWEIGHTINGS}, saw {self.reweighting!r}')
        if self.vote not in VOTES:
            raise ValueError(f'vote must be one of {VOTES}, saw {self.vote!r}')
        if self.max_hypotheses < 1 or self.candidates < self.max_hypotheses:
            raise ValueError(
                f'wanted 1 <= max_hypotheses <= candidates, saw {self.max_hypotheses} and '
                f'{self.candidates}'
            )
        least = {'samples': 1, 'rounds': 1, 'iterations': 1, 'base_iterations': 1, 'lost_images': 1}
        least |= {'combinations': 1, 'alternatives': 1, 'temperature': 0, 'exploration': 0}
        for name, bound in least.items():
            if not getattr(self, name) >= bound:
                raise ValueError(f'{name} must be at least {bound}, saw {getattr(self, name)}')
        if not self.tails > 0:
            raise ValueError(f'tails must be positive, saw {self.tails}')
        if not 0 < self.jump_probability < 1:
            raise ValueError(f'jump_probability must lie in (0, 1), saw {self.jump_probability}')


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


@dataclass(frozen=True, eq=False)
class _Product:
    """A trunk, configurations of each limb, and what they cost.

    Attributes:
        modes, members, log_weights: (G, d), (G,), (G,) of the modes with this trunk.
        alternatives: one entry a chain.
        changes: energy change that each alternative makes alone.
        energy: of the first mode.
        row: of the textures.
    """

    modes: Array
    members: Index
    log_weights: Array
    alternatives: list[Alternatives]
    changes: list[Array]
    energy: float
    row: int


@dataclass(frozen=True, eq=False)
class _Candidates:
    """Poses to be optimised.

    Attributes:
        poses: (N, d).
        parents: (N,) the mode that each comes from.
        log_priors: (N,) log probability given the modes before.
        centres: (N, d) where each is expected.
        jumped: (N, d) what did not move there.
        textures: of the last image.
        texture_rows: (N,) row of the textures that each carries.
    """

    poses: Array
    parents: Index
    log_priors: Array
    centres: Array
    jumped: NDArray[np.bool_]
    textures: Textures | None
    texture_rows: Index


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
        self.status = Status.WAITING

    def step(
        self, image: Image, stamp: int, keypoints: Keypoints | None = None
    ) -> tuple[GaussianMixture, GaussianMixture] | tuple[None, None]:
        """Takes the next image.

        Args:
            image: (H, W, 3) BGR uint8, of the camera's size.
            stamp: of the image, ns; later than the one before.
            keypoints: joints seen in this image, if any.

        Returns:
            The posterior p(x_t | R_t) and the likelihood p(r_t | x_t) as mixtures over poses,
            heaviest first with weights that sum to 1; (None, None) while there is no track.

        Raises:
            ValueError: an image of another size, or a stamp that does not increase.
        """
        size = (self.camera.height, self.camera.width)
        if image.shape[:2] != size:
            raise ValueError(f'the camera gives images of {size}, saw {image.shape[:2]}')
        if self._last_stamp is not None and stamp <= self._last_stamp:
            raise ValueError(f'stamps must increase, saw {stamp} after {self._last_stamp} ns')
        self.evaluations = 0
        if self._modes is None:
            if not self._can_start(stamp):
                if self._learning:
                    self.background.learn(image)
                return None, None
            observation = self._observe(image, keypoints)
            self._begin(observation)
        else:
            assert self._last_stamp is not None
            observation = self._observe(image, keypoints)
            if self.status is Status.LOST and self._recover(observation):
                self._bad_images = 0
            else:
                self._propagate(observation, (stamp - self._last_stamp) * 1e-9)
        self._last_image, self._last_stamp = image, stamp
        self._judge(observation)
        return self.posterior, self.likelihood_mixture(observation)

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
        free = ~_resting(m.poses, gradient, body)
        covariances = _covariances(hessian, free)
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

    def _can_start(self, stamp: int) -> bool:
        if isinstance(self._start, Subject):
            return stamp >= self._start.stamp_ns
        return self._start is not None

    def _begin(self, observation: Observation) -> None:
        s = self.settings
        if isinstance(self._start, Subject):
            begun = start_from_keypoints(self.model, self.camera, self._start)
            self._use_body(begun.body)
            self._flesh = FleshFit(self.body)
            observation = replace(observation, keypoints=self._start.keypoints)
            poses, log_weights = begun.poses, np.zeros(len(begun.poses))
            precisions = np.zeros((len(poses), self.body.dimension, self.body.dimension))
        else:
            assert self._start is not None
            poses = self._start.means
            with np.errstate(divide='ignore'):
                log_weights = np.log(self._start.normalised().weights)
            precisions = _inverses(self._start.covariances)

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

    def _recover(self, observation: Observation) -> bool:
        """Starts anew from what an image alone shows; False where that is not enough.

        The body keeps its lengths and widths. From keypoints come all poses that explain them, from
        a silhouette mean poses of several headings at its place; the present modes stay in
        the race.
        """
        s, poses = self.settings, None
        if observation.keypoints is not None:
            seen = np.isfinite(observation.keypoints.pixels).all(1)
            if seen.sum() >= FEWEST_KEYPOINTS:
                poses = poses_from_keypoints(self.body, self.camera, observation.keypoints)
        if poses is None and observation.outline is not None:
            poses = poses_from_outline(self.body, self.camera, observation.outline)
        if poses is None:
            return False
        poses = np.concatenate([self.modes.poses, poses])

        def energy(x: Array, _: Index) -> tuple[Array, Array, Array]:
            return self._energy(x, observation, None, None)

        solved = self._minimise(energy, poses, 3 * s.iterations)
        self._keep(solved, np.zeros(len(poses)), np.zeros_like(poses), observation)
        return True

    def _fit_flesh(self, observation: Observation) -> bool:
        """Moves the widths of the flesh by what an image says; False where it says nothing more."""
        if self._flesh.images >= self.settings.flesh_images or observation.outline is None:
            return False
        m = self.modes
        poses, weights = m.poses[:4], np.exp(m.log_weights[:4])
        body = self._flesh.update(
            self._likelihood, replace(observation, keypoints=None), poses, weights / weights.sum()
        )
        self.evaluations += len(poses) * (2 * len(self._flesh.widths) + 1)
        self._use_body(body)
        return True

    def _use_body(self, body: Body) -> None:
        self.body = body
        for name in ('_likelihood', '_motion_likelihood', '_searches'):
            self.__dict__.pop(name, None)

    # One image after another.

    def _propagate(self, observation: Observation, dt: float) -> None:
        s, m, body = self.settings, self.modes, self.body
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
        sources = _Candidates(moved, everyone, m.log_weights, moved, still, m.textures, everyone)
        if s.proposals == 'kjs':
            candidates = self._jumps(base, sources, covariances, observation)
        else:
            candidates = self._samples(base, sources, covariances, observation)
        solved = self._solve(candidates, precisions, observation)
        for _ in range(s.rounds - 1 if s.proposals == 'kjs' else 0):
            if solved.value.min() < self._usual_energy + s.surprise:
                break
            base, sources = self._search_around(
                solved, candidates, covariances, precisions, observation
            )
            more = self._jumps(base, sources, covariances, observation)
            solved = _joined_minima(solved, self._solve(more, precisions, observation))
            candidates = _joined_candidates(candidates, more)
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

    def _solve(
        self, candidates: _Candidates, precisions: Array, observation: Observation
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
        candidates: _Candidates,
        covariances: Array,
        precisions: Array,
        observation: Observation,
    ) -> tuple[Minimum, _Candidates]:
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
        sampled = _Candidates(
            drawn,
            np.full(n, c.parents[lead[0]]),
            np.full(n, c.log_priors[lead[0]] + np.log(s.jump_probability)),
            drawn,
            np.ones(drawn.shape, dtype=np.bool_),
            c.textures,
            rows[:n],
        )
        found = self._solve(sampled, precisions, observation)
        kept = _Candidates(
            c.poses[best], c.parents[best], c.log_priors[best], c.centres[best], c.jumped[best],
            c.textures, c.texture_rows[best],
        )  # fmt: skip
        return _joined_minima(_some_minima(solved, best), found), _joined_candidates(kept, sampled)

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
        textures, everyone = self.modes.textures, np.arange(len(predicted))

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

    def _jumps(
        self, base: Minimum, sources: _Candidates, covariances: Array, observation: Observation
    ) -> _Candidates:
        """Candidates of kinematic jump sampling, from optima and how each of them came about."""
        s, textures = self.settings, sources.textures
        everything: list[tuple[Array, Index, Array, Array, Index]] = []
        for group in self._groups(base)[:MOST_GROUPS]:
            lead = int(group[0])
            pose, lead_row = base.x[lead], int(sources.texture_rows[lead])
            found = self._search(
                pose, covariances[sources.parents[lead]], observation, textures, lead_row
            )
            log_weights = sources.log_priors[group]
            alternatives = [
                self._alternatives(base.x[group], chain, found.get(chain))
                for chain in CHAINS
                if chain in self.body.chains
            ]
            changes, energy = self._rate(pose, alternatives, observation, textures, lead_row)
            products = [
                _Product(base.x[group], group, log_weights, alternatives, changes, energy, lead_row)
            ]
            weight = np.array([np.logaddexp.reduce(log_weights) + np.log(s.jump_probability)])
            for pair in PAIRS:
                if not set(pair) <= set(self.body.chains):
                    continue
                swapped = self._swap(pose, pair)
                if swapped is None:
                    continue
                row = lead_row
                if textures is not None:
                    row = len(textures.counts)
                    textures = with_swapped_sides(
                        textures, lead_row, *(self.body.skeleton.chains[chain] for chain in pair)
                    )
                rated, energy = self._rate(swapped[0], swapped[1], observation, textures, row)
                choices, joined = [], []
                for chain, change in zip(alternatives, changes, strict=True):
                    if chain.chain in pair:
                        i = pair.index(chain.chain)
                        choices.append(swapped[1][i])
                        joined.append(rated[i])
                    else:
                        choices.append(Alternatives(chain.chain, chain.angles, chain.penalties[:1]))
                        joined.append(change)
                products.append(
                    _Product(swapped[0][None], group[:1], weight, choices, joined, energy, row)
                )
            for flipped, hung in self._torso_flips(pose, [a.chain for a in alternatives]):
                changes, energy = self._rate(flipped, hung, observation, textures, lead_row)
                products.append(
                    _Product(flipped[None], group[:1], weight, hung, changes, energy, lead_row)
                )
            for product in products:
                combined = best_combinations(
                    self.body, product.modes, product.log_weights, product.energy,
                    product.alternatives, product.changes, s.temperature, s.combinations,
                )  # fmt: skip
                members = product.members[combined.parents]
                rows = np.full(len(members), product.row)
                if product.row == lead_row:
                    rows = sources.texture_rows[members]
                everything.append(
                    (combined.poses, members, combined.log_priors, combined.energies, rows)
                )
        poses, members, log_priors, energies, rows = (
            np.concatenate([part[i] for part in everything]) for i in range(5)
        )
        kept = choose_hypotheses(
            self._relative_joints(poses),
            s.exploration * (log_priors - s.temperature * energies),
            s.candidates,
            same=s.hypothesis_merge_distance,
        ).chosen
        poses, members = poses[kept], members[kept]
        # A chain that jumped is expected where it landed, the rest where it was predicted.
        changed = np.abs(poses - base.x[members]) > 1e-9
        return _Candidates(
            poses,
            sources.parents[members],
            log_priors[kept],
            np.where(changed, poses, sources.centres[members]),
            changed | sources.jumped[members],
            textures,
            rows[kept],
        )

    def _samples(
        self, base: Minimum, sources: _Candidates, covariances: Array, observation: Observation
    ) -> _Candidates:
        """Candidates of covariance-scaled or spherical sampling."""
        s, m = self.settings, self.modes
        draw = covariance_scaled_samples if s.proposals == 'css' else spherical_samples
        moved = sources.poses
        k = len(moved)
        each = max(s.samples // k, 1)
        drawn = draw(self.body, moved, covariances, each, s.sample_scale, self._rng)
        poses = np.concatenate([base.x, drawn.reshape(-1, self.body.dimension)])
        parents = np.concatenate([np.arange(k), np.repeat(np.arange(k), each)])
        energies = self._value(poses, observation, m.textures, parents)
        kept = choose_hypotheses(
            self._relative_joints(poses),
            m.log_weights[parents] - s.temperature * energies,
            s.candidates,
            same=s.hypothesis_merge_distance,
        ).chosen
        parents = parents[kept]
        return _Candidates(
            poses[kept], parents, m.log_weights[parents], moved[parents],
            np.zeros((len(parents), self.body.dimension), dtype=np.bool_), m.textures, parents,
        )  # fmt: skip

    def _groups(self, base: Minimum) -> list[Index]:
        """Modes with nearly the same trunk, each group with its best mode first."""
        names = [name for name in TRUNK if name in self.body.joint_names]
        which = self.body.skeleton.joint_index(names)
        trunk = self.body.joint_positions(base.x)[:, which]
        left = list(np.argsort(base.value, kind='stable'))
        groups = []
        while left:
            gaps = np.linalg.norm(trunk[left] - trunk[left[0]], axis=2).max(1)
            near = gaps < 0.06
            groups.append(np.array([i for i, ok in zip(left, near) if ok], dtype=np.intp))
            left = [i for i, ok in zip(left, near) if not ok]
        return groups

    def _search(
        self,
        pose: Array,
        covariance: Array,
        observation: Observation,
        textures: Textures | None,
        row: int,
    ) -> dict[str, Array]:
        """Configurations of some chains, chosen by vote, that fit the image."""
        shape = observation.distance is not None or observation.edges is not None
        names = list(self._searches) if shape else []
        count = min(self.settings.searched_chains, len(names))
        if count == 0:
            return {}
        votes = chain_votes(self.body, covariance[None], names, self.settings.vote)[0]
        chosen = self._rng.choice(len(names), size=count, replace=False, p=votes)
        result = {}
        for i in sorted(chosen):
            search = self._searches[names[i]]
            result[names[i]] = search.find(pose, covariance, observation, textures, row, self._rng)
            own = self.settings.search
            self.evaluations += own.samples + own.refined * own.iterations
        return result

    def _alternatives(self, modes: Array, chain: str, found: Array | None) -> Alternatives:
        """Configurations of a chain in a group: the modes' own, what was found, and all flips."""
        s = self.settings
        own = chain_dofs(self.body, chain)
        jump = -np.log(s.jump_probability)
        angles, penalties = [modes[:, own]], [np.where(np.eye(len(modes)) > 0, 0.0, jump)]
        if found is not None:
            angles.append(found)
            penalties.append(np.full((len(modes), len(found)), jump))
        if chain in SIBLINGS:
            # Limbs that cross in the image are easily taken for each other.
            swapped, _ = rehang_chain(
                self.body, modes[:1], modes[:1], chain, image_of=SIBLINGS[chain]
            )
            angles.append(swapped[:, own])
            penalties.append(np.full((len(modes), len(swapped)), jump))
        sources = np.concatenate(angles)
        poses = np.repeat(modes[:1], len(sources), axis=0)
        poses[:, own] = sources
        flips, parents = enumerate_flips(self.body, self.camera, poses, chain)
        first = np.concatenate([[True], parents[1:] != parents[:-1]])
        flips, parents = flips[~first], parents[~first]
        angles.append(flips[:, own])
        penalties.append(np.full((len(modes), len(flips)), jump))
        return distinct_alternatives(
            self.body, modes[0], chain, np.concatenate(angles), np.concatenate(penalties, axis=1),
            apart=0.08, most=s.alternatives,
        )  # fmt: skip

    def _torso_flips(
        self, pose: Array, chains: list[str]
    ) -> list[tuple[Array, list[Alternatives]]]:
        """The pose with its torso flipped, and its limbs in all ways that keep their image."""
        result = []
        for flipped in flip_torso(self.body, pose[None])[0]:
            base, alternatives = flipped.copy(), []
            for chain in chains:
                own = chain_dofs(self.body, chain)
                hung, _ = rehang_chain(self.body, pose[None], flipped[None], chain)
                angles = hung[:, own] if len(hung) else flipped[None, own]
                base[own] = angles[0]
                distinct = distinct_alternatives(
                    self.body, flipped, chain, angles, np.zeros((1, len(angles))),
                    apart=0.08, most=self.settings.alternatives,
                )  # fmt: skip
                alternatives.append(distinct)
            result.append((base, alternatives))
        return result

    def _swap(self, pose: Array, pair: tuple[str, str]) -> tuple[Array, list[Alternatives]] | None:
        """The pose with two limbs each on the other's image, in all ways; None if they reach not.

        Limbs that cross in the image are easily taken for each other, and one alone that changes
        sides leaves its own place empty.
        """
        base, alternatives = pose.copy(), []
        for chain, sibling in (pair, pair[::-1]):
            own = chain_dofs(self.body, chain)
            hung, _ = rehang_chain(self.body, pose[None], pose[None], chain, image_of=sibling)
            if len(hung) == 0:
                return None
            base[own] = hung[0, own]
            distinct = distinct_alternatives(
                self.body, pose, chain, hung[:, own], np.zeros((1, len(hung))),
                apart=0.08, most=self.settings.alternatives,
            )  # fmt: skip
            alternatives.append(distinct)
        return base, alternatives

    def _rate(
        self,
        pose: Array,
        alternatives: list[Alternatives],
        observation: Observation,
        textures: Textures | None,
        row: int,
    ) -> tuple[list[Array], float]:
        """Energy change that each alternative makes alone, and the energy of the pose itself."""
        poses = [pose[None]]
        for chain in alternatives:
            block = np.repeat(pose[None], len(chain.angles), axis=0)
            block[:, chain_dofs(self.body, chain.chain)] = chain.angles
            poses.append(block)
        everything = np.concatenate(poses)
        value = self._value(everything, observation, textures, np.full(len(everything), row))
        ends = np.cumsum([1] + [len(c.angles) for c in alternatives])
        return [value[a:b] - value[0] for a, b in pairwise(ends)], float(value[0])

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
        log_weights = log_priors[usable] - s.temperature * solved.value[usable]
        kept = choose_hypotheses(
            self._relative_joints(solved.x[usable]),
            log_weights,
            s.max_hypotheses,
            same=s.hypothesis_merge_distance,
        )
        weights = kept.log_weights - np.logaddexp.reduce(kept.log_weights)
        if predicted is not None:
            rows = usable[kept.chosen]
            weights = weights + inherited_log_weights(
                solved.x[rows], _covariances(solved.hessian[rows], solved.free[rows]),
                np.argsort(-weights, kind='stable'), predicted,
            )  # fmt: skip
            weights -= np.logaddexp.reduce(weights)
        weights = np.maximum(weights, s.least_log_weight)
        weights -= np.logaddexp.reduce(weights)
        order = np.argsort(-weights, kind='stable')
        rows = usable[kept.chosen[order]]
        poses = solved.x[rows]
        frames = forward(self.body.skeleton, poses)
        textures = None
        if observation.intensity is not None:
            textures = capture_textures(self.body, self.camera, frames, observation.intensity)
        image = self._likelihood.image_energy(frames, observation, derivatives=False)
        filtered = _covariances(solved.hessian[rows], solved.free[rows])
        covariances = filtered
        if _shows_shape(observation):
            covariances = self._honest_covariances(poses, frames, solved.free[rows], observation)
        self._modes = Modes(
            poses, velocities[rows], covariances, filtered, weights[order], -image.value, textures
        )
        self._outline_costs = image.costs

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
        return _covariances(hessian - (1.0 - self.settings.image_trust) * shape.hessian, free)

    def _judge(self, observation: Observation) -> None:
        """Whether the track is lost: how much of the image no mode explains."""
        s = self.settings
        shares = [0.0]
        if self._outline_costs.size:
            t = s.likelihood.coverage
            most = 0.5 * t.weight / self._outline_costs.shape[1] * t.scale**2
            limit = UNEXPLAINED**2 / (UNEXPLAINED**2 + t.scale**2)
            shares.append(float((self._outline_costs > limit * most).mean(1).min()))
        if observation.keypoints is not None:
            shares.append(self._unexplained_keypoints(observation.keypoints))
        self.misfit = max(shares)
        self._bad_images = self._bad_images + 1 if self.misfit > s.lost_misfit else 0
        self.status = Status.LOST if self._bad_images >= s.lost_images else Status.TRACKING

    def _unexplained_keypoints(self, keypoints: Keypoints) -> float:
        """Share of the keypoints that the best mode does not explain."""
        seen = np.flatnonzero(np.isfinite(keypoints.pixels).all(1))
        if len(seen) == 0:
            return 0.0
        which = self.body.skeleton.joint_index([keypoints.names[i] for i in seen])
        pixels = self.camera.project(self.body.joint_positions(self.modes.poses)[:, which])
        error = pixels - keypoints.pixels[seen]
        precisions = np.linalg.inv(keypoints.covariances[seen])
        sigma = self.settings.likelihood.joints.sigma
        distance = np.einsum('kna,nab,knb->kn', error, precisions, error) / sigma**2
        return float((~(distance < UNEXPLAINED**2)).mean(1).min())

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
    def _searches(self) -> dict[str, ChainSearch]:
        s = self.settings
        return {
            chain: ChainSearch(self.body, self.camera, s.likelihood, chain, s.search)
            for chain in CHAINS[:4]
            if chain in self.body.chains
        }

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
        pixels = self.camera.project(self.body.joint_positions(self._modes.poses)).reshape(-1, 2)
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

    def _relative_joints(self, poses: Array) -> Array:
        joints = self.body.joint_positions(poses)
        return joints - joints[:, :1]


def _shows_shape(observation: Observation) -> bool:
    maps = (observation.distance, observation.edges, observation.flow, observation.intensity)
    return any(m is not None for m in maps)


def _some_minima(minima: Minimum, which: Index) -> Minimum:
    return Minimum(*(getattr(minima, f.name)[which] for f in fields(Minimum)))


def _joined_minima(a: Minimum, b: Minimum) -> Minimum:
    return Minimum(
        *(np.concatenate([getattr(a, f.name), getattr(b, f.name)]) for f in fields(Minimum))
    )


def _joined_candidates(a: _Candidates, b: _Candidates) -> _Candidates:
    """Both; the textures of the second contain those of the first."""
    joined = {
        name: np.concatenate([getattr(a, name), getattr(b, name)])
        for name in ('poses', 'parents', 'log_priors', 'centres', 'jumped', 'texture_rows')
    }
    return _Candidates(textures=b.textures, **joined)


def _inverses(matrices: Array) -> Array:
    return np.asarray(np.linalg.inv(matrices), dtype=np.float64)


def _resting(poses: Array, gradient: Array, body: Body) -> NDArray[np.bool_]:
    at_lower = (poses <= body.lower) & (gradient > 0)
    result: NDArray[np.bool_] = at_lower | ((poses >= body.upper) & (gradient < 0))
    return result


def _covariances(hessians: Array, free: NDArray[np.bool_]) -> Array:
    """Inverse Hessians on the free variables.

    A variable at its limit has a deviation of 3 degrees, and none one above `WIDEST`.
    """
    h = hessians.copy()
    rows, dofs = np.nonzero(~free)
    h[rows, dofs, :] = 0.0
    h[rows, :, dofs] = 0.0
    h[rows, dofs, dofs] = 0.05**-2.0
    diagonal = np.arange(h.shape[1])
    h[:, diagonal, diagonal] += WIDEST**-2.0
    result = np.linalg.inv(0.5 * (h + h.transpose(0, 2, 1)))
    return 0.5 * (result + result.transpose(0, 2, 1))
