"""import-video: writes a video, its camera and the output of a detector into a bag for replay.

The bag has the topics `/image/compressed` and `/camera_info`, and also `/keypoints`,
`/keypoints_3d` and `/mask` if known, or `/detections` for several people. Each message has the
stamp of its frame.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Generator, Iterable
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from hmt_ros.app.command_line import (
    CommandParser,
    image_size,
    number,
    run_command,
    whole_number,
)
from hmt_ros.app.import_video.frames import Frame, FrameSource, Masks, Selection, open_source
from hmt_ros.app.import_video.keypoint_files.choice import BY_DISTANCE, BY_SIZE, Choice
from hmt_ros.app.import_video.keypoint_files.persons import FoundPersons
from hmt_ros.app.import_video.keypoint_files.reading import (
    ClipReading,
    keypoints_of_person,
    read_keypoints,
)
from hmt_ros.app.progress import Notify, notify_user, say, with_progress
from hmt_ros.body import Camera
from hmt_ros.detectors.detector import Detector
from hmt_ros.detectors.people import PeopleDetector, SeenPerson
from hmt_ros.detectors.registry import DETECTORS, USUAL_DETECTOR
from hmt_ros.image.keypoint_schemes import AUTO
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference.arrays import Array, Image, Mask
from hmt_ros.sessions.camera_file import camera_of_view, read_camera
from hmt_ros.sessions.keypoints_session import MAX_PEOPLE, detected_people
from msg_tools import BagWriter, RosbagsMessages
from msg_tools.messages.camera_info import camera_info_message
from msg_tools.messages.detections import NO_KEYPOINTS, people_message
from msg_tools.messages.headers import FRAME_ID, START_NS
from msg_tools.messages.images import encode_jpeg, image_message, jpeg_message
from msg_tools.messages.keypoints import keypoints_message, positions_message

IMAGE, CAMERA_INFO, MASK = 'image/compressed', 'camera_info', 'mask'
KEYPOINTS, KEYPOINTS_3D, DETECTIONS = 'keypoints', 'keypoints_3d', 'detections'

EPILOG = """\
SOURCE is any video file that OpenCV reads, or a folder of images in the order of the numbers in
their names. JPEG images are copied unchanged. Stamps are --first-stamp plus the times in the
video file. Frames of a phone are turned upright as the metadata of the file say.

--keypoints takes these layouts, with the detector's names and in pixels of the upright frames:
  FILE.json  COCO results [{image_id, keypoints, score}] or annotations, MMPose, AlphaPose, a list
             of what Ultralytics' to_json gives for each frame
  FOLDER     a file for each frame: JSON of OpenPose, MMPose or Ultralytics, such as
             walk_000000000012_keypoints.json, or labels (.txt) of Ultralytics (save_txt)
  FILE.npz   pixels (T, n, 2), optionally landmark_names (n,), visibility (T, n), detected (T,) and
             world (T, n, 3), the positions in m; row t is frame t
  FILE.csv   a row for each person: frame, NAME_u, NAME_v, NAME_confidence, ...; or for each
             keypoint: frame, name, u, v, confidence; time_s, in the video or of Unix, or stamp_ns
             may replace frame, and a column person keeps several persons apart; or DeepLabCut
  FILE.trc   markers in pixels, as Sports2D writes them
An image_id, or the name of a keypoint or mask file, is the name of the frame's file, or its last
number is the number of the frame, counted from --first-number. A point with confidence 0, or at
(0, 0) or NaN, was not seen. Points without names have the order of --scheme or, without it, the
order of as many points that gives human bone lengths: see docs/video.md.

examples:
  import-video walk.mp4 -o walk --fov 60 --keypoints walk.json
  import-video frames -o walk --fps 25 --camera camera.yaml --keypoints openpose --masks masks
  import-video walk.mp4 -o walk --fov 60 --detector mediapipe --start 2 --end 10 --every 2
  import-video street.mp4 -o street --fov 60 --people 3

