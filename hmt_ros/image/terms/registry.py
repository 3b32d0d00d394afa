"""All terms of the image likelihood.

    E_image(x) = sum_t E_t(x)        over the terms t of the registry

A new term needs a file in this folder and a line in `TERMS`. The core, which computes the terms
pose by pose, needs a header in `core/terms` and a line in `core/terms.h`, in the same order.
"""

from __future__ import annotations

from typing import NamedTuple

from hmt_ros.body.camera import Lens
from hmt_ros.body.kinematics import Tree
from hmt_ros.image.surface import FleshTable
from hmt_ros.image.terms.depth import DEPTH
from hmt_ros.image.terms.edges import EDGES
from hmt_ros.image.terms.image_term import ImageTerm
from hmt_ros.image.terms.silhouette import COVERAGE
from hmt_ros.inference.arrays import Mask

TERMS: tuple[ImageTerm, ...] = (COVERAGE, EDGES, DEPTH)


class Model(NamedTuple):
    """Body and camera as inputs of the compiled core.

    Attributes:
        tree, flesh, lens: skeleton; parts and rings of the flesh; camera.
        traced: (B,) parts whose contour is compared with the image.
        occluders: (B,) parts that can hide other parts.
        contour_points: number of contour points to which weights refer; 0: the number of existing
            points.
    """

    tree: Tree
    flesh: FleshTable
    lens: Lens
    traced: Mask
    occluders: Mask
    contour_points: int
