"""lift: computes mixtures over poses from the keypoints of a detector, without images.

    lift walk.json -o walk --fov 60 --size 1280x720 --fps 30

See `experts.lifter`; with images `track-video` is more accurate.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from hmt_ros.app.command_line import (
    CommandParser,
    gravity_of,
    image_size,
    number,
    run_command,
    whole_number,
)
from hmt_ros.app.import_video.command import (
    add_camera_arguments,
    add_keypoint_arguments,
    camera_of,
)
from hmt_ros.app.import_video.frames import FrameSource
from hmt_ros.app.import_video.keypoint_files.persons import FoundPersons
from hmt_ros.app.import_video.keypoint_files.reading import (
    ClipReading,
    keypoints_of_person,
    read_keypoints,
)
from hmt_ros.app.progress import notify_user, say, show_progress
from hmt_ros.app.report.command import ReportOptions, write_report
from hmt_ros.body import Body, Camera, load_body
from hmt_ros.experts.lifted_fit import lift_poses
from hmt_ros.experts.lifter import SHIPPED, load_lifter
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.error_model import seconds
from hmt_ros.sessions.camera_frames import unit_vector
from hmt_ros.sessions.camera_session import CAMERA_INFO
from hmt_ros.sessions.image_inputs import PREDICTION
from hmt_ros.sessions.track_reports import reversed_gravity
from hmt_ros.tracking import read_subject
from hmt_ros.tracking.ground import GroundEstimator, KnownGround
from hmt_ros.tracking.initialisation import start_from_keypoints
from hmt_ros.tracking.track_state import SAME_PERSON_CHAIN
from msg_tools import BagWriter, RosbagsMessages
from msg_tools.messages.camera_info import camera_info_message
from msg_tools.messages.detections import NO_KEYPOINTS
from msg_tools.messages.headers import FRAME_ID, SECOND_NS, START_NS
from msg_tools.messages.pose_mixtures import MixtureKind, PoseMixture, pose_mixture_message

LIFTED_FOLDER, REPORT_FOLDER = 'lifted', 'report'
# Minimum component of gravity along the optical axis at which gravity is checked with poses lifted
# without it.
MIN_STEEP_COMPONENT = 0.8
# Minimum leap, as the ratio of a distance to the local median; half width of the median's window,
# s; fraction of images with leaps above which the user is warned.
LEAP_RATIO, NEIGHBOUR_TIME, MAX_LEAP_FRACTION = 1.5, 1.0, 0.05
# Angle between trunk and vertical above which a person is lying, rad.
LYING_ANGLE = np.radians(55.0)
# Maximum ratio of frames to entries for which frames without an entry get an empty mixture.
_MAX_GAP_FRAMES = 1000

EPILOG = """\
KEYPOINTS has a layout of import-video: .json, .npz, .csv, .trc, or a folder.

DIR gets
  lifted/             a bag with pose_prediction: a mixture over poses for each image
  report/report.html  the page that report writes, for a browser

An image with fewer than five landmarks gets an empty mixture. --stature sets the height of the
person, and --subject the segment lengths too; without them the lengths of the body model are used.

examples:
  lift walk.json -o walk --fov 60 --size 1280x720 --fps 25
  lift mediapipe.npz -o walk --camera camera.yaml --size 640x480 --fps 30 --level --stature 1.75

