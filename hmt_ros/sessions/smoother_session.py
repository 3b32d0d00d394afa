"""The smoother behind its topics.

The node and offline replay give their messages to a `SmootherSession`; the same messages in the
same order give the same bytes. The rules:

- Mixtures are smoothed in the order of their stamps, in a sliding window. A pose is published as
  smoothed once `fixed_lag` later ones have been seen; the poses that are still open are published
  when the window ends: at the end of the stream (`finish`), where time jumps back, at a new body.
- A mixture that is not younger than the one before is skipped, or starts a new window with
  `reset_on_time_jump`.
- Topics may overtake each other: a mixture waits for the body to which its joint positions belong.
  At most `queue_size` wait; the oldest are dropped. A body with other lengths is a new track, and
  starts a new window.
- The dynamics bridge gaps. One that is longer than `longest_interval` is reported.
- What can not be used is skipped. The first fault of each kind is logged; all are counted.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from hmt_ros.body import Body, load_body, named_body
from hmt_ros.inference import GaussianMixture
from hmt_ros.sessions.handled import Fault, Handled, Output
from hmt_ros.sessions.session import Order, Session, SessionState, everything
from hmt_ros.sessions.smoothed_messages import (
    TOPICS,
    SmoothedBody,
    final_messages,
    trajectory_content,
    window_messages,
)
from hmt_ros.sessions.smoother_parameters import SmootherParameters
from hmt_ros.smoothing import FinalPose, MixtureSmoother, SlidingWindow
from hmt_ros.smoothing.mode_sequence import merge_close_modes
from hmt_ros.smoothing.path_smoother import PathSmoother
from msg_tools import MessageError
from msg_tools.files.error_line import error_line
from msg_tools.messages.headers import SECOND_NS, time_ns
from msg_tools.messages.message_error import MessageFault, check_names
from msg_tools.messages.pose_mixtures import MixtureKind, PoseMixture, pose_mixture_of
from msg_tools.messages.trajectory_mixtures import trajectory_mixture_message

BODY, MIXTURE = 'body', 'likelihood_mixture'
FINISH = 'finish'  # what `finish` calls the end of the stream

# Positions of joints agree with the kinematics up to this, m.
_SAME_PLACE = 1e-4


@dataclass(frozen=True)
class SmootherState(SessionState):
    """State of the smoother: its status is 'no body', 'waiting' or 'smoothing'.

    Attributes:
        window: poses in the window.
        trajectories: components of the mixture over them.
        gaps: intervals between mixtures that were longer than `longest_interval`.
        longest_gap: s.
    """

    window: int = 0
    trajectories: int = 0
    gaps: int = 0
    longest_gap: float = 0.0

    def summary(self) -> str:
        """The present estimate in a few words."""
        return f'{self.trajectories} trajectories of {self.window} poses'

    def values(self) -> list[tuple[str, str]]:
        """Keys and values of the diagnostics."""
        return [
            ('poses in the window', str(self.window)),
            ('trajectories', str(self.trajectories)),
            ('entropy of the weights, nats', f'{self.entropy:.3f}'),
            ('gaps', str(self.gaps)),
            ('longest gap, s', f'{self.longest_gap:.3f}'),
        ]


class KeptMixtures(NamedTuple):
    """Likelihoods that have been smoothed since the window began, the newest.

    Attributes:
        of: whose poses they are; None: no body has come.
        items: (stamp, mixture), as they were received.
    """

    of: SmoothedBody | None
    items: tuple[tuple[int, GaussianMixture], ...]


class SmootherSession(Session[SmootherParameters, SmootherState]):
    """Smooths the poses of one person; see `Session` for arguments and attributes.

    `smooth_span` may be called by any thread.

    Attributes:
        kept: for `smooth_span`.
    """

    TOPICS = TOPICS
    COUNTED = MIXTURE
    UNIT = 'mixture'
    DONE = 'smoothed'
    ESTIMATE = 'the window'
    CHECKED = ('body_model',)

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
        self._gaps, self._longest_gap = 0, 0.0
        self.kept = KeptMixtures(None, ())
        self.state = self._present_state()

    # Inputs.

    def finish(self) -> Handled:
        """Publishes the poses that are still open; the next mixture begins a new window."""
        self._log.begin()
        stamp = self._newest or 0
        self._end_window()
        return self._handled(FINISH, stamp)

    def _take(self, source: str, message: Any, stamp: int) -> None:
        if source == BODY:
            self._take_body(message)
        else:
            self._waiting.append(message)
        self._smooth_what_is_ready()
        while len(self._waiting) > self.parameters.queue_size:
            self._drop(self._waiting.popleft())

    def _forget(self) -> None:
        self._window = None
        self._newest = None
        self.kept = KeptMixtures(self._of, ())

    def _take_body(self, message: Any) -> None:
        try:
            body = self._body_of(message)
        except ValueError as error:
            self._log.fault(Fault.BODY, str(error))
            return
        known, self._of = self._of, SmoothedBody(body, str(message.header.frame_id))
        if known is None:
            self.kept = KeptMixtures(self._of, ())
        elif not _same(known, self._of):
            if self._newest is not None:
                self._log.note(Fault.NEW_BODY, 'another body has come: a new window begins')
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
        self._log.fault(Fault.NO_BODY, f'mixture of {stamp} ns is dropped: {what}')

    def _take_mixture(self, message: Any, content: PoseMixture | None, of: SmoothedBody) -> None:
        stamp = time_ns(message.header.stamp)
        mixture = self._readable(message, content, stamp, of)
        order = Order.SKIPPED if mixture is None else self._order(stamp, self._newest)
        if mixture is None or order is Order.SKIPPED:
            return
        if order is Order.JUMP:
            self._end_window()
        p = self.parameters
        if self._newest is not None:
            interval = (stamp - self._newest) / SECOND_NS
            if interval > p.longest_interval:
                self._gaps += 1
                self._longest_gap = max(self._longest_gap, interval)
                self._log.note(
                    Fault.GAP,
                    f'no mixture for {interval:.2f} s before {stamp} ns: the dynamics bridge it',
                )
        if self._window is None:
            self._window = self._new_window(of.body)
        used = mixture
        if p.merge_distance > 0:
            used = merge_close_modes([mixture], p.merge_distance)[0]
        try:
            update = self._window.step(stamp, used)
        except (ValueError, ArithmeticError) as error:
            text = error_line(error)
            self._log.skip(Fault.ESTIMATE, f'mixture of {stamp} ns can not be smoothed: {text}')
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
            kind = error.fault if isinstance(error, MessageError) else MessageFault.OTHER
            self._log.skip(kind, f'mixture of {stamp} ns: {error}')
            return None
        if content.kind in (MixtureKind.POSTERIOR, MixtureKind.SMOOTHED):
            self._log.note(
                Fault.MIXTURE_KIND,
                f'mixtures are of the kind {content.kind.name}, wanted LIKELIHOOD: what the images '
                'say counts more than once',
            )
        return content.mixture

    def _new_window(self, body: Body) -> SlidingWindow:
        p = self.parameters
        return SlidingWindow(self._smoother(body, PathSmoother), p.fixed_lag, p.random_seed)

    def _smoother(self, body: Body, closed_form: type[MixtureSmoother]) -> MixtureSmoother:
        """The smoother that the parameters ask for, with `closed_form` for the paths."""
        p = self.parameters
        kind = closed_form if p.method == 'paths' else MixtureSmoother
        return kind(
            p.dynamics.of(body.skeleton),
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

    # Outputs.

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

    # State.

    def _present_state(self) -> SmootherState:
        status, wants = 'no body', 'body'
        if self._of is not None:
            smooths = self._newest is not None
            status, wants = ('smoothing', '') if smooths else ('waiting', 'likelihood_mixture')
        return SmootherState(
            status,
            wants,
            **self._totals(),
            window=0 if self._window is None else len(self._window.stamps_ns),
            trajectories=len(self._weights),
            gaps=self._gaps,
            longest_gap=self._longest_gap,
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
