"""replay: tracks the person in a bag, offline or through live nodes, and writes a new bag.

Without a subject file the track starts from the keypoints in the bag, or from the prediction of a
trained model.

Offline and live replay pass the same messages to the same objects in the same order, and write the
results in this order, so the two bags are equal, byte for byte. `hmt_ros.sessions.track_messages`,
`smoothed_messages` and `bme_session` list the topics of a new bag.
"""

from __future__ import annotations

import argparse
import re
from functools import partial
from pathlib import Path

from hmt_ros.app.command_line import CommandParser, run_command
from hmt_ros.app.progress import notify_user, say
from hmt_ros.app.replay.many_bags import has_several_bags, replay_many
from hmt_ros.app.replay.one_bag import replay_bag
from hmt_ros.app.replay.options import LOG_TIMES, STAMPS, ReplayOptions

EPILOG = """\
A track starts from a subject file (see below), which gives the joints of the person in one image.
Without one it starts from the keypoints of a detector, if the bag has some, or else from the
prediction of a model trained on silhouettes (--bme); neither gives the size of the person.

  stamp_ns: 1700000000000000000          # stamp of that image
  sigma_px: 3.0                          # standard deviation of a click
  keypoints: {left_hip: [246.9, 219.9], right_hip: [224.2, 219.3], ...}
  segment_lengths_m: {thigh: 0.415, ...} # optional, as measured with a tape
  stature_m: 1.75                        # optional

OUT gets the topics pose_mixture and likelihood_mixture (hmt_msgs/PoseMixture: weights, poses,
covariances, joint positions), body, person_pose, human_joint_states, /tf, markers and
overlay/compressed; from the smoother smoothed_pose_mixture, trajectory_mixture,
smoothed_joint_states and trajectory_markers; from the BME pose_prediction; and the ground_truth of
IN if it has one. Their names are absolute, /pose_mixture or, with --namespace /humans/bodies/anna,
/humans/bodies/anna/pose_mixture. OUT is written completely or not at all.

Several bags, or a folder with bags at any depth, go into the folder OUT, each under its own name,
with <name>.replay.json beside it, which records its input and parameters. Existing bags of the same
input and parameters are skipped; unfinished bags are replayed again.
{bag} in --subject, --background, --bme and --body stands for the folder of each bag. With
--scheduler Dask (the Python package distributed) replays the bags; its workers must see the files
under the same names; the new bags are the same, byte for byte.

examples:
  replay bags/reach -o out --subject bags/reach/subject.yaml --background bags/reach/background.png
  replay walk.mcap -o out --subject walk.yaml --set max_hypotheses=16 --seed 1
  replay walk.mcap -o out --subject walk.yaml --config filter.yaml --live
  replay walk.mcap -o out --background empty.png --set bme.stature=1.75
  replay recording -o out --namespace /humans/bodies/anna --image-topic /camera/image_raw
  replay archive -o tracked --subject {bag}/subject.yaml --scheduler local

exit code: 0 done, 1 bad input (one line on stderr explains it) or some of several bags failed (one
line for each), 130 interrupted
"""

# Help texts of the topic options: content and default name of each topic.
_TOPICS = {
    'image': 'the images (default: image/compressed, else image, else the only topic of images)',
    'camera-info': 'the calibration (default: camera_info beside the images, else the only one)',
    'mask': 'the masks (default: mask, else mask/compressed)',
    'depth': 'depth images that are registered to the images (default: depth)',
    'keypoints': 'the 2D keypoints (default: keypoints)',
}


def main(argv: list[str] | None = None) -> int:
    """Runs the command; returns 0 on success, 1 for bad input (explained in one line on stderr)."""
    return run_command(_parser(), _replay, argv, whole_or_nothing=True)


