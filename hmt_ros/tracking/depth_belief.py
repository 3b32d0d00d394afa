"""Whether depth images show the person: those of another camera, time or place do not.

    m = E_depth(x) / (w c^2 / 2)              misfit of a pose, from 0 to 1
    M <- M + gain (m(x) - M)                  of the track

A depth image that is not registered to the colour image, or late, shows the background where the
model has limbs. Then most points cost what the kernel allows, whatever the pose, and the others
pull the wrong way: such images are left out until they fit again. A pose that does not fit is moved
to the depth that was measured before it counts, as a track without depth is not at its distance.
"""

from __future__ import annotations

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.kinematics import forward
from hmt_ros.image.likelihood import ImageLikelihood, LikelihoodSettings
from hmt_ros.image.observation import Observation
from hmt_ros.image.sampling import ImageMap
from hmt_ros.image.terms.depth import DEPTH
from hmt_ros.inference.arrays import Array
from hmt_ros.tracking.start_depth import moved_to_depth

# Of depths that are not used; 0.03 to 0.06 where all is well, 0.3 and more where depths are shifted
# by 8 px of a person 80 px wide.
LARGEST_MISFIT = 0.25
# How far the misfit follows that of the newest image.
GAIN = 0.2


def depth_misfits(body: Body, camera: Camera, poses: Array, depths: ImageMap) -> Array:
    """Share of the visible surface (N,) that poses (N, d) have elsewhere than depths show it."""
    likelihood = ImageLikelihood(body, camera, LikelihoodSettings.of_terms(depth=DEPTH.settings))
    seen = Observation(evidence={DEPTH.name: depths})
    found = likelihood.energies(forward(body.skeleton, poses), seen, derivatives=False)
    s = DEPTH.settings
    result: Array = found.terms[DEPTH.name] / (0.5 * s.weight * s.scale**2)
    return result


class DepthBelief:
    """Belief in the depth images of one track.

    Args:
        camera: that they are registered to.
    """

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._misfit: float | None = None

    @property
    def believed(self) -> bool:
        """Whether depth images are used."""
        return self._misfit is None or self._misfit <= LARGEST_MISFIT

    def update(self, body: Body, pose: Array, depths: ImageMap | None) -> None:
        """Takes in a pose (d,) and the depths of its image, if there are some."""
        if depths is None:
            return
        camera, poses = self._camera, pose[None]
        misfit = float(depth_misfits(body, camera, poses, depths)[0])
        if misfit > LARGEST_MISFIT:
            poses = moved_to_depth(body, camera, poses, depths)
            misfit = min(misfit, float(depth_misfits(body, camera, poses, depths)[0]))
        if self._misfit is None:
            self._misfit = misfit
        self._misfit += GAIN * (misfit - self._misfit)

    def reset(self) -> None:
        """Forgets the track."""
        self._misfit = None
