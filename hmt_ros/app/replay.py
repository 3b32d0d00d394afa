"""replay: tracks and smooths the person in a bag, offline or through live nodes, into a new bag.

Without a subject file the track starts from what a trained model predicts from the images.

Both ways give the same messages to the same objects in the same order, and write what comes out in
the order in which it came: the bags are the same, byte for byte. What stands in one is listed in
`hmt_ros.nodes.track_messages`, `smoothed_messages` and `bme_session`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, TypeVar

from tqdm import tqdm

from hmt_ros.app.command_line import CommandParser, run_command
from hmt_ros.app.played_track import (
    BME,
    FILTER,
    SMOOTHER,
    LiveTrack,
    NodeParameters,
    OfflineTrack,
    PlayedTrack,
)
from hmt_ros.app.recorded_input import GROUND_TRUTH, RecordedInput, recorded_input
from hmt_ros.body.plain_yaml import load_plain_yaml
from hmt_ros.nodes import bme_session, smoothed_messages, track_messages
from hmt_ros.nodes.bme_parameters import BmeParameters
from hmt_ros.nodes.camera_input import CAMERA_INFO, IMAGE
from hmt_ros.nodes.declared_parameters import with_values
from hmt_ros.nodes.filter_parameters import FilterParameters
from hmt_ros.nodes.filter_session import KEYPOINTS
from hmt_ros.nodes.handled import Handled
from hmt_ros.nodes.parameter_file import read_parameter_file
from hmt_ros.nodes.smoother_parameters import SmootherParameters
from hmt_ros.nodes.track_start import prepare_start
from hmt_ros.tracking import Subject
from msg_tools import BagError, BagMessage, BagReader, BagWriter, RosbagsMessages
from msg_tools.error_line import error_line
from msg_tools.headers import header_message, time_ns

Settings = TypeVar('Settings')

# What the bag and the command say, whatever a parameter file says.
_DECIDED_HERE = ('image_transport', 'autostart')
# What stands before the parameters of a node in --set.
_PREFIXES = {SMOOTHER: 'smoother.', BME: 'bme.', FILTER: ''}
# What every node has.
_OF_ROS = ('qos_overrides.', 'use_sim_time', 'start_type_description_service')

EPILOG = """\
A track starts from a subject file, which says where the joints of the person are in one image;
without one from what a trained model predicts from silhouettes (--bme), which knows nothing of the
person's size:

  stamp_ns: 1700000000000000000          # of that image
  sigma_px: 3.0                          # how exactly one has clicked
  keypoints: {left_hip: [246.9, 219.9], right_hip: [224.2, 219.3], ...}
  segment_lengths_m: {thigh: 0.415, ...} # optional, as measured with a tape
  stature_m: 1.75                        # optional

OUT gets the topics pose_mixture and likelihood_mixture (hmt_msgs/PoseMixture: weights, poses,
covariances, joint positions), body, joint_states, /tf, markers and overlay/compressed; of the
smoother smoothed_pose_mixture, trajectory_mixture, smoothed_joint_states and trajectory_markers;
of the BME pose_prediction; and the ground_truth of IN where it has one. It is written whole or not
at all.

examples:
  replay bags/reach -o out --subject bags/reach/subject.yaml --background bags/reach/background.png
  replay walk.mcap -o out --subject walk.yaml --set max_hypotheses=16 --set proposals=css --seed 1
  replay walk.mcap -o out --subject walk.yaml --config filter.yaml --live
  replay walk.mcap -o out --background empty.png --set bme.stature=1.75