def _parser() -> CommandParser:
    parser = CommandParser(
        'replay',
        'Tracks and smooths the person in a bag of images into a new bag of mixtures over poses.',
        EPILOG,
    )
    parser.add_argument(
        'bags',
        nargs='+',
        type=Path,
        metavar='IN',
        help='bag: a folder, or a file such as .mcap; several bags or a folder of bags, see below',
    )
    parser.add_output('OUT', 'bag', 'folder of the new bag, or of the new bags')
    parser.add_argument(
        '--live',
        action='store_true',
        help='run the real nodes, over DDS, one image at a time; the new bag is the same',
    )
    parser.add_argument(
        '--no-smoother',
        action='store_false',
        dest='with_smoother',
        help='only track; the new bag has no smoothed poses',
    )
    parser.add_argument(
        '--keep-going',
        action='store_true',
        help='skip unusable messages, with a warning for the first of each kind of fault, and '
        'read a damaged bag up to its damage (default: stop with an error)',
    )
    parser.add_argument(
        '--people',
        action='store_true',
        help='track several people from the detections in the bag, each on topics '
        'humans/bodies/<id>/...; without smoother and BME',
    )
    parser.add_argument(
        '--scheduler',
        metavar='ADDRESS',
        help='replay many bags through Dask: address of a scheduler, or local for all cores of '
        'this machine',
    )

    person = parser.add_argument_group('the person')
    person.add_argument('--subject', type=Path, metavar='FILE', help='subject file, see below')
    person.add_argument(
        '--bme',
        nargs='?',
        const='',
        metavar='MODEL',
        help='also predict poses with a trained model and use them (always if neither --subject '
        'nor keypoints are given); without MODEL use the small model shipped with the '
        'package',
    )
    person.add_argument(
        '--background',
        type=Path,
        metavar='FILE',
        help='image of the empty scene (default: learned from the images before the track starts)',
    )
    person.add_argument(
        '--body', metavar='NAME', help='body model: a name or a YAML file (default: human37)'
    )

    settings = parser.add_argument_group('settings')
    settings.add_argument(
        '--config',
        action='append',
        default=[],
        type=Path,
        metavar='FILE',
        help='parameter file, such as hmt_ros/config/filter_node.yaml, which lists all parameters '
        'of the filter; sections smoother_node and bme_node are for the other nodes; may be '
        'repeated',
    )
    settings.add_argument(
        '--set',
        action='append',
        default=[],
        dest='settings',
        metavar='NAME=VALUE',
        help='one parameter of the filter, or smoother.NAME=VALUE, or bme.NAME=VALUE; may be '
        'repeated, and takes precedence over --config',
    )
    settings.add_argument(
        '--seed', type=int, metavar='N', help='seed of all random numbers (default: 0)'
    )

    topics = parser.add_argument_group('topics')
    for name, what in _TOPICS.items():
        topics.add_argument(f'--{name}-topic', metavar='NAME', help=f'topic of {what}')
    topics.add_argument(
        '--times',
        choices=(STAMPS, LOG_TIMES),
        default=STAMPS,
        help='times of the images: their stamps, or log: their recording times, if stamps are '
        'missing or wrong (default: stamps)',
    )
    topics.add_argument(
        '--namespace',
        type=_namespace,
        default='',
        metavar='NAME',
        help='namespace of the results, such as /humans/bodies/anna (default: the root); topics of '
        'IN in this namespace are preferred to those in the root',
    )
    topics.add_argument(
        '--with-images',
        action='store_true',
        help='also copy images and camera_info into OUT (bags get large)',
    )
    return parser


def _namespace(text: str) -> str:
    """Reads a ROS namespace; '' is the root."""
    name = text.strip('/')
    if name and not re.fullmatch(r'[A-Za-z_]\w*(/[A-Za-z_]\w*)*', name, re.ASCII):
        raise argparse.ArgumentTypeError(
            f'wanted a namespace such as /humans/bodies/anna (letters, digits, _; no name begins '
            f'with a digit), saw {text!r}'
        )
    return f'/{name}' if name else ''


def _replay(arguments: argparse.Namespace) -> int:
    values, notify = vars(arguments), partial(notify_user, 'replay')
    bags, output, scheduler = (values.pop(name) for name in ('bags', 'output', 'scheduler'))
    options = ReplayOptions(**values)
    if has_several_bags(bags, scheduler):
        return replay_many(bags, output, options, notify, scheduler)
    replayed = replay_bag(bags[0], output, options.of_bag(bags[0]), notify)
    if not options.quiet:
        say(f'{output}: {replayed}')
    return 0
