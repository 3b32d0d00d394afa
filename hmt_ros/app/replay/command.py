"""replay: tracks and smooths the person in a bag, offline or through live nodes, into a new bag.

Without a subject file the track starts from what a trained model predicts from the images.

Both ways give the same messages to the same objects in the same order, and write what comes out in
the order in which it came: the bags are the same, byte for byte. What stands in one is listed in
`hmt_ros.sessions.track_messages`, `smoothed_messages` and `bme_session`.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from tqdm import tqdm

from hmt_ros.app.command_line import CommandParser, run_command
from hmt_ros.app.replay.replay_many import is_many, of_bag, replay_many
from hmt_ros.app.replay.replayed_bag import replay_bag

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

Several bags, or a folder with bags at any depth, go into the folder OUT, each under its own name,
with <name>.replay.json beside it, which says from what it was made. A bag that is there and was
made from the same input with the same parameters is skipped, one that was left half done is done
anew. {bag} in --subject, --background, --bme and --body is the folder of each bag. With --scheduler
the bags go through Dask (the Python package distributed), whose workers must see the files under
the same names; the new bags are the same, byte for byte.

examples:
  replay bags/reach -o out --subject bags/reach/subject.yaml --background bags/reach/background.png
  replay walk.mcap -o out --subject walk.yaml --set max_hypotheses=16 --set proposals=css --seed 1
  replay walk.mcap -o out --subject walk.yaml --config filter.yaml --live
  replay walk.mcap -o out --background empty.png --set bme.stature=1.75
  replay archive -o tracked --subject {bag}/subject.yaml --scheduler local

exit code: 0 done, 1 bad input (one line on stderr says which), or a bag of several could not be
replayed (a line each), 130 interrupted
"""


def main(argv: list[str] | None = None) -> int:
    """Runs the command; 0: the bag is there, 1: bad input, and one line on stderr says which."""
    return run_command(_parser(), _replay, argv, whole_or_nothing=True)


def _parser() -> CommandParser:
    parser = CommandParser(
        prog='replay',
        description='Tracks and smooths the person in a bag of images, into a new bag of mixtures '
        'over poses.',
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        'bags',
        nargs='+',
        type=Path,
        metavar='IN',
        help='bag: a folder, or a file such as .mcap; several, or a folder of bags, see below',
    )
    parser.add_argument(
        '-o',
        '--output',
        type=Path,
        required=True,
        metavar='OUT',
        help='folder of the new bag, or of the new bags',
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
    parser.add_argument(
        '--scheduler',
        metavar='ADDRESS',
        help='replay many bags through Dask: the address of a scheduler, or local, which makes use '
        'of all cores of this machine',
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
    if is_many(options):
        return replay_many(options, _tell)
    replayed = replay_bag(of_bag(options, options.bags[0], options.output), _tell)
    if not options.quiet:
        print(replayed)
    return 0


def _tell(text: str) -> None:
    tqdm.write(f'replay: {text}', file=sys.stderr)


if __name__ == '__main__':
    sys.exit(main())