exit code: 0 done, 1 bad input (one line on stderr says which), 130 interrupted
"""


def main(argv: list[str] | None = None) -> int:
    """Runs the command; 0: the bag is there, 1: bad input, and one line on stderr says which."""
    return run_command(_parser(), _replay, argv)


def _parser() -> CommandParser:
    parser = CommandParser(
        prog='replay',
        description='Tracks and smooths the person in a bag of images, into a new bag of mixtures '
        'over poses.',
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        'bag', type=Path, metavar='IN', help='bag: a folder, or a file such as .mcap'
    )
    parser.add_argument(
        '-o', '--output', type=Path, required=True, metavar='OUT', help='folder of the new bag'
    )
    parser.add_argument('--overwrite', action='store_true', help='replace the bag that is there')
    parser.add_argument('--quiet', action='store_true', help='neither progress bar nor summary')
    parser.add_argument(
        '--live',
        action='store_true',
        help='through the real nodes, over DDS, one image at a time; the same bag comes out',
    )
    parser.add_argument(
        '--no-smoother', action='store_true', help='only track; the bag has no smoothed poses'
    )
    parser.add_argument(
        '--keep-going',
        action='store_true',
        help='skip what can not be used, with a warning for the first of each kind, and take what '
        'can be read of a damaged bag (by default the command ends there)',
    )

    person = parser.add_argument_group('the person')
    person.add_argument('--subject', type=Path, metavar='FILE', help='subject file, see below')
    person.add_argument(
        '--bme',
        nargs='?',
        const='',
        metavar='MODEL',
        help='predict poses with a trained model too, and use them (always without --subject); '
        'without MODEL the small one that comes with the package',
    )
    person.add_argument(
        '--background',
        type=Path,
        metavar='FILE',
        help='image of the empty scene (learned from the images before the track starts)',
    )
    person.add_argument(
        '--body', metavar='NAME', help='body model: a name or a YAML file (human37)'
    )

    settings = parser.add_argument_group('settings')
    settings.add_argument(
        '--config',
        action='append',
        default=[],
        type=Path,
        metavar='FILE',
        help='parameter file, such as hmt_ros/config/filter_node.yaml, which lists all of the '
        'filter; what is for the others stands in sections smoother_node and bme_node. May be '
        'given several times',
    )
    settings.add_argument(
        '--set',
        action='append',
        default=[],
        metavar='NAME=VALUE',
        help='one parameter of the filter, or smoother.NAME=VALUE, or bme.NAME=VALUE; may be given '
        'several times, and goes before --config',
    )
    settings.add_argument('--seed', type=int, metavar='N', help='of all that is random (0)')

    topics = parser.add_argument_group('topics')
    topics.add_argument(
        '--image-topic',
        metavar='NAME',
        help='images (image/compressed, else image, else the only topic of images)',
    )
    topics.add_argument(
        '--camera-info-topic',
        metavar='NAME',
        help='calibration (camera_info beside the images, else the only one)',
    )
    topics.add_argument(
        '--with-images',
        action='store_true',
        help='copy images and camera_info into OUT as well (bags get large)',
    )
    return parser


def _replay(options: argparse.Namespace) -> int:
    try:
        summary = _replayed(options)
    except KeyboardInterrupt:
        print('replay: interrupted, nothing is written', file=sys.stderr)
        return 130
    if not options.quiet:
        print(summary)
    return 0


def _replayed(options: argparse.Namespace) -> str:
    """Replays the bag; a line that sums up what came out."""
    source, target = options.bag, options.output
    if target.exists() and target.resolve() in (source.resolve(), source.resolve().parent):
        raise ValueError(f'{target} is the bag that is read; give another name')
    with BagReader(source) as bag:
        if bag.damage is not None and not options.keep_going:
            raise BagError(f'{source} {bag.damage}')
        recorded = recorded_input(bag, options.image_topic, options.camera_info_topic)
        parameters = _node_parameters(options, recorded)
        # What the parameters name is looked at before a node is started.
        subject = prepare_start(parameters.filter).initial
        if subject is None and not options.quiet:
            _tell(f'no --subject: the track starts from a prediction{_subject_hint(source)}')
        with BagWriter(target, overwrite=options.overwrite) as out:
            topics = dict(track_messages.TOPICS)
            if parameters.smoother is not None:
                topics.update(smoothed_messages.TOPICS)
            if parameters.bme is not None:
                topics.update(bme_session.TOPICS)
            for topic, published in topics.items():
                out.add_topic(topic, published.msgtype, latched=published.latched)
            way = LiveTrack if options.live else OfflineTrack
            with way(parameters, out.write_serialised) as track:
                count = _play(options, bag, recorded, parameters.filter, track, out)
            if not count.tracked:
                raise ValueError(f'{source}: {_why_nothing(count, subject)}')
    return f'{target}: {count.tracked} of {count.images} images tracked'


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
        **{
            f'background.{field.name}': getattr(tracking.background, field.name)
            for field in fields(tracking.background)
        },
        **_given_values(options, BME),
        'image_transport': recorded.transport,
    }
    if options.bme:
        values['model_file'] = options.bme
    return with_values(BmeParameters(), values)


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
) -> _Count:
    """Gives the nodes what is in the bag; copies what is to be copied."""
    count = _Count()
    if not parameters.use_keypoints:
        recorded = replace(recorded, keypoints=None)
    copied = {GROUND_TRUTH, IMAGE, CAMERA_INFO} if options.with_images else {GROUND_TRUTH}
    hidden = options.quiet or not sys.stderr.isatty()
    with tqdm(
        total=recorded.image.message_count, unit='image', desc=str(options.output), disable=hidden
    ) as bar:

        def judge(handled: Handled) -> None:
            count.tracked += sum(topic == 'pose_mixture' for topic, _ in handled.published)
            if handled.faults:
                count.last_fault = handled.faults[-1]
                if not options.keep_going:
                    raise ValueError(
                        f'{bag.path}: {handled.faults[0]} (--keep-going skips what can not be used)'
                    )
            for text in handled.warnings:
                _tell(f'{bag.path}: {text}')

        for source, stored in _readable(recorded.messages(bag), options.keep_going):
            if source in copied:
                out.write(stored.topic, stored.log_time_ns, stored.message)
            if source == GROUND_TRUTH:
                continue
            judge(track.take(source, stored.message))
            if source == IMAGE:
                count.images += 1
                count.last_stamp = time_ns(stored.message.header.stamp)
                bar.update()
        if parameters.use_keypoints:
            # The last images need not wait any longer.
            judge(track.take(KEYPOINTS, _nobody(count.last_stamp)))
        judge(track.finish())
    return count


def _readable(
    messages: Iterator[tuple[str, BagMessage]], keep_going: bool
) -> Iterator[tuple[str, BagMessage]]:
    """The messages, without those whose bytes are none, up to where the bag is damaged.

    Raises:
        BagError: there is such a place, and it is not to be passed over.
    """
    while True:
        try:
            source, stored = next(messages)
            # Read here, where it is known that a fault is one of the bag.
            assert stored.message is not None
        except StopIteration:
            return
        except BagError as error:
            if not keep_going:
                raise
            _tell(str(error))
            continue
        yield source, stored


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


def _tell(text: str) -> None:
    tqdm.write(f'replay: {text}', file=sys.stderr)


if __name__ == '__main__':
    sys.exit(main())
