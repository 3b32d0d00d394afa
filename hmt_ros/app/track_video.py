"""track-video: from a video to a report: import-video, replay and report in one command.

track-video walk.mp4 -o walk --fov 60 --keypoints walk.json
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

from hmt_ros.app.command_line import CommandParser, gravity_of, number, run_command
from hmt_ros.app.import_video.command import ImportOptions, add_video_arguments, import_video
from hmt_ros.app.progress import tell_user
from hmt_ros.app.replay.one_bag import replay_bag
from hmt_ros.app.replay.options import ReplayOptions
from hmt_ros.app.report.command import ReportOptions, write_report
from hmt_ros.app.subject import find_start, subject_text
from hmt_ros.body import load_body

VIDEO, SUBJECT, TRACKED, REPORT = 'video', 'subject.yaml', 'tracked', 'report'

EPILOG = """\
DIR gets
  video/              the bag that import-video writes, see import-video --help
  subject.yaml        the start of the track, with --stature only, see subject --help
  tracked/            the bag that replay writes, see replay --help
  report/report.html  the page that report writes, for a browser

An unknown tilt of the camera is taken for a lean of the person: tell --level where the camera looks
to the horizon and stands upright, or --gravity.

The track starts from the keypoints that were imported, or without any from a prediction. --subject
names a subject file instead, and --stature writes one from the keypoints of an image.

examples:
  track-video walk.mp4 -o walk --fov 60 --keypoints walk.json
  track-video walk.mp4 -o walk --fov 60 --detector mediapipe --stature 1.75 --level

exit code: 0 done, 1 bad input (one line on stderr explains it), 130 interrupted
"""


def main(argv: list[str] | None = None) -> int:
    """Runs the command; 0: the report is there, 1: bad input, which one line on stderr explains."""
    return run_command(_parser(), _track, argv)


def _parser() -> CommandParser:
    parser = CommandParser(
        'track-video', 'Imports a video, tracks the person in it, and writes a report.', EPILOG
    )
    add_video_arguments(parser)
    parser.add_output('DIR', 'result', 'folder for the bags and the report')
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
        '--set', action='append', default=[], dest='settings', metavar='NAME=VALUE',
        help='one parameter of the tracker, see replay; may be repeated',
    )  # fmt: skip
    return parser


def _track(arguments: argparse.Namespace) -> int:
    folder, quiet = arguments.output, arguments.quiet
    tell = partial(tell_user, 'track-video')
    overwrite, stature = arguments.overwrite, arguments.stature

    def say(text: object) -> None:
        if not quiet:
            print(text, flush=True)

    with_keypoints = arguments.keypoints is not None or arguments.detector is not None
    if stature is not None and not with_keypoints:
        raise ValueError('--stature goes with --keypoints or --detector')
    for given in (arguments.subject, arguments.background):
        if given is not None and not given.is_file():
            raise ValueError(f'{given}: no such file')
    taken = [x for x in (VIDEO, SUBJECT, TRACKED, REPORT) if (folder / x).exists()]
    if taken and not overwrite:
        raise ValueError(f'{folder / taken[0]} exists; give another name, or --overwrite')

    video, start = folder / VIDEO, folder / SUBJECT
    imported = import_video(ImportOptions.of(arguments, video), tell)
    say(f'{video}: {imported}')
    subject = arguments.subject
    if stature is not None:
        try:
            seen = find_start(video, load_body('human37'))
        except ValueError as error:
            tell(f'{error}: --stature is not used')
        else:
            subject = start
            start.write_text(subject_text(seen, stature=stature), encoding='utf-8')
            say(f'{start}: {len(seen.joints.names)} joints at {seen.stamp_ns} ns')
    options = ReplayOptions(
        overwrite=overwrite, quiet=quiet, subject=subject,
        background=arguments.background, seed=arguments.seed,
        settings=[*_of_gravity(arguments), *arguments.settings],
    )  # fmt: skip
    replayed = replay_bag(video, folder / TRACKED, options, tell)
    say(f'{folder / TRACKED}: {replayed}')
    _, written = write_report(
        ReportOptions(
            folder / TRACKED, folder / REPORT, overwrite=overwrite, quiet=quiet, images=video
        )
    )
    say(written)
    return 0


def _of_gravity(arguments: argparse.Namespace) -> list[str]:
    """The setting of the tracker that tells how the camera is tilted, if it is known."""
    gravity = gravity_of(arguments)
    return [] if gravity is None else [f'gravity={gravity}']