exit code: 0 done, 1 bad input (one line on stderr explains it), 130 interrupted
"""


def main(argv: list[str] | None = None) -> int:
    """Runs the command; returns 0 on success, 1 for bad input (explained in one line on stderr)."""
    return run_command(_parser(), _lift, argv)


def _parser() -> CommandParser:
    parser = CommandParser(
        'lift', 'Estimates the poses of a person from the keypoints of a detector alone.', EPILOG
    )
    parser.add_argument('keypoints', type=Path, metavar='KEYPOINTS', help='file or folder')
    parser.add_output('DIR', 'result', 'folder for the bag and the report')
    add_camera_arguments(parser)
    parser.add_argument(
        '--size',
        type=image_size,
        metavar='WxH',
        help='width and height of the images, px; not needed if the file has them',
    )
    parser.add_argument(
        '--fps', type=number(0.01, 1000), default=30.0, help='images per second (default: 30)'
    )
    parser.add_argument(
        '--first-stamp',
        type=whole_number(1, 2**62),
        default=START_NS,
        metavar='NS',
        help=f'stamp of the first image, ns (default: {START_NS})',
    )
    parser.add_argument(
        '--first-number',
        type=whole_number(0),
        default=0,
        metavar='N',
        help='number of the first image (default: 0)',
    )
    add_keypoint_arguments(parser)
    person = parser.add_mutually_exclusive_group()
    person.add_argument(
        '--stature', type=number(0.3, 3), help='stature of the person, m (default: not known)'
    )
    person.add_argument(
        '--subject',
        type=Path,
        metavar='FILE',
        help='subject file with joints and lengths of the person, see replay',
    )
    parser.add_gravity()
    parser.add_argument(
        '--causal', action='store_true', help='use past images only, as with a live camera'
    )
    parser.add_argument(
        '--lifter',
        default=SHIPPED,
        metavar='MODEL',
        help='file that "learn lifter" wrote (default: the shipped one)',
    )
    return parser


def _lift(arguments: argparse.Namespace) -> int:
    folder, quiet = arguments.output, arguments.quiet
    taken = [x for x in (LIFTED_FOLDER, REPORT_FOLDER) if (folder / x).exists()]
    if taken and not arguments.overwrite:
        raise ValueError(f'{folder / taken[0]} exists; give another name, or --overwrite')
    lifter = load_lifter(arguments.lifter)
    source = FrameSource(arguments.keypoints, (), arguments.first_number)
    found = read_keypoints(arguments.keypoints, source, arguments.first_stamp)
    size = arguments.size or found.size
    if size is None:
        raise ValueError('the size of the images is unknown: --size WxH')
    notify = partial(notify_user, 'lift')
    camera = camera_of(arguments, size, notify)
    reading = ClipReading(
        arguments.person, arguments.scheme, arguments.keypoints_size, arguments.mirror
    )
    chosen = keypoints_of_person(found, reading, size, notify, rate=arguments.fps)
    times, seen = _in_frames(found, chosen, arguments.fps)
    stamps = [arguments.first_stamp + time for time in times]
    nobody = not any(len(one.names) for one in seen)
    if nobody and (not seen or any(found.persons())):
        raise ValueError(f'{arguments.keypoints}: no keypoints of the chosen person; see --person')
    body = _body(camera, arguments)
    up = _up(seen, body, arguments)
    ups = None if up is None else np.tile(up, (len(stamps), 1))

    def lifted(ups: Array | None) -> list[GaussianMixture | None]:
        return lift_poses(
            lifter,
            body,
            camera,
            1e-9 * np.array(times, dtype=np.float64),
            seen,
            ups,
            lengths_known=arguments.subject is not None,
            causal=arguments.causal,
            scheme=arguments.scheme,
        )

    with show_progress('lifting', quiet=quiet):
        mixtures = lifted(ups)
    if all(one is None for one in mixtures) and not nobody:
        raise ValueError(
            f'{arguments.keypoints}: no image shows five known landmarks; see --scheme'
        )
    mixtures = _with_leaps(mixtures, stamps)
    if up is not None and not nobody:
        checked = mixtures if abs(up[2]) < MIN_STEEP_COMPONENT else lifted(None)
        _check_gravity(up, body, [one for one in checked if one is not None])
    folder.mkdir(parents=True, exist_ok=True)
    messages = RosbagsMessages()
    with BagWriter(folder / LIFTED_FOLDER, overwrite=arguments.overwrite) as bag:
        track, met = 1, stamps[0]
        for stamp, mixture in zip(stamps, mixtures, strict=True):
            track += bool(SAME_PERSON_CHAIN.closed(1.0, seconds(stamp - met)) < 0.5)
            met = met if mixture is None else stamp
            info = camera_info_message(messages, camera, stamp, FRAME_ID)
            bag.write(CAMERA_INFO, stamp, info)
            content = PoseMixture.of_body(
                body, mixture, MixtureKind.PREDICTION, stamp, FRAME_ID, track_id=track
            )
            bag.write(PREDICTION, stamp, pose_mixture_message(messages, content))
    options = ReportOptions(
        folder / LIFTED_FOLDER,
        folder / REPORT_FOLDER,
        overwrite=arguments.overwrite,
        quiet=quiet,
        topics=(PREDICTION,),
    )
    _, written = write_report(options)
    if not quiet:
        posed = sum(one is not None for one in mixtures)
        say(f'{folder / LIFTED_FOLDER}: {len(mixtures)} images, {posed} with a pose\n{written}')
    return 0


def _in_frames(
    found: FoundPersons, chosen: dict[int, Keypoints], fps: float
) -> tuple[list[int], list[Keypoints]]:
    """Times, ns, and keypoints of the chosen person; `NO_KEYPOINTS` if the person is missing."""
    sparse = found.timed or found.last > _MAX_GAP_FRAMES * len(found.frames)
    keys = found.keys if sparse else list(range(found.last + 1))
    times = keys if found.timed else [round(key * SECOND_NS / fps) for key in keys]
    return times, [chosen.get(key, NO_KEYPOINTS) for key in keys]


def _up(seen: Sequence[Keypoints], body: Body, arguments: argparse.Namespace) -> Array | None:
    """Unit vector (3,) opposite to the given gravity, camera frame; None if gravity is not given.

    A gravity that points to the head of the person is taken as the reading of an accelerometer: its
    sign is reversed, and the user is notified.
    """
    gravity = gravity_of(arguments)
    if gravity is None:
        return None
    ground = GroundEstimator(KnownGround(-unit_vector(gravity, '--gravity')))
    for one in seen:
        ground.update_sign_by_keypoints(one.named_for(body, arguments.scheme)[0])
    if ground.reversed:
        notify_user('lift', reversed_gravity(ground.estimate.up))
    return ground.estimate.up


def _with_leaps(
    mixtures: Sequence[GaussianMixture | None], stamps: Sequence[int]
) -> list[GaussianMixture | None]:
    """Widens mixtures along the line of sight where the estimated distance of the person leaps.

    If little of the person is in view, the estimated distance can change faster than a person can
    walk. The user is warned if many images have such leaps.
    """
    posed = [i for i, one in enumerate(mixtures) if one is not None]
    places = np.array([one.means[0, :3] for one in mixtures if one is not None]).reshape(-1, 3)
    distances = np.linalg.norm(places, axis=1)
    times = 1e-9 * np.array([stamps[i] for i in posed])
    result, most, leaps = list(mixtures), 1.0, 0
    for i, time, distance in zip(posed, times, distances, strict=True):
        usual = float(np.median(distances[np.abs(times - time) <= NEIGHBOUR_TIME]))
        ratio = max(distance / usual, usual / distance)
        if ratio < LEAP_RATIO:
            continue
        most, leaps = max(most, ratio), leaps + 1
        one = mixtures[i]
        assert one is not None
        covariances = one.covariances.copy()
        along = (usual / distance - 1.0) * one.means[:, :3]
        covariances[:, :3, :3] += along[:, :, None] * along[:, None]
        result[i] = GaussianMixture(one.weights, one.means, covariances)
    if leaps > MAX_LEAP_FRACTION * len(posed):
        notify_user(
            'lift',
            f'the distance jumps in {leaps} of {len(posed)} images, up to {most:.1f} times: too '
            'little of the person is seen for keypoints alone; use the images too '
            '(track-video), or give lengths (--subject) and --gravity',
        )
    return result


def _check_gravity(up: Array, body: Body, mixtures: Sequence[GaussianMixture]) -> None:
    """Warns the user if, with the given vertical (3,), the person is lying in most poses."""
    joints = body.joint_positions(np.array([one.means[0] for one in mixtures]))
    neck, pelvis = body.skeleton.joint_index(('neck', 'pelvis'))
    trunk = joints[:, neck] - joints[:, pelvis]
    lean = float(np.median(np.arccos(trunk @ up / np.linalg.norm(trunk, axis=1))))
    if lean > LYING_ANGLE:
        notify_user(
            'lift',
            f'the person leans by {np.degrees(lean):.0f} degrees against the given gravity: the '
            'person lies, or --gravity is not in the optical frame (x right, y down, z forward)',
        )


def _body(camera: Camera, arguments: argparse.Namespace) -> Body:
    """The body with the segment lengths of the person, if they are known."""
    body = load_body('human37')
    if arguments.subject is not None:
        subject = read_subject(arguments.subject, body)
        return start_from_keypoints(body, camera, subject).body
    return body if arguments.stature is None else body.with_stature(arguments.stature)
