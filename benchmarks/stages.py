"""A clock for parts of a program, wrapped from outside, and the stages of a tracking step."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from hmt_ros.image.background import BackgroundModel
from hmt_ros.image.pose_energy import PoseEnergy
from hmt_ros.tracking import filter as filter_module
from hmt_ros.tracking import observer as observer_module
from hmt_ros.tracking import tracker as tracker_module
from hmt_ros.tracking.filter import MixtureFilter
from hmt_ros.tracking.posterior import Posterior
from hmt_ros.tracking.proposals import kinematic_jumps as jumps_module

# Owner, name and stage of each part; time in a nested part counts only for that part.
Stages = Sequence[tuple[Any, str, str]]
STAGES: Stages = (
    (BackgroundModel, 'split', 'background'),
    (observer_module, 'observe', 'observation'),
    (MixtureFilter, 'begin', 'start of the track'),
    (filter_module, 'follow_flow', 'motion'),
    (filter_module, 'propose', 'proposals'),
    (jumps_module, 'find_limb', 'chain search'),
    (PoseEnergy, 'values', 'rating'),
    (Posterior, 'minimise', 'candidates'),
    (MixtureFilter, '_weigh', 'keeping'),
    (MixtureFilter, '_select', 'keeping'),
    (MixtureFilter, '_fit_shape', 'shape'),
    (tracker_module, 'likelihood_modes', 'likelihood modes'),
)
# Stages that include their minimisation and rating.
WHOLE = ('motion', 'start of the track', 'chain search')
PROPOSED = ('proposals',)


class StageClock:
    """Seconds per stage, summed up.

    Args:
        stages: owner, attribute name and stage of each part.
        clock: function that returns the time, s.
    """

    def __init__(
        self, stages: Stages = STAGES, clock: Callable[[], float] = time.perf_counter
    ) -> None:
        self._stages = stages
        self._clock = clock
        self.seconds: dict[str, float] = {}
        self._stack: list[str] = []
        self._since = 0.0
        self._proposed = False

    def begin_step(self) -> None:
        """Begins a new image; minimisation before its proposals belongs to the predictions."""
        self._proposed = False

    def _enter(self, stage: str) -> None:
        if stage in ('candidates', 'rating') and self._stack and self._stack[-1] in WHOLE:
            stage = self._stack[-1]
        elif stage == 'candidates' and not self._proposed:
            stage = 'predictions'
        self._proposed |= stage in PROPOSED
        self._charge()
        self._stack.append(stage)

    def _hand_over(self) -> None:
        self._charge()
        self._stack.pop()

    def _charge(self) -> None:
        now = self._clock()
        if self._stack:
            stage = self._stack[-1]
            self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._since
        self._since = now

    def _wrapped(self, function: Callable[..., Any], stage: str) -> Callable[..., Any]:
        def timed(*args: Any, **kwargs: Any) -> Any:
            self._enter(stage)
            try:
                return function(*args, **kwargs)
            finally:
                self._hand_over()

        return timed

    @contextmanager
    def running(self) -> Iterator[StageClock]:
        """Times all calls of the parts in this context."""
        usual = [(owner, name, getattr(owner, name)) for owner, name, _ in self._stages]
        try:
            for (owner, name, stage), (_, _, function) in zip(self._stages, usual, strict=True):
                setattr(owner, name, self._wrapped(function, stage))
            yield self
        finally:
            for owner, name, function in usual:
                setattr(owner, name, function)
