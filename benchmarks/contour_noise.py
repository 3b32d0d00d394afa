"""contour_noise: distances of people's contours from the model's, in metres.

The body, with the true lengths, is fitted to the true joints of rendered clips of another body; its
flesh is fitted once to the true silhouettes of all clips, with a Gaussian prior on its growth. Then
the signed distances, positive outwards, of uncovered contour points to the outline of the
subtracted silhouettes give robust deviations by part, at the sides and in front or behind, and
correlations along the contour: the content of `hmt_ros/image/contour_noise.yaml`.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.clips import with_file
from benchmarks.command import benchmark_parser, run_benchmark, told
from benchmarks.machine import description
from benchmarks.truth_fits import QUICK, SUBTRACTED, TRUE, best_poses, fitted, silhouettes_of
from hmt_ros.body import Body, Camera
from hmt_ros.body.kinematics import forward
from hmt_ros.body.shape import GROWTH_SIGMAS, ShapeSpace
from hmt_ros.core import mark_visibility, trace_contour
from hmt_ros.image.likelihood import ImageLikelihood, LikelihoodSettings, ObservedImage
from hmt_ros.image.observation import Observation, observe
from hmt_ros.image.pose_energy import PoseEnergy
from hmt_ros.image.surface import empty_contour, flesh_table_of
from hmt_ros.image.terms.image_term import TermSettings
from hmt_ros.inference.energy import Derivatives
from hmt_ros.tracking.shape_estimation import ShapeEstimate

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

CLIPS = ('walk', 'charleston', 'wander', 'shoot', 'signals', 'scoop', 'kick', 'exercise')
EVERY = 12  # interval of the used images
QUICK_EVERY, QUICK_STEPS = 60, 1
# Settings of the coverage term for fitting the flesh to the true silhouettes.
TERM = TermSettings(30.0, 3.0, 8.0)
SETTINGS = LikelihoodSettings.of_terms(coverage=TERM)
MOST_STEPS = 25
# Maximum step, and step of a central difference, in standard deviations over people.
LARGEST_STEP, DIFFERENCE = 0.8, 0.3
CONVERGED = 0.002  # relative decrease of the energy
AHEAD = 0.7  # |sine| of the angle around a ring from which a point is in front or behind
MARGIN = 2  # px from the border of an image
RINGS_APART = (1, 2, 3)
FURTHEST = 0.05  # bound to which distances are clipped for correlations, m
HEADER = (
    'How far the contour of a person lies from that of the model at the true pose, as standard '
    'deviations in m: at the sides of a part, along the x axis of its segment, and in front and '
    'behind, along y.',
    'Learned by `python -m benchmarks contour_noise` from {clips} rendered clips of another body '
    "than the model's (MuJoCo's humanoid, moved by motion capture of CMU, mocap.cs.cmu.edu): "
    "robust deviations of the subtracted silhouettes' outlines from the model's contours, the "
    'flesh fitted once to all clips. Neighbouring points err together: the correlation is '
    '{first:.2f} from one ring of a part to the next, {second:.2f} and {third:.2f} over two and '
    'three, so that {points:.0f} points on the outline are worth {worth:.0f}.',
)


class Distances(NamedTuple):
    """Distances of contour points to outlines: M points.

    Attributes:
        values: (M,) signed distances, m, positive if the model is larger.
        parts: (M,) index of the part.
        ahead: (M,) whether the point is in front of or behind its part, not at a side.
        rings: (M,) ring of the point; the second points of rings have their own numbers.
        images: (M,) number of the image.
    """

    values: Array
    parts: Index
    ahead: Mask
    rings: Index
    images: Index


@dataclass(frozen=True, eq=False)
class Posed:
    """A clip of T images, with the poses nearest to the truth.

    Attributes:
        body: body with the true lengths.
        camera: camera of the clip.
        poses: (T, d) poses nearest to the truth.
        observations: observations of the true silhouettes.
        masks: silhouettes from background subtraction.
    """

    body: Body
    camera: Camera
    poses: Array
    observations: list[Observation]
    masks: list[Mask]


def posed(folder: Path, every: int = EVERY) -> Posed:
    """Reads a clip.

    Raises:
        ValueError: the clip can not be read, or lacks true silhouettes or the empty scene.
    """
    clip, body, starts = fitted(folder)
    silhouettes = silhouettes_of(clip, every)
    if {SUBTRACTED, TRUE} - set(silhouettes):
        raise ValueError(f'{folder}: wanted true silhouettes and the empty scene')
    pairs = zip(clip.images[::every], silhouettes[TRUE], strict=True)
    observations = [observe(*pair, wanted=('coverage',)) for pair in pairs]
    poses = best_poses(body, clip, clip.stamps[::every], starts)
    return Posed(body, clip.camera, poses, observations, silhouettes[SUBTRACTED])


def fitted_growth(clips: Sequence[Posed], most_steps: int = MOST_STEPS) -> Array:
    """Growth (G, 5) of the groups of parts that fits the true silhouettes at fixed poses.

    Levenberg-Marquardt, with a Gaussian prior of standard deviations `GROWTH_SIGMAS`. The gradient
    is computed by differences, because derivatives do not include changes of visibility along the
    contour.
    """
    groups = len(ShapeSpace(clips[0].body).groups)
    spread = np.tile(np.array([*GROWTH_SIGMAS.values()]), groups)
    growth, damping = np.zeros(len(spread)), 0.1
    least, (gradient, curvature) = energy_of(clips, growth), derivatives_of(clips, growth)
    for _ in range(most_steps):
        damped = curvature + damping * np.diag(np.diagonal(curvature))
        step = -np.linalg.solve(damped, gradient)
        furthest = float(np.abs(step / spread).max())
        step *= min(1.0, LARGEST_STEP / max(furthest, 1e-12))
        energy = energy_of(clips, growth + step)
        if energy < least:
            growth, damping = growth + step, 0.3 * damping
            if least - energy < CONVERGED * least:
                break
            least, (gradient, curvature) = energy, derivatives_of(clips, growth)
        else:
            damping *= 5.0
    return growth.reshape(groups, -1)


def energy_of(clips: Sequence[Posed], growth: Array) -> float:
    """Energy of growth (G * 5,) from the true silhouettes of all clips and the prior."""
    spread = np.tile(np.array([*GROWTH_SIGMAS.values()]), len(growth) // len(GROWTH_SIGMAS))
    result = 0.5 * float(((growth / spread) ** 2).sum())
    for clip in clips:
        body = grown(clip.body, growth)
        likelihood = ImageLikelihood(body, clip.camera, SETTINGS)
        for pose, observation in zip(clip.poses, clip.observations, strict=True):
            image = PoseEnergy(likelihood, (ObservedImage(likelihood, observation),))
            result += float(image.energy(pose[None], derivatives=Derivatives.NONE).value[0])
    return result


def derivatives_of(clips: Sequence[Posed], growth: Array) -> tuple[Array, Array]:
    """Gradient (G * 5,), by central differences, and Gauss-Newton Hessian of the energy."""
    spread = np.tile(np.array([*GROWTH_SIGMAS.values()]), len(growth) // len(GROWTH_SIGMAS))
    gradient, curvature = np.empty(len(growth)), np.diag(spread**-2.0)
    for i, step in enumerate(DIFFERENCE * np.diag(spread)):
        rise = energy_of(clips, growth + step) - energy_of(clips, growth - step)
        gradient[i] = rise / (2.0 * step[i])
    for clip in clips:
        body = grown(clip.body, growth)
        grows = slice(ShapeSpace(body).lengths, None)
        likelihood, estimate = ImageLikelihood(body, clip.camera, SETTINGS), ShapeEstimate(body)
        for pose, observation in zip(clip.poses, clip.observations, strict=True):
            found = estimate.linearised(likelihood, observation, pose[None])
            curvature += found.curvature[0, grows, grows]
    return gradient, curvature


def grown(body: Body, growth: Array) -> Body:
    """The body with growth (G, 5), or flat, applied to its groups of parts."""
    space = ShapeSpace(body)
    return space.moved(np.concatenate([np.zeros(space.lengths), np.ravel(growth)]))


def contour_distances(body: Body, camera: Camera, poses: Array, masks: Sequence[Mask]) -> Distances:
    """Distances of uncovered contour points from the outlines of silhouettes, for all poses."""
    columns, origins = forward(body.skeleton, poses).by_pose()
    count, every = len(body.flesh.ring_parts), np.ones(len(body.shapes), dtype=np.bool_)
    # With deviations of 0 at the sides and 1 ahead, the noise of a point is its share of ahead.
    flesh = flesh_table_of(body)._replace(ring_noise=np.tile([0.0, 1.0], (count, 1)))
    height, width = masks[0].shape
    found = []
    for n, mask in enumerate(masks):
        contour = empty_contour(count)
        trace_contour(flesh, every, camera.lens, columns[n], origins[n], contour)
        mark_visibility(
            flesh,
            every,
            columns[n],
            origins[n],
            contour.parts,
            contour.points,
            contour.valid,
            contour.covered,
            contour.hidden,
        )
        use = np.flatnonzero(contour.valid & ~contour.covered)
        at, row = np.round(contour.pixels[use]).astype(np.intp).T
        inner = (at >= MARGIN) & (at < width - MARGIN) & (row >= MARGIN) & (row < height - MARGIN)
        use, at, row = use[inner], at[inner], row[inner]
        away = signed_distance(np.ascontiguousarray(mask).view(np.uint8))
        magnification = np.array([camera.magnification(z) for z in contour.points[use, 2].tolist()])
        ahead = contour.noise[use] > AHEAD
        rings = np.where(use < count, use, use + count)
        values = away[row, at] / magnification
        found.append((values, contour.parts[use], ahead, rings, np.full(len(use), n)))
    return Distances(*(np.concatenate(columns) for columns in zip(*found, strict=True)))


def joined(found: Sequence[Distances]) -> Distances:
    """Distances of several clips, with consecutive image numbers."""
    images, before = [], 0
    for own in found:
        images.append(own.images + before)
        before += 1 + int(own.images.max(initial=-1))
    columns = (np.concatenate([own[i] for own in found]) for i in range(4))
    return Distances(*columns, np.concatenate(images))


def robust_deviation(values: Array) -> float:
    """Standard deviation of a Gaussian with the median absolute deviation of the values."""
    return float(1.4826 * np.median(np.abs(values - np.median(values))))


def correlation(found: Distances, apart: int) -> float:
    """Correlation of distances on the same part of an image, `apart` rings apart."""
    places = {place: i for i, place in enumerate(zip(found.images, found.rings, strict=True))}
    pairs = [
        (i, other)
        for (image, ring), i in places.items()
        if (other := places.get((image, ring + apart))) is not None
        and found.parts[i] == found.parts[other]
    ]
    first, second = np.clip(found.values[np.array(pairs, dtype=np.intp)], -FURTHEST, FURTHEST).T
    return float((first * second).mean() / (first * first).mean())


def independent_points(points: float, correlations: Sequence[float]) -> float:
    """Effective number of independent points, if neighbouring ones are correlated."""
    return points / (1.0 + 2.0 * sum(correlations))


def groups_of(body: Body) -> list[str]:
    """Name of the group of each part, without sides."""
    names = [body.skeleton.segment_names[shape.segment] for shape in body.shapes]
    return [name.removeprefix('left_').removeprefix('right_') for name in names]


def measure(clips: Path | None = None, *, quick: bool = False) -> dict[str, Any]:
    """Deviations by group of parts, correlations, and fitted growth.

    Args:
        clips: folder of the clips; None means the development clips.
        quick: a few images of one clip, and one step of the fit.

    Raises:
        FileNotFoundError: a clip is missing.
        ValueError: a clip can not be used.
    """
    wanted = CLIPS[:QUICK] if quick else CLIPS
    folders = with_file(wanted, clips, 'truth.npz')
    every, steps = (QUICK_EVERY, QUICK_STEPS) if quick else (EVERY, MOST_STEPS)
    known = [posed(folder, every) for folder in told('contour_noise', folders)]
    growth = fitted_growth(known, steps)
    found = joined(
        [contour_distances(grown(x.body, growth), x.camera, x.poses, x.masks) for x in known]
    )
    source = {'machine': description(), 'clips': list(wanted)}
    return {**source, **summary(found, known[0].body, growth)}


def summary(found: Distances, body: Body, growth: Array) -> dict[str, Any]:
    """Numbers by group of parts, and correlations."""
    names = np.array(groups_of(body))[found.parts]
    groups = ShapeSpace(body).groups
    rows = {}
    for name, own in zip(groups, growth, strict=True):
        row: dict[str, Any] = {'growth': own.tolist()}
        for side, at in (('side', ~found.ahead), ('ahead', found.ahead)):
            values = found.values[(names == name) & at]
            row[side] = {
                'points': len(values),
                'median': float(np.median(values)) if len(values) else None,
                'deviation': robust_deviation(values) if len(values) else None,
            }
        rows[name] = row
    points = len(found.values) / len(np.unique(found.images))
    correlations = [correlation(found, apart) for apart in RINGS_APART]
    return {
        'groups': rows,
        'points': points,
        'correlations': correlations,
        'independent_points': independent_points(points, correlations),
    }


def as_yaml(result: dict[str, Any]) -> str:
    """Text of the file for the likelihood; `other` parts get the median over the groups."""
    rows = {
        name: [row[side]['deviation'] for side in ('side', 'ahead')]
        for name, row in result['groups'].items()
    }
    whole = np.array([*rows.values()], dtype=np.float64)
    rows['other'] = np.nanmedian(whole, axis=0).tolist()
    first, second, third = result['correlations']
    numbers = {
        'clips': len(result['clips']), 'first': first, 'second': second, 'third': third,
        'points': result['points'], 'worth': result['independent_points'],
    }  # fmt: skip
    head = '\n#\n'.join(
        textwrap.fill(text.format(**numbers), 100, initial_indent='# ', subsequent_indent='# ')
        for text in HEADER
    )
    # A side that was never visible gets the other side's deviation.
    lines = [
        f'{name}: [{side or ahead:.3f}, {ahead or side:.3f}]'
        for name, (side, ahead) in rows.items()
    ]
    return '\n'.join([head, *lines, ''])


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """New text of the file `hmt_ros/image/contour_noise.yaml`."""
    text = as_yaml(result)
    return f'```yaml\n{text}```' if markdown else text


def signed_distance(mask: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Distance (H, W) to the outline of a mask (H, W), 0 or 1, px, positive outside."""
    outside = cv2.distanceTransform(1 - mask, cv2.DIST_L2, 5)
    inside = cv2.distanceTransform(mask, cv2.DIST_L2, 5)
    # The outline lies between pixels, half a pixel from either side.
    return np.where(mask > 0, 0.5 - inside, outside - 0.5)


def main(argv: list[str]) -> int:
    """Runs the benchmark; reports missing clips."""
    parser = benchmark_parser(
        'contour_noise', __doc__, quick='a few images of one clip, and one step of the fit'
    )
    parser.add_argument('--clips', type=Path, metavar='DIR', help='folder of the clips')
    options = parser.parse_args(argv)
    return run_benchmark(
        'contour_noise',
        lambda: measure(options.clips, quick=options.quick),
        as_text,
        as_json=options.json,
    )
