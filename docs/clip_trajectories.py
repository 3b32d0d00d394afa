"""A window of a clip for the figures of VMS, from the filter's modes to optima.

The evidence is that of the nodes: modes, posterior weights and ancestry of the likelihood mixtures.
Motions of the window are found as in `smoother_node`, and refined on the images as in `person_node`
on request (VMS 4 to 7). The chosen window of a clip is the one in which two likely motions differ
longest.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from benchmarks.clips import ROOT, Clip, development_folder, read_clip
from benchmarks.runs import begun, stepped
from hmt_ros.body import Body
from hmt_ros.body.mirror import free_limits, without_turns
from hmt_ros.body.motion_prior import motion_prior
from hmt_ros.evaluation.track_scores import Truth
from hmt_ros.image.image_sequence import ImageSequence, SeenImage
from hmt_ros.inference.arrays import Array, Index, Mask
from hmt_ros.inference.linear_gaussian_dynamics import TrajectoryPrior
from hmt_ros.inference.mode_chain import backward_weights, drawn_paths
from hmt_ros.sessions.camera_file import read_camera
from hmt_ros.sessions.smoother_session import DIFFUSION_FACTOR
from hmt_ros.smoothing import ImageModes, Link, MotionSmoother, TrajectoryMixture
from hmt_ros.smoothing.image_refinement import refined_on_images
from hmt_ros.smoothing.likelihood import LikelihoodPart
from hmt_ros.smoothing.motion_smoother import PATH_SAMPLES, SmoothedMotions
from hmt_ros.smoothing.trajectory_refinement import refine
from hmt_ros.smoothing.variational_mixture import VariationalMixture, minimise_free_energy

# Number of images in a window, and step from window to window.
TIMES, STEP = 47, 5
# Minimum distance of a joint between different motions, m; minimum weight of a likely motion.
APART, LIKELY = 0.2, 0.1
# Added to the number of images in which motions differ, to break ties.
TIE = 1e-6
# Compared joints: torso and arms.
UPPER = (
    'neck', 'head', *(f'{side}_{x}' for x in ('shoulder', 'elbow', 'wrist', 'hand')
                      for side in ('left', 'right')),
)  # fmt: skip
SHOULDERS = ('left_shoulder', 'right_shoulder')
DEMONSTRATION, DESK = 'reach', 'desk_1'
# Numbers of samples and iterations of the free-energy descent.
SAMPLES, ITERATIONS = 16, 15


@dataclass(frozen=True, eq=False)
class ClipTrajectories:
    """A window of a clip, smoothed step by step.

    Attributes:
        clip: clip of the window.
        truth: (T, J, 3) true joints of the body, see `from_shoulders`; unknown ones are NaN.
        inputs: inputs of the tracker, see `benchmarks.runs`.
        body: body of the person at the end of tracking.
        modes: the filter's modes in each of T images.
        smoother: smoother of the node, without resting feet.
        found: N motions, as in the node.
        images: the T images, as observations.
        optima: M motions; distinct ones are refined on the images.
        origins: (M,) index of the motion from which each optimum was refined.
        refined: (M,) whether each optimum is refined.
        pair: indices of the two likely optima that differ longest.
    """

    clip: Clip
    truth: Array
    inputs: str
    body: Body
    modes: Sequence[ImageModes]
    smoother: MotionSmoother
    found: SmoothedMotions
    images: ImageSequence
    optima: TrajectoryMixture
    origins: Index
    refined: Mask
    pair: tuple[int, int]

    @property
    def seconds(self) -> Array:
        """Times (T,) from the first image on, s."""
        stamps = np.array([one.stamp_ns for one in self.modes])
        return (stamps - stamps[0]) * 1e-9

    @property
    def paths(self) -> Array:
        """Poses (M, T, d) of the modes from which the optima were refined."""
        return self.found.evidence.means[self.origins]

    def joints(self, poses: Array) -> Array:
        """Joints (..., J, 3) at poses (..., d), see `from_shoulders`."""
        return from_shoulders(joints_of(self.body, poses), self.body.joint_names)

    @property
    def weights(self) -> list[Array]:
        """Weights (K_t,) of the modes of each image, given all images."""
        return backward_weights([one.link for one in self.modes])

    @property
    def paths_through(self) -> Index:
        """Mode indices (N, T) of paths drawn from the chain."""
        return drawn_paths([one.link for one in self.modes], PATH_SAMPLES, self.smoother.seed)[0]

    def observed(self, poses: Array) -> Array:
        """-log p (M,) of the images along poses (M, T, d), nats."""
        count, times, d = poses.shape
        at = np.tile(np.arange(times), count)
        value = self.images.energy(poses.reshape(-1, d), at).value
        return np.asarray(value.reshape(count, times).sum(1))

    def prior(self, count: int) -> TrajectoryPrior:
        """Prior of the states of the first images, as in the refinement."""
        of = self.origins[self.refined]
        noise = self.found.noise_factor[of].max()
        return self.smoother.dynamics.prior(np.diff(self.seconds[:count]), noise=noise)

    def spectrum(self, count: int) -> Array:
        """Eigenvalues, decreasing, of the Hessian at the optimum of the first images (VMS 7).

        It is the optimum nearest to the heaviest one for all images; velocities are integrated
        out. Metres and radians are not scaled, as in the paper.
        """
        start, part = (
            self.optima.states[self.refined][:1, :count],
            LikelihoodPart(self.images, 0, count),
        )
        found = refine(start, self.prior(count), part, *free_limits(self.body))
        d, n = self.body.dimension, start.shape[2]
        units = np.zeros((count, d, count, n))
        for t in range(count):
            units[t, :, t, :d] = np.eye(d)
        columns = found.factors[0].solve(units.reshape(count * d, count, n))
        return 1.0 / np.linalg.eigvalsh(columns[:, :, :d].reshape(count * d, count * d))

    def descent(self) -> VariationalMixture:
        """The descent of the free energy from the optima: weights, means, inflations (VMS 6)."""
        low, high = self.smoother.limits()
        weights = self.optima.weights[self.refined]
        return minimise_free_energy(
            weights / weights.sum(),
            self.optima.states[self.refined],
            [self.optima.factors[i] for i in np.flatnonzero(self.refined)],
            self.prior(TIMES),
            self.images,
            low=low,
            high=high,
            samples=SAMPLES,
            max_iterations=ITERATIONS,
        )


def clip_trajectories(name: str, inputs: str) -> ClipTrajectories:
    """Motions and optima of the window of a clip in which two likely motions differ longest.

    Raises:
        ValueError: the clip can not be read, or the filter has lost the person.
    """
    clip, true, names = read(name)
    body, modes, shown = followed(clip, inputs)
    prior = motion_prior(body)
    smoother = MotionSmoother(
        replace(prior, diffusion=DIFFUSION_FACTOR * prior.diffusion),
        *free_limits(body),
        points=body.relative_joints,
    )
    windows = [slice(a, a + TIMES) for a in range(0, len(modes) - TIMES + 1, STEP)]
    motions = [smoother.motions(modes[window]) for window in windows]
    scores = [apart(body, x.trajectories.weights, x.trajectories.means)[1] for x in motions]
    best = int(np.argmax(scores))
    window, found = windows[best], motions[best]
    stamps = [one.stamp_ns for one in modes[window]]
    images = ImageSequence.of(shown[window], stamps, of_changes=True)
    optima = refined_on_images(smoother, found, images)
    refined, origins = traced(body, optima.means, found.trajectories.means)
    weights = np.where(refined, optima.weights, 0.0) if refined.sum() > 1 else optima.weights
    pair = apart(body, weights, optima.means)[0]
    truth = np.full((TIMES, len(body.joint_names), 3), np.nan)
    known = [name for name in names if name in body.joint_names]
    into, own = ([of.index(name) for name in known] for of in (body.joint_names, names))
    truth[:, into] = np.array([true[stamp] for stamp in stamps])[:, own]
    truth = from_shoulders(truth, body.joint_names)
    return ClipTrajectories(
        clip, truth, inputs, body, modes[window], smoother, found, images, optima, origins, refined,
        pair,
    )  # fmt: skip


def read(name: str) -> tuple[Clip, Mapping[int, Array], Sequence[str]]:
    """The demonstration, or a clip of the development data, and its true joints by timestamp, m.

    Unknown joints are NaN; the truth in the clip itself may omit them.

    Raises:
        ValueError: a file can not be read.
    """
    folder = ROOT / 'bags' / name if name == DEMONSTRATION else development_folder() / name
    if name != DESK:
        clip = read_clip(folder)
        return clip, clip.truth.joints, clip.truth.joint_names
    with np.load(folder / 'truth.npz') as content:
        joints, names = content['joints'].astype(float), content['joint_names'].tolist()
        true = dict(zip(content['stamps'].tolist(), joints, strict=True))
    video = cv2.VideoCapture(str(folder / f'{name}.mp4'))
    images = [np.asarray(video.read()[1], dtype=np.uint8) for _ in true]
    camera = read_camera(folder / 'camera.yaml', images[0].shape[1::-1])
    shoulders = {t: one[[names.index(x) for x in SHOULDERS]] for t, one in true.items()}
    truth = Truth(name, SHOULDERS, shoulders)
    return Clip(folder, camera, [*true], images, truth, {}, None), true, names


def followed(clip: Clip, inputs: str) -> tuple[Body, list[ImageModes], list[SeenImage]]:
    """Body, modes and evidence of the images in which the tracker sees the person.

    Raises:
        ValueError: the chain of modes breaks.
    """
    tracker, keypoints = begun(clip, inputs, with_subject=clip.subject.is_file())
    chain: list[ImageModes] = []
    shown: list[SeenImage] = []
    identities = np.empty(0, dtype=np.int64)
    for one in stepped(clip, tracker, keypoints):
        estimate = tracker.estimate
        told, body = estimate.likelihood, estimate.body
        if one.likelihood is None or estimate.shown is None:
            continue
        if chain and not np.array_equal(told.ancestors, identities):
            raise ValueError(f'{clip.name}: the chain of modes breaks at {one.stamp} ns')
        means = told.mixture.means
        before = chain[-1].mixture.means if chain else means[:1]
        mixture = replace(told.mixture, means=without_turns(body, means, before))
        link = Link(told.posterior_weights, told.origins)
        chain.append(ImageModes(one.stamp, link, mixture, told.errors))
        shown.append(estimate.shown)
        identities = told.identities
    return body, chain, shown


def joints_of(body: Body, poses: Array) -> Array:
    """Joints (..., J, 3) at poses (..., d), camera frame, m."""
    flat = body.joint_positions(poses.reshape(-1, poses.shape[-1]))
    return flat.reshape(*poses.shape[:-1], *flat.shape[1:])


def traced(body: Body, optima: Array, motions: Array) -> tuple[Mask, Index]:
    """Whether optima (M, T, d) are refined, and the source (M,) of each among motions (N, T, d).

    The source is the same motion or, for a refined optimum, the nearest motion that is not itself
    an optimum.
    """
    away = np.linalg.norm(joints_of(body, optima)[:, None] - joints_of(body, motions), axis=-1)
    away = away.mean((2, 3))
    refined = away.min(1) > 0.0
    away[np.ix_(refined, away.min(0) == 0.0)] = np.inf
    return refined, away.argmin(1)


def from_shoulders(joints: Array, names: Sequence[str]) -> Array:
    """Joints (..., J, 3), camera frame, relative to the middle of the shoulders, m.

    All clips have the shoulders in their truth.
    """
    middle = joints[..., [names.index(name) for name in SHOULDERS], :].mean(-2, keepdims=True)
    return joints - middle


def upper_distances(body: Body, poses: Array) -> Array:
    """Distances (M, M, T, J) of joints `UPPER` from the pelvis between poses (M, T, d), m."""
    joints = joints_of(body, poses)
    joints = joints[:, :, [body.joint_names.index(name) for name in UPPER]] - joints[:, :, :1]
    return np.asarray(np.linalg.norm(joints[:, None] - joints, axis=-1))


def apart(body: Body, weights: Array, poses: Array) -> tuple[tuple[int, int], float]:
    """The two motions that differ longest, the heavier first, and their score.

    The score is the number of images times the smaller weight, and almost 0 unless both motions
    are likely.

    Args:
        weights: (M,) decreasing weights; a motion with weight 0 is not chosen.
        poses: (M, T, d).
    """
    images = (upper_distances(body, poses).max(3) > APART).sum(2)
    least = np.minimum.outer(weights, weights)
    score = np.triu(least * (images * (least >= LIKELY) + TIE), 1)
    i, j = np.unravel_index(int(np.argmax(score)), score.shape)
    return (int(i), int(j)), float(score.max())