exit code: 0 done, 1 bad input (one line on stderr explains it), 130 interrupted
"""


@dataclass
class Imported:
    """Counts of the images and keypoints that were written.

    Attributes:
        with_keypoints: number of images with keypoints; None if no keypoints were given.
        with_masks: number of images with a mask; None if no masks were given.
    """

    images: int = 0
    with_keypoints: int | None = None
    with_masks: int | None = None

    def __str__(self) -> str:
        counts = (('keypoints', self.with_keypoints), ('masks', self.with_masks))
        text = ', '.join(f'{n} with {what}' for what, n in counts if n is not None)
        return f'{self.images} images{", " if text else ""}{text}'


def main(argv: list[str] | None = None) -> int:
    """Runs the command; returns 0 on success, 1 for bad input (explained in one line on stderr)."""
    return run_command(_parser(), _import, argv, whole_or_nothing=True)


def _parser() -> CommandParser:
    parser = CommandParser(
        'import-video',
        'Writes a video, its camera and the keypoints of a 2D detector into a bag for replay.',
        EPILOG,
    )
    add_video_arguments(parser)
    parser.add_output('BAG', 'bag', 'folder of the new bag')
    return parser


def add_camera_arguments(parser: CommandParser, *, required: bool = True) -> None:
    """Adds the arguments that describe the camera, for `camera_of`."""
    camera = parser.add_argument_group('camera, one of these')
    camera = camera.add_mutually_exclusive_group(required=required)
    angle = number(1, 150, what='an angle', unit=' degrees')
    camera.add_argument(
        '--fov',
        type=angle,
        metavar='DEGREES',
        help='horizontal field of view, from the left border of the upright image to the right',
    )
    camera.add_argument(
        '--vertical-fov',
        type=angle,
        metavar='DEGREES',
        help='vertical field of view, from top to bottom',
    )
    camera.add_argument(
        '--camera',
        type=Path,
        metavar='FILE',
        help='calibration file of OpenCV (YAML, XML, JSON), ROS (YAML), kalibr (camchain YAML), '
        'anipose, Pose2Sim or caliscope (TOML); FILE:NAME is camera NAME of several',
    )


def add_video_arguments(parser: CommandParser, *, camera_required: bool = True) -> None:
    """Adds the arguments that select the input."""
    parser.add_argument(
        'source', type=Path, metavar='SOURCE', help='video file, or folder of images'
    )
    add_camera_arguments(parser, required=camera_required)
    frames = parser.add_argument_group('frames')
    frames.add_argument(
        '--fps',
        type=number(0.01, 1000),
        help='images per second of a folder; replaces the times in a video file',
    )
    seconds = number(0, 1e6, what='a time', unit=' s')
    frames.add_argument(
        '--start', type=seconds, default=0.0, help='time of the first frame to import, s'
    )
    frames.add_argument(
        '--end', type=seconds, default=math.inf, help='time at which the import ends, s'
    )
    frames.add_argument(
        '--every', type=whole_number(1), default=1, metavar='N', help='import every N-th frame'
    )
    frames.add_argument(
        '--first-stamp',
        type=whole_number(1, 2**62),
        default=START_NS,
        metavar='NS',
        help=f'stamp of the first frame of SOURCE, ns (default: {START_NS})',
    )
    frames.add_argument(
        '--jpeg-quality',
        type=whole_number(1, 100),
        default=90,
        metavar='Q',
        help='JPEG quality of images that are not JPEG files, 1 to 100 (default: 90)',
    )
    person = parser.add_argument_group('the person')
    found = person.add_mutually_exclusive_group()
    found.add_argument(
        '--keypoints', type=Path, metavar='PATH', help='keypoints from a detector, see below'
    )
    found.add_argument(
        '--detector',
        choices=tuple(DETECTORS),
        help='find keypoints with an installed detector, such as MediaPipe Pose',
    )
    found.add_argument(
        '--people',
        type=whole_number(1, MAX_PEOPLE),
        metavar='N',
        help=f'follow up to N people with {DETECTORS[USUAL_DETECTOR].title}, for replay --people',
    )
    add_keypoint_arguments(person)
    person.add_argument(
        '--masks',
        type=Path,
        metavar='PATH',
        help='masks of the person, bright on black: a folder of images, or a video',
    )
    person.add_argument(
        '--detector-masks', action='store_true', help='also take the masks of --detector'
    )
    person.add_argument(
        '--first-number',
        type=whole_number(0),
        default=0,
        metavar='N',
        help='number of the first frame for keypoints and masks (default: 0)',
    )


def add_keypoint_arguments(parser: argparse._ActionsContainer) -> None:
    """Adds the arguments that select how keypoints are read."""
    parser.add_argument(
        '--person',
        type=person_choice,
        default=Choice(),
        metavar='WHICH',
        help='person to import if there are several: largest in each frame; nearest to the '
        'previous one, starting with the largest; at:X,Y or at:X,Y,T, the person at this '
        'position, px, at this time, s; track:N, the N-th longest track, from 1; id:NAME, '
        'an identity of the detector; or index:N, the N-th in the list of each frame, from '
        '0 (default: nearest)',
    )
    parser.add_argument(
        '--keypoints-size',
        type=image_size,
        metavar='WxH',
        help='size of the images in which the keypoints were found (default: the size in their '
        'file, or the size of the frames)',
    )
    parser.add_argument(
        '--scheme',
        default=AUTO,
        help='names or order of the keypoints, see docs/keypoints.md (auto)',
    )
    parser.add_argument(
        '--mirror',
        action='store_true',
        help='undo the mirroring of a selfie camera, in frames, keypoints, masks and sides',
    )


def person_choice(text: str) -> Choice:
    """Reads --person."""
    try:
        return Choice.parse(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def _import(arguments: argparse.Namespace) -> int:
    notify = partial(notify_user, 'import-video')
    imported = import_video(arguments, notify)
    if not arguments.quiet:
        say(f'{arguments.output}: {imported}')
    return 0


def import_video(options: argparse.Namespace, notify: Notify) -> Imported:
    """Writes a video into a new bag, completely or not at all.

    Args:
        options: arguments of the command.

    Raises:
        ValueError: bad input.
    """
    if options.detector_masks and (options.detector is None or options.masks is not None):
        raise ValueError('--detector-masks goes with --detector, and not with --masks')
    if options.detector is not None and options.person != Choice():
        raise ValueError(
            f'{DETECTORS[options.detector].title} finds one person: --person goes with --keypoints'
        )
    selection = Selection(options.start, options.end, options.every)
    source = open_source(options.source, options.fps, options.first_number)
    for note in source.notes:
        notify(note)
    masks = None if options.masks is None else Masks(options.masks, source)
    found = None
    if options.keypoints is not None:
        found = read_keypoints(options.keypoints, source, options.first_stamp)
    with ExitStack() as opened:
        see = _seer(options, source, found, masks, notify)
        writer = opened.enter_context(BagWriter(options.output, overwrite=options.overwrite))
        frames = opened.enter_context(closing(_same_size(source, selection, options.mirror)))
        counted = with_progress(
            frames, str(options.output), 'images', _expected(source, selection), quiet=options.quiet
        )
        shown = opened.enter_context(closing(counted))
        lifts = options.detector is not None or (found is not None and found.lifts)
        result = _write(writer, options, shown, see, lifts, notify)
        if not result.images:
            raise ValueError(
                f'{options.source}: no frame was read'
                + (f' of {source.count}; see --start and --end' if source.count else '')
            )
        _check_ends(options, source, found, masks, notify)
        if found is not None:
            _check_keypoints(options, result, found, notify)
        if masks is not None and not result.with_masks:
            raise ValueError(
                f'{options.masks}: no mask belongs to one of the {result.images} imported frames; '
                'see --first-number'
            )
    return result


def _expected(source: FrameSource, selection: Selection) -> int | None:
    """Number of frames to import; None if unknown before reading."""
    if not source.claimed or selection.start > 0 or math.isfinite(selection.end):
        return None
    return -(-source.claimed // selection.every)


Seer = Callable[[Frame, int], tuple[Keypoints | None, Mask | None]]


def _seer(
    options: argparse.Namespace,
    source: FrameSource,
    found: FoundPersons | None,
    masks: Masks | None,
    notify: Notify,
) -> Seer:
    """Returns a function that maps a frame and its stamp to keypoints and mask."""
    chosen: dict[int, Keypoints] | None = None
    reading = ClipReading(options.person, options.scheme, options.keypoints_size, options.mirror)
    detector = None
    if options.detector is not None:
        detector = DETECTORS[options.detector].make(with_mask=options.detector_masks)

    def see(frame: Frame, stamp_ns: int) -> tuple[Keypoints | None, Mask | None]:
        nonlocal chosen
        mask = None if masks is None else masks.of(frame)
        if mask is not None and options.mirror:
            mask = np.ascontiguousarray(mask[:, ::-1])
        if detector is not None:
            keypoints = _detected(detector, frame, stamp_ns)
            if options.detector_masks and detector.mask is not None:
                mask = _in_pixels_of(frame, detector.mask)
            return keypoints, mask
        if found is None:
            return None, mask
        if chosen is None:
            height, width = frame.image.shape[:2]
            first = frame.time_ns if found.timed else frame.number
            chosen = keypoints_of_person(
                found, reading, (width, height), notify, first, source.rate
            )
        key = found.key_of(frame)
        return None if key is None else chosen.get(key), mask

    return see


def _detected(detector: Detector, frame: Frame, stamp_ns: int) -> Keypoints | None:
    """Keypoints detected in a frame; the detector gets a copy with square pixels."""
    found = detector.detect(_with_square_pixels(frame), stamp_ns)
    return None if found is None else _in_frame(frame, found)


def _people_in(detector: PeopleDetector, frame: Frame, stamp_ns: int) -> list[SeenPerson]:
    """People detected in a frame; the detector gets a copy with square pixels."""
    return [
        one._replace(keypoints=_in_frame(frame, one.keypoints), corners=one.corners * _scale(frame))
        for one in detector.detect(_with_square_pixels(frame), stamp_ns)
    ]


def _scale(frame: Frame) -> Array:
    """Factors (2,) from coordinates in the copy with square pixels to pixels of the frame."""
    width = frame.image.shape[1]
    return np.array([width / round(width * frame.aspect), 1.0])


def _with_square_pixels(frame: Frame) -> Image:
    if frame.aspect == 1.0:
        return frame.image
    height, width = frame.image.shape[:2]
    size = round(width * frame.aspect), height
    return np.asarray(cv2.resize(frame.image, size, interpolation=cv2.INTER_AREA), np.uint8)


def _in_frame(frame: Frame, found: Keypoints) -> Keypoints:
    """Converts keypoints from the image with square pixels to pixels of the frame."""
    if frame.aspect == 1.0:
        return found
    scale = _scale(frame)
    covariances = found.covariances * np.outer(scale, scale)
    return replace(found, pixels=(found.pixels + 0.5) * scale - 0.5, covariances=covariances)


def _in_pixels_of(frame: Frame, mask: Mask) -> Mask:
    height, width = frame.image.shape[:2]
    resized = cv2.resize(mask.view(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
    return np.asarray(resized).view(np.bool_)


def _same_size(
    source: FrameSource, selection: Selection, mirror: bool
) -> Generator[Frame, None, None]:
    """Yields the frames, mirrored on request; raises ValueError if their sizes differ."""
    size: tuple[int, ...] | None = None
    for frame in source.frames(selection):
        if size is not None and frame.image.shape != size:
            (height, width), (rows, columns) = frame.image.shape[:2], size[:2]
            raise ValueError(
                f'{source.path}: {frame.name or f"frame {frame.number}"} has {width}x{height} '
                f'pixels, the frames before it {columns}x{rows}; wanted one size'
            )
        size = frame.image.shape
        if mirror:
            frame = replace(frame, image=np.ascontiguousarray(frame.image[:, ::-1]), jpeg=None)
        yield frame


def camera_of(
    options: argparse.Namespace,
    size: tuple[int, int],
    notify: Notify,
    aspect: float = 1.0,
) -> Camera:
    """Camera from the command line options, for images of the given size."""
    if options.camera is not None:
        return read_camera(options.camera, size, notify)
    return camera_of_view(size, options.fov, options.vertical_fov, aspect)


def _write(
    bag: BagWriter,
    options: argparse.Namespace,
    frames: Iterable[Frame],
    see: Seer,
    lifts: bool,
    notify: Notify,
) -> Imported:
    """Writes the frames one by one; only one frame is in memory at a time.

    If `lifts` is true, every image gets a message with 3D positions, possibly empty.
    """
    messages = RosbagsMessages()
    result, camera = Imported(), None
    people = None if options.people is None else PeopleDetector(options.people)
    alone = options.keypoints is not None or options.detector is not None
    if alone or people is not None:
        result.with_keypoints = 0
    if options.masks is not None or options.detector_masks:
        result.with_masks = 0
    for frame in frames:
        height, width = frame.image.shape[:2]
        camera = camera or camera_of(options, (width, height), notify, frame.aspect)
        stamp = options.first_stamp + frame.time_ns
        jpeg = frame.jpeg or encode_jpeg(frame.image, options.jpeg_quality)
        bag.write(IMAGE, stamp, jpeg_message(messages, jpeg, stamp, FRAME_ID))
        bag.write(CAMERA_INFO, stamp, camera_info_message(messages, camera, stamp, FRAME_ID))
        keypoints, mask = see(frame, stamp)
        if people is not None and result.with_keypoints is not None:
            seen = detected_people(_people_in(people, frame, stamp))
            result.with_keypoints += bool(seen)
            bag.write(DETECTIONS, stamp, people_message(messages, seen, stamp, FRAME_ID))
        elif result.with_keypoints is not None:
            result.with_keypoints += keypoints is not None
            content = keypoints or NO_KEYPOINTS
            message = keypoints_message(messages, content, stamp, FRAME_ID)
            bag.write(KEYPOINTS, stamp, message)
            if lifts:
                lifted = positions_message(messages, content, stamp, FRAME_ID)
                bag.write(KEYPOINTS_3D, stamp, lifted)
        if mask is not None and result.with_masks is not None:
            result.with_masks += 1
            picture = mask.astype(np.uint8) * 255
            bag.write(MASK, stamp, image_message(messages, picture, stamp, FRAME_ID))
        result.images += 1
    return result


def _check_ends(
    options: argparse.Namespace,
    source: FrameSource,
    found: FoundPersons | None,
    masks: Masks | None,
    notify: Notify,
) -> None:
    """Checks that the numbers of frames, keypoints and masks agree, if all frames were read.

    Keypoints and masks are accepted for frames that are missing because the video is truncated.
    """
    if not source.ended:
        return
    count, claimed = source.count, source.claimed
    if claimed > count:
        notify(
            f'{source.path}: {count} of the {claimed} frames that its header announces can be '
            'read; keypoints and masks of later frames may belong to other frames'
        )
    of_masks = -1 if masks is None else masks.last
    of_keypoints = -1 if found is None else found.last
    if found is not None and found.rows not in (None, count, claimed):
        raise ValueError(
            f'{options.keypoints} has {found.rows} rows, but {source.path} has {count} frames; '
            'wanted one row for each frame'
        )
    for path, last in ((options.keypoints, of_keypoints), (options.masks, of_masks)):
        if last >= max(count, claimed):
            first = options.first_number
            raise ValueError(
                f'{path} has frame {last + first}, but {source.path} has {count} frames, {first} '
                f'to {count - 1 + first}; --first-number {first + 1} if it counts from '
                f'{first + 1}'
            )


def _check_keypoints(
    options: argparse.Namespace, result: Imported, found: FoundPersons, notify: Notify
) -> None:
    """Checks that imported images have keypoints; raises ValueError or notifies the user."""
    if not result.with_keypoints and any(found.persons()):
        text = (
            f'{options.keypoints}: none of the {result.images} imported frames has keypoints of '
            'the chosen person; see --person and --first-number'
        )
        if options.person.kind not in (BY_SIZE, BY_DISTANCE):
            raise ValueError(text)
        notify(text)
