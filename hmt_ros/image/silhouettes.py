"""Silhouettes from a segmenter or from background subtraction, and checks of the background.

The mask of a segmenter is used if available. Otherwise the background is subtracted, as soon as the
scene is known to be empty (`EmptyScene`). When a track starts from joints, the pose is known, and
the fraction

    f = |foreground and area of the body| / |area of the body|

is near 1 if the background is the empty scene, and lower for clothes in the colours of the room. If
f is below `MIN_FOREGROUND_FRACTION`, a learned background is forgotten. It is rebuilt from those
pixels of later images that the person covers in no mode of the posterior; cues other than
silhouettes then locate the person. No silhouettes are used until the background around the person
is known.
"""

from __future__ import annotations

import cv2
import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.camera_pose import CameraPose
from hmt_ros.body.keep_out import RUNNING_SPEED
from hmt_ros.body.rasterisation import render_silhouettes
from hmt_ros.image.background import BackgroundModel, SceneWatch, Silhouette, one_person
from hmt_ros.image.empty_scene import EmptyScene
from hmt_ros.image.observation import Box
from hmt_ros.image.person_shape import resized
from hmt_ros.inference.arrays import Array, Image, Mask

# Image shift of a stationary scene above which the background is of another view, px.
VIEW_SHIFT = 2.0
# Foreground fraction of the person's area below which a learned background is rejected.
MIN_FOREGROUND_FRACTION = 0.35
# Log odds of a person in a background that was rebuilt without people, nats.
COMPLETED_LOG_ODDS = -6.0
# Margins of a body's area, as fractions of the area's height: inwards for pixels that certainly
# show the person, outwards for pixels that possibly show the person.
INNER_MARGIN, OUTER_MARGIN = 0.01, 0.06
# Maximum unknown fraction of the person's area for silhouettes to be used.
MAX_UNKNOWN_FRACTION = 0.02
# Margin of the box that can contain the person around the joints of all modes, as a fraction of the
# joints' extent.
REGION_MARGIN = 0.3


