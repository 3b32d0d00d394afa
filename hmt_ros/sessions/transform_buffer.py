"""Transforms between frames over time, from the messages on /tf and /tf_static, without ROS.

The rules are as in tf2: a frame has one parent; between two stamps rotations are interpolated on
the shortest arc and positions along a line; nothing is extrapolated; a transform on /tf_static
is valid at all times. The same messages in the same order give the same transforms.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from hmt_ros.core import elementary
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.linear_algebra import length, product
from msg_tools.files.error_line import one_line
from msg_tools.messages.headers import SECOND_NS, time_ns

# Sources of transforms.
TF, TF_STATIC = TRANSFORMS = ('tf', 'tf_static')
TRANSFORMS_TYPE = 'tf2_msgs/msg/TFMessage'

# Time for which places of moving frames are kept, as in tf2, s; maximum numbers of frames, and of
# stamps per frame.
MEMORY_TIME = 10.0
MAX_FRAMES, MAX_STAMPS = 1000, 10_000
# Maximum deviation of the length of a quaternion from 1, twice the limit in tf2.
_UNIT_TOLERANCE = 1e-2
# Cosine of half the angle between two rotations above which interpolation is linear.
_CLOSE_COSINE = 0.9995
# Maximum number of frame names in an error message.
_MAX_LISTED_FRAMES = 12


class TransformError(ValueError):
    """No transform between two frames is known at a time; the message is one line."""


class Transform(NamedTuple):
    """Transform from a frame to its parent: p_parent = R p_child + t.

    Attributes:
        rotation: R (3, 3).
        translation: t (3,), m.
    """

    rotation: Array
    translation: Array

    def after(self, inner: Transform) -> Transform:
        """Return the transform that applies `inner` first and then this one."""
        return Transform(
            product(self.rotation, inner.rotation),
            product(self.rotation, inner.translation) + self.translation,
        )

    def inverse(self) -> Transform:
        """Return the inverse transform."""
        back = self.rotation.T
        return Transform(back, product(-back, self.translation))


class _Sample(NamedTuple):
    """Place of a frame in its parent: position (3,) m, unit quaternion (4,) x y z w."""

    parent: str
    position: Array
    quaternion: Array

    def transform(self) -> Transform:
        return Transform(rotation_matrix(self.quaternion), self.position)


class _Frame:
    """Places of a frame in its parent over time.

    Attributes:
        static: constant place; None if the frame moves.
        places: stamps, ns, and places of a moving frame, in the order of the stamps.
    """

    def __init__(self, static: _Sample | None = None) -> None:
        self.static = static
        self.places: list[tuple[int, _Sample]] = []
        # A place at a distant time, which is used only if the next place confirms that time.
        self._aside: tuple[int, _Sample] | None = None

    @property
    def parent(self) -> str:
        """Newest parent of the frame."""
        newest = self.places[-1][1] if self.static is None else self.static
        return newest.parent

    def put(self, stamp: int, sample: _Sample) -> None:
        aside, self._aside = self._aside, None
        if self.places and abs(stamp - self.places[-1][0]) > MEMORY_TIME * SECOND_NS:
            if aside is None or not 0 < stamp - aside[0] <= MEMORY_TIME * SECOND_NS:
                self._aside = stamp, sample
                return
            # Time has jumped.
            self.places = [aside]
        self.places[self.first(stamp) : self.first(stamp + 1)] = [(stamp, sample)]
        old = self.first(self.places[-1][0] - round(MEMORY_TIME * SECOND_NS))
        del self.places[: max(old, len(self.places) - MAX_STAMPS)]

    def at(self, stamp: int) -> _Sample | None:
        """Return the place at a time; None outside of the range of known stamps."""
        if self.static is not None:
            return self.static
        after = self.first(stamp)
        if after < len(self.places) and self.places[after][0] == stamp:
            return self.places[after][1]
        if after in (0, len(self.places)):
            return None
        (start, one), (end, other) = self.places[after - 1 : after + 1]
        if one.parent != other.parent:
            return one
        share = (stamp - start) / (end - start)
        return _Sample(
            one.parent,
            one.position + share * (other.position - one.position),
            slerp(one.quaternion, other.quaternion, share),
        )

    def first(self, stamp: int) -> int:
        """Return the index of the first place that is not older than a stamp."""
        return bisect_left(self.places, stamp, key=lambda place: place[0])


class TransformBuffer:
    """Stores transforms and composes them along the tree of frames."""

    def __init__(self) -> None:
        self._frames: dict[str, _Frame] = {}

    def put(self, message: Any, *, static: bool) -> list[str]:
        """Stores the transforms of a tf2_msgs/TFMessage.

        Args:
            message: message of `rosbags` or of ROS.
            static: whether the message is from /tf_static.

        Returns:
            A line for each transform that was rejected, with the reason.
        """
        faults = []
        for stamped in message.transforms:
            parent, child = _name(stamped.header.frame_id), _name(stamped.child_frame_id)
            try:
                self._put(parent, child, stamped, static=static)
            except ValueError as error:
                faults.append(f'transform from {child!r} to {parent!r}: {error}')
        return faults

    def forget_after(self, stamp_ns: int) -> None:
        """Removes the places of moving frames that are later than a stamp."""
        for frame in self._frames.values():
            del frame.places[frame.first(stamp_ns + 1) :]
        self._frames = {name: x for name, x in self._frames.items() if x.static or x.places}

    def has_later(self, stamp_ns: int, timeout_ns: float) -> bool:
        """Whether any moving frame has a place that is more than a timeout later than a stamp.

        A much later place is ignored, because its stamp may be wrong.
        """
        longest = timeout_ns + MEMORY_TIME * SECOND_NS
        return any(
            timeout_ns < frame.places[-1][0] - stamp_ns <= longest
            for frame in self._frames.values()
            if frame.places
        )

    def frames(self) -> list[str]:
        """Return the names of all frames, sorted."""
        return sorted(self._frames.keys() | {frame.parent for frame in self._frames.values()})

    def lookup(self, target: str, source: str, stamp_ns: int) -> Transform:
        """Return the transform p_target = R p_source + t at a time.

        Raises:
            TransformError: a frame is unknown, the frames are not connected or form a loop, or no
                transform is known at that time.
        """
        target, source = _name(target), _name(source)
        from_target, why = self._to_root(target, stamp_ns)
        from_source, also = self._to_root(source, stamp_ns)
        for name, inner in from_source.items():
            if name in from_target:
                return from_target[name].inverse().after(inner)
        known = self.frames()
        for name in (source, target):
            if name not in known:
                raise TransformError(f'there is no frame {name!r}; there are: {_listed(known)}')
        raise TransformError(
            why
            or also
            or f'{source!r} and {target!r} are not connected; there are: {_listed(known)}'
        )

    def _put(self, parent: str, child: str, stamped: Any, *, static: bool) -> None:
        if not parent or not child:
            raise ValueError('a frame has no name')
        if parent == child:
            raise ValueError('a frame can not be its own parent')
        t, r = stamped.transform.translation, stamped.transform.rotation
        position, quaternion = np.array([t.x, t.y, t.z]), np.array([r.x, r.y, r.z, r.w])
        if not (np.isfinite(position).all() and np.isfinite(quaternion).all()):
            raise ValueError('its numbers are not finite')
        length = math.hypot(*quaternion)
        if abs(length - 1.0) > _UNIT_TOLERANCE:
            raise ValueError(f'its quaternion has length {length:.3g}, wanted 1')
        known = self._frames.get(child)
        if known is None and len(self._frames) >= MAX_FRAMES:
            raise ValueError(f'there are {MAX_FRAMES} frames already')
        sample = _Sample(parent, position, quaternion / length)
        if static:
            self._frames[child] = _Frame(sample)
            return
        if known is None or known.static is not None:
            known = self._frames[child] = _Frame()
        known.put(time_ns(stamped.header.stamp), sample)

    def _to_root(self, frame: str, stamp_ns: int) -> tuple[dict[str, Transform], str]:
        """Return the transforms to a frame's ancestors, and why the root is not reached, or ''."""
        reached = {frame: Transform(np.eye(3), np.zeros(3))}
        here, total = frame, reached[frame]
        while (known := self._frames.get(here)) is not None:
            sample = known.at(stamp_ns)
            if sample is None:
                first, last = known.places[0][0], known.places[-1][0]
                return reached, (
                    f'{here!r} has transforms of {first} to {last} ns, wanted {stamp_ns} ns'
                )
            if sample.parent in reached:
                return reached, f'the frames {_listed([*reached, sample.parent])} form a loop'
            total = sample.transform().after(total)
            here = sample.parent
            reached[here] = total
        return reached, ''


def rotation_matrix(quaternion: Array) -> Array:
    """Return the rotation (3, 3) of a unit quaternion (4,) x y z w."""
    x, y, z, w = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def slerp(start: Array, end: Array, share: float) -> Array:
    """Interpolate unit quaternions (4,) on the shortest arc (Shoemake 1985)."""
    cosine = float(product(start, end))
    if cosine < 0:
        end, cosine = -end, -cosine
    if cosine > _CLOSE_COSINE:
        between = start + share * (end - start)
    else:
        angle = elementary.arccos(cosine)
        between = elementary.sin((1 - share) * angle) * start + elementary.sin(share * angle) * end
    return between / length(between)


def _name(frame: Any) -> str:
    """Return a frame name in the style of tf2, without the leading slash of tf."""
    return str(frame).removeprefix('/')


def _listed(names: Iterable[str]) -> str:
    every = [one_line(name) for name in names]
    more = f' and {len(every) - _MAX_LISTED_FRAMES} more' if len(every) > _MAX_LISTED_FRAMES else ''
    return (', '.join(every[:_MAX_LISTED_FRAMES]) or 'none') + more
