"""Allocation of the evaluations of one image: a count, so that results do not depend on speed.

    budget B    predictions descend    limbs and trunks are rated    candidates descend
    share       about B / 8            at most 2 B / 3                about B / 5

Where limbs are searched for as well, at most 2 B / 5 are rated.

The rest goes to covariances and shape of the modes and to the likelihood alone. Settings bound each
part; a budget below them takes from all parts. An image that moves the heaviest mode far from its
prediction, as when people move fast, gets more. The usual distance grows with the information in
the image, so with the time between two images:

    m' P m  >  `SURPRISING` E m' P m  =  `SURPRISING` tr(I - P H^-1)

m leads from the mode's prediction, which has the precision P, to its optimum, where the energy has
the Hessian H; so the covariance of m is P^-1 - H^-1.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hmt_ros.inference.arrays import Array

if TYPE_CHECKING:
    from hmt_ros.tracking.settings import TrackerSettings

# Budgets of the nodes, which have to keep up with a camera, and of everything else.
LIVE, ACCURATE = 300, 400
# Ratio of the motion of the heaviest mode to the expected one above which an image is surprising:
# the motion prior is wider than most motions. Factor on the budget of such an image.
SURPRISING, MORE = 0.3, 4
# Below this budget no limb is searched.
LEAST_SEARCHED = 100


def is_surprising(moved: Array, precision: Array, hessian: Array) -> bool:
    """Whether an image has moved a mode far for its information; never where it has none.

    Args:
        moved: (d,) from the prediction of the mode to its optimum.
        precision: (d, d) of the prediction.
        hessian: (d, d) of the energy, motion prior included, at the optimum.
    """
    expected = len(moved) - np.trace(np.linalg.solve(hessian, precision))
    return bool(moved @ precision @ moved > SURPRISING * max(expected, 1.0))


@dataclass(frozen=True)
class EvaluationPlan:
    """Sizes of the search in an image.

    Attributes:
        hypotheses: maximum number of modes that are kept, K.
        candidates: maximum number of hypotheses that are fully optimised.
        iterations: number of Newton steps on the predictions, and on the candidates.
        groups: maximum number of groups of modes with a trunk of their own that are searched.
        rated: maximum number of poses that are rated, all groups together, where limbs are
            searched for.
        rated_alone: the same without limb search.
        alternatives: maximum number of configurations of a limb.
        combinations: maximum number of combinations on each trunk.
        searched_chains: number of limbs searched in each group.
        samples, refined: number of samples that a limb draws, and of the best that are refined.
        surprising: whether the image is surprising.
    """

    hypotheses: int
    candidates: int
    iterations: int
    groups: int
    rated: int
    rated_alone: int
    alternatives: int
    combinations: int
    searched_chains: int
    samples: int
    refined: int
    surprising: bool


def plan_of(settings: TrackerSettings, *, surprising: bool = False) -> EvaluationPlan:
    """The plan that keeps to the evaluation budget of some settings, and to their bounds.

    Args:
        settings: of the tracker.
        surprising: whether the image is surprising.
    """
    s = settings
    budget = settings.evaluation_budget * (MORE if surprising else 1)
    hypotheses = min(s.max_hypotheses, max(budget // 25, 1))
    searched = max(round(budget / ACCURATE), 1) if budget >= LEAST_SEARCHED else 0
    return EvaluationPlan(
        hypotheses=hypotheses,
        candidates=max(min(s.candidates, budget // 40), hypotheses),
        iterations=min(s.iterations, max(budget // 60, 1)),
        groups=min(3, max(budget // 65, 1)),
        rated=2 * budget // 5,
        rated_alone=2 * budget // 3,
        alternatives=min(s.alternatives, max(budget // 65, 2)),
        combinations=min(s.combinations, max(budget // 8, 4)),
        searched_chains=min(s.searched_chains, searched),
        samples=min(s.search.samples, max(budget // 8, 6)),
        refined=min(s.search.refined, max(budget // 130, 1)),
        surprising=surprising,
    )
