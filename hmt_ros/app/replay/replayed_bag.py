"""One bag that is replayed, as the command asks for it."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from tqdm import tqdm

from hmt_ros.app.replay.played_track import (
    BME,
    FILTER,
    SMOOTHER,
    LiveTrack,
    NodeParameters,
    OfflineTrack,
    PlayedTrack,
)
from hmt_ros.app.replay.read_ahead import ReadAhead
from hmt_ros.app.replay.recorded_input import (
    COMPRESSED,
    GROUND_TRUTH,
    RecordedInput,
    recorded_input,
)
from hmt_ros.app.replay.write_behind import WriteBehind
from hmt_ros.sessions import bme_session, smoothed_messages, track_messages
from hmt_ros.sessions.bme_parameters import BmeParameters
from hmt_ros.sessions.camera_session import CAMERA_INFO, IMAGE
from hmt_ros.sessions.declared_parameters import with_values
from hmt_ros.sessions.filter_parameters import FilterParameters
from hmt_ros.sessions.filter_session import KEYPOINTS
from hmt_ros.sessions.handled import Handled
from hmt_ros.sessions.parameter_file import read_parameter_file
from hmt_ros.sessions.smoother_parameters import SmootherParameters
from hmt_ros.sessions.track_start import prepare_start
from hmt_ros.tracking import Subject
from msg_tools import BagError, BagMessage, BagReader, BagWriter, RosbagsMessages
from msg_tools.files.error_line import error_line
from msg_tools.files.plain_yaml import load_plain_yaml
from msg_tools.messages.headers import header_message, time_ns
from msg_tools.messages.images import ImageError, decode_image, image_message

# What the bag and the command say, whatever a parameter file says.
_DECIDED_HERE = ('image_transport', 'autostart')
# What stands before the parameters of a node in --set.
_PREFIXES = {SMOOTHER: 'smoother.', BME: 'bme.', FILTER: ''}
# What every node has.
_OF_ROS = ('qos_overrides.', 'use_sim_time', 'start_type_description_service')

Tell = Callable[[str], None]


@dataclass(frozen=True)
class Replayed:
    """What came of a bag.

    Attributes:
        target: the new bag.
        images: how many there were.
        tracked: in how many of them the person was tracked.
    """

    target: Path
    images: int
    tracked: int

    def __str__(self) -> str:
        return f'{self.target}: {self.tracked} of {self.images} images tracked'


def replay_bag(options: argparse.Namespace, tell: Tell) -> Replayed:
    """Replays a bag into a new one, which is written whole or not at all.

    Args:
        options: of the command.
        tell: takes what a person should know, in lines.

    Raises:
        ValueError: bad input.
    """
    source, target = options.bag, options.output
    if target.exists() and target.resolve() in (source.resolve(), source.resolve().parent):
        raise ValueError(f'{target} is the bag that is read; give another name')
    with BagReader(source) as bag:
        if not options.keep_going:
            bag.raise_damage()
        recorded = recorded_input(bag, options.image_topic, options.camera_info_topic)
        parameters = _node_parameters(options, recorded)
        # What the parameters name is looked at before a node is started.
        subject = prepare_start(parameters.filter).initial
        if subject is None and not options.quiet:
            tell(f'no --subject: the track starts from a prediction{_subject_hint(source)}')
        with BagWriter(target, overwrite=options.overwrite) as out:
            topics = dict(track_messages.TOPICS)
            if parameters.smoother is not None:
                topics.update(smoothed_messages.TOPICS)
            if parameters.bme is not None:
                topics.update(bme_session.TOPICS)
            for topic, published in topics.items():
                out.add_topic(topic, published.msgtype, latched=published.latched)
            way = LiveTrack if options.live else OfflineTrack
            # Bytes are compressed and images decoded while the next image is tracked.
            with WriteBehind() as behind:
                write = partial(behind.call, out.write_serialised)
                with way(parameters, write) as track:
                    count = _play(
                        options, bag, recorded, parameters.filter, track, out, behind, tell
                    )
            if not count.tracked:
                raise ValueError(f'{source}: {_why_nothing(count, subject)}')
    return Replayed(target, count.images, count.tracked)


def parameters_of(options: argparse.Namespace) -> NodeParameters:
    """Parameters of the nodes for a bag.

    Raises:
        ValueError: bad input.
    """
    with BagReader(options.bag) as bag:
        recorded = recorded_input(bag, options.image_topic, options.camera_info_topic)
    return _node_parameters(options, recorded)


def _node_parameters(options: argparse.Namespace, recorded: RecordedInput) -> NodeParameters:
    tracking = _filter_parameters(options, recorded)
    smoothing = None if options.no_smoother else _smoother_parameters(options)
    predicting = None
    if options.bme is not None or not tracking.subject_file:
        predicting = _bme_parameters(options, recorded, tracking)
        tracking = replace(tracking, use_predictions=True)
    else:
        for text in options.set:
            if text.startswith(_PREFIXES[BME]):
                raise ValueError(f'--set {text}: nothing is predicted; --bme does')
    return NodeParameters(tracking, smoothing, predicting)


def _filter_parameters(options: argparse.Namespace, recorded: RecordedInput) -> FilterParameters:
    values = _given_values(options, FILTER)
    given = {
        'random_seed': options.seed,
        'body_model': options.body,
        'subject_file': options.subject,
        'background_file': options.background,
    }
    for name, value in given.items():
        if value is not None:
            values[name] = str(value) if isinstance(value, Path) else value
    values.setdefault('use_keypoints', recorded.keypoints is not None)
    values['image_transport'] = recorded.transport
    return with_values(FilterParameters(), values)


def _smoother_parameters(options: argparse.Namespace) -> SmootherParameters:
    values = _given_values(options, SMOOTHER)
    if options.seed is not None:
        values['random_seed'] = options.seed
    if options.body is not None:
        # The name in the messages does not say where the file of the body is.
        values['body_model'] = options.body
    return with_values(SmootherParameters(), values)


def _bme_parameters(
    options: argparse.Namespace, recorded: RecordedInput, tracking: FilterParameters
) -> BmeParameters:
    values = {
        'background_file': tracking.background_file,
        **_given_values(options, BME),
        'image_transport': recorded.transport,
    }
    if options.bme:
        values['model_file'] = options.bme
    return with_values(BmeParameters(background=tracking.background), values)


def _given_values(options: argparse.Namespace, node: str) -> dict[str, Any]:
    """What --config and --set give a node, by name."""
    values: dict[str, Any] = {}
    for file in options.config:
        # What stands for all nodes is the filter's: many names mean something else to the smoother.
        read = read_parameter_file(file, node, by_name=node != FILTER)
        values.update(
            (name, value)
            for name, value in read.items()
            if not name.startswith(_OF_ROS) and name not in _DECIDED_HERE
        )
    for text in options.set:
        name, equals, value = text.partition('=')
        of = next(of for of, prefix in _PREFIXES.items() if name.startswith(prefix))
        name = name.removeprefix(_PREFIXES[of])
        if not equals or name in _DECIDED_HERE:
            why = f'{name} is decided by replay' if equals else 'wanted NAME=VALUE'
            raise ValueError(f'--set {text}: {why}')
        if of != node:
            continue
        try:
            values[name] = load_plain_yaml(value)
        except ValueError as error:
            raise ValueError(f'--set {text}: {error_line(error)}') from error
        if values[name] is None:
            values[name] = value
    return values


def _subject_hint(bag: Path) -> str:
    beside = (bag if bag.is_dir() else bag.parent) / 'subject.yaml'
    if beside.is_file():
        return f'; beside the bag lies {beside}'
    return ''


@dataclass
class _Count:
    """Images that were read, images that were tracked, and the stamp of the last."""

    images: int = 0
    tracked: int = 0
    last_stamp: int = 0
    last_fault: str = ''


def _play(
    options: argparse.Namespace,
    bag: BagReader,
    recorded: RecordedInput,
    parameters: FilterParameters,
    track: PlayedTrack,
    out: BagWriter,
    behind: WriteBehind,
    tell: Tell,
) -> _Count:
    """Gives the nodes what is in the bag; copies what is to be copied."""
    count = _Count()
    if not parameters.use_keypoints:
        recorded = replace(recorded, keypoints=None)
    copied = {GROUND_TRUTH, IMAGE, CAMERA_INFO} if options.with_images else {GROUND_TRUTH}
    messages = recorded.messages(bag)
    with (
        ReadAhead(partial(_read, messages, not options.live), messages.close) as ahead,
        tqdm(
            total=recorded.image.message_count,
            unit='image',
            desc=str(options.output),
            disable=options.quiet or None,  # None: shown where stderr is a terminal
        ) as bar,
    ):

        def judge(handled: Handled) -> None:
            behind.check()
            count.tracked += sum(topic == 'pose_mixture' for topic, _ in handled.published)
            if handled.faults:
                count.last_fault = handled.faults[-1]
                if not options.keep_going:
                    raise ValueError(
                        f'{bag.path}: {handled.faults[0]} (--keep-going skips what can not be used)'
                    )
            for text in handled.warnings:
                tell(f'{bag.path}: {text}')

        for source, stored, given in _readable(ahead, options.keep_going, tell):
            if source in copied:
                behind.call(out.write, stored.topic, stored.log_time_ns, stored.message)
            if source == GROUND_TRUTH:
                continue
            judge(track.take(source, given))
            if source == IMAGE:
                count.images += 1
                count.last_stamp = time_ns(stored.message.header.stamp)
                bar.update()
        if parameters.use_keypoints:
            # The last images need not wait any longer.
            judge(track.take(KEYPOINTS, _nobody(count.last_stamp)))
        judge(track.finish())
    return count


def _read(messages: Iterator[tuple[str, BagMessage]], decode: bool) -> tuple[str, BagMessage, Any]:
    """The next message, and what is to be given to the nodes: an image that is decoded already.

    Raises:
        BagError: its bytes are none; the one behind it can be read all the same.
        StopIteration: there is none.
    """
    source, stored = next(messages)
    given = stored.message
    if decode and source == IMAGE and stored.msgtype == COMPRESSED:
        try:
            picture = decode_image(given)
        except ImageError:
            # Whoever takes it says what is wrong with it.
            return source, stored, given
        given = image_message(
            RosbagsMessages(), picture, time_ns(given.header.stamp), str(given.header.frame_id)
        )
    return source, stored, given


def _readable(
    messages: Iterator[tuple[str, BagMessage, Any]], keep_going: bool, tell: Tell
) -> Iterator[tuple[str, BagMessage, Any]]:
    """The messages, without those whose bytes are none, up to where the bag is damaged.

    Raises:
        BagError: there is such a place, and it is not to be passed over.
    """
    while True:
        try:
            found = next(messages)
        except StopIteration:
            return
        except BagError as error:
            if not keep_going:
                raise
            tell(str(error))
            continue
        yield found


def _nobody(stamp_ns: int) -> Any:
    """hmt_msgs/Keypoints2D of an image in which no joint was seen."""
    messages = RosbagsMessages()
    return messages.create(
        'hmt_msgs/msg/Keypoints2D', header=header_message(messages, stamp_ns, '')
    )


def _why_nothing(count: _Count, subject: object) -> str:
    if isinstance(subject, Subject) and count.images and subject.stamp_ns > count.last_stamp:
        return (
            f'the joints of the subject file were seen at {subject.stamp_ns} ns, after the last '
            f'image, which is of {count.last_stamp} ns: is it the file of another bag?'
        )
    if subject is None and not count.last_fault:
        return (
            f'nobody is seen in its {count.images} images: give the empty scene by --background '
            'FILE, or the joints of the person in one image by --subject FILE'
        )
    why = f': {count.last_fault}' if count.last_fault else ''
    return f'none of its {count.images} images was tracked{why}'
