"""Finds the filter's input in a bag: images, calibration, additional inputs, transforms."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice

from hmt_ros.sessions.camera_session import CAMERA_INFO, IMAGE
from hmt_ros.sessions.image_inputs import (
    COMPRESSED_TYPE,
    DETECTIONS,
    DETECTIONS_INPUT,
    IMAGE_TYPE,
    INPUTS,
    PREDICTION_INPUT,
    SOURCES,
)
from hmt_ros.sessions.transform_buffer import TRANSFORMS, TRANSFORMS_TYPE
from msg_tools import BagError, BagMessage, BagReader, RosbagsMessages, Topic
from msg_tools.bags.bag_metadata import absolute_name
from msg_tools.bags.video_messages import VIDEO_TYPE, image_stamp, is_video, with_pictures
from msg_tools.messages.camera_info import camera_from_info, camera_info_message
from msg_tools.messages.headers import time_message, time_ns
from msg_tools.messages.images import decode_image
from msg_tools.messages.pose_mixtures import POSE_MIXTURE

CAMERA_INFO_TYPE = 'sensor_msgs/msg/CameraInfo'

# Preferred names of the image topic.
_USUAL_TOPICS = ('image/compressed', 'image')
GROUND_TRUTH = 'ground_truth'
# Inputs read from the bag; replay recomputes predictions.
RECORDED_INPUTS = (*(row for row in INPUTS if row is not PREDICTION_INPUT), DETECTIONS_INPUT)
# Fixed frames with z up [REP 105], and maximum number of messages searched for these frames.
UPRIGHT_FRAMES = ('odom', 'map', 'world')
_MAX_SEARCHED_MESSAGES = 2000
# Suffix of the topic with the filter's overlay images.
OVERLAY = 'overlay/compressed'


@dataclass(frozen=True)
class RecordedInput:
    """The topics of a bag that a replay reads.

    Attributes:
        given: topics of the additional inputs, by source.
        transforms: topics of the transforms in the bag, by source in `TRANSFORMS`; None if
            transforms are not used.
        upright_frame: ancestor of the camera frame among `UPRIGHT_FRAMES`; empty if missing.
        video: whether the images are packets of a video, which `messages` decodes.
        scaled: image size (width, height), px, to which `messages` scales the calibration; None
            if the calibration needs no scaling.
        by_log: whether `messages` replaces stamps by the log times of the images.
    """

    image: Topic
    camera_info: Topic
    given: Mapping[str, Topic] = field(default_factory=dict)
    ground_truth: Topic | None = None
    transforms: Mapping[str, Topic] | None = None
    upright_frame: str = ''
    video: bool = False
    scaled: tuple[int, int] | None = None
    by_log: bool = False

    @property
    def transport(self) -> str:
        """Value of the parameter `image_transport`."""
        compressed = self.image.msgtype == COMPRESSED_TYPE and not self.video
        return 'compressed' if compressed else 'raw'

    def of(self, name: str) -> Topic | None:
        """Topic of the input with this name in `RECORDED_INPUTS`; None if the bag lacks it."""
        row = next(row for row in RECORDED_INPUTS if row.name == name)
        return next((self.given[source] for source in row.types if source in self.given), None)

    def messages(self, bag: BagReader) -> Generator[tuple[str, BagMessage], None, None]:
        """Yields (source, message) by log time; a source is a filter input or `GROUND_TRUTH`.

        Raises:
            BagError: the bag is damaged; raised after the intact messages.
        """
        sources = {self.image.name: IMAGE, self.camera_info.name: CAMERA_INFO}
        if self.ground_truth is not None:
            sources[self.ground_truth.name] = GROUND_TRUTH
        for topics in (self.given, self.transforms or {}):
            sources |= {topic.name: source for source, topic in topics.items()}
        found = bag.messages(sources)
        if self.video:
            found = with_pictures(found, self.image.name)
        if self.by_log:
            found = _by_log(found, self.image.name)
        for stored in found:
            if self.scaled is not None and stored.topic == self.camera_info.name:
                yield CAMERA_INFO, _scaled(stored, self.scaled)
            else:
                yield sources[stored.topic], stored

    def check_stamps(self, bag: BagReader) -> None:
        """Raises BagError if images have no stamps and log times do not replace them."""
        try:
            first = [x.message for x in islice(bag.messages([self.image.name]), 2)]
        except BagError:
            return  # the replay itself reports the damage and the remedy
        if not self.by_log and len(first) == 2 and not any(map(image_stamp, first)):
            raise BagError(
                f'{bag.path}: the images on {self.image.name} have no stamps (all are 0): '
                '--times log uses the times at which they were recorded'
            )


def _scaled(stored: BagMessage, size: tuple[int, int]) -> BagMessage:
    """Scales the calibration in a camera_info message to a different image size."""
    try:
        camera, header = camera_from_info(stored.message, size), stored.message.header
    except ValueError:
        return stored  # the node that receives the message reports the fault
    stamp, frame = time_ns(header.stamp), str(header.frame_id)
    return stored.with_message(camera_info_message(RosbagsMessages(), camera, stamp, frame))


def fitted(
    bag: BagReader, recorded: RecordedInput, notify: Callable[[str], object]
) -> RecordedInput:
    """Returns the input, with `scaled` set if images and calibration differ in size."""
    messages = bag.messages([recorded.image.name])
    if recorded.video:
        messages = with_pictures(messages, recorded.image.name)
    notices: list[str] = []
    try:
        height, width = decode_image(next(messages).message).shape[:2]
        info = next(bag.messages([recorded.camera_info.name])).message
        camera = camera_from_info(info)
        if (camera.width, camera.height) == (width, height):
            return recorded
        camera_from_info(info, (width, height), notices.append)
    except (ValueError, StopIteration):
        return recorded  # the replay itself reports the fault
    notify(f'{bag.path}: {notices[-1]}')
    return replace(recorded, scaled=(width, height))


def _by_log(messages: Iterator[BagMessage], image: str) -> Iterator[BagMessage]:
    """Replaces the stamp of each image by its log time.

    Any other message gets the log time of the newest image that had the same stamp, or else its own
    log time. Transforms get their own log times.
    """
    times: dict[int, int] = {}
    for stored in messages:
        try:
            message = stored.message
        except BagError:
            message = None  # the node that receives the message reports the fault
        for each in getattr(message, 'transforms', [message]):
            if (header := getattr(each, 'header', None)) is None:
                continue
            stamp, new = time_ns(header.stamp), stored.log_time_ns
            if stored.topic == image:
                times[stamp] = new
            elif each is message:
                new = times.get(stamp, new)
            header.stamp = time_message(RosbagsMessages(), new)
        yield stored


def recorded_input(
    bag: BagReader,
    image_topic: str | None = None,
    camera_info_topic: str | None = None,
    *,
    topics: Mapping[str, str | None] | None = None,
    namespace: str = '',
) -> RecordedInput:
    """Finds the topics that a replay reads.

    Images are on `image/compressed`, else on `image`, else on the only image topic. The calibration
    is on `camera_info` in the namespace of the images, else on the only topic of its type.
    Additional inputs have the names in the table of inputs; transforms are on `/tf` and
    `/tf_static`.

    Args:
        image_topic, camera_info_topic: topic names that replace the automatic choice.
        topics: topics that replace the automatic choice, by the name of the input.
        namespace: preferred namespace of the topics, '/humans/bodies/p1' for example.

    Raises:
        BagError: there are no images or no camera_info, or the choice is ambiguous.
    """
    named = partial(_in_namespace, bag, namespace)
    given: dict[str, Topic] = {}
    for row in RECORDED_INPUTS:
        types = {
            s: (tuple(SOURCES.values()) if s == DETECTIONS else (t,)) for s, t in row.types.items()
        }
        chosen = (topics or {}).get(row.name)
        if chosen is not None:
            found = bag.find_topic([x for kinds in types.values() for x in kinds], chosen)
            given[next(s for s, kinds in types.items() if found.msgtype in kinds)] = found
            continue
        for source, kinds in types.items():
            if (topic := named(source, kinds)) is not None:
                given[source] = topic
                break
    besides = [topic.name.lstrip('/') for topic in given.values()]
    of_pixels = [
        source for row in RECORDED_INPUTS if row.pixels is not None for source in row.types
    ]
    image = _image_topic(bag, image_topic, namespace, (*of_pixels, *besides))
    transforms = {source: _named(bag, source, (TRANSFORMS_TYPE,)) for source in TRANSFORMS}
    return RecordedInput(
        image,
        _camera_info_topic(bag, image, camera_info_topic),
        given,
        named(GROUND_TRUTH, (POSE_MIXTURE,)),
        {source: topic for source, topic in transforms.items() if topic is not None},
        video=is_video(bag, image),
    )


def upright_frame(bag: BagReader, recorded: RecordedInput) -> str:
    """The nearest ancestor of the camera frame in `UPRIGHT_FRAMES`; empty if missing."""
    names = {topic.name for topic in (recorded.transforms or {}).values()}
    if not names:
        return ''
    parents: dict[str, str] = {}
    camera = ''
    with suppress(BagError):  # the replay itself reports the damage and the remedy
        for stored in islice(
            bag.messages({*names, recorded.camera_info.name}), _MAX_SEARCHED_MESSAGES
        ):
            if stored.topic in names:
                for each in stored.message.transforms:
                    child, parent = each.child_frame_id, each.header.frame_id
                    parents[child.removeprefix('/')] = parent.removeprefix('/')
            else:
                camera = stored.message.header.frame_id.removeprefix('/')
            found = _upright_above(camera, parents)
            if found:
                return found
    return ''


def _upright_above(frame: str, parents: Mapping[str, str]) -> str:
    seen = set()
    while frame in parents and frame not in seen:
        seen.add(frame)
        frame = parents[frame]
        if frame in UPRIGHT_FRAMES:
            return frame
    return ''


def _image_topic(
    bag: BagReader, name: str | None, namespace: str, besides: tuple[str, ...]
) -> Topic:
    kinds = (COMPRESSED_TYPE, IMAGE_TYPE, VIDEO_TYPE)
    if name is not None:
        return bag.find_topic(kinds, name)
    for usual in _USUAL_TOPICS:
        topic = _in_namespace(bag, namespace, usual, kinds)
        if topic is not None:
            return topic
    return _the_only(bag, kinds, '--image-topic', besides=besides)


def _camera_info_topic(bag: BagReader, image: Topic, name: str | None) -> Topic:
    kinds = (CAMERA_INFO_TYPE,)
    if name is not None:
        return bag.find_topic(kinds, name)
    # The calibration of /camera/image_raw/compressed is on /camera/camera_info.
    namespace = image.name.strip('/')
    if image.msgtype != IMAGE_TYPE:
        namespace = namespace.removesuffix('/compressed').removesuffix('/foxglove')
    namespace = namespace.rpartition('/')[0]
    beside = _named(bag, f'{namespace}/camera_info'.lstrip('/'), kinds)
    if beside is not None:
        return beside
    if not bag.topics_of(*kinds):
        raise BagError(
            f'{bag.path} has images on {image.name}, but no camera_info: without a calibration, '
            'images do not determine positions in space'
        )
    return _the_only(bag, kinds, '--camera-info-topic')


def _in_namespace(
    bag: BagReader, namespace: str, name: str, kinds: tuple[str, ...]
) -> Topic | None:
    """The topic with a given name and type, in the namespace or else in the root."""
    inside = absolute_name(name, namespace).lstrip('/')
    return _named(bag, inside, kinds) or _named(bag, name, kinds)


def _named(bag: BagReader, name: str, kinds: tuple[str, ...]) -> Topic | None:
    """The topic with a given name and one of the given types."""
    found = (topic for topic in bag.topics_of(*kinds) if topic.name.lstrip('/') == name)
    return next(found, None)


def _the_only(
    bag: BagReader, kinds: tuple[str, ...], option: str, besides: tuple[str, ...] = ()
) -> Topic:
    """The only topic of the given types, apart from `besides` and the filter's overlay images."""
    found = [
        topic
        for topic in bag.topics_of(*kinds)
        if topic.name.lstrip('/') not in besides and not topic.name.endswith(OVERLAY)
    ]
    if len(found) == 1:
        return found[0]
    if len(found) > 1:
        names = ', '.join(topic.name for topic in found)
        what = ' or '.join(kind.rpartition('/')[2] for kind in kinds)
        raise BagError(f'{bag.path} has several topics of {what}: name one of {names} by {option}')
    return bag.find_topic(kinds)
