"""From a silhouette to a mixture over full poses: descriptor, experts, encoding and root.

    mask, image -> centred view -> descriptor -> experts -> mixture over targets
    mask -> bounding box -> root of each component -> mixture over poses

One object and one file contain everything that is learned. Rule (1) (BME 2.1) can propagate the
mixture of the previous image, with a model of p(x_t | x_t-1, r_t) trained for one time step.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike

from hmt_ros.body import Body, Camera
from hmt_ros.body.learned_file import (
    Arrays,
    body_of,
    check_covariances,
    header,
    nested,
    parameters_of,
    part,
    read_model,
    require,
    write_model,
)
from hmt_ros.body.motion_prior import motion_prior
from hmt_ros.core import elementary
from hmt_ros.experts.conditional_density import ConditionalDensity, stored_model
from hmt_ros.experts.density_propagation import joined, propagate
from hmt_ros.experts.descriptor.contour import PersonBlob, centred_view, person_blob
from hmt_ros.experts.descriptor.silhouette_descriptor import (
    ANGULAR_BINS,
    FIXED_FEATURES,
    MAP_SIDE,
    MOMENTS,
    PAIR_BINS,
    RADIAL_BINS,
    SilhouetteDescriptor,
    SilhouetteParts,
    silhouette_parts,
)
from hmt_ros.experts.pose_encoding import PoseEncoding
from hmt_ros.experts.root_placement import (
    SIZE_SPREAD,
    place_roots,
    placed_gaussians,
)
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.arrays import Array, Image
from hmt_ros.inference.linear_algebra import inverse, product, singular_values
from hmt_ros.inference.reduction import reduced

FOLDER = Path(__file__).resolve().parent / 'models'
# Name of the shipped model, which was learned from motion capture.
SHIPPED = 'silhouettes'

KIND = 'pose_predictor'
MAX_COMPONENTS = 8
MIN_WEIGHT = 1e-3  # weight below which a component is dropped
# Rate of the training sequences of rule (1), Hz, and their time step, s.
RATE = 30.0
STEP = 1.0 / RATE
ADDED_VARIANCE = 1e-9  # variance added to each coordinate of poses, m^2 and rad^2
# Methods of propagating a mixture: rule (1), or none.
BY_EXPERTS, WITHOUT_PROPAGATION = 'experts', 'none'
PROPAGATIONS = (BY_EXPERTS, WITHOUT_PROPAGATION)
# Rate at which the past is discarded, 1/s, so that a lost track recovers. Chosen by hand.
FORGETTING_RATE = 5.0
# Maximum condition number of a target basis; maximum deviation of a short length from its usual
# value, m.
MAX_CONDITION, MAX_OFFSET = 1e12, 0.06


@dataclass(frozen=True, eq=False)
class Prediction:
    """The prediction from a silhouette.

    Attributes:
        mixture: Mixture over poses, heaviest component first.
        place: Person in the image, with remarks for the user.
        support: Similarity of the silhouette to the training data, from 0 to 1.
    """

    mixture: GaussianMixture
    place: PersonBlob
    support: float


class PosePredictor:
    """Predicts mixtures over the poses of a body from silhouettes.

    Args:
        model: Trained model of p(z | descriptor).
        target_basis: (D, D) matrix B; the models predict z = B' x instead of a target x.
        equilibrium: Prior p(x) of targets, a mixture with one component.
        dynamics: Trained model of p(z | previous z, descriptor), or None.
        notes: Card of the file, serialisable as JSON.

    Raises:
        ValueError: the parts do not match.
    """

    def __init__(
        self,
        body: Body,
        descriptor: SilhouetteDescriptor,
        model: ConditionalDensity,
        target_basis: Array,
        equilibrium: GaussianMixture,
        dynamics: ConditionalDensity | None = None,
        notes: Mapping[str, Any] | None = None,
    ) -> None:
        self.encoding = PoseEncoding(body)
        self.descriptor = descriptor
        self.model = model
        self.equilibrium = equilibrium
        self.dynamics = dynamics
        self.notes = dict(notes or {})
        size = self.encoding.size
        self.target_basis = target_basis
        _check_fit('model', model, descriptor.size, size)
        if dynamics is not None:
            _check_fit('dynamics', dynamics, size + descriptor.size, size)
        require(
            target_basis.shape == (size, size) and np.isfinite(target_basis).all(),
            f'target_basis must be finite and ({size}, {size}), saw {target_basis.shape}',
        )
        right = (len(equilibrium), equilibrium.dimension) == (1, size)
        require(right, f'equilibrium must be one component over {size} numbers')
        sizes = singular_values(target_basis)[1]
        require(sizes[0] <= MAX_CONDITION * sizes[-1], 'target_basis is singular')
        self._from_basis = np.asarray(inverse(target_basis), dtype=np.float64)

    @property
    def body(self) -> Body:
        """Body of the predicted poses."""
        return self.encoding.body

    def with_body(self, body: Body) -> PosePredictor:
        """Return the predictor for a body with new segment lengths or a new level.

        Raises:
            ValueError: the body has other degrees of freedom.
        """
        _check_body(body, self.body.dof_names, f'this predictor, of {self.body.name},')
        return PosePredictor(
            body,
            self.descriptor,
            self.model,
            self.target_basis,
            self.equilibrium,
            self.dynamics,
            self.notes,
        )

    def predict(
        self, mask: ArrayLike, camera: Camera, image: Image | None = None
    ) -> GaussianMixture:
        """Mixture over poses of the person in a mask (H, W); see `observe`."""
        return self.observe(mask, camera, image=image).mixture

    def observe(
        self,
        mask: ArrayLike,
        camera: Camera,
        previous: GaussianMixture | None = None,
        interval: float = STEP,
        *,
        propagation: str = WITHOUT_PROPAGATION,
        max_components: int = MAX_COMPONENTS,
        size_spread: float = SIZE_SPREAD,
        image: Image | None = None,
    ) -> Prediction:
        """Predict poses from the silhouette of a person.

        Args:
            mask: (H, W) nonzero in the foreground.
            previous: Previous mixture over poses, to be propagated; None to use the image alone.
            interval: Time since `previous`, s.
            propagation: one of `PROPAGATIONS`.
            max_components: Maximum number of components; the heaviest are kept.
            size_spread: Relative standard deviation of the person's size; 0 if the body has the
                person's lengths.
            image: (H, W, 3) BGR image, for edges inside the mask; None if there is no image.

        Raises:
            NoSilhouetteError: the mask has no person.
            ValueError: the mask or the image differs in size from the camera's image.
        """
        seen = np.asarray(mask)
        require(
            seen.shape == (camera.height, camera.width),
            f'the mask has shape {seen.shape}, but the camera gives '
            f'({camera.height}, {camera.width})',
        )
        right = image is None or image.shape == (*seen.shape, 3)
        require(right, f'the image must have the size of the mask, {seen.shape}, and 3 channels')
        blob = person_blob(seen)
        descriptor = self.described(blob, camera, image)
        support = float(self.model.support(descriptor[None])[0])
        targets = self.targets_after(
            descriptor, previous, interval, propagation=propagation, max_components=max_components
        )
        placement = place_roots(
            self.encoding,
            camera,
            blob,
            targets.means,
            targets.covariances,
            size_spread=size_spread,
        )
        means, covariances = placed_gaussians(
            self.encoding, targets.means, targets.covariances, placement
        )
        covariances += ADDED_VARIANCE * np.eye(self.encoding.size)
        mixture = GaussianMixture(targets.weights, means, covariances)
        return Prediction(mixture, blob, support)

    def described(self, blob: PersonBlob, camera: Camera, image: Image | None = None) -> Array:
        """Compute the descriptor (p,) of a person."""
        grey = None
        if image is not None:
            grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
        view, seen = centred_view(blob, camera, self.body.level, grey)
        parts = silhouette_parts(view, self.descriptor.points, seen)
        return np.asarray(self.descriptor.describe([parts])[0])

    def targets_after(
        self,
        descriptor: ArrayLike,
        previous: GaussianMixture | None = None,
        interval: float = STEP,
        *,
        propagation: str = WITHOUT_PROPAGATION,
        max_components: int = MAX_COMPONENTS,
    ) -> GaussianMixture:
        """Predict the mixture over targets (D,) for one descriptor, heaviest component first.

        Args:
            descriptor: (p,).

        Raises:
            ValueError: the propagation is unknown, or its model is missing.
        """
        row = np.asarray(descriptor, dtype=np.float64)
        found = _heaviest(self.model.predict(row[None])[0], max_components)
        if previous is None or propagation == WITHOUT_PROPAGATION:
            return _transformed(found, self._from_basis)
        forgotten = -float(elementary.expm1(-FORGETTING_RATE * interval))
        if propagation != BY_EXPERTS:
            raise ValueError(f'no propagation {propagation!r}, wanted one of {PROPAGATIONS}')
        if self.dynamics is None:
            raise ValueError('the predictor has no model for rule (1): train it with --dynamics')
        # The model predicts over one `STEP`; the motion prior of the body covers the time before.
        before = self._to_targets(self._expected(previous, max(interval - STEP, 0.0)))
        # Steep experts would let the covariance grow without bound from step to step, so it is kept
        # below the covariance of p(x).
        known = inverse(before.covariances) + inverse(self.equilibrium.covariances)
        before = GaussianMixture(before.weights, before.means, inverse(known))
        after = propagate(
            self.dynamics,
            _transformed(before, self.target_basis),
            row,
            without_past=found,
            n_components=max_components,
        )
        whole = joined([(1.0 - forgotten, after), (forgotten, found)])
        whole = _heaviest(reduced(whole, max_components), max_components)
        return _transformed(whole, self._from_basis)

    def poses_at(self, descriptor: Array, root: Array, max_components: int) -> tuple[Array, Array]:
        """Predict poses (K, d) with a known root (3,), heaviest first, and their weights (K,)."""
        targets = self.targets_after(descriptor, max_components=max_components)
        roots = np.repeat(root[None], len(targets), axis=0)
        return self.encoding.decode(targets.means, roots), targets.weights

    def _expected(self, poses: GaussianMixture, interval: float) -> GaussianMixture:
        """Predict the mixture over poses after an interval, s, by the motion prior of the body."""
        if interval <= 0.0:
            return poses
        prior = motion_prior(self.body)
        return GaussianMixture(
            poses.weights, *prior.predict_poses(poses.means, poses.covariances, interval)
        )

    def _to_targets(self, poses: GaussianMixture) -> GaussianMixture:
        """Convert a mixture over poses to a mixture over targets."""
        slopes = self.encoding.encoding_jacobians(poses.means)
        covariances = product(product(slopes, poses.covariances), slopes.transpose(0, 2, 1))
        # Unit vectors have no variance along themselves, so the covariance would be singular.
        covariances += ADDED_VARIANCE * np.eye(self.encoding.size)
        return GaussianMixture(poses.weights, self.encoding.encode(poses.means), covariances)

    def to_arrays(self) -> Arrays:
        """The arrays of a file."""
        body = self.body
        parameters = {
            'body': body.name,
            'dof_names': list(body.dof_names),
            'lengths': body.segment_lengths,
            'points': self.descriptor.points,
        }
        arrays: Arrays = header(KIND, parameters)
        arrays |= nested('descriptor', self.descriptor.to_arrays())
        arrays |= nested('model', self.model.to_arrays())
        if self.dynamics is not None:
            arrays |= nested('dynamics', self.dynamics.to_arrays())
        arrays['target_basis'] = self.target_basis
        arrays['equilibrium_mean'] = self.equilibrium.means[0]
        arrays['equilibrium_covariance'] = self.equilibrium.covariances[0]
        return arrays

    @classmethod
    def from_arrays(cls, arrays: Arrays, body: Body | None = None) -> PosePredictor:
        """Build the predictor that `to_arrays` and a card describe; see `load`.

        Raises:
            ValueError, LookupError, TypeError: arrays or parameters are missing or invalid, or the
                body differs.
        """
        parameters = parameters_of(arrays)
        if body is None:
            body, own = body_of(parameters), parameters['lengths']
            usual = body.segment_lengths
            # Some lengths are offsets near zero, of either sign.
            allowed = {k: 0.9 * x if x > MAX_OFFSET else MAX_OFFSET for k, x in usual.items()}
            human = all(abs(own[k] - x) <= allowed[k] for k, x in usual.items())
            require(human and own.keys() == usual.keys(), 'nobody has its lengths')
            body = body.with_segment_lengths(own)
        _check_body(body, parameters['dof_names'], 'the predictor')
        descriptor = SilhouetteDescriptor.from_arrays(
            part('descriptor', arrays), parameters['points']
        )
        dynamics = part('dynamics', arrays)
        equilibrium = GaussianMixture(
            np.ones(1), arrays['equilibrium_mean'][None], arrays['equilibrium_covariance'][None]
        )
        check_covariances('equilibrium', equilibrium.covariances)
        return cls(
            body,
            descriptor,
            stored_model(part('model', arrays)),
            arrays['target_basis'],
            equilibrium,
            stored_model(dynamics) if dynamics else None,
            parameters_of(arrays, 'card'),
        )

    def answer(self, given: Array) -> GaussianMixture:
        """Predict targets (D,) from silhouette parts; uses the dynamics if available."""
        contexts, *others = np.split(
            given, np.cumsum([-FIXED_FEATURES, PAIR_BINS, MAP_SIDE * MAP_SIDE, MOMENTS])
        )
        parts = SilhouetteParts(contexts.reshape(-1, RADIAL_BINS * ANGULAR_BINS), *others)
        row = self.descriptor.describe([parts])[0]
        found = self.model.answer(row)
        if self.dynamics is not None:
            found = self.dynamics.answer(np.concatenate([found.mean(), row]))
        return _transformed(found, self._from_basis)

    def save(self, path: str | Path) -> Path:
        """Write the predictor to an .npz file, with its notes as the card, and return its path."""
        read = partial(self.from_arrays, body=self.body)
        # Random numbers from 0 to 1, because most values of silhouette parts are in this range.
        size = self.descriptor.points * RADIAL_BINS * ANGULAR_BINS + FIXED_FEATURES
        example = np.random.default_rng(0).integers(0, 64, size) / 64.0
        return write_model(path, self, read, self.notes, example)

    @classmethod
    def load(cls, path: str | Path, body: Body | None = None) -> PosePredictor:
        """Read a predictor that `save` wrote.

        Args:
            body: Body of the person, with the degrees of freedom of the predictor. None selects the
                shipped body named in the file, with the lengths in the file.

        Raises:
            FileNotFoundError: the file does not exist.
            ValueError: the file is not a predictor, has an unsupported version or a different body,
                or is invalid.
        """
        return read_model(path, KIND, partial(cls.from_arrays, body=body))


def load_predictor(model: str | Path = SHIPPED) -> PosePredictor:
    """Load a shipped predictor by its name, or a predictor from a file that `train` wrote.

    Raises:
        FileNotFoundError: the argument is neither a shipped name nor an existing file.
        ValueError: the file is not a predictor, or has an unsupported version or a different body.
    """
    known = sorted(path.stem for path in FOLDER.glob('*.npz'))
    if str(model) in known:
        return PosePredictor.load(FOLDER / f'{model}.npz')
    if not Path(model).is_file():
        raise FileNotFoundError(f'{model}: no such model; wanted a file, or one of {known}')
    return PosePredictor.load(model)


def _check_body(body: Body, names: Sequence[str], what: str) -> None:
    require(
        tuple(names) == body.dof_names,
        f'{what} is for a body of {len(names)} degrees of freedom, but {body.name} has '
        f'{body.dimension} or others: use that body or train again',
    )


def _check_fit(what: str, model: ConditionalDensity, inputs: int, outputs: int) -> None:
    require(
        (model.n_inputs_, model.n_outputs_) == (inputs, outputs),
        f'the {what} has {model.n_inputs_} inputs and {model.n_outputs_} outputs, wanted '
        f'{inputs} and {outputs}',
    )


def _heaviest(mixture: GaussianMixture, count: int) -> GaussianMixture:
    """Return the heaviest components, normalised."""
    ordered = mixture.normalised().sorted()
    kept = max(int((ordered.weights >= MIN_WEIGHT).sum()), 1)
    return ordered[: min(kept, count)].normalised()


def _transformed(mixture: GaussianMixture, basis: Array) -> GaussianMixture:
    """Convert a mixture over x to a mixture over B' x."""
    covariances = product(product(basis.T, mixture.covariances), basis)
    covariances = 0.5 * (covariances + covariances.transpose(0, 2, 1))
    return GaussianMixture(mixture.weights, product(mixture.means, basis), covariances)
