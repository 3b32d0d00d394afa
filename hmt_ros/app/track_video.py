"""track-video: runs import-video, replay and report in one command.

track-video walk.mp4
track-video street.mp4 --people 3

Missing arguments get defaults: an installed detector finds the keypoints; the field of view is from
the metadata of the video, or else typical of cameras; gravity is estimated from lines in the scene;
a folder of images gets a usual frame rate. The uncertainty of the field of view is included in all
depths.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

from hmt_ros.app.command_line import CommandParser, gravity_of, number, run_command
from hmt_ros.app.first_subject import find_start, subject_text
from hmt_ros.app.import_video.command import (
    add_video_arguments,
    import_video,
)
from hmt_ros.app.import_video.frames import Selection, open_source
from hmt_ros.app.import_video.lens import METADATA_FOV_SIGMA, metadata_fov
from hmt_ros.app.progress import notify_user, say
from hmt_ros.app.replay.one_bag import replay_bag
from hmt_ros.app.replay.options import ReplayOptions
from hmt_ros.app.report.command import ReportOptions, write_report
from hmt_ros.body import load_body
from hmt_ros.detectors.registry import surest_detector
from hmt_ros.sessions.focal_length import USUAL_FOV, USUAL_SIGMA
from msg_tools.files.new_folder import new_file

VIDEO, SUBJECT, TRACKED, REPORT = 'video', 'subject.yaml', 'tracked', 'report'
# Assumed rate of a folder of images, images per second.
USUAL_RATE = 30.0

EPILOG = """\
DIR gets
  video/              the bag that import-video writes, see import-video --help
  subject.yaml        the start of the track, with --stature only, see replay --help
  tracked/            the bag that replay writes, see replay --help
  report/report.html  the page that report writes, for a browser

Without --keypoints the best installed detector finds them (see install-detector): MediaPipe Pose,
with MoveNet if installed. Without --fov or --camera the field of view is taken from the metadata of
the video, or assumed; its uncertainty is included in all published depths. Without --level or
--gravity the tilt of the camera is estimated from straight lines in the scene where possible; an
unknown tilt appears as a lean of the person. With --people MediaPipe Pose finds up to N people, and
the page shows each on a separate topic.

The track starts from the keypoints, or without any from a prediction. --subject names a subject
file instead, and --stature writes one from the keypoints of an image.

examples:
  track-video walk.mp4
  track-video walk.mp4 -o walk --fov 60 --keypoints walk.json
  track-video walk.mp4 -o walk --camera camera.yaml --stature 1.75 --level
  track-video street.mp4 --people 3

