"""Inputs of a tracker from an image: a view of a person, and an observation of the person.

    view          silhouettes near the person and anywhere, keypoints     before a pose is known
    observation   evidence of every term of the likelihood in use         near a pose

Existence and starts depend on the view. The observation is made from the view once the place of the
person and the validity of the silhouettes are known.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.image.observation import Observation, observe
from hmt_ros.image.person_shape import raster_step
from hmt_ros.image.silhouettes import Silhouettes, region_of
from hmt_ros.image.terms.depth import DEPTH
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.image.terms.registry import TERMS
from hmt_ros.inference.arrays import Array, Image, Mask
from hmt_ros.tracking.hypotheses import PosePrediction
from hmt_ros.tracking.misfit import SILHOUETTE
from hmt_ros.tracking.settings import TrackerSettings
from hmt_ros.tracking.validity import Validity


class View(NamedTuple):
    """An image with its inputs, and results that do not need a pose.

    Attributes:
        image: (H, W, 3) BGR image.
        stamp: timestamp of the image, ns.
        keypoints: keypoints from a detector; if no keypoint is seen, it found nobody. None: no
            detector, or no result.
        prediction: pose hypotheses from an external predictor, if any.
        mask: (H, W) pixels of the person from a segmenter; None: unknown.
        predicted: whether a predictor found a person in this image; None: no predictor, or no
            result.
        others: (H, W) pixels that other people cover; None: no such pixels.
        depth: (H, W) depth along the axis of the camera, m; None: unknown.
        silhouette: (H, W) foreground near the person, possibly empty; None: neither background nor
            mask.
        anywhere: (h, w) all foreground of the image on a coarser raster; None: neither background
            nor mask.
        changed: share of the pixels that differ from the background.
        unsure: (H, W) pixels that show the person or a shadow; None: no such pixels.
        hidden: (S,) segments that other objects cover; None: no such segments.
    """

    image: Image
    stamp: int = 0
    keypoints: Keypoints | None = None
    prediction: PosePrediction | None = None
    mask: Mask | None = None
    predicted: bool | None = None
    others: Mask | None = None
    depth: NDArray[np.floating] | None = None
    silhouette: Mask | None = None
    anywhere: Mask | None = None
    changed: float = 0.0
    unsure: Mask | None = None
    hidden: Mask | None = None


class Observer:
    """Makes views and observations for the terms of a likelihood.

    Args:
        camera: camera of the images.
        settings: settings of the tracker; terms of weight 0 get no evidence.
        silhouettes: source of the silhouettes.

    Attributes:
        last_image: (H, W, 3) previous image, for the optical flow; None: no flow.
    """

    def __init__(self, camera: Camera, settings: TrackerSettings, silhouettes: Silhouettes) -> None:
        self.last_image: Image | None = None
        self._camera = camera
        self._settings = settings
        self._silhouettes = silhouettes

    def check(self, given: View, body: Body, last: int | None) -> None:
        """Checks the inputs of an image.

        Args:
            given: the image with its inputs.
            body: body with the degrees of freedom that a prediction must have.
            last: timestamp of the previous image, ns; None: first image.

        Raises:
            ValueError: an array does not have the size of the camera's images, the timestamp does
                not increase, the keypoints have names of a detector, or the body of the prediction
                has other degrees of freedom.
        """
        if given.prediction is not None:
            given.prediction.seen_as(body)
        if last is not None and given.stamp <= last:
            raise ValueError(f'stamps must increase, saw {given.stamp} after {last} ns')
        names = () if given.keypoints is None else given.keypoints.names
        if strange := [name for name in names if name not in body.joint_names]:
            raise ValueError(
                f"the body has no joints {strange}; use Keypoints.named_for for a detector's names"
            )
        size = (self._camera.height, self._camera.width)
        for name, each in (
            ('', given.image),
            ('a mask of ', given.mask),
            ('a mask of ', given.others),
            ('depths of ', given.depth),
        ):
            if each is not None and each.shape[:2] != size:
                raise ValueError(f'the camera gives images of {size}, saw {name}{each.shape[:2]}')

    def view(self, given: View, body: Body, poses: Array | None, dt: float) -> View:
        """Makes the view of a person in an image.

        Args:
            given: the image with its inputs, without silhouettes.
            body: body of the person.
            poses: (K, d) poses in an earlier image; None: the person may be anywhere.
            dt: time since the earlier image, s.
        """
        if self._settings.likelihood.coverage.weight == 0:
            return given
        region = None if poses is None else region_of(body, self._camera, poses, dt=dt)
        image, mask, others = given.image, given.mask, given.others
        silhouettes = self._silhouettes
        found = silhouettes.silhouette(image, given.stamp, mask, region, others)
        if found is None:
            return given
        return given._replace(
            silhouette=found.foreground,
            unsure=found.unsure,
            anywhere=silhouettes.anywhere(image, mask, others, raster_step(self._camera.height)),
            changed=silhouettes.background.changed if mask is None else 0.0,
        )

    def observation(self, view: View, pose: Array | None, validity: Validity) -> Observation:
        """Makes the observation of a person in an image.

        Args:
            view: view of the image.
            pose: (d,) approximate pose; None: unknown.
            validity: validity of the cues; a silhouette or depth image that is probably invalid is
                left out.
        """
        likelihood = self._settings.likelihood
        weighed = [term for term in TERMS if getattr(likelihood, term.name).weight > 0]
        wanted = {'coverage'} | {term.name for term in weighed}
        keypoints = view.keypoints
        if keypoints is not None and not keypoints.seen.any():
            keypoints = None
        found = observe(
            view.image,
            view.silhouette if validity.is_trusted(SILHOUETTE) else None,
            keypoints,
            last_image=self.last_image if self._settings.flow_weight > 0 else None,
            wanted=wanted,
            unsure=view.unsure,
            others=view.others,
            depth=view.depth,
            threads=self._settings.threads,
        )
        evidence = dict(found.evidence)
        depths = evidence.get(DEPTH.name)
        if not validity.is_trusted(DEPTH.name):
            evidence.pop(DEPTH.name, None)
        magnification = 0.0 if pose is None else self._camera.magnification(float(pose[2]))
        return replace(
            found,
            evidence=evidence,
            foreground=view.silhouette,
            hidden=view.hidden,
            depths=depths,
            magnification=magnification,
        )
