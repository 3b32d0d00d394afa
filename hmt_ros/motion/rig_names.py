"""Standard joint names for the skeletons of motion files.

Every maker of motion files names joints his own way: CMU's ASF (`lfemur`), its BVH conversions by
cgspeed (`LeftUpLeg`, or `lThigh` for Daz), Character Creator (`CC_Base_L_Thigh`), MotionBuilder,
Mixamo and the capture suits (`mixamorig:LeftUpLeg`, `LeftHip`), game rigs (`thigh_l`). A joint is
named after the segment that starts at it, so `LeftUpLeg`, the thigh, is the left hip.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from itertools import pairwise

SIDES = ('left', 'right')
ARM = ('shoulder', 'elbow', 'wrist', 'hand')
LEG = ('hip', 'knee', 'ankle', 'toe')

# Names in lower case without separators, sides and prefixes; the first that a file has wins.
CENTRAL = {
    'pelvis': ('hips', 'hip', 'pelvis', 'root'),
    'neck': ('lowerneck', 'neck', 'necktwist01', 'neck01', 'neck1', 'necklower'),
    'head': ('head',),
}
PAIRED = {
    'hip': ('femur', 'upleg', 'thigh', 'upperleg', 'thighbend', 'hip'),
    'knee': ('tibia', 'leg', 'lowleg', 'lowerleg', 'shin', 'calf', 'knee'),
    'ankle': ('foot', 'ankle'),
    'toe': ('toes', 'toebase', 'toe', 'ball'),
    'shoulder': ('humerus', 'arm', 'upperarm', 'uparm', 'shldr', 'shldrbend', 'shoulder'),
    'elbow': ('radius', 'forearm', 'lowerarm', 'lowarm', 'forearmbend', 'elbow'),
    'wrist': ('wrist', 'hand'),
    'hand': ('fingerbase', 'hand', 'handend', 'mid1', 'middle1', 'handmiddle1', 'fingers'),
}
TIPPED = {'toe': 'ankle', 'hand': 'wrist'}  # else whatever comes next after that joint
PREFIX = re.compile(r'^(cc_base_|bip0*1[ _]?|def[-_]|mixamorig\d*[:_]?|character\d+_)', re.I)


def standard_names(names: Sequence[str], parents: Sequence[int]) -> list[str]:
    """The names of a file's joints, with the standard ones where the skeleton is a human's.

    Args:
        names: (J,) of the joints in the file.
        parents: (J,) the joint that each bone comes from, -1 for the root.

    Returns:
        (J,) each joint once, under its standard name (`left_hip`) or else the file's. No standard
        name is given unless pelvis, neck, head and all of hips, knees, ankles, shoulders, elbows
        and wrists are found and lie in that order on the way outwards.
    """
    found = _matches(names, parents)
    if found is None:
        return list(names)
    by_joint = {joint: standard for standard, joint in found.items()}
    result = []
    for joint, name in enumerate(names):
        own = by_joint.get(joint, name)
        if joint not in by_joint and own in found:  # a standard name that means another joint
            own += '_'
        result.append(own)
    return result


def _matches(names: Sequence[str], parents: Sequence[int]) -> dict[str, int] | None:
    known: dict[str, int] = {}
    for joint, name in enumerate(names):
        known.setdefault(_plain(name), joint)
    used: set[int] = set()
    found: dict[str, int] = {}
    for standard, variants in _spellings():
        candidates = [known[v] for v in variants if v in known]
        side, _, kind = standard.partition('_')
        if kind in TIPPED:
            carrier = found.get(f'{side}_{TIPPED[kind]}')
            candidates += [j for j, p in enumerate(parents) if p == carrier]
        for joint in candidates:
            if joint not in used:
                found[standard] = joint
                used.add(joint)
                break
    for way in _ways():
        needed = [name for name in way if name.partition('_')[2] not in TIPPED]
        if not all(name in found for name in needed):
            return None
        present = [found[name] for name in way if name in found]
        if not all(_leads_to(parents, a, b) for a, b in pairwise(present)):
            return None
    return found


def _plain(name: str) -> str:
    name = PREFIX.sub('', name.rpartition(':')[2])
    return re.sub(r'[^a-z0-9]', '', name.lower())


def _spellings() -> Iterator[tuple[str, list[str]]]:
    for standard, variants in CENTRAL.items():
        yield standard, list(variants)
    for standard, variants in PAIRED.items():
        for side in SIDES:
            marks = (side, side[0])
            spelt = [f'{m}{v}' for v in variants for m in marks]
            yield f'{side}_{standard}', spelt + [f'{v}{m}' for v in variants for m in marks]


def _ways() -> Iterator[list[str]]:
    yield ['pelvis', 'neck', 'head']
    for side in SIDES:
        for limb in (ARM, LEG):
            yield ['pelvis', *(f'{side}_{joint}' for joint in limb)]


def _leads_to(parents: Sequence[int], start: int, end: int) -> bool:
    while end >= 0 and end != start:
        end = parents[end]
    return end == start
