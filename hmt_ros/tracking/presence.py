"""Whether the person of a track is in view: what each cue says, and how long none has said so.

A cue says yes, no, or nothing. The person is seen in an image unless a cue says no and none says
yes; nobody is there when the person has not been seen for `absence_time`.

    silhouette   yes:  |F and M| / |M| >= 0.3 usual,  or F is as large as usual and looks like one
                       person: the pose may be wrong, but somebody is there
                 no:   otherwise; also where most of the image differs from the background
    keypoints    yes:  6 or more, with confidences that sum to 3 at least
                 no:   the detector reports no joint, or confidences that sum to 1 at most
    prediction   no:   the predictor saw nobody
    colours      yes:  m >= outside + 0.65 (inside - outside) and m - n >= 0.25 (inside - outside)
                 no:   otherwise, or where the colours on M were not seen before
    border       no:   no more than a tenth of the joints lie in the image

Of somebody whom others hide for the most part no cue says no, for `LONGEST_HIDDEN` at most.

M are the pixels that the model covers and nobody else, and F those of the silhouette. Where the
clothes have the colours of the room only a part of M is foreground: usual is what this track has
seen so far, with time constant `MEMORY`. Colours are asked where the silhouette can not be used: m
and n are the means of p(M | colour), the ratio of two histograms, over M and over its surroundings;
inside and outside are usual values of m and n. When they are alike the colours say nothing. Colours
are learned slowly and from clear images, or else they would become those of the room.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.flesh import Mesh
from hmt_ros.body.kinematics import forward
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.image.texture import coarse_mesh
from hmt_ros.inference.arrays import Array, Image, Mask

# Time constant of what is usual for a track, and of its colours, s.
MEMORY = 1.0
COLOUR_MEMORY = 4.0
# Share of the model on the silhouette that is expected before a track has seen any, and the
# fraction of the usual one at which the person is still there.
FIRST_SHARE = 0.4
LEAST_SHARE = 0.3
# A silhouette of this fraction of the usual area is somebody, wherever the model is.
LEAST_AREA = 0.5
# Above this multiple of the usual area it is no person.
MOST_AREA = 4.0
# Share of the pixels that differ from the background, beside those that the model covers, above
# which something happened to the light or to the camera.
MOST_CHANGED = 0.5
# Fewest keypoints that are a person, and the sums of confidences that are one, and that are none.
FEWEST_KEYPOINTS = 6
SURE, UNSURE = 3.0, 1.0
# Stamps are rounded, and images do not come to the ms, s.
ROUNDING = 0.002
# Fewest joints in the image, as a fraction of all.
LEAST_INSIDE = 0.1
# A person's silhouette is this long at least, px, and neither a line nor a rectangle.
LEAST_LENGTH = 40
LEAST_FILLED, MOST_FILLED = 0.04, 0.9
# Height of the raster that areas and colours are taken at, px.
RASTER = 240
# Where between the usual values outside and inside a mean colour belongs to the person; how far
# apart they must be, what of this contrast the image must show, and how much of the colours must
# have been seen before.
INSIDE, CLEARLY_INSIDE = 0.65, 0.8
LEAST_CONTRAST = 0.2
LEAST_APART = 0.25
LEAST_FAMILIAR = 0.3
# Share of the model that others cover from which the person is hidden; how long one may be, s.
HIDDEN = 0.6
LONGEST_HIDDEN = 3.0
# Bins of a colour channel.
BINS = 8


class View(NamedTuple):
    """What an image may show of a person.

    Attributes:
        image: (H, W, 3) BGR.
        silhouette: (H, W) foreground, all false where there is none; None: there is no background.
        changed: share of the pixels that differ from the background.
        keypoints: of a detector; without any that was seen: it saw nobody. None: no detector.
        nobody_predicted: whether a predictor saw nobody.
        unsure: (H, W) what may be the person or a shadow; None: nothing.
        others: (H, W) what somebody else covers; None: nothing.
        depth: (H, W) depth along the axis of the camera, m; None: unknown.
    """

    image: Image
    silhouette: Mask | None = None
    changed: float = 0.0
    keypoints: Keypoints | None = None
    nobody_predicted: bool = False
    unsure: Mask | None = None
    others: Mask | None = None
    depth: NDArray[np.floating] | None = None


class Presence:
    """Decides, image by image, whether the person of one track is in view.

    Args:
        absence_time: after which nobody is there, s.

    Attributes:
        absent: whether nobody is there.
        hidden: whether others hid the person in the last image.
    """

    def __init__(self, absence_time: float) -> None:
        self.absent = False
        self.hidden = False
        self._hidden_for = 0.0
        self._absence_time = absence_time
        self._share = FIRST_SHARE
        self._area = np.inf
        self._colours = Colours()
        self._last_stamp: int | None = None
        self._last_seen: int | None = None
        self._unseen = 0

    def sees(self, view: View, stamp: int, body: Body, camera: Camera, pose: Array) -> bool:
        """Whether the person is seen in the next image.

        Args:
            view: what it shows.
            stamp: of the image, ns; later than the one before.
            body, camera: who is seen by what.
            pose: (d,) of the heaviest mode, in this image or the one before.
        """
        dt = 0.0 if self._last_stamp is None else 1e-9 * (stamp - self._last_stamp)
        if self._last_seen is None:
            self._last_seen = stamp
        self._last_stamp = stamp
        seen = self._judge(view, dt, body, camera, pose)
        if seen:
            self._last_seen, self._unseen = stamp, 0
        else:
            self._unseen += 1
        # One image alone may be damaged, however late it comes.
        unseen = 1e-9 * (stamp - self._last_seen) + ROUNDING
        self.absent = self._unseen > 1 and unseen >= self._absence_time
        return seen

    def _judge(self, view: View, dt: float, body: Body, camera: Camera, pose: Array) -> bool:
        """Whether the person is seen in an image; learns from it what is usual."""
        step = max(round(camera.height / RASTER), 1)
        model = covered(body, camera, pose, step)
        whole = max(_count(model), 1)
        if view.others is not None:
            model = model & ~_at(view.others, model)
        open_to_view = _count(model) / whole
        self.hidden = view.others is not None and open_to_view < 1.0 - HIDDEN
        self._hidden_for = self._hidden_for + dt if self.hidden else 0.0
        if self.hidden and self._hidden_for <= LONGEST_HIDDEN + ROUNDING:
            return True
        cues = [sees_person(view.keypoints), False if view.nobody_predicted else None]
        if _inside(body, camera, pose) <= LEAST_INSIDE:
            cues.append(False)
        usable = False
        if view.silhouette is not None:
            silhouette = _at(view.silhouette, model)
            usable = view.changed <= MOST_CHANGED + _count(model) / model.size
            usable = usable and step**2 * _count(silhouette) <= MOST_AREA * self._area
            cues.append(usable and self._on_silhouette(view, model, step, dt, open_to_view))
        image = _at(view.image, model)
        score = None
        if not usable and True not in cues:
            score = self._colours.score(image, model)
            cues.append(None if score is None else score >= INSIDE)
        seen = True in cues or False not in cues
        if seen and (score is None or score >= CLEARLY_INSIDE):
            self._colours.learn(image, model, dt)
        return seen

    def hides(self, view: View) -> bool:
        """Whether others hide the person, and no detector sees what is left."""
        return self.hidden and (view.keypoints is None or not view.keypoints.seen.any())

    def _on_silhouette(
        self, view: View, model: Mask, step: int, dt: float, open_to_view: float
    ) -> bool:
        silhouette = view.silhouette
        assert silhouette is not None
        found = _at(silhouette, model)
        share = _count(found & model) / max(_count(model), 1)
        area = step**2 * _count(found) / max(open_to_view, 1.0 - HIDDEN)
        if share < LEAST_SHARE * self._share:
            return area >= LEAST_AREA * self._area and looks_like_person(silhouette)
        gain = min(dt / MEMORY, 1.0)
        self._share += gain * (share - self._share)
        known = np.isfinite(self._area)
        self._area = self._area + gain * (area - self._area) if known else float(area)
        return True


def _inside(body: Body, camera: Camera, pose: Array) -> float:
    """Share of the joints that lie in the image."""
    joints = camera.project(body.joint_positions(pose[None]))
    with np.errstate(invalid='ignore'):
        within = (joints >= 0) & (joints <= [camera.width - 1, camera.height - 1])
    return float(np.all(within, axis=2).mean())


def _at(image: NDArray[Any], raster: Mask) -> NDArray[Any]:
    """An image (H, W, ...) at the pixels of a coarser raster."""
    size = raster.shape[::-1]
    seen = image.view(np.uint8) if image.dtype == np.bool_ else image
    return np.asarray(cv2.resize(seen, size, interpolation=cv2.INTER_NEAREST)).view(image.dtype)


def sees_person(keypoints: Keypoints | None) -> bool | None:
    """Whether a detector sees a person; None: it does not say."""
    if keypoints is None:
        return None
    sure = keypoints.confidences[keypoints.seen]
    if len(sure) >= FEWEST_KEYPOINTS and sure.sum() >= SURE:
        return True
    return False if sure.sum() <= UNSURE else None


def looks_like_person(silhouette: Mask) -> bool:
    """Whether a silhouette (H, W) has the size and shape of one person."""
    _, _, width, height = cv2.boundingRect(_bytes(silhouette))
    length, area = max(width, height), _count(silhouette)
    return (
        length >= LEAST_LENGTH
        and area >= LEAST_FILLED * length**2
        and area <= MOST_FILLED * width * height
    )


def covered(body: Body, camera: Camera, pose: Array, step: int = 1) -> Mask:
    """Every step-th pixel (H / step, W / step) that a body covers at a pose (d,).

    Each part of the flesh counts as the convex hull of its projected points.
    """
    mesh = _mesh(body)
    points = forward(body.skeleton, pose[None]).points(mesh.segments, mesh.vertices)[:, :, 0]
    shape = -(-camera.height // step), -(-camera.width // step)
    limit = 4.0 * max(shape)
    pixels = camera.project(points) / step
    usable: Mask = np.all(np.isfinite(pixels), axis=1)
    pixels = np.clip(np.nan_to_num(pixels), -limit, limit).round().astype(np.int32)
    mask = np.zeros(shape, dtype=np.uint8)
    for part in range(len(body.flesh.parts)):
        here = mesh.parts == part
        # A part that is partly behind the camera has no hull.
        if usable[here].all():
            hull = cv2.convexHull(pixels[here])
            cv2.fillConvexPoly(mask, hull, 1)
    return mask.view(np.bool_)


@lru_cache(maxsize=8)
def _mesh(body: Body) -> Mesh:
    return coarse_mesh(body)


@dataclass(eq=False)
class Colours:
    """The colours of a person against those of the surroundings.

    Attributes:
        inside, outside: histograms of the colours on the model and around it; None: not learned.
        usual_inside, usual_outside: usual mean of p(M | colour) there.
        usual_familiar: usual share of the colours on the model that were known.
    """

    inside: Array | None = None
    outside: Array | None = None
    usual_inside: float = 1.0
    usual_outside: float = 0.0
    usual_familiar: float = 1.0

    def score(self, image: Image, model: Mask) -> float | None:
        """How far the colours of an image on the model are the person's.

        About 1 where they are, about 0 where they are those of the surroundings, minus infinity
        where they are strange; None: they can not be told apart.

        Args:
            image: (H, W, 3) BGR.
            model: (H, W) pixels that the model covers.
        """
        around = surroundings(model)
        if self.inside is None or not model.any() or not around.any():
            return None
        on = histogram(image, model)
        if np.minimum(on, self.inside).sum() < LEAST_FAMILIAR * self.usual_familiar:
            return -np.inf
        contrast = self.usual_inside - self.usual_outside
        if contrast < LEAST_CONTRAST:
            return None
        ratio = self._ratio()
        if (on - histogram(image, around)) @ ratio < LEAST_APART * contrast:
            return -np.inf
        return float(on @ ratio - self.usual_outside) / contrast

    def learn(self, image: Image, model: Mask, dt: float) -> None:
        """Takes in the colours of an image in which the person is seen; `dt` s after the last."""
        around = surroundings(model)
        if not model.any() or not around.any():
            return
        on, off = histogram(image, model), histogram(image, around)
        if self.inside is None or self.outside is None:
            self.inside, self.outside = on, off
            ratio = self._ratio()
            self.usual_inside, self.usual_outside = float(on @ ratio), float(off @ ratio)
            return
        gain = min(dt / MEMORY, 1.0)
        ratio = self._ratio()
        self.usual_inside += gain * (float(on @ ratio) - self.usual_inside)
        self.usual_outside += gain * (float(off @ ratio) - self.usual_outside)
        familiar = float(np.minimum(on, self.inside).sum())
        self.usual_familiar += gain * (familiar - self.usual_familiar)
        self.inside += min(dt / COLOUR_MEMORY, 1.0) * (on - self.inside)
        self.outside += gain * (off - self.outside)

    def _ratio(self) -> Array:
        """p(M | colour), a number for each bin."""
        assert self.inside is not None
        assert self.outside is not None
        rare = 1e-4
        result: Array = self.inside / (self.inside + self.outside + rare)
        return result


def histogram(image: Image, where: Mask) -> Array:
    """Share of each colour among some pixels of an image (H, W, 3)."""
    counts = cv2.calcHist([image], [0, 1, 2], _bytes(where), 3 * [BINS], 3 * [0.0, 256.0]).ravel()
    return np.asarray(counts / max(counts.sum(), 1.0), dtype=np.float64)


def _count(mask: Mask) -> int:
    return cv2.countNonZero(_bytes(mask))


def _bytes(mask: Mask) -> NDArray[np.uint8]:
    return mask.view(np.uint8)


def surroundings(model: Mask) -> Mask:
    """Pixels (H, W) around those that the model covers, up to half its size away."""
    x, y, width, height = cv2.boundingRect(_bytes(model))
    margin = max(width, height) // 2
    near = max(margin // 5, 1)
    size = (2 * near + 1, 2 * near + 1)
    grown = cv2.dilate(_bytes(model), np.ones(size, np.uint8))
    result = np.zeros(model.shape, dtype=np.bool_)
    rows = slice(max(y - margin, 0), y + height + margin)
    columns = slice(max(x - margin, 0), x + width + margin)
    result[rows, columns] = grown[rows, columns] == 0
    return result
