"""subject: writes a subject file from the keypoints of a detector in one image of a bag.

    subject walk -o walk.yaml --stature 1.75

The schemes of keypoints say at which joint a landmark lies (`hmt_ros.image.keypoint_schemes`).
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hmt_ros.app.command_line import CommandParser, add_body, number, run_command, whole_number
from hmt_ros.app.progress import with_progress
from hmt_ros.app.replay.inputs import recorded_input
from hmt_ros.body import Body, load_body
from hmt_ros.image.keypoint_schemes import landmarks_of
from hmt_ros.image.terms.keypoints import Keypoints
from msg_tools import BagReader
from msg_tools.messages.detections import NO_KEYPOINTS
from msg_tools.messages.headers import SECOND_NS, time_ns
from msg_tools.messages.keypoints import keypoints_of

# Joints that an image to start from shows, and how many of them.
WANTED = tuple(
    f'{side}_{joint}'
    for joint in ('hip', 'shoulder', 'knee', 'ankle', 'elbow', 'wrist')
    for side in ('left', 'right')
)
ENOUGH = 10
FEWEST = 4  # that a subject file may have
CONFIDENT = 0.5
# The landmark of a head that lies at its joint.
_CENTRE_OF_HEAD = 'centre_of_head'
# Standard deviation of a keypoint, in sizes of the person in the image, and at least, px.
SIGMA, LEAST_SIGMA = 0.03, 2.0

EPILOG = """\
BAG has the topic keypoints, as import-video writes it. The subject file has the joints in the image
at --stamp or --time; else in the first image that shows at least 10 of the hips, shoulders, knees,
ankles, elbows and wrists with a confidence of 0.5, all hips and shoulders among them; else in the
image that shows most of them. replay --subject starts there. Eyes, ears and nose are left out: they
do not lie at a joint.

examples:
  subject walk -o walk.yaml
  subject walk -o walk.yaml --time 1.5 --stature 1.75

