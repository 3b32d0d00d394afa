"""Inputs of a tracker from an image: a view of anybody who is there, and evidence on the person.

    view          silhouettes near the person and anywhere, keypoints     before a pose is known
    observation   evidence of every term of the likelihood that counts    near a pose

Existence and starts are decided from the view. The observation is made from it once it is known
where the person is and whether the silhouettes of this track are believed.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.image.observation import Observation, observe
from hmt_ros.image.terms.depth import DEPTH
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.image.terms.registry import TERMS
from hmt_ros.inference.arrays import Array, Image, Mask
from hmt_ros.tracking.misfit import SILHOUETTE
from hmt_ros.tracking.person_shape import raster_step
from hmt_ros.tracking.settings import TrackerSettings
from hmt_ros.tracking.silhouettes import Silhouettes, region_of
from hmt_ros.tracking.validity import Validity
from hmt_ros.tracking.view import View


class Observer:
    """Makes views and observations for the terms of a likelihood.

    Args:
        camera: that takes the images.
        settings: of the tracker; terms of weight 0 need nothing.
        silhouettes: where those of the images come from.

    Attributes:
        last_image: (H, W, 3) that the optical flow starts from; None: there is no flow.
    """

    def __init__(self, camera: Camera, settings: TrackerSettings, silhouettes: Silhouettes) -> None:
        self.last_image: Image | None = None
        self._camera = camera
        self._settings = settings
        self._silhouettes = silhouettes

    def check_sizes(
        self,
        image: Image,
        mask: Mask | None,
        others: Mask | None,
        depth: NDArray[np.floating] | None,
    ) -> None:
        """Raises ValueError where an array does not have the size of the camera's images."""
        size = (self._camera.height, self._camera.width)
        named = ((image, ''), (mask, 'a mask of '), (others, 'a mask of '), (depth, 'depths of '))
        for each, name in named:
            if each is not None and each.shape[:2] != size:
                raise ValueError(f'the camera gives images of {size}, saw {name}{each.shape[:2]}')

    def view(
        self,
        image: Image,
        stamp: int,
        keypoints: Keypoints | None,
        mask: Mask | None,
        body: Body,
        poses: Array | None,
        dt: float,
        *,
        predicted: bool | None,
        others: Mask | None = None,
        depth: NDArray[np.floating] | None = None,
    ) -> View:
        """The view of a person in an image.

        Args:
            image: (H, W, 3) BGR uint8.
            stamp: of the image, ns.
            keypoints: of a detector, if any.
            mask: (H, W) of a segmenter, if any.
            body: of the person.
            poses: (K, d) in an image before; None: the person may be anywhere.
            dt: time since that image, s.
            predicted: whether a predictor expects somebody; None: it does not say.
            others: (H, W) pixels that somebody else covers; None: none.
            depth: (H, W) of a depth camera, m, if any.
        """
        s = self._settings
        silhouettes = self._silhouettes
        found, anywhere, changed = None, None, 0.0
        if s.likelihood.coverage.weight > 0:
            region = None if poses is None else region_of(body, self._camera, poses, dt=dt)
            found = silhouettes.silhouette(image, stamp, mask, region, others)
        if found is not None:
            anywhere = silhouettes.anywhere(image, mask, others, raster_step(self._camera.height))
            changed = silhouettes.background.changed if mask is None else 0.0
        foreground, unsure = (None, None) if found is None else found
        return View(
            image, foreground, anywhere, changed, keypoints, predicted, unsure, others, depth
        )

    def seen_anywhere(self, view: View, stamp: int, mask: Mask | None) -> View:
        """The same view, with the silhouette of somebody who may be anywhere in it."""
        found = self._silhouettes.silhouette(view.image, stamp, mask, None, view.others)
        if found is None:
            return view
        return view._replace(silhouette=found.foreground, unsure=found.unsure)

    def observation(self, view: View, pose: Array | None, validity: Validity) -> Observation:
        """The evidence of an image about a person.

        Args:
            view: of the image.
            pose: (d,) that the person is about at; None: unknown.
            validity: of the cues; those that more likely show something else are left out.
        """
        likelihood = self._settings.likelihood
        weighed = [term for term in TERMS if getattr(likelihood, term.name).weight > 0]
        wanted = {'coverage'} | {term.name for term in weighed}
        keypoints = view.keypoints
        if keypoints is not None and not keypoints.seen.any():
            keypoints = None
        found = observe(
            view.image,
            view.silhouette if validity.believes(SILHOUETTE) else None,
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
        if not validity.believes(DEPTH.name):
            evidence.pop(DEPTH.name, None)
        magnification = 0.0 if pose is None else self._camera.magnification(float(pose[2]))
        return replace(
            found,
            evidence=evidence,
            foreground=view.silhouette,
            depths=depths,
            magnification=magnification,
        )
