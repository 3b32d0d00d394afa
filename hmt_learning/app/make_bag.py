"""make-bag: renders a motion, procedural or recorded, into a bag with ground truth.

`hmt_learning.app.rendered_bag` describes the files.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from hmt_learning.app.motions import add_body, add_seed
from hmt_learning.app.rendered_bag import (
    CROSSING,
    MEASURED,
    Take,
    crossing_takes,
    new_bag_folder,
    write_bag,
    write_people,
)
from hmt_learning.motion.limb_motions import sole
from hmt_learning.motion.motion_file import Motion, read_motion
from hmt_learning.motion.procedural_motion import PROCEDURAL_MOTIONS, procedural_motion
from hmt_learning.motion.retarget import body_from_motion, retarget
from hmt_learning.motion.viewpoint import Viewpoint
from hmt_learning.rendering.scene import Scene
from hmt_ros.app.command_line import (
    CommandParser,
    image_size,
    number,
    run_command,
    whole_number,
)
from hmt_ros.body import Body, Camera, load_body
from hmt_ros.inference.arrays import Array

DURATION, HEADING = 4.0, 30.0  # default duration, s; default heading of recorded motions, degrees


@dataclass(frozen=True)
class MotionOptions:
    """Arguments that select the motion; see the help of the command."""

    name: str
    mocap: Path | None
    body: str
    stature: float | None
    duration: float | None
    start: float
    fps: float
    heading: float | None
    seed: int


def main(argv: list[str] | None = None) -> int:
    """Runs the command; returns 0, or 1 after bad input, which one line on stderr explains."""
    return run_command(_parser(), _make_bag, argv)


def _parser() -> CommandParser:
    parser = CommandParser('make-bag', 'Renders a motion into a bag with ground truth.')
    parser.add_argument(
        'name',
        help=f'a procedural motion ({", ".join(PROCEDURAL_MOTIONS)}), {CROSSING} for two people '
        'who walk past each other, or any name with --mocap',
    )
    parser.add_output('DIR', 'bag', 'folder of the bag')
    add_seed(parser)

    motion = parser.add_argument_group('motion')
    motion.add_argument(
        '--mocap', type=Path, metavar='FILE', help='recorded motion (.bvh, or .amc beside its .asf)'
    )
    add_body(motion)
    motion.add_argument(
        '--stature',
        type=number(0.3, 3),
        help='stature of the person, m; not with --mocap (default: that of the body model)',
    )
    motion.add_argument(
        '--duration',
        type=number(0.001, 1e5),
        help=f'duration, s (default: {DURATION:g}, or all of --mocap)',
    )
    motion.add_argument(
        '--start',
        type=number(0, 1e6),
        default=0.0,
        help='time in --mocap at which the bag begins, s (default: 0)',
    )
    motion.add_argument(
        '--fps',
        type=number(0.01, 1000),
        default=30.0,
        help='images per second; with --mocap the nearest rate that every n-th frame gives '
        '(default: 30)',
    )
    motion.add_argument(
        '--heading',
        type=number(-3600, 3600),
        help='heading of the person at the beginning, degrees; 0: towards the camera, 90: to the '
        f'right of the image (default: chosen for the motion, {HEADING:g} with --mocap)',
    )

    camera = parser.add_argument_group('camera and scene')
    camera.add_argument(
        '--size',
        type=image_size,
        default=(640, 480),
        metavar='WxH',
        help='size of the images, px (default: 640x480)',
    )
    camera.add_argument(
        '--fov',
        type=number(1, 150),
        default=51.7,
        help='horizontal field of view, degrees (default: 51.7)',
    )
    camera.add_argument(
        '--distance',
        type=number(0.3, 1000),
        default=5.6,
        help='distance of the camera from the middle of the motion, m (default: 5.6)',
    )
    camera.add_argument(
        '--camera-height',
        type=number(0.01, 100),
        default=1.2,
        help='height of the camera above the floor, m (default: 1.2)',
    )
    camera.add_argument(
        '--pitch',
        type=number(-80, 80),
        default=0.0,
        help='angle by which the camera looks down, degrees (default: 0)',
    )
    camera.add_argument(
        '--noise',
        type=number(0, 100),
        default=2.5,
        help='standard deviation of the pixel noise, grey levels of 255 (default: 2.5)',
    )
    camera.add_argument(
        '--shadow',
        action=argparse.BooleanOptionalAction,
        default=True,
        help='draw the shadow of the person on the floor (default: yes)',
    )
    camera.add_argument(
        '--depth',
        action='store_true',
        help='add depth images with the noise and the holes of a sensor, registered to the images',
    )
    camera.add_argument(
        '--jpeg-quality',
        type=whole_number(1, 100),
        default=90,
        metavar='Q',
        help='JPEG quality, 1 to 100 (default: 90)',
    )
    return parser


def _make_bag(arguments: argparse.Namespace) -> int:
    options = MotionOptions(
        **{field.name: getattr(arguments, field.name) for field in fields(MotionOptions)}
    )
    viewpoint = Viewpoint(
        arguments.distance, arguments.camera_height, math.radians(arguments.pitch)
    )
    scene = Scene(
        viewpoint=viewpoint,
        seed=arguments.seed,
        noise=arguments.noise,
        shadow=Scene.shadow if arguments.shadow else 0.0,
    )
    camera = _camera(arguments.size, arguments.fov)
    given = {'quality': arguments.jpeg_quality, 'progress': not arguments.quiet}
    with new_bag_folder(arguments.output, overwrite=arguments.overwrite) as folder:
        if options.name == CROSSING and options.mocap is None:
            if arguments.depth:
                raise ValueError(f'--depth does not go with {CROSSING}, which has no depth images')
            write_people(folder, _crossing(options, viewpoint), camera, scene, **given)
        else:
            take = motion_of(options, viewpoint)
            write_bag(folder, take, camera, scene, with_depth=arguments.depth, **given)
    return 0


def _camera(size: tuple[int, int], fov: float) -> Camera:
    width, height = size
    focal = 0.5 * width / math.tan(math.radians(fov) / 2)
    return Camera(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)


def _crossing(options: MotionOptions, viewpoint: Viewpoint) -> list[Take]:
    for name in ('heading', 'stature', 'start'):
        if getattr(options, name):
            raise ValueError(f'--{name} does not go with {CROSSING}, whose seed determines it')
    duration = DURATION if options.duration is None else options.duration
    body = _body(options.body)
    return crossing_takes(body, duration, options.fps, options.seed, viewpoint)


def _body(name: str) -> Body:
    body = load_body(name)
    missing = sorted(set(MEASURED) - set(body.segment_lengths))
    if missing or not body.shapes:
        what = f'no lengths {missing}' if missing else 'no flesh'
        raise ValueError(f'body {name} has {what}: wanted one such as human37')
    return body


def motion_of(options: MotionOptions, viewpoint: Viewpoint) -> Take:
    """The motion selected by options, in front of a camera.

    Raises:
        ValueError: options contradict each other, or a file can not be used.
    """
    body = _body(options.body)
    heading = None if options.heading is None else math.radians(options.heading)
    if options.mocap is not None:
        if options.stature is not None:
            raise ValueError(
                '--stature does not go with --mocap, whose file determines the stature'
            )
        return _recorded(options.mocap, options, body, heading, viewpoint)
    if options.start:
        raise ValueError('--start goes with --mocap only')
    if options.stature is not None:
        body = body.with_stature(options.stature)
    duration = DURATION if options.duration is None else options.duration
    poses = procedural_motion(
        options.name,
        body,
        duration,
        options.fps,
        options.seed,
        heading=heading,
        viewpoint=viewpoint,
    )
    return Take(f'{options.name}, seed {options.seed}', body, poses, options.fps)


def _recorded(
    file: Path, options: MotionOptions, body: Body, heading: float | None, viewpoint: Viewpoint
) -> Take:
    motion = read_motion(file)
    step = max(round(motion.fps / options.fps), 1)
    first = round(options.start * motion.fps)
    if first >= len(motion):
        raise ValueError(
            f'--start {options.start:g} is after the end of {file}, which has '
            f'{len(motion) / motion.fps:.2f} s'
        )
    stop = (
        None if options.duration is None else first + max(round(options.duration * motion.fps), 1)
    )
    part = motion.part(first, stop, step)
    body = body_from_motion(part, body)
    if heading is None:
        heading = math.radians(HEADING)
    poses = retarget(part, body, _placed(part, heading, sole(body), viewpoint))
    return Take(file.name, body, poses, part.fps)


def _placed(
    motion: Motion, heading: float, ankle_height: float, viewpoint: Viewpoint
) -> tuple[Array, Array]:
    """Rotation and translation from the world frame of a motion to the camera frame.

    The middle of the motion is at the viewpoint's origin; the person first faces `heading`.
    """
    hips = motion.joint_positions(['left_hip', 'right_hip'])[0]
    x, y = (hips[1] - hips[0])[:2]  # to the person's right; the person faces (-y, x)
    turn = heading - math.atan2(y, x)
    c, s = math.cos(turn), math.sin(turn)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    pelvis = motion.joint_positions(['pelvis'])[:, 0] @ rotation.T
    names = motion.body.joint_names
    feet = [f'{a}_{b}' for a in ('left', 'right') for b in ('ankle', 'toe') if f'{a}_{b}' in names]
    lowest = motion.joint_positions(feet)[..., 2].min(1)
    centre = 0.5 * (pelvis.min(0) + pelvis.max(0))
    centre[2] = np.percentile(lowest, 10) - ankle_height
    return viewpoint.rotation @ rotation, viewpoint.translation - viewpoint.rotation @ centre
