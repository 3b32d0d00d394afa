"""compile: compiles all kernels, so that the first image of a node or a command does not wait.

A short film is rendered and tracked in every way that has kernels of its own: images, depth images
and keypoints, smoother and experts. What is compiled is kept (see `hmt_ros.compiled_code`).
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from hmt_ros.app import make_bag
from hmt_ros.app.command_line import CommandParser, run_command
from hmt_ros.app.progress import show_progress
from hmt_ros.app.replay.one_bag import replay_bag
from hmt_ros.app.replay.options import ReplayOptions
from hmt_ros.body import Camera, load_body
from hmt_ros.body.camera import Viewpoint
from hmt_ros.compiled_code import compiled_functions, folder_in_use
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.motion.procedural_motion import procedural_motion
from hmt_ros.rendering.renderer import render_frames
from hmt_ros.rendering.scene import Scene
from hmt_ros.tracking import KnownGround, Tracker

IMAGES, RATE = 5, 10.0
VIEW = Viewpoint(distance=3.5)


def main(argv: list[str] | None = None) -> int:
    """Runs the command; 0: done, 1: bad input, which one line on stderr explains."""
    return run_command(_parser(), _compile, argv)


def _parser() -> CommandParser:
    parser = CommandParser('compile', 'Compiles all kernels, so that no first image waits for it.')
    parser.add_argument('--quiet', action='store_true', help='print only warnings and errors')
    return parser


def _compile(arguments: argparse.Namespace) -> int:
    compiled, start = compiled_functions(), time.monotonic()
    before = compiled.count
    with show_progress('kernels', quiet=arguments.quiet):
        _track_keypoints()
        _replay()
    if not arguments.quiet:
        count, spent = compiled.count - before, time.monotonic() - start
        print(f'{count} functions compiled in {spent:.0f} s, kept in {folder_in_use()}')
    return 0


def _track_keypoints() -> None:
    """Tracks by images and keypoints, from keypoints on, over a known floor."""
    body, camera = load_body('human37'), Camera(220.0, 220.0, 119.5, 89.5, 240, 180)
    ground = KnownGround(np.array([0.0, -1.0, 0.0]), VIEW.height)
    tracker = Tracker(body, camera, known_ground=ground)
    poses = procedural_motion('walk', body, IMAGES / RATE, RATE, 3, viewpoint=VIEW)[:IMAGES]
    for i, shown in enumerate(render_frames(body, poses, camera, Scene(viewpoint=VIEW))):
        pixels = camera.project(body.joint_positions(poses[i : i + 1]))[0]
        n = len(pixels)
        seen = Keypoints(body.joint_names, pixels, np.tile(np.eye(2), (n, 1, 1)), np.ones(n))
        tracker.step(shown.image, round(1e9 * (1.0 + i / RATE)), seen)


def _replay() -> None:
    """Replays a bag with images and depth images through filter, smoother and experts."""
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / 'bag'
        film = f'--duration {IMAGES / RATE} --fps {RATE} --distance {VIEW.distance} --size 240x180'
        made = make_bag.main(['walk', '-o', str(bag), *film.split(), '--depth', '--quiet'])
        if made != 0:
            raise ValueError('the film that is tracked to compile could not be rendered')
        options = ReplayOptions(
            quiet=True, bme='', subject=bag / 'subject.yaml', background=bag / 'background.png'
        )
        replay_bag(bag, Path(folder) / 'out', options, lambda text: None)


if __name__ == '__main__':
    sys.exit(main())