exit code: 0 done, 1 bad input (one line on stderr explains it)
"""


@dataclass(frozen=True)
class Seen:
    """Joints in an image.

    Attributes:
        stamp_ns: of the image.
        joints: under the names of the body, those that were seen with confidence.
    """

    stamp_ns: int
    joints: Keypoints

    @property
    def count(self) -> int:
        """Number of the wanted joints among them."""
        return len({*self.joints.names} & {*WANTED})

    @property
    def is_enough(self) -> bool:
        """Whether a track can start well from them."""
        return self.count >= ENOUGH and {*WANTED[:4]} <= {*self.joints.names}


def main(argv: list[str] | None = None) -> int:
    """Runs the command; 0: the file is there, 1: bad input, which one line on stderr explains."""
    return run_command(_parser(), _subject, argv)


def _parser() -> CommandParser:
    parser = CommandParser(
        'subject', 'Writes a subject file from the keypoints of a detector in a bag.', EPILOG
    )
    parser.add_argument('bag', type=Path, metavar='BAG', help='bag: a folder, or a file')
    parser.add_argument(
        '-o', '--output', type=Path, required=True, metavar='FILE', help='subject file to write'
    )
    parser.add_argument('--overwrite', action='store_true', help='replace an existing file')
    when = parser.add_mutually_exclusive_group()
    when.add_argument('--stamp', type=whole_number(0), metavar='NS', help='stamp of the image, ns')
    when.add_argument(
        '--time',
        type=number(0, 1e9, what='a time', unit=' s'),
        help='time since the first image, s; the image nearest to it is taken',
    )
    parser.add_argument(
        '--stature', type=number(0.3, 3), help='stature of the person, m (default: not known)'
    )
    parser.add_argument(
        '--sigma',
        type=number(0.01, 1e4),
        help='standard deviation of a keypoint, px (default: 3 %% of the size of the person in the '
        'image, at least 2)',
    )
    add_body(parser)
    return parser


def _subject(arguments: argparse.Namespace) -> int:
    if arguments.output.exists() and not arguments.overwrite:
        raise ValueError(f'{arguments.output} exists; give another name, or --overwrite')
    body = load_body(arguments.body)
    seen = find_start(arguments.bag, body, stamp_ns=arguments.stamp, time=arguments.time)
    text = subject_text(seen, stature=arguments.stature, sigma=arguments.sigma)
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    arguments.output.write_text(text, encoding='utf-8')
    print(f'{arguments.output}: {len(seen.joints.names)} joints at {seen.stamp_ns} ns')
    return 0


def find_start(
    path: Path, body: Body, *, stamp_ns: int | None = None, time: float | None = None
) -> Seen:
    """The joints in the image of a bag that a track starts from.

    Args:
        stamp_ns: of the image; or
        time: since the first image, s, of which the nearest image is taken; or neither: see EPILOG.

    Raises:
        ValueError: the bag has no keypoints, or too few in that image.
    """
    nearest: Seen | None = None
    best: Seen | None = None
    with BagReader(path) as bag:
        topic = recorded_input(bag).of('keypoints')
        if topic is None:
            raise ValueError(f'{path} has no keypoints: import them with the video')
        first: int | None = None
        messages = bag.messages([topic.name])
        for stored in with_progress(messages, str(path), 'messages', topic.message_count):
            stamp = time_ns(stored.message.header.stamp)
            first = stamp if first is None else first
            seen = Seen(stamp, joints_of(keypoints_of(stored.message, LEAST_SIGMA), body))
            if stamp_ns is not None or time is not None:
                at = stamp_ns if stamp_ns is not None else first + round((time or 0) * SECOND_NS)
                if nearest is None or abs(stamp - at) < abs(nearest.stamp_ns - at):
                    nearest = seen
            elif best is None or seen.count > best.count:
                best = seen
                if seen.is_enough:
                    break
    if stamp_ns is not None and nearest is not None and nearest.stamp_ns != stamp_ns:
        raise ValueError(
            f'{path} has no keypoints at {stamp_ns} ns, the nearest are at {nearest.stamp_ns} ns'
        )
    chosen = nearest or best
    count = 0 if chosen is None else len(chosen.joints.names)
    if chosen is None or count < FEWEST:
        where = 'in each image' if nearest is None else f'at {nearest.stamp_ns} ns'
        raise ValueError(
            f'{path}: {count} joints of {body.name} are seen with confidence {where}, wanted '
            f'{FEWEST} at least'
        )
    return chosen


def joints_of(keypoints: Keypoints, body: Body) -> Keypoints:
    """The joints of a body at which confident landmarks lie, under the names of the body.

    A landmark that has the name of the joint stands for it; if the detector has none of that name,
    the mean of those at the joint does, as of the fingers for the hand.
    """
    names, known = keypoints.names, body.joint_names
    sure = keypoints.seen & (keypoints.confidences >= CONFIDENT)
    places: dict[str, list[int]] = {}
    for i, mark in enumerate(landmarks_of(names, known)):
        joint = names[i] if mark is None else mark.joint
        stands_for_it = names[i] == joint or joint not in names
        beside_it = mark is not None and joint == 'head' and mark.name != _CENTRE_OF_HEAD
        if sure[i] and joint in known and stands_for_it and not beside_it:
            places.setdefault(joint, []).append(i)
    if not places:
        return NO_KEYPOINTS
    pixels = np.array([keypoints.pixels[i].mean(0) for i in places.values()])
    covariances = np.array([keypoints.covariances[i].mean(0) for i in places.values()])
    confidences = np.array([keypoints.confidences[i].mean() for i in places.values()])
    return Keypoints(tuple(places), pixels, covariances, confidences)


def subject_text(seen: Seen, *, stature: float | None = None, sigma: float | None = None) -> str:
    """The subject file.

    Args:
        stature: m; None: not known.
        sigma: standard deviation of a joint, px; None: follows from the size of the person.
    """
    pixels = seen.joints.pixels
    if sigma is None:
        sigma = max(SIGMA * float(np.ptp(pixels, axis=0).max()), LEAST_SIGMA)
    lines = [
        '# joints in one image, as a detector found them',
        f'stamp_ns: {seen.stamp_ns}',
        f'sigma_px: {sigma:.1f}',
        "keypoints:  # name: [u, v] in pixels; left and right are the person's own",
    ]
    for name, (u, v) in zip(seen.joints.names, pixels, strict=True):
        lines.append(f'  {name}: [{u:.1f}, {v:.1f}]')
    if stature is not None:
        lines.append(f'stature_m: {stature:g}')
    return '\n'.join(lines) + '\n'
