"""Replays one bag into a new bag."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Generic, TypeVar

from hmt_ros.app.progress import Notify, Progress, show_progress
from hmt_ros.app.replay.inputs import GROUND_TRUTH, RECORDED_INPUTS, RecordedInput, fitted
from hmt_ros.app.replay.options import NodeParameters, ReplayOptions, node_parameters
from hmt_ros.app.replay.tracks import LiveTrack, OfflineTrack, PlayedTrack
from hmt_ros.sessions import bme_session, smoothed_messages, track_messages
from hmt_ros.sessions.bme_session import BmeSession
from hmt_ros.sessions.camera_session import CAMERA_INFO, IMAGE
from hmt_ros.sessions.handled import Handled
from hmt_ros.sessions.image_inputs import COMPRESSED_TYPE, KEYPOINTS
from hmt_ros.sessions.people_session import published_topic, session_of
from hmt_ros.sessions.track_start import prepare_start
from hmt_ros.sessions.tracking_parameters import PeopleParameters
from hmt_ros.sessions.transform_buffer import TF_STATIC, TRANSFORMS, TRANSFORMS_TYPE
from hmt_ros.tracking import Subject
from msg_tools import BagError, BagMessage, BagReader, BagWriter, RosbagsMessages
from msg_tools.bags.bag_metadata import absolute_name
from msg_tools.messages.headers import time_ns
from msg_tools.messages.images import ImageError, decode_image, image_message

Item = TypeVar('Item')

# Maximum number of waiting calls; each keeps a message or an image in memory.
_MAX_WAITING_CALLS = 32


@dataclass
class Replayed:
    """The outcome of a replay.

    Attributes:
        tracked: number of images in which the person was tracked.
        last_stamp: stamp of the last image, ns.
        last_fault: text of the newest fault; '' without faults.
    """

    images: int = 0
    tracked: int = 0
    last_stamp: int = 0
    last_fault: str = ''

    def __str__(self) -> str:
        return f'{self.tracked} of {self.images} images tracked'


def replay_bag(
    source: Path, target: Path, options: ReplayOptions, notify: Notify, *, shows: bool | None = None
) -> Replayed:
    """Replays a bag into a new bag, which is written completely or not at all.

    Args:
        shows: whether progress is shown; None shows it unless `options.quiet`.

    Raises:
        ValueError: bad input.
    """
    if target.exists() and target.resolve() in (source.resolve(), source.resolve().parent):
        raise ValueError(f'{target} is the input bag; give another name')
    with BagReader(source) as bag:
        recorded = options.recorded(bag)
        recorded.check_stamps(bag)
        recorded = fitted(bag, recorded, notify)
        parameters = node_parameters(options, recorded)
        # Read the files that the parameters name, so that errors are raised before a node starts.
        subject = prepare_start(parameters.filter).initial
        if subject is None and not options.quiet and not options.people:
            sources = ' or '.join(parameters.filter.sources)
            notify(f'no --subject: the track starts from {sources}{_subject_hint(source)}')
        frame = recorded.upright_frame
        if frame and frame == parameters.filter.gravity_frame and not options.quiet:
            notify(f'gravity and the motion of the camera: from {frame}')
        recorded = _used(recorded, parameters)
        with BagWriter(target, overwrite=options.overwrite, namespace=options.namespace) as out:
            topics = {} if options.people else dict(track_messages.TOPICS)
            if parameters.smoother is not None:
                topics.update(smoothed_messages.TOPICS)
            if parameters.bme is not None:
                topics.update(bme_session.TOPICS)
            for topic, published in topics.items():
                out.add_topic(topic, published.msgtype, latched=published.latched)
            if recorded.transforms and TF_STATIC in recorded.transforms:
                topic = absolute_name(recorded.transforms[TF_STATIC].name)
                out.add_topic(topic, TRANSFORMS_TYPE, latched=True)
            # Writing and decoding run in separate threads while an image is tracked.
            hidden = options.quiet if shows is None else not shows
            with (
                WriteBehind() as behind,
                show_progress(
                    str(target), 'images', recorded.image.message_count, quiet=hidden
                ) as bar,
                _track(options, parameters, out, behind) as track,
            ):
                result = _play(options, bag, recorded, track, out, behind, bar, notify)
            if not result.tracked:
                reason = _reason_for_no_track(result, subject, KEYPOINTS in recorded.given)
                why = f'{source}: {reason}'
                if subject is not None or result.last_fault or not result.images:
                    raise ValueError(why)
                notify(why)
    return result


def _track(
    options: ReplayOptions, parameters: NodeParameters, out: BagWriter, behind: WriteBehind
) -> PlayedTrack:
    write = partial(behind.call, out.write_serialised)
    if options.live:
        return LiveTrack(parameters, write)
    known: set[str] = set()

    def write_of_person(topic: str, stamp: int, data: bytes) -> None:
        if topic not in known:
            known.add(topic)
            msgtype, latched = published_topic(topic)
            behind.call(partial(out.add_topic, topic, msgtype, latched=latched))
        write(topic, stamp, data)

    return OfflineTrack(parameters, write_of_person if options.people else write)


def _subject_hint(bag: Path) -> str:
    beside = (bag if bag.is_dir() else bag.parent) / 'subject.yaml'
    return f'; there is {beside} beside the bag' if beside.is_file() else ''


def _used(recorded: RecordedInput, parameters: NodeParameters) -> RecordedInput:
    """The recorded input, reduced to the topics that at least one node uses."""
    tracking, bme = parameters.filter, parameters.bme
    rows = session_of(tracking).inputs_of(tracking)
    used = [row for row in rows if row.is_used(tracking)]
    if bme is not None:
        used += [row for row in BmeSession.inputs_of(bme) if row.is_used(bme)]
    sources = {source for row in used for source in row.types}
    given = {source: topic for source, topic in recorded.given.items() if source in sources}
    recorded = replace(recorded, given=given)
    if isinstance(tracking, PeopleParameters):
        return replace(recorded, ground_truth=None)
    return recorded if tracking.uses_transforms else replace(recorded, transforms=None)


def _play(
    options: ReplayOptions,
    bag: BagReader,
    recorded: RecordedInput,
    track: PlayedTrack,
    out: BagWriter,
    behind: WriteBehind,
    bar: Progress,
    notify: Notify,
) -> Replayed:
    """Passes the messages of the bag to the nodes, and copies some into the new bag."""
    result = Replayed()
    # Small inputs are copied, so that the new bag can be replayed with the same inputs.
    small = {source for row in RECORDED_INPUTS if row.pixels is None for source in row.types}
    copied = {GROUND_TRUTH, *small, *TRANSFORMS}
    if options.with_images:
        copied |= {IMAGE, CAMERA_INFO}

    def check(handled: Handled) -> None:
        behind.check()
        # Count stamps, not messages: several people may be tracked in one image.
        result.tracked += len(
            {stamp for topic, stamp in handled.published if topic.endswith('human_joint_states')}
        )
        if handled.faults:
            result.last_fault = handled.faults[-1]
            if not options.keep_going:
                raise ValueError(
                    f'{bag.path}: {handled.faults[0]} (--keep-going skips such messages)'
                )
        for text in handled.warnings:
            notify(f'{bag.path}: {text}')

    messages = recorded.messages(bag)
    with ReadAhead(partial(_read, messages, not options.live), messages.close) as ahead:
        for source, stored, given in _readable(ahead, options.keep_going, notify):
            if source in copied:
                # Inputs keep their names; the namespace applies only to results.
                topic = absolute_name(stored.topic)
                behind.call(out.write, topic, stored.log_time_ns, stored.message)
            if source == GROUND_TRUTH:
                continue
            check(track.take(source, given))
            if source == IMAGE:
                result.images += 1
                result.last_stamp = time_ns(stored.message.header.stamp)
                bar.update()
        check(track.finish())
    return result


def _read(messages: Iterator[tuple[str, BagMessage]], decode: bool) -> tuple[str, BagMessage, Any]:
    """Returns the source of the next message, the stored message, and the message for the nodes.

    With `decode`, compressed images are decoded for the nodes.

    Raises:
        BagError: the bytes are not a valid message; the next message can still be read.
        StopIteration: there is no further message.
    """
    source, stored = next(messages)
    given = stored.message
    if decode and source == IMAGE and stored.msgtype == COMPRESSED_TYPE:
        try:
            picture = decode_image(given)
        except ImageError:
            # The node that receives the image reports the fault.
            return source, stored, given
        given = image_message(
            RosbagsMessages(), picture, time_ns(given.header.stamp), str(given.header.frame_id)
        )
    return source, stored, given


def _readable(
    messages: Iterator[tuple[str, BagMessage, Any]], keep_going: bool, notify: Notify
) -> Iterator[tuple[str, BagMessage, Any]]:
    """Yields the messages that can be read.

    Raises:
        BagError: a message can not be read, and `keep_going` is false.
    """
    while True:
        try:
            found = next(messages)
        except StopIteration:
            return
        except BagError as error:
            if not keep_going:
                raise
            notify(str(error))
            continue
        yield found


def _reason_for_no_track(result: Replayed, subject: object, detected: bool) -> str:
    if isinstance(subject, Subject) and result.images and subject.stamp_ns > result.last_stamp:
        return (
            f'the joints of the subject file were seen at {subject.stamp_ns} ns, after the last '
            f'image, at {result.last_stamp} ns: is it the file of another bag?'
        )
    if subject is None and not result.last_fault:
        remedy = (
            ': give an image of the empty scene with --background FILE, the joints of the '
            'person in one image with --subject FILE, or a bag with keypoints'
        )
        return f'nobody is found in its {result.images} images{"" if detected else remedy}'
    why = f': {result.last_fault}' if result.last_fault else ''
    return f'none of its {result.images} images was tracked{why}'


class ReadAhead(AbstractContextManager['ReadAhead[Item]'], Generic[Item]):
    """An iterator that prepares its next item in a thread while the current item is in use.

    Iteration can continue after an error. The context manager ends the thread.

    Args:
        make: returns the next item, or raises StopIteration.
        close: called at the end, in the thread of `make`.
    """

    def __init__(self, make: Callable[[], Item], close: Callable[[], None]) -> None:
        self._make, self._close = make, close
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix='read_ahead')
        self._next: Future[Item] = self._thread.submit(make)

    def __iter__(self) -> Iterator[Item]:
        return self

    def __next__(self) -> Item:
        made = self._next
        if not isinstance(made.exception(), StopIteration):
            self._next = self._thread.submit(self._make)
        return made.result()

    def __exit__(self, *_: object) -> None:
        self._next.cancel()
        self._thread.submit(self._close)
        self._thread.shutdown(wait=True)


class WriteBehind(AbstractContextManager['WriteBehind']):
    """Runs queued calls in order in a thread, while the caller continues.

    Leaving the context waits for all queued calls, or drops them after an error. Calls after a
    failed call are skipped. The error of the failed call is raised by `check` and on leaving the
    context, but not by `call`, whose caller could mistake it for its own error.
    """

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix='write_behind')
        self._waiting: deque[Future[None]] = deque()
        self._error: BaseException | None = None

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._thread.shutdown(wait=True, cancel_futures=kind is not None)
        if kind is None:
            self.check()

    def call(self, function: Callable[..., None], *arguments: Any) -> None:
        """Queues a call, which runs after all earlier calls."""
        while self._waiting and (
            len(self._waiting) >= _MAX_WAITING_CALLS or self._waiting[0].done()
        ):
            self._waiting.popleft().result()
        self._waiting.append(self._thread.submit(self._make, function, arguments))

    def check(self) -> None:
        """Raises the error of a queued call that has failed, if any."""
        if self._error is not None:
            raise self._error

    def _make(self, function: Callable[..., None], arguments: tuple[Any, ...]) -> None:
        if self._error is not None:
            return
        try:
            function(*arguments)
        except BaseException as error:  # noqa: BLE001 - `check` raises it
            self._error = error
