"""Motions of a stick figure in BVH files, in m and degrees; y is up, and it faces z."""

from __future__ import annotations

from pathlib import Path

import numpy as np

Joints = dict[str, tuple[str, np.ndarray]]


def figure(
    size: float = 1.0, arms: float = 1.0, hips: float = 1.0, *, hang: bool = False
) -> Joints:
    """Parent and offset of each joint, in the order of the file.

    Args:
        size: scale of the whole figure.
        arms: scale of the arms.
        hips: scale of the height of the root above the hips.
        hang: whether the arms hang down instead of forming a T.
    """
    chains = [('Hips', {'Spine': (0, 0.15, 0), 'Neck': (0, 0.28, 0), 'Head': (0, 0.18, 0)})]
    legs = []
    for side, x in (('Left', 1.0), ('Right', -1.0)):
        along = np.array([0.0, -arms, 0.0] if hang else [arms * x, 0.0, 0.0])
        arm = {'Arm': arms * np.array([0.18 * x, 0.26, 0]), 'ForeArm': 0.28 * along}
        leg = {'UpLeg': (0.1 * x, -0.1 * hips, 0), 'Leg': (0, -0.42, 0), 'Foot': (0, -0.41, 0)}
        arm['Hand'], leg['ToeBase'] = 0.23 * along, (0, -0.03, 0.13)
        chains.append(('Spine', {side + name: offset for name, offset in arm.items()}))
        legs.append(('Hips', {side + name: offset for name, offset in leg.items()}))
    joints: Joints = {'Hips': ('', np.zeros(3))}
    for parent, bones in chains + legs:
        for name, offset in bones.items():
            joints[name] = (parent, size * np.array(offset))
            parent = name
    return joints


def write_bvh(path: Path, joints: Joints, rows: np.ndarray, fps: float = 30.0) -> Path:
    """Writes rows (T, 3 + 3 J): the place of the root and angles about z, x and y of each joint."""

    def part(name: str) -> str:
        parent, offset = joints[name]
        root = '' if parent else 'Xposition Yposition Zposition '
        below = [part(child) for child, (above, _) in joints.items() if above == name]
        end = ' '.join(f'{x:.5f}' for x in 0.3 * offset)
        inside = ''.join(below) or f'End Site\n{{\nOFFSET {end}\n}}\n'
        return (
            f'{"JOINT" if parent else "ROOT"} {name}\n{{\n'
            f'OFFSET {" ".join(f"{x:.5f}" for x in offset)}\n'
            f'CHANNELS {3 if parent else 6} {root}Zrotation Xrotation Yrotation\n'
            f'{inside}}}\n'
        )

    lines = ''.join(' '.join(f'{x:.4f}' for x in row) + '\n' for row in rows)
    head = f'HIERARCHY\n{part("Hips")}MOTION\nFrames: {len(rows)}\nFrame Time: {1 / fps:.6f}\n'
    path.write_text(head + lines)
    return path