exit code: 0 done, 1 bad input (one line on stderr explains it), 130 interrupted
"""


def main(argv: list[str] | None = None) -> int:
    """Runs the command; returns 0 on success, 1 for bad input (explained in one line on stderr)."""
    return run_command(_parser(), _track, argv)


def _parser() -> CommandParser:
    parser = CommandParser(
        'track-video', 'Imports a video, tracks the person in it, and writes a report.', EPILOG
    )
    add_video_arguments(parser, camera_required=False)
    parser.add_argument(
        '--no-detector', action='store_true', help='do not run a detector if --keypoints is missing'
    )
    what = 'folder for the bags and the report (default: the name of SOURCE and _tracked)'
    parser.add_output('DIR', 'result', what, required=False)
    start = parser.add_mutually_exclusive_group()
    start.add_argument(
        '--subject', type=Path, metavar='FILE', help='subject file to start from, see replay'
    )
    start.add_argument(
        '--stature', type=number(0.3, 3), help='stature of the person, m (default: not known)'
    )
    parser.add_argument(
        '--background', type=Path, metavar='FILE', help='image of the empty scene, see replay'
    )
    parser.add_gravity()
    parser.add_argument('--seed', type=int, metavar='N', help='seed of all random numbers')
    parser.add_argument(
        '--set',
        action='append',
        default=[],
        dest='settings',
        metavar='NAME=VALUE',
        help='one parameter of the tracker, see replay; may be repeated',
    )
    return parser


def _track(arguments: argparse.Namespace) -> int:
    folder, quiet = arguments.output, arguments.quiet
    folder = folder or Path(f'{arguments.source.absolute().stem}_tracked')
    notify = partial(notify_user, 'track-video')
    overwrite, stature = arguments.overwrite, arguments.stature

    def done(text: object) -> None:
        if not quiet:
            say(text)

    several = arguments.people is not None
    for option in ('subject', 'stature'):
        if several and getattr(arguments, option) is not None:
            raise ValueError(f'--{option} is for one person, and does not go with --people')
    given = several or arguments.keypoints is not None or arguments.detector is not None
    if not (given or arguments.no_detector):
        arguments.detector = surest_detector()
    with_keypoints = given or arguments.detector is not None
    if stature is not None and not with_keypoints:
        raise ValueError(
            '--stature goes with --keypoints, or with a detector: python -m hmt_ros '
            'install-detector'
        )
    for given in (arguments.subject, arguments.background):
        if given is not None and not given.is_file():
            raise ValueError(f'{given}: no such file')
    taken = [x for x in (VIDEO, SUBJECT, TRACKED, REPORT) if (folder / x).exists()]
    if taken and not overwrite:
        raise ValueError(f'{folder / taken[0]} exists; give another name, or --overwrite')

    settings, notes = _assumed(arguments)
    if not (with_keypoints or arguments.masks or arguments.subject or arguments.background):
        notes.append(
            'neither keypoints nor the empty scene are given: the person may not be found; run '
            '"python -m hmt_ros install-detector", or give --keypoints or --background'
        )
    for note in notes:
        notify(note)
    video, start = folder / VIDEO, folder / SUBJECT
    imported = import_video(argparse.Namespace(**{**vars(arguments), 'output': video}), notify)
    done(f'{video}: {imported}')
    subject = arguments.subject
    if stature is not None:
        try:
            seen = find_start(video, load_body('human37'))
        except ValueError as error:
            notify(f'{error}: --stature is not used')
        else:
            subject = start
            with new_file(start) as file:
                file.write(subject_text(seen, stature).encode())
            done(f'{start}: {len(seen.joints.names)} joints at {seen.stamp_ns} ns')
    options = ReplayOptions(
        overwrite=overwrite,
        quiet=quiet,
        subject=subject,
        background=arguments.background,
        seed=arguments.seed,
        people=several,
        settings=[*settings, *_of_gravity(arguments), *arguments.settings],
    )
    replayed = replay_bag(video, folder / TRACKED, options, notify)
    done(f'{folder / TRACKED}: {replayed}')
    _, written = write_report(
        ReportOptions(
            folder / TRACKED,
            folder / REPORT,
            overwrite=overwrite,
            quiet=quiet,
            images=video,
            notes=notes,
        )
    )
    done(written)
    return 0


def _assumed(arguments: argparse.Namespace) -> tuple[list[str], list[str]]:
    """Completes the arguments; returns tracker settings, and notes about the assumptions."""
    source, settings, notes = arguments.source, [], []
    if source.is_dir() and any(source.glob('*.mcap')):
        raise ValueError(f'{source} is a bag: replay {source} tracks the person in it')
    if source.is_dir() and arguments.fps is None:
        arguments.fps = USUAL_RATE
        notes.append(
            f'{source} is a folder: {USUAL_RATE:g} images per second are assumed; --fps sets '
            'another rate'
        )
    if (arguments.camera, arguments.fov, arguments.vertical_fov) == (None, None, None):
        first = next(iter(open_source(source, arguments.fps).frames(Selection())), None)
        told = None if source.is_dir() else metadata_fov(source)
        fov, sigma = (USUAL_FOV, USUAL_SIGMA) if told is None else (told, METADATA_FOV_SIGMA)
        height, width = (0, 1) if first is None else first.image.shape[:2]
        arguments.fov, arguments.vertical_fov = (fov, None) if width >= height else (None, fov)
        settings.append(f'focal_length_sigma={sigma}')
        notes.append(
            f'the field of view is {"assumed to be" if told is None else "by the metadata"} '
            f'{fov:.0f} degrees along the longer side; focal length and distances may err by '
            f'{sigma:.0%} (one standard deviation, included in the results): give --fov or '
            '--camera if known'
        )
    return settings, notes


def _of_gravity(arguments: argparse.Namespace) -> list[str]:
    """Tracker settings with the direction of gravity; empty if gravity is not given."""
    gravity = gravity_of(arguments)
    return [] if gravity is None else [f'gravity={gravity}']
