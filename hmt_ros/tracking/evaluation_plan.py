"""Images that move the modes far, as when people move fast: they get more evaluations.

    m' P m  >  `SURPRISING_RATIO` E m' P m  =  `SURPRISING_RATIO` tr(I - P H^-1)

m leads from the prediction of the heaviest mode, which has the precision P, to its optimum, where
the energy has the Hessian H; so the covariance of m is P^-1 - H^-1. The usual distance grows with
the information in the image, so with the time between two images.
"""

from __future__ import annotations

import numpy as np

from hmt_ros.inference.arrays import Array
from hmt_ros.tracking.settings import SURPRISING_RATIO


def is_surprising(moved: Array, precision: Array, hessian: Array) -> bool:
    """Whether an image has moved a mode far for its information; never where it has none.

    Args:
        moved: (d,) from the prediction of the mode to its optimum.
        precision: (d, d) of the prediction.
        hessian: (d, d) of the energy, motion prior included, at the optimum.
    """
    expected = len(moved) - np.trace(np.linalg.solve(hessian, precision))
    return bool(moved @ precision @ moved > SURPRISING_RATIO * max(expected, 1.0))