class Silhouettes:
    """The silhouettes of one person in the images of one camera.

    Args:
        background: background model, either of the empty scene or without images.
        shared: whether several people share the background; other code then learns it.

    Attributes:
        scene: model of the empty scene.
        watch: detects whether the camera has moved since the background was taken.
        doubted: whether the background shows the person and has not been rebuilt yet.
    """

    def __init__(self, background: BackgroundModel, *, shared: bool = False) -> None:
        self.scene = EmptyScene(background, trusted=shared)
        self.doubted = False
        self.watch = SceneWatch()
        self._shared = shared
        self._learning = background.frames == 0 and not shared
        self._seen_from: CameraPose | None = None

    @property
    def background(self) -> BackgroundModel:
        """Model of the empty scene; parts can be unknown."""
        return self.scene.background

    @property
    def known(self) -> str:
        """State of the background, as a short text for users."""
        unknown = self.background.unknown
        if unknown is not None:
            return f'forgotten, {1 - unknown.mean():.0%} known again'
        if self.scene.known:
            return 'known'
        return 'not yet seen empty' if self.background.frames else 'unknown'

    def forget(self) -> None:
        """Discards the background, because the camera sees another scene."""
        self.scene = EmptyScene(BackgroundModel(self.background.settings), trusted=self._shared)
        self.doubted, self._learning = False, not self._shared
        self.watch = SceneWatch()

    def set_camera_pose(self, pose: CameraPose, camera: Camera) -> None:
        """Sets the pose of the camera; if the view has changed, the background is forgotten."""
        if self._seen_from is None:
            self._seen_from = pose
        elif pose.shift(self._seen_from, camera) > VIEW_SHIFT:
            self.forget()
            self._seen_from = pose

    def learn(self, image: Image, stamp: int, detected: bool | None = None) -> None:
        """Learns the scene from an image before a track starts; see `EmptyScene.learn`."""
        if self._learning:
            if self.doubted:
                self.forget()
            self.scene.learn(image, stamp, detected)

    def silhouette(
        self,
        image: Image,
        stamp: int,
        mask: Mask | None,
        region: Box | None,
        others: Mask | None = None,
    ) -> Silhouette | None:
        """The silhouette in an image; None if unknown.

        Args:
            image: (H, W, 3).
            stamp: stamp of the image, ns.
            mask: (H, W) mask from a segmenter; None if missing.
            region: box that can contain the person; None: the whole image.
            others: (H, W) pixels that other people cover; None if missing.
        """
        if mask is not None:
            mask = mask if others is None else mask & ~others
            return Silhouette(one_person(mask, self.background.settings, region))
        scene = self.scene
        if self.doubted or not (scene.seen and scene.background.frames):
            return None
        if not self._shared:
            self.watch.update(image, self.background)
        scene.update(image, stamp)
        if scene.is_of_somebody:
            self._forget_background()
        return self.background.split(image, region, others) if scene.known else None

    def anywhere(self, image: Image, mask: Mask | None, others: Mask | None, step: int) -> Mask:
        """The whole foreground of an image, at every step-th pixel (H / step, W / step).

        Args:
            image, mask, others: as for `silhouette`, whose result must not be None.
            step: step between pixels, px.
        """
        found = self.background.foreground(image) if mask is None else mask
        coarse = found[::step, ::step]
        if others is not None:
            coarse = coarse & ~others[::step, ::step]
        pixels = np.ascontiguousarray(coarse).view(np.uint8)
        # Single pixels are noise.
        return np.asarray(cv2.medianBlur(pixels, 3), dtype=np.uint8).view(np.bool_)

    def check(self, image: Image, body: Body, camera: Camera, poses: Array) -> None:
        """Forgets the background if too little of the person, in poses (K, d), is foreground.

        A given background, which was not learned, is assumed to be the empty scene.
        """
        if not self.background.frames or not self._learning:
            return
        inside = resized(_area(body, camera, poses), -INNER_MARGIN)
        if not inside.any():
            return
        if self.background.foreground(image)[inside].mean() < MIN_FOREGROUND_FRACTION:
            self._forget_background()

    def _forget_background(self) -> None:
        """Forgets a background that shows the person."""
        self.doubted = True
        self.background.forget()

    def complete(self, image: Image, body: Body, camera: Camera, poses: Array) -> None:
        """Rebuilds a forgotten background from pixels outside the person in poses (K, d)."""
        if self.background.unknown is None:
            return
        area = _area(body, camera, poses)
        around = resized(area, OUTER_MARGIN)
        self.background.complete(image, around)
        unknown = self.background.unknown
        known = unknown is None or (unknown & around).sum() <= MAX_UNKNOWN_FRACTION * area.sum()
        trusted, self.doubted = not self.doubted, not known
        if known and not trusted:
            self.scene.log_odds, self.scene.seen = COMPLETED_LOG_ODDS, True
            self.check(image, body, camera, poses[:1])


def region_of(
    body: Body, camera: Camera, poses: Array, margin: float = REGION_MARGIN, dt: float = 0.0
) -> Box | None:
    """Box that can contain a person in the next image, given poses (K, d); None: anywhere.

    Args:
        body, camera, poses: body of the person, camera, and (K, d) earlier poses.
        margin: margin around all joints, as a fraction of their extent.
        dt: time since the image of these poses, s.
    """
    pixels = camera.project(body.joint_positions(poses)).reshape(-1, 2)
    pixels = pixels[np.isfinite(pixels).all(1)]
    if len(pixels) == 0:
        return None
    low, high = pixels.min(0), pixels.max(0)
    nearest = max(float(poses[:, 2].min()), 0.1)
    reach = RUNNING_SPEED * dt * camera.magnification(nearest)
    margin = max(margin * max(float((high - low).max()), 1.0), reach)
    size = (camera.width, camera.height)
    left, top = (int(x) for x in np.clip(np.floor(low - margin), 0, size))
    right, bottom = (int(x) for x in np.clip(np.ceil(high + margin), 0, size))
    if right - left < 2 or bottom - top < 2:
        return None
    return left, top, right, bottom


def _area(body: Body, camera: Camera, poses: Array) -> Mask:
    """Pixels (H, W) that the body covers in any of the poses (K, d)."""
    return np.asarray(render_silhouettes(body, poses, camera).any(0), dtype=np.bool_)
