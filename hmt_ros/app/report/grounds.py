"""The floor and the contacts in a bag, which a report shows."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

from msg_tools import BagReader
from msg_tools.messages.ground import GROUND, GroundState, ground_of


def read_grounds(path: Path, topic: str, frame_id: str) -> dict[int, GroundState]:
    """What a bag tells of the ground, by stamp in ns; nothing if it has no such topic.

    Args:
        path: path of the bag.
        topic: topic of the mixtures that are shown: the ground is on the topic of the same
            namespace, or else on the only one of the bag.
        frame_id: frame of the mixtures; a ground in another frame is left out.

    Raises:
        ValueError: a message that can not be understood.
    """
    with BagReader(path) as bag:
        names = [
            each.name
            for each in bag.topics.values()
            if each.msgtype == GROUND and each.message_count
        ]
        beside = [name for name in names if _namespace(name) == _namespace(topic)]
        chosen = beside or names
        if len(chosen) != 1:
            return {}
        found = {}
        for stored in bag.messages(chosen):
            try:
                content = ground_of(stored.message)
            except ValueError as error:
                where = f'{path}: {stored.topic} at {stored.log_time_ns} ns'
                raise ValueError(f'{where}: {error}') from error
            if content.frame_id == frame_id:
                found[content.stamp_ns] = content
    return found


def ground_data(grounds: dict[int, GroundState], stamps: Collection[int]) -> dict[str, Any] | None:
    """The ground in the data of the page; None: nothing is known at these times.

    Returns:
        For each time or None: `planes`, (a, b, c, d) with a x + b y + c z + d = 0 on the floor, m,
        camera optical frame; `contacts`, the probability that a foot stands on it by its side.
    """
    shown = [grounds.get(stamp) for stamp in stamps]
    planes = [None if one is None else one.plane for one in shown]
    contacts = [{} if one is None else one.contacts for one in shown]
    if all(plane is None for plane in planes) and not any(contacts):
        return None
    return {
        'planes': [
            None if plane is None else [round(float(x), 6) for x in plane] for plane in planes
        ],
        'contacts': [
            {foot.removesuffix('_foot'): round(float(p), 3) for foot, p in one.items()}
            for one in contacts
        ],
    }


def _namespace(topic: str) -> str:
    return topic.lstrip('/').rpartition('/')[0]
