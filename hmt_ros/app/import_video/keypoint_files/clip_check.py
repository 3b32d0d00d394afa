"""Checks the keypoints of a whole clip before they are used.

Detector files do not say what their numbers mean: confidences can be percent or fractions,
positions can be from smaller images, and lists of points have one of several orders. In the right
interpretation the clip shows people: confidences up to 1, points all over the image, bones of human
lengths. An interpretation that fits is reported to the user; if none fits, the error names the
option that helps.

Bones: with d the length of bone b in an image, L its usual human length and s = sum d / sum L, the
90 % quantile q of d / (s L) over the images is near c = 1.18, because a bone that is oblique to the
image plane in one image is parallel to it in another:

    z = (mean_b ((log q_b / c) / sigma_b)^4)^(1/4)

L and sigma are from `bone_lengths`; sigma is 1.67 times as large if q is below c. In 21 clips of a
detector z is 0.4 to 1.9; for wrong orders of the same number of points it is 2 to 14, mostly above
4.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from hmt_ros.app.import_video.keypoint_files.persons import FoundPersons, Person
from hmt_ros.app.progress import Notify
from hmt_ros.image.keypoint_schemes import (
    AUTO,
    JOINTS,
    bone_lengths,
    landmarks_of,
    recognised,
    scheme_of,
    schemes,
    unnamed_orders,
)
from hmt_ros.inference.arrays import Array, Mask

# Upper ends of the confidence scales of detectors.
_SCALES = (100.0, 255.0, 1000.0)
# Maximum of the median confidence on the scale from 0 to 1.
_FRACTIONS = 1.5
_MIN_SCALE = 10.0
# Maximum coordinate for which positions are taken to be fractions of the image.
_FRACTION = 2.0
# Minimum fraction of confident points in or near the image, minimum confidence of these points, and
# margin around the image, in image sizes. Detectors are not confident of points that they guess.
_MIN_INSIDE_FRACTION, _MIN_CONFIDENCE, _IMAGE_MARGIN = 0.7, 0.5, 0.05
# Fraction of width and height that contains all points only if they are from smaller images.
_REDUCED_FRACTION = 0.5
_SHAPE_TOLERANCE = 0.02
_MIN_POINTS = 100  # minimum number of points for a conclusion about all points
# Minimum confidence of the ends of a bone, and minimum number of bones for a check.
_MIN_BONE_CONFIDENCE, _MIN_BONES = 0.3, 6
_MIN_PERSONS, _MAX_PERSONS = 10, 2000  # minimum and maximum number of persons that are checked
_QUANTILE, _USUAL, _BELOW = 0.9, 1.18, 1.67
# Maximum z for an accepted order of points; ratio of z below which a different order replaces the
# usual order; maximum z for points with names.
_MAX_Z, _MAX_Z_RATIO, _MAX_Z_OF_NAMES = 2.75, 0.6, 3.5
# A leap: minimum mean motion of the points, in diagonals of the box; maximum distance after the
# return, as a fraction of the leap; maximum number of frames until the return. Limits for an error:
# minimum number of leaps, and minimum ratio of leaps to steps.
_LEAP, _BACK, _SOON, _LEAPS, _OFTEN = 0.2, 0.4, 10, 3, 0.1


def check_clip(
    found: FoundPersons,
    size: tuple[int, int],
    notify: Notify,
    *,
    scheme: str = AUTO,
    points_size: tuple[int, int] | None = None,
) -> None:
    """Converts confidences, positions and names of a clip to the usual units and scheme.

    Args:
        size: width and height of the images, px.
        scheme: order of unnamed points; `AUTO` selects the order that fits.
        points_size: size of the images in which the points were found, px; None if unknown.

    Raises:
        ValueError: no interpretation fits (the message names the option to use), or the scheme is
            unknown.
    """
    scheme_of((), scheme)
    if not any(found.persons()):
        return
    try:
        _scale_confidences(found, notify)
        _scale_places(found, size, notify, points_size)
        _name_points(found, notify, scheme)
    except ValueError as error:
        raise ValueError(f'{found.path}: {error}') from error


def _likely(found: FoundPersons) -> list[Person]:
    """A limited number of likely persons, spread evenly over the clip."""
    persons = [x for those in found.likely().values() for x in those]
    return persons[:: -(-len(persons) // _MAX_PERSONS)]


def _scale_confidences(found: FoundPersons, notify: Notify) -> None:
    """Scales confidences to the range from 0 to 1."""
    persons = [x.keypoints for x in _likely(found)]
    sure = np.concatenate([x.confidences[x.seen] for x in persons])
    largest, scale = float(sure.max()), 1.0
    if np.median(sure) > _FRACTIONS:
        scale = next((x for x in _SCALES if _MIN_SCALE < largest <= x), 1.0)
        how = f'read as parts of {scale:g}' if scale > 1.0 else 'those above 1 are taken as 1'
        notify(f'{found.path}: confidences up to {largest:g}: {how}')
    equal = len(sure) >= _MIN_POINTS and sure.min() == largest != 1.0
    if equal:
        notify(
            f'{found.path}: all confidences are {largest:g}: they carry no information, and are '
            'taken as 1'
        )

    divisor = largest if equal else scale
    found.change(lambda x: replace(x, confidences=np.clip(x.confidences / divisor, 0.0, 1.0)))


def _scale_places(
    found: FoundPersons, size: tuple[int, int], notify: Notify, points_size: tuple[int, int] | None
) -> None:
    """Scales positions to pixels of the images."""
    (width, height), given = size, points_size or found.size
    persons = _likely(found)
    points = np.concatenate([x.keypoints.pixels[x.keypoints.seen] for x in persons])
    factor, shift = np.ones(2), np.zeros(2)
    if found.fractions or np.abs(points).max() <= _FRACTION:
        factor = np.array(size, dtype=np.float64)
        if points.min() < -1.0 / _FRACTION**2:  # coordinates from -1 to 1 over the width
            factor, shift = np.full(2, width / 2), np.array(size) / 2
        notify(f'{found.path}: positions are fractions of the image, of {width}x{height} pixels')
    elif given is not None:
        if given[0] <= 0 or abs(given[1] / given[0] * width / height - 1.0) > _SHAPE_TOLERANCE:
            raise ValueError(
                f'the keypoints were found in images of {given[0]}x{given[1]} pixels, but the '
                f'frames have {width}x{height}; --keypoints-size WxH sets another size'
            )
        factor = np.array(size) / given
        if (factor != 1.0).any():
            notify(
                f'{found.path}: positions are scaled from {given[0]}x{given[1]} to {width}x{height}'
            )
    else:
        sure = np.concatenate([x.keypoints.confidences[x.keypoints.seen] for x in persons])
        _check_places(points, sure >= min(_MIN_CONFIDENCE, sure.max()), size)
    found.change(lambda x: replace(x, pixels=x.pixels * factor + shift))


def _check_places(points: Array, sure: Mask, size: tuple[int, int]) -> None:
    """Raises ValueError if points (n, 2) seem to be from images of a different size."""
    (width, height), shares = size, points / size
    outside = ((shares < -_IMAGE_MARGIN) | (shares > 1 + _IMAGE_MARGIN)).any(1) & sure
    if outside.sum() > (1 - _MIN_INSIDE_FRACTION) * sure.sum():
        raise ValueError(
            f'{outside.sum()} of {sure.sum()} keypoints lie outside of the images, of '
            f'{width}x{height}: found in larger images, or not upright? --keypoints-size WxH '
            'sets the size of those images'
        )
    if len(points) >= _MIN_POINTS and (shares < _REDUCED_FRACTION).all():
        raise ValueError(
            f'all keypoints lie in the upper left quarter of {width}x{height}: found in smaller '
            f'images? --keypoints-size WxH sets their size, such as {width // 2}x{height // 2}, '
            f'or {width}x{height} where the person is there'
        )


def _name_points(found: FoundPersons, notify: Notify, scheme: str) -> None:
    """Names unnamed points in the order for which bones have human lengths."""
    persons = _likely(found)
    names = persons[0].keypoints.names
    alike = [x.keypoints for x in persons if x.keypoints.names == names]
    pixels = np.stack(
        [np.where(x.confidences[:, None] < _MIN_BONE_CONFIDENCE, np.nan, x.pixels) for x in alike]
    )
    orders = unnamed_orders().get(found.unnamed, ())
    if scheme != AUTO:
        if found.unnamed and scheme != JOINTS and len(schemes()[scheme].names) == len(names):
            _rename(found, scheme)
        return
    tried = {x: bone_deviation(schemes()[x].names, pixels, x) for x in orders}
    usual = next(iter(tried), '')
    if not tried:
        tried[usual] = bone_deviation(names, pixels)
    if not tried[usual] > (_MAX_Z if orders else _MAX_Z_OF_NAMES):
        return
    best = min(tried, key=lambda x: np.nan_to_num(tried[x], nan=math.inf))
    if tried[best] > min(_MAX_Z, _MAX_Z_RATIO * tried[usual]):
        own = recognised(names)
        what = f'{found.unnamed} points are not in the order of {" or ".join(orders)}'
        raise ValueError(
            f'bone lengths are not human: {what if orders else "the names are wrong"}, or points '
            f'of two people are in one list; --scheme {usual or (own.name if own else JOINTS)} '
            'accepts them as they are'
        )
    notify(
        f'{found.path}: bone lengths are human in the order of {best}, not in that of {usual}; '
        f'--scheme {usual} selects the latter'
    )
    _rename(found, best)


def _rename(found: FoundPersons, scheme: str) -> None:
    """Gives unnamed points the names of a scheme with the same number of points."""
    names = schemes()[scheme].names
    found.change(lambda x: replace(x, names=names) if len(x.names) == len(names) else x)


def bone_deviation(names: Sequence[str], pixels: Array, scheme: str = AUTO) -> float:
    """Deviation z of bone lengths from human lengths, in standard deviations; NaN if unknown.

    Args:
        names: (n,) names of the points.
        pixels: (N, n, 2) points of N persons, px; NaN where a point was not seen.
    """
    marks = [x.name if x else '' for x in landmarks_of(names, (), scheme)]
    where = {
        x.replace('centre_of_left', 'left').replace('centre_of_right', 'right'): i
        for i, x in enumerate(marks)
    }
    bones = [(where[a], where[b], *x) for (a, b), x in bone_lengths().items() if {a, b} <= {*where}]
    if len(bones) < _MIN_BONES:
        return math.nan
    one, other, usual, sigma = (np.array(x) for x in zip(*bones, strict=True))
    lengths = np.linalg.norm(pixels[:, one] - pixels[:, other], axis=2)
    seen = np.isfinite(lengths)
    kept = seen.sum(1) >= _MIN_BONES
    lengths, seen = lengths[kept], seen[kept]
    if len(lengths) < _MIN_PERSONS:
        return math.nan
    scale = np.where(seen, lengths, 0.0).sum(1) / (seen * usual).sum(1)
    ratios = lengths / usual / np.maximum(scale, 1e-6)[:, None]
    ratios, sigma = ratios[:, seen.any(0)], sigma[seen.any(0)]
    logs = np.log(np.maximum(np.nanquantile(ratios, _QUANTILE, axis=0), 1e-3) / _USUAL)
    return float(np.mean((logs / (sigma * np.where(logs > 0.0, 1.0, _BELOW))) ** 4) ** 0.25)


def check_steps(persons: Sequence[Person]) -> None:
    """Raises ValueError if a person leaps back and forth, as when a list mixes two people.

    Args:
        persons: one person in successive frames.
    """
    leaps = 0
    for i, (before, one) in enumerate(pairwise(persons)):
        step = one.distance(before)
        soon = persons[i + 2 : i + 2 + _SOON] if step > _LEAP * before.size else ()
        leaps += any(x.distance(before) < _BACK * step for x in soon)
    if leaps >= _LEAPS and leaps > _OFTEN * len(persons):
        raise ValueError(
            f'{leaps} times the person jumps away in one frame and back in the next: points of '
            'two people under one name? Write a list for each; --person at:X,Y or track:1 '
            'follows one'
        )
