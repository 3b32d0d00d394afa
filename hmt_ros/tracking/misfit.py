"""Share of each cue of an image that no mode explains, from 0 to 1.

    silhouette   visible points of the model that are not foreground
    outline      samples of the silhouette's outline over `GATE_SIGMAS` from the model's outline
    keypoints    keypoints of a group over `GATE_SIGMAS` from their landmarks
    depth        energy of the visible surface, as a share of the largest possible

Clothes in the colours of the scene are not foreground, and a mask of another image misses the
person. A depth image that is late or not registered shows the background at the limbs of the model.
Most points then have the maximum cost of their kernel at any pose.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.kinematics import forward
from hmt_ros.image.joint_depths import moved_to_depth
from hmt_ros.image.likelihood import ImageLikelihood, LikelihoodSettings, ObservedImage
from hmt_ros.image.observation import Observation, observe
from hmt_ros.image.pose_energy import PoseEnergy
from hmt_ros.image.sampling import ImageMap
from hmt_ros.image.surface_points import SurfacePoints
from hmt_ros.image.terms.depth import DEPTH
from hmt_ros.image.terms.image_term import TermSettings
from hmt_ros.image.terms.keypoints import EXCHANGED, KeypointTerm
from hmt_ros.inference.arrays import Array, Mask
from hmt_ros.tracking.settings import GATE_SIGMAS

# Keys of the misfits. The misfit of the silhouette's outline is evidence about the track only.
SILHOUETTE, OUTLINE, KEYPOINTS = 'silhouette', 'outline', 'keypoints'


class Misfit(NamedTuple):
    """Unexplained share of a cue, by group.

    Attributes:
        shares: (G,) unexplained shares, from 0 to 1.
        counts: (G,) numbers of measurements; if 0, the share is unknown.
    """

    shares: Array
    counts: Array

    @property
    def share(self) -> float:
        """Unexplained share of all measurements together; 0 without measurements."""
        return float((self.shares * self.counts).sum() / max(self.counts.sum(), 1.0))


def of_silhouette(
    body: Body,
    camera: Camera,
    poses: Array,
    observation: Observation,
    term: TermSettings,
    costs: Array,
    points: SurfacePoints | None,
) -> dict[str, Misfit]:
    """Misfits of a silhouette and of its outline, given modes.

    Without a silhouette the result is empty. An empty silhouette gives a misfit of surface points
    only if there are keypoints.

    Args:
        body, camera, poses: body, camera and poses (K, d) of the modes, heaviest first.
        observation: observation of the image; its outline is used even if the likelihood leaves it
            out.
        term: settings of the energies of outline samples.
        costs: (K, M) energies of outline samples in the likelihood.
        points: visible surface points of the modes; None: unknown.
    """
    found: dict[str, Misfit] = {}
    foreground, beliefs = observation.foreground, observation.beliefs
    if foreground is None or term.weight == 0:
        return found
    belief = 1.0 if beliefs is None else beliefs.silhouette
    if observation.outline is None:
        belief, costs = 1.0, outline_costs(body, camera, poses, foreground, term)
    share = of_outline(costs, term, belief)
    found[OUTLINE] = Misfit(np.array([share]), np.array([costs.shape[1]]))
    if points is not None and (foreground.any() or observation.keypoints is not None):
        found[SILHOUETTE] = of_points(points, 0, foreground)
    return found


def of_points(points: SurfacePoints, row: int, foreground: Mask) -> Misfit:
    """Share of the visible points of a mode that are not foreground.

    Args:
        points: visible points of the modes.
        row: row of the mode.
        foreground: (H, W) foreground mask.
    """
    n = int(points.counts[row])
    column, line = points.pixels[row, :n].T.round().astype(np.intp)
    height, width = foreground.shape
    inside = (column >= 0) & (line >= 0) & (column < width) & (line < height)
    missed = ~foreground[line[inside], column[inside]]
    share = float(missed.mean()) if len(missed) else 0.0
    return Misfit(np.array([share]), np.array([float(len(missed))]))


def of_outline(costs: Array, term: TermSettings, belief: float) -> float:
    """Share of the samples of the silhouette's outline that the best mode does not explain.

    Args:
        costs: (K, M) energies of the samples at the modes.
        term: settings of the energies; the weight is divided among the samples.
        belief: factor on the weight of the term.
    """
    if costs.size == 0:
        return 0.0
    most = 0.5 * belief * term.weight / costs.shape[1] * term.scale**2
    limit = GATE_SIGMAS**2 / (GATE_SIGMAS**2 + term.scale**2)
    return float((costs > limit * most).mean(1).min())


def outline_costs(
    body: Body, camera: Camera, poses: Array, foreground: Mask, term: TermSettings
) -> Array:
    """Energies (K, M) of samples on a silhouette's outline, at poses (K, d).

    Args:
        body, camera, poses: body, camera and poses to compare with the silhouette.
        foreground: (H, W) silhouette, which the tracker's likelihood does not use.
        term: settings of the energies.
    """
    if not foreground.any():
        return np.empty((len(poses), 0))
    likelihood = ImageLikelihood(body, camera, LikelihoodSettings.of_terms(coverage=term))
    seen = observe(np.zeros((*foreground.shape, 3), np.uint8), foreground, wanted=('coverage',))
    image = PoseEnergy(likelihood, (ObservedImage(likelihood, seen),))
    return image.by_cue(poses, derivatives=False).outline_costs


def of_keypoints(term: KeypointTerm, poses: Array) -> Misfit:
    """Unexplained share of the keypoints in each group, for the best of poses (K, d).

    For each pose the most likely exchange of sides is assumed.
    """
    groups = term.measured.points.groups
    count = EXCHANGED.shape[1]
    counts = np.bincount(groups, minlength=count).astype(np.float64)
    if len(groups) == 0:
        return Misfit(np.zeros(count), counts)
    missed = ~(term.distances(forward(term.skeleton, poses)) < GATE_SIGMAS)
    best = missed[missed.mean(1).argmin()]
    found = np.bincount(groups, weights=best, minlength=count)
    return Misfit(found / np.maximum(counts, 1.0), counts)


def of_depth(body: Body, camera: Camera, poses: Array, depths: ImageMap) -> Array:
    """Share (N,) of the visible surface of poses (N, d) that disagrees with depths."""
    likelihood = ImageLikelihood(body, camera, LikelihoodSettings.of_terms(depth=DEPTH.settings))
    seen = Observation(evidence={DEPTH.name: depths})
    image = PoseEnergy(likelihood, (ObservedImage(likelihood, seen),))
    s = DEPTH.settings
    found = image.by_cue(poses, derivatives=False).energy.value
    result: Array = found / (0.5 * s.weight * s.scale**2)
    return result


def of_depth_at_best(body: Body, camera: Camera, pose: Array, depths: ImageMap) -> float:
    """Unexplained share of depths, minimum over a pose (d,) and this pose moved to the depths.

    A track that was fitted without depths may be at a wrong distance.
    """
    poses = np.concatenate([pose[None], moved_to_depth(body, camera, pose[None], depths)])
    return float(of_depth(body, camera, poses, depths).min())
