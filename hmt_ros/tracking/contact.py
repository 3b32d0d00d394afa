"""Contact of the feet of the modes, as far as the ground is known; see `body.foot_contact`."""

from __future__ import annotations

from dataclasses import replace

from hmt_ros.body.body import Body
from hmt_ros.body.foot_contact import contacts, first_contacts
from hmt_ros.body.ground_terms import FEET, FloorPlane, sole_points
from hmt_ros.tracking.hypotheses import Modes


def contacts_of(
    body: Body, plane: FloorPlane, modes: Modes, before: Modes | None, dt: float, *, still: bool
) -> Modes:
    """Modes with their soles, and the probabilities that these rest.

    Args:
        body: of the modes.
        plane: gravity and floor.
        modes: of an image.
        before: modes of the image before, in the same camera frame, where the ancestors are; None:
            the modes come from nothing before.
        dt: time since then, s.
        still: whether the motion of the camera is known.
    """
    points = sole_points(body, modes.poses)
    if before is None:
        return replace(modes, soles=points, contacts=first_contacts(plane, points))
    rested, soles = before.contacts[modes.ancestors], before.soles[modes.ancestors]
    found = contacts(plane, points, rested, soles, dt, still=still)
    return replace(modes, soles=points, contacts=found)


def by_foot(modes: Modes) -> dict[str, float]:
    """Probability that the heaviest mode rests on a foot, by 'left_foot' and 'right_foot'.

    Empty without modes, where the ground is not used, and for a body without feet.
    """
    if not modes.contacts.size:
        return {}
    best = modes.contacts[0].reshape(len(FEET), -1).max(1)
    return {f'{side}_foot': float(p) for side, p in zip(FEET, best, strict=True)}
