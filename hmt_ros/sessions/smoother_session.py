"""Session of the smoother: likelihood mixtures in, smoothed poses and trajectories out.

The rules, in addition to those of `Session`:

- Mixtures are smoothed in the order of their stamps, in a sliding window. As neighbouring results
  hardly differ, the interval between two smoothings is at least 0.1 s or, if shorter, a fifth of
  `fixed_lag`. A smoothed pose is published with a delay of at most 1.2 times `fixed_lag`. A window
  ends at the end of the stream (`finish`), when time jumps back, and at a new body; its
  unpublished poses are then published.
- A mixture names its body and carries the segment lengths of the person; without them the lengths
  of the model apply. Another body, a jump of the lengths, another frame or another track_id means
  a new track and starts a new window. Slow changes of the lengths are accepted as better estimates.
- A likelihood without components means that nobody is in view: the window ends, and a smoothed
  mixture without components is published, with markers that remove the earlier ones.
- Likelihoods carry the chain of the filter's modes (`posterior_weight`, `ancestry`), which alone
  determines the weights of motions. Without the chain, a mode may continue every mode within reach.
- Errors of consecutive images are correlated, according to the error model of the likelihood and
  the time between the images (`error_model`). A likelihood without an error model is skipped; so is
  a forecast, because it contains no evidence.
- The uncertainty of the person's shape is the same in all images. It is added once, to the
  covariances that are published.
- Near the limits of the root's angles, for example with a camera on its side, mixtures are smoothed
  in a camera frame that is rotated by quarter turns; this begins a new window.
- Cyclic angles are unwrapped from mixture to mixture, each mode relative to the nearest previous
  mode, because the dynamics would treat a whole turn as a jump.
- The dynamics bridge gaps. Gaps longer than `MAX_INTERVAL` are reported.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hmt_ros.body import Body, load_body, named_body
from hmt_ros.body.mirror import clear_level, free_limits, relevelled, without_turns
from hmt_ros.body.motion_prior import motion_prior
from hmt_ros.body.resting_points import RestingPoints
from hmt_ros.image.image_sequence import ImageSequence
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.arrays import Array
from hmt_ros.sessions.image_evidence import Evidence, KeptMixtures, continued, evidence_of
from hmt_ros.sessions.named_file import named_file, public_line
from hmt_ros.sessions.seen_images import SeenImages
from hmt_ros.sessions.session import Session, SessionState
from hmt_ros.sessions.smoothed_messages import (
    TOPICS,
    OpenPose,
    SmoothedBody,
    final_messages,
    nobody_messages,
    trajectory_content,
    window_messages,
)
from hmt_ros.sessions.smoother_parameters import AT_END, NEVER, SmootherParameters
from hmt_ros.sessions.track import resembles
from hmt_ros.smoothing import FinalPose, MotionSmoother, SlidingWindow, TrajectoryMixture
from hmt_ros.smoothing.image_refinement import refined_on_images
from msg_tools import MessageError
from msg_tools.files.error_line import error_line
from msg_tools.messages.bodies import body_of
from msg_tools.messages.headers import SECOND_NS
from msg_tools.messages.pose_mixtures import (
    MixtureKind,
    PoseMixture,
    pose_mixture_of,
)
from msg_tools.messages.trajectory_mixtures import trajectory_mixture_message

MIXTURE, TRAJECTORIES = 'likelihood_mixture', 'trajectory_mixture'
NOBODY_STATUS = 'nobody'  # status while nobody is in view
# Maximum change of a segment length between two mixtures of the same person, m.
LENGTH_TOLERANCE = 0.02
# Minimum time between two smoothings, as a fraction of the lag, and upper bound of this time, s.
INTERVAL_OF_LAG, MAX_MIN_INTERVAL = 0.2, 0.1
# Maximum interval between two mixtures that is not reported as a gap, s.
MAX_INTERVAL = 0.25
# Factor on the diffusion of the filter's motion prior, chosen on clips (docs/smoothing.md): sudden
# motion is more frequent than a Gaussian with the mean variance predicts.
DIFFUSION_FACTOR = 2.0


@dataclass(frozen=True)
class SmootherState(SessionState):
    """State of the smoother: its status is 'waiting', 'smoothing' or 'nobody'.

    Attributes:
        window: number of poses in the window.
        trajectories: number of components of the mixture over trajectories.
        gaps: number of intervals between mixtures that were longer than `MAX_INTERVAL`.
        longest_gap: longest interval between mixtures that counts as a gap, s.
    """

    window: int = 0
    trajectories: int = 0
    gaps: int = 0
    longest_gap: float = 0.0

    def summary(self) -> str:
        """The present estimate in a few words."""
        return f'{self.trajectories} trajectories of {self.window} poses'

    def trouble(self) -> str:
        """Return 'nobody in view', or '' if somebody is in view."""
        return 'nobody in view' if self.status == NOBODY_STATUS else ''

    def values(self) -> list[tuple[str, str]]:
        """Keys and values of the diagnostics."""
        return [
            ('poses in the window', str(self.window)),
            ('trajectories', str(self.trajectories)),
            ('entropy of the weights, nats', f'{self.entropy:.3f}'),
            ('gaps', str(self.gaps)),
            ('longest gap, s', f'{self.longest_gap:.3f}'),
        ]


def ignore_event(text: str) -> None:
    """Ignores a log message."""


class SmootherSession(Session[SmootherParameters, SmootherState]):
    """Smooths the poses of one person; see `Session` for arguments and attributes.

    `smooth_span` is thread-safe.

    Attributes:
        kept: newest likelihoods of the window, for `smooth_span`.
    """

    TOPICS = TOPICS
    COUNTED = MIXTURE
    UNIT = 'mixture'
    DONE = 'smoothed'
    ESTIMATE = 'the window'
    CHECKED = ('body_model',)

    def _set_up(self) -> None:
        if model := self.parameters.body_model:
            _chosen_body(model)
        self._of: SmoothedBody | None = None
        self._resolved: tuple[Any, SmoothedBody] | None = None
        self._gaps, self._longest_gap = 0, 0.0
        self._first_identity = 1
        self._images = SeenImages()
        self.restart()

    def share(self, images: SeenImages) -> None:
        """See `Session`."""
        self._images = images
        self._want_images()

    def _want_images(self) -> None:
        p = self.parameters
        self._images.wanted = 0 if p.refine_on_images == NEVER else p.window_length

    # Inputs.

    def _end(self) -> int:
        """Publishes the poses that are still open; the next mixture begins a new window."""
        stamp = self._newest or 0
        asked = self.parameters.refine_on_images == AT_END and self._wanted(TRAJECTORIES)
        if asked and self.kept.items:
            self._publish(TRAJECTORIES, stamp, self.smooth_span(notify=self._log.add_event))
        self._end_window()
        self._orders.clear()
        return stamp

    def restart(self) -> None:
        """See `Session`."""
        self._window: SlidingWindow | None = None
        self._weights = np.empty(0)
        # Poses of the window that have not been published, by stamp.
        self._open: dict[int, OpenPose] = {}
        self._newest: int | None = None
        self._nobody = False
        self.kept = KeptMixtures(self._of, ())
        super().restart()

    def _jump_back(self, first: int, last: int) -> None:
        self._end_window()
        self._first_identity = 1

    def _take(self, source: str, message: Any, stamp: int) -> None:
        try:
            content = pose_mixture_of(message)
            if content.kind is MixtureKind.LIKELIHOOD and not len(content.weights):
                self._take_nobody(stamp, content.existence_probability)
                return
            evidence, of = evidence_of(content), self._person_of(content)
            of = self._clear(of, evidence.modes.mixture)
        except MessageError as error:
            self._log.skip(error.fault, f'mixture of {stamp} ns: {error}')
            return
        if content.kind in (MixtureKind.POSTERIOR, MixtureKind.SMOOTHED):
            self._log.note(
                'kind of mixture',
                f'mixtures are of the kind {content.kind.name}, wanted LIKELIHOOD: the evidence '
                'of the images is counted more than once',
            )
        if content.posterior_weights is None:
            self._log.note(
                'ancestry',
                'mixtures have no posterior weights and ancestry of their components, unlike '
                'those of the filter: their weights are used, and a component may continue '
                'every component of the previous mixture within reach',
            )
        self._begin_track(of)
        self._want_images()
        evidence = self._chained(_levelled(evidence, of.body), content, of.body)
        p = self.parameters
        if self._newest is not None:
            interval = (stamp - self._newest) / SECOND_NS
            if interval > MAX_INTERVAL:
                self._gaps += 1
                self._longest_gap = max(self._longest_gap, interval)
                self._log.note(
                    'gap',
                    f'no mixture for {interval:.2f} s before {stamp} ns: the dynamics bridge the '
                    'gap',
                )
        if self._window is None:
            self._window = SlidingWindow(
                self._smoother(of.body),
                p.fixed_lag,
                first_identity=self._first_identity,
                every=min(INTERVAL_OF_LAG * p.fixed_lag, MAX_MIN_INTERVAL),
            )
        try:
            update = self._window.step(evidence.modes)
        except (ValueError, ArithmeticError) as error:
            text = error_line(error)
            self._log.skip('estimate', f'mixture of {stamp} ns can not be smoothed: {text}')
            self._end_window()
            return
        self._newest, self._nobody = stamp, False
        self._open[stamp] = OpenPose(content.state, content.existence_probability, evidence.shape)
        self._log.counts['smoothed'] += 1
        self.kept = KeptMixtures(of, (*self.kept.items, evidence)[-p.window_length :])
        if update.trajectories is not None:
            self._weights = update.trajectories.weights
            shapes = _shapes((at, one.shape) for at, one in self._open.items())
            for topic, made in window_messages(
                update.trajectories,
                of,
                self._wanted,
                covariances=p.publish_covariances,
                shapes=shapes,
            ):
                self._publish(topic, stamp, made)
        for pose in update.final:
            self._publish_final(pose, of)

    def _chained(self, evidence: Evidence, content: PoseMixture, body: Body) -> Evidence:
        """Return the evidence with unwrapped angles and modes linked to the previous mixture."""
        mixture, kept = evidence.modes.mixture, self.kept.items
        heaviest = mixture.means[[int(np.argmax(mixture.weights))]]
        before = kept[-1].modes.mixture.means if kept else heaviest
        mixture = replace(mixture, means=without_turns(body, mixture.means, before))
        evidence = evidence._replace(modes=evidence.modes._replace(mixture=mixture))
        if not kept:
            return evidence
        points = body.relative_joints(mixture.means), body.relative_joints(before)
        return continued(evidence, content, kept[-1], *points)

    def _take_nobody(self, stamp: int, existence: float) -> None:
        """Ends the window: the person is no longer in view."""
        of, smooths = self._of, self._window is not None
        self._end_window()
        self._nobody = True
        if of is not None and smooths:
            self._log.add_event(f'nobody in view at the mixture of {stamp} ns: the window ends')
            for topic, made in nobody_messages(of, stamp, existence, self._wanted):
                self._publish(topic, stamp, made)

    def _person_of(self, content: PoseMixture) -> SmoothedBody:
        """Return the person of a mixture; it is the same object while the person does not change.

        Raises:
            MessageError: the body is unknown, or differs from the body that the parameters name.
        """
        about = (
            content.body_model,
            content.dof_names,
            content.segment_lengths,
            content.frame_id,
            content.track_id,
        )
        if self._window is not None and self._resolved is not None and self._resolved[0] == about:
            return self._resolved[1]
        chosen = self.parameters.body_model
        try:
            # A message must not cause files to be read: the named body must ship with the package.
            model = _chosen_body(chosen) if chosen else named_body(content.body_model)
        except (OSError, ValueError) as error:
            raise MessageError(public_line(error), 'body') from error
        body = body_of(content, model, any_name=bool(chosen))
        of = SmoothedBody(body, content.frame_id, content.track_id)
        self._resolved = about, of
        return of

    def _clear(self, of: SmoothedBody, mixture: GaussianMixture) -> SmoothedBody:
        """Return the person, levelled so that the root angles of the heaviest pose avoid poles."""
        heaviest = mixture[np.array([np.argmax(mixture.weights)])]
        seen = relevelled(of.body.levelled(np.eye(3)), heaviest, of.body)
        level = clear_level(of.body, seen.means[0])
        if np.array_equal(level, of.body.level):
            return of
        of = replace(of, body=of.body.levelled(level))
        assert self._resolved is not None
        self._resolved = self._resolved[0], of
        return of

    def _begin_track(self, of: SmoothedBody) -> None:
        """Sets the person; ends the window if it belongs to another person."""
        known = self._of
        if known is not None and _same(known, of):
            self._of = of
            return
        if self._newest is not None:
            text = 'mixtures belong to another body or another track: a new window begins'
            self._log.note('new body', text)
        self._end_window()
        self._of, self._first_identity = of, 1
        self.kept = KeptMixtures(of, ())

    def _smoother(self, body: Body) -> MotionSmoother:
        """Return a smoother configured by the parameters."""
        p = self.parameters
        prior = motion_prior(body)
        return MotionSmoother(
            replace(prior, diffusion=DIFFUSION_FACTOR * prior.diffusion),
            *free_limits(body),
            points=body.relative_joints,
            max_motions=p.max_hypotheses,
            resting=RestingPoints.of_soles(body) if p.resting_feet else None,
            seed=p.random_seed,
        )

    def _end_window(self) -> None:
        """Publishes the poses that are still open, and forgets the window."""
        if self._window is not None and self._of is not None:
            # The track may continue in the next window, where identities must not be used again.
            self._first_identity = self._window.next_identity
            for pose in self._window.finish():
                self._publish_final(pose, self._of)
        self.restart()

    # Outputs.

    def _publish_final(self, pose: FinalPose, of: SmoothedBody) -> None:
        p = self.parameters
        for topic, made in final_messages(
            pose,
            of,
            self._open.pop(pose.stamp_ns),
            self._wanted,
            frame_prefix=p.frame_prefix if p.publish_tf else None,
        ):
            self._publish(topic, pose.stamp_ns, made)

    def smooth_span(
        self, from_ns: int = 0, to_ns: int = 0, notify: Callable[[str], None] = ignore_event
    ) -> Any:
        """Smooths the kept mixtures of a span of time, all at once.

        Thread-safe.

        Args:
            from_ns, to_ns: first and last stamp, inclusive, ns; 0 selects the oldest and the newest
                mixture.
            notify: function that receives a line about whether images refined the motions or, if
                not, about the reason.

        Returns:
            hmt_msgs/TrajectoryMixture with covariances.

        Raises:
            ValueError: the span has no mixtures, or they can not be smoothed.
        """
        found, of = self.smoothed_span(from_ns, to_ns, notify)
        shapes = _shapes((one.modes.stamp_ns, one.shape) for one in self.kept.items)
        content = trajectory_content(found, of, covariances=True, shapes=shapes)
        return trajectory_mixture_message(self._messages, content)

    def smoothed_span(
        self, from_ns: int = 0, to_ns: int = 0, notify: Callable[[str], None] = ignore_event
    ) -> tuple[TrajectoryMixture, SmoothedBody]:
        """Return the trajectories of a span of time, and the person; see `smooth_span`."""
        of, items = self.kept
        chosen = [
            item.modes
            for item in items
            if from_ns <= item.modes.stamp_ns and (to_ns == 0 or item.modes.stamp_ns <= to_ns)
        ]
        if of is None or not chosen:
            kept = 'none is'
            if items:
                first, last = (items[i].modes.stamp_ns for i in (0, -1))
                kept = f'those from {first} to {last} ns are kept'
            raise ValueError(f'no mixture from {from_ns} to {to_ns} ns: {kept}')
        smoother = self._smoother(of.body)
        found = smoother.motions(chosen)
        if self.parameters.refine_on_images == NEVER:
            notify('smoothed without images, as refine_on_images says')
            return found.trajectories, of
        stamps = [modes.stamp_ns for modes in chosen]
        images = [one.levelled(of.body.level) for one in self._images.of(stamps) if one is not None]
        if len(images) < len(stamps):
            notify(
                f'smoothed without images: {len(stamps) - len(images)} of {len(stamps)} are not '
                'kept, as the filter runs in another process or publishes in fixed_frame, or as '
                f'they take more than {self._images.most_mb:g} MB'
            )
            return found.trajectories, of
        notify(f'motions are refined on {len(images)} images')
        sequence = ImageSequence.of(images, stamps, of_changes=True)
        return refined_on_images(smoother, found, sequence), of

    # State.

    def _present_state(self) -> SmootherState:
        smooths = self._newest is not None
        status, wants = ('smoothing', '') if smooths else ('waiting', 'likelihood_mixture')
        if self._nobody:
            status, wants = NOBODY_STATUS, ''
        return SmootherState(
            status,
            wants,
            **self._totals(self._weights),
            window=0 if self._window is None else len(self._window.stamps_ns),
            trajectories=len(self._weights),
            gaps=self._gaps,
            longest_gap=self._longest_gap,
        )


def _chosen_body(model: str) -> Body:
    """Return the body that the parameters name."""
    with named_file('body_model', model, 'body model'):
        return load_body(model)


def _levelled(evidence: Evidence, body: Body) -> Evidence:
    """Convert the root angles of evidence from the camera frame to the frame of a levelled body."""
    camera = body.levelled(np.eye(3))
    if camera is body:
        return evidence
    mixture, shape = evidence.modes.mixture, evidence.shape
    if shape is not None:
        at_best = GaussianMixture(np.ones(1), mixture.means[:1], shape[None])
        shape = relevelled(camera, at_best, body).covariances[0]
    modes = evidence.modes._replace(mixture=relevelled(camera, mixture, body))
    return evidence._replace(modes=modes, shape=shape)


def _shapes(items: Iterable[tuple[int, Array | None]]) -> dict[int, Array]:
    """Return the known covariances of shape errors, by stamp."""
    return {stamp: shape for stamp, shape in items if shape is not None}


def _same(one: SmoothedBody, other: SmoothedBody) -> bool:
    """Whether two bodies belong to one person; length estimates of a person change slowly."""
    same_track = 0 in (one.track_id, other.track_id) or one.track_id == other.track_id
    return (
        same_track
        and one.frame_id == other.frame_id
        and np.array_equal(one.body.level, other.body.level)
        and resembles(one.body, other.body, LENGTH_TOLERANCE)
    )
