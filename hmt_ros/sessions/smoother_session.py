"""The smoother behind its topics: messages in, messages out, without ROS.

The node and offline replay give their messages to a `SmootherSession`, one after the other; the
same messages in the same order give the same bytes. The rules:

- Mixtures are smoothed in the order of their stamps, in a window that slides. A pose is published
  as smoothed once `fixed_lag` later ones have been seen; those that are still open are published
  when the window ends: at the end of the stream (`finish`), where time jumps back, at a new body.
- A mixture that is not younger than the one before is skipped, or starts a new window where
  `reset_on_time_jump` says so.
- A mixture waits until the body has come that its joint positions are of: topics may overtake each
  other. At most `queue_size` wait; the oldest are dropped. A body with other lengths is a new
  track, and starts a new window.
- Gaps are bridged by the dynamics. One that is longer than `longest_interval` is told.
- What can not be used is skipped. Of each kind of fault the first is told, all are counted.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from hmt_ros.body import Body, load_body, named_body
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.reduction import merged_if_close
from hmt_ros.sessions.handled import Handled, Output
from hmt_ros.sessions.session import Session, entropy, everything
from hmt_ros.sessions.smoothed_messages import (
    SmoothedBody,
    final_messages,
    trajectory_content,
    window_messages,
)
from hmt_ros.sessions.smoother_parameters import SmootherParameters
from hmt_ros.smoothing import FinalPose, MixtureSmoother, SlidingWindow
from hmt_ros.smoothing.mixture_smoother import PathSmoother
from msg_tools import MessageError
from msg_tools.files.error_line import error_line
from msg_tools.messages.headers import SECOND_NS, time_ns
from msg_tools.messages.message_error import check_names
from msg_tools.messages.pose_mixtures import MixtureKind, PoseMixture, pose_mixture_of
from msg_tools.messages.trajectory_mixtures import trajectory_mixture_message

BODY, MIXTURE = 'body', 'likelihood_mixture'
FINISH = 'finish'  # what `finish` calls the end of the stream

# Positions of joints agree with the kinematics up to this, m.
_SAME_PLACE = 1e-4
# Kinds of faults of a mixture, by words of what is said of them.
_FAULTS = ('dof_names', 'no components', 'not finite', 'not positive definite', 'weight')


@dataclass(frozen=True)
class SmootherState:
    """What is going on, for diagnostics.

    Attributes:
        status: 'no body', 'waiting' or 'smoothing'.
        wants: what the next step waits for, '' while smoothing.
        window: poses in the window.
        trajectories: components of the mixture over them.
        entropy: of their weights, nats.
        gaps: intervals between mixtures that were longer than `longest_interval`.
        longest_gap: s.
        mixtures: number of mixtures: 'received', and of these 'smoothed', 'skipped', 'dropped'.
        faults: number of faults by kind.
        last_fault: the newest; '' before the first.
    """

    status: str
    wants: str
    window: int = 0
    trajectories: int = 0
    entropy: float = math.nan
    gaps: int = 0
    longest_gap: float = 0.0
    mixtures: Counter[str] = field(default_factory=Counter)
    faults: Counter[str] = field(default_factory=Counter)
    last_fault: str = ''


class KeptMixtures(NamedTuple):
    """Likelihoods that have been smoothed since the window began, the newest.

    Attributes:
        of: whose poses they are; None: nobody is known.
        items: (stamp, mixture), as they were received.
    """

    of: SmoothedBody | None
    items: tuple[tuple[int, GaussianMixture], ...]


class SmootherSession(Session):
    """One person, from the first message on.

    All methods but `smooth_span` are to be called by one thread; `state`, `kept` and `parameters`
    may be read and replaced by others.

    Args:
        parameters: of the node.
        publish: takes what is to be published, as soon as it is there.
        wanted: whether a topic needs to be published.

    Raises:
        ValueError: the parameters name a body that can not be used.

    Attributes:
        parameters: a new value takes effect when `declared_parameters` says.
        start: None, there is but one way to start.
        state: see `SmootherState`.
        kept: for `smooth_span`.
    """

    def __init__(
        self,
        parameters: SmootherParameters,
        publish: Callable[[Output], None],
        wanted: Callable[[str], bool] = everything,
    ) -> None:
        if parameters.body_model:
            known_body(parameters.body_model)
        super().__init__(parameters, publish, wanted)
        self._of: SmoothedBody | None = None
        self._window: SlidingWindow | None = None
        self._waiting: deque[Any] = deque()
        self._newest: int | None = None
        self._weights = np.empty(0)
        self._gaps, self._longest_gap = 0, 0.0
        self.kept = KeptMixtures(None, ())
        self.state = self._present_state()

    # What comes in.

    def take(self, source: str, message: Any) -> Handled:
        """Handles a message.

        Args:
            source: `BODY` or `MIXTURE`.
            message: hmt_msgs/Body or PoseMixture.
        """
        self._log.begin()
        if source == BODY:
            self._take_body(message)
        else:
            self._log.counts['received'] += 1
            self._waiting.append(message)
        self._smooth_what_is_ready()
        while len(self._waiting) > self.parameters.queue_size:
            self._drop(self._waiting.popleft())
        self.state = self._present_state()
        return self._log.handled(source, time_ns(message.header.stamp))

    def finish(self) -> Handled:
        """The stream ends: publishes the poses that are still open; what comes begins a window."""
        self._log.begin()
        stamp = self._newest or 0
        self._end_window()
        self.state = self._present_state()
        return self._log.handled(FINISH, stamp)

    def restart(self, start: None = None) -> None:
        """Forgets the window; the next mixture is the first of a new one."""
        self._window = None
        self._newest = None
        self._weights = np.empty(0)
        self.kept = KeptMixtures(self._of, ())
        self.state = self._present_state()

    def _take_body(self, message: Any) -> None:
        try:
            body = self._body_of(message)
        except ValueError as error:
            self._log.fault('body', str(error))
            return
        known, self._of = self._of, SmoothedBody(body, str(message.header.frame_id))
        if known is None:
            self.kept = KeptMixtures(self._of, ())
        elif not _same(known, self._of):
            if self._newest is not None:
                self._log.note('new body', 'another body has come: a new window begins')
            new, self._of = self._of, known
            self._end_window()
            self._of = new
            self.kept = KeptMixtures(new, ())

    def _body_of(self, message: Any) -> Body:
        chosen = self.parameters.body_model
        name = chosen or str(message.name)
        # A message must not have files read: what it names ships with the package.
        body = known_body(name, load_body if chosen else named_body)
        lengths = dict(
            zip(map(str, message.segment_names), map(float, message.segment_lengths), strict=False)
        )
        try:
            body = body.with_segment_lengths(lengths)
        except KeyError as error:
            raise ValueError(f'body {name}: {error.args[0]}') from error
        check_names(tuple(map(str, message.dof_names)), body.dof_names, f'body {name}: dof_names')
        return body

    def _smooth_what_is_ready(self) -> None:
        received, self._waiting = self._waiting, deque()
        for message in received:
            content = None if self._of is None else _content(message, self._of.body)
            if self._of is None or not (content is None or _is_of(content, self._of.body)):
                self._waiting.append(message)
                continue
            # The body of those before will not come any more.
            for older in self._waiting:
                self._drop(older)
            self._waiting.clear()
            self._take_mixture(message, content, self._of)

    def _drop(self, message: Any) -> None:
        self._log.counts['dropped'] += 1
        stamp = time_ns(message.header.stamp)
        what = 'no body has come' if self._of is None else 'no body that its joints are of has come'
        self._log.fault('no body', f'mixture of {stamp} ns is dropped: {what}')

    def _take_mixture(self, message: Any, content: PoseMixture | None, of: SmoothedBody) -> None:
        stamp = time_ns(message.header.stamp)
        mixture = self._readable(message, content, stamp, of)
        if mixture is None or not self._in_time(stamp):
            return
        p = self.parameters
        if self._newest is not None:
            interval = (stamp - self._newest) / SECOND_NS
            if interval > p.longest_interval:
                self._gaps += 1
                self._longest_gap = max(self._longest_gap, interval)
                self._log.note(
                    'gap',
                    f'no mixture for {interval:.2f} s before {stamp} ns: the dynamics bridge it',
                )
        if self._window is None:
            self._window = self._new_window(of.body)
        used = mixture
        if p.merge_distance > 0:
            used = merged_if_close(mixture, p.merge_distance)
        try:
            update = self._window.step(stamp, used)
        except (ValueError, ArithmeticError) as error:
            text = error_line(error)
            self._log.skip('estimate', f'mixture of {stamp} ns can not be smoothed: {text}')
            self._end_window()
            return
        self._newest = stamp
        self._log.counts['smoothed'] += 1
        self.kept = KeptMixtures(of, (*self.kept.items, (stamp, mixture))[-p.window_length :])
        self._weights = update.trajectories.weights
        window_messages(
            self._messages,
            update.trajectories,
            of,
            covariances=p.publish_covariances,
            wanted=self._wanted,
            publish=lambda topic, made: self._publish(topic, stamp, made),
        )
        for pose in update.final:
            self._publish_final(pose, of)

    def _readable(
        self, message: Any, content: PoseMixture | None, stamp: int, of: SmoothedBody
    ) -> GaussianMixture | None:
        """The mixture of a message, None where it can not be used."""
        name = str(message.body_model)
        try:
            if not self.parameters.body_model and name and name != of.body.name:
                raise MessageError(f'mixture is of the body {name}, wanted one of {of.body.name}')
            if content is None:
                content = pose_mixture_of(message, of.body.dof_names)
        except ValueError as error:
            text = str(error)
            kind = next((words for words in _FAULTS if words in text), 'mixture')
            self._log.skip(kind, f'mixture of {stamp} ns: {text}')
            return None
        if content.kind in (MixtureKind.POSTERIOR, MixtureKind.SMOOTHED):
            self._log.note(
                'kind of mixture',
                f'mixtures are of the kind {content.kind.name}, wanted LIKELIHOOD: what the images '
                'say counts more than once',
            )
        return content.mixture

    def _in_time(self, stamp: int) -> bool:
        """Whether a mixture comes after the one before, or may begin a new window."""
        newest = self._newest
        if newest is None or stamp > newest:
            return True
        text = f'mixture of {stamp} ns comes after one of {newest} ns'
        if stamp == newest:
            self._log.skip('time stands still', f'{text}, wanted stamps that increase')
            return False
        if not self.parameters.reset_on_time_jump:
            self._log.skip(
                'time jumps back',
                f'{text}: skipped; with reset_on_time_jump a new window would begin',
            )
            return False
        self._log.note('time jumps back', f'{text}: a new window begins')
        self._end_window()
        return True

    def _new_window(self, body: Body) -> SlidingWindow:
        p = self.parameters
        return SlidingWindow(self._smoother(body, PathSmoother), p.fixed_lag, p.random_seed)

    def _smoother(self, body: Body, closed_form: type[MixtureSmoother]) -> MixtureSmoother:
        """The smoother that the parameters ask for, with `closed_form` for the paths."""
        p = self.parameters
        kind = closed_form if p.method == 'paths' else MixtureSmoother
        return kind(
            p.dynamics.of(body),
            body.lower,
            body.upper,
            p.max_trajectories,
            through_modes=p.through_modes,
            error_correlation=p.error_correlation,
        )

    def _end_window(self) -> None:
        """Publishes what is still open, and forgets the window."""
        if self._window is not None and self._of is not None:
            for pose in self._window.finish():
                self._publish_final(pose, self._of)
        self.restart()

    # What comes out.

    def _publish_final(self, pose: FinalPose, of: SmoothedBody) -> None:
        final_messages(
            self._messages,
            pose,
            of,
            components=self.parameters.max_hypotheses,
            wanted=self._wanted,
            publish=lambda topic, made: self._publish(topic, pose.stamp_ns, made),
        )

    def smooth_span(self, from_ns: int = 0, to_ns: int = 0) -> Any:
        """Smooths the kept mixtures of a span of time, fully refined, all at once.

        May be called by any thread, at any time.

        Args:
            from_ns, to_ns: first and last stamp, inclusive; 0: the oldest, the newest.

        Returns:
            hmt_msgs/TrajectoryMixture with covariances.

        Raises:
            ValueError: there is none in the span, or they can not be smoothed.
        """
        of, items = self.kept
        chosen = [
            (stamp, mixture)
            for stamp, mixture in items
            if from_ns <= stamp and (to_ns == 0 or stamp <= to_ns)
        ]
        if of is None or not chosen:
            kept = f'those from {items[0][0]} to {items[-1][0]} ns are kept' if items else 'none is'
            raise ValueError(f'no mixture from {from_ns} to {to_ns} ns: {kept}')
        stamps, mixtures = zip(*chosen, strict=True)
        smoother = self._smoother(of.body, MixtureSmoother)
        found = smoother.smooth(mixtures, self.parameters.random_seed, stamps_ns=stamps)
        content = trajectory_content(found, of, covariances=True)
        return trajectory_mixture_message(self._messages, content)

    # What is told.

    def _present_state(self) -> SmootherState:
        status, wants = 'no body', 'body'
        if self._of is not None:
            smooths = self._newest is not None
            status, wants = ('smoothing', '') if smooths else ('waiting', 'likelihood_mixture')
        return SmootherState(
            status,
            wants,
            window=0 if self._window is None else len(self._window.stamps_ns),
            trajectories=len(self._weights),
            entropy=entropy(self._weights),
            gaps=self._gaps,
            longest_gap=self._longest_gap,
            mixtures=Counter(self._log.counts),
            faults=Counter(self._log.faults),
            last_fault=self._log.last_fault,
        )


def known_body(name: str, load: Callable[[str], Body] = load_body) -> Body:
    """The body of a name, or of a file where `load` takes one.

    Raises:
        ValueError: there is none.
    """
    try:
        return load(name)
    except OSError as error:
        text = error_line(error)
        raise ValueError(f'{text}; body_model names it, or a file with it') from error


def _content(message: Any, body: Body) -> PoseMixture | None:
    """The content of a mixture with the joints of a body; None: there are none, or faults."""
    try:
        return pose_mixture_of(message, body.dof_names, body.joint_names)
    except ValueError:
        return None


def _is_of(content: PoseMixture, body: Body) -> bool:
    """Whether the joints of a mixture are where the body has them."""
    computed = body.joint_positions(content.mixture.means[:1])
    return bool(np.abs(computed - content.joint_positions[:1]).max() < _SAME_PLACE)


def _same(one: SmoothedBody, other: SmoothedBody) -> bool:
    return (one.body.name, one.body.segment_lengths, one.frame_id) == (
        other.body.name,
        other.body.segment_lengths,
        other.frame_id,
    )
