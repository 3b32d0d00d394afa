"""Rendered bags: images of a moving person, with ground truth, as a bag and files beside it.

The bag has the topics `/image/compressed`, `/camera_info`, `/ground_truth` (hmt_msgs/PoseMixture)
and `/body` (hmt_msgs/Body, latched), and `/depth` (sensor_msgs/Image, 16UC1) on request. Its folder
also has the files that replay and evaluate need: `background.png` (the empty scene), `subject.yaml`
(joints as clicked in the first image) and `truth.npz` (joints, pixels, silhouettes, gravity and the
height of the camera). `/tf_static` has the camera's pose in `odom`, as on a robot.

A bag of several people, such as two who walk past each other, has instead of `/ground_truth` and
`/body` the topics `/humans/bodies/a/ground_truth`, `.../b/ground_truth` and `/detections`
(hmt_msgs/People2D: COCO keypoints of all, without identities). A keypoint that another person hides
is not detected, and a person with fewer than `MIN_KEYPOINTS` visible keypoints is not detected at
all. The order of the people in a message is random. Beside it are `background.png`, and
`truth_a.npz` and `truth_b.npz`, without silhouettes.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from string import ascii_lowercase
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hmt_learning.motion.procedural_motion import procedural_motion
from hmt_learning.motion.viewpoint import Viewpoint
from hmt_learning.rendering.renderer import render_frames, render_people, sensed_depth
from hmt_learning.rendering.scene import Scene
from hmt_ros.app.progress import show_progress
from hmt_ros.body import Body, Camera
from hmt_ros.body.kinematics import forward
from hmt_ros.image.keypoint_schemes import schemes
from hmt_ros.image.terms.keypoints import USUAL_STATURE, Keypoints
from hmt_ros.inference.arrays import Array
from hmt_ros.sessions.transform_buffer import TRANSFORMS_TYPE
from msg_tools import BagWriter, RosbagsMessages
from msg_tools.files.new_folder import FolderKind
from msg_tools.messages.bodies import message_of_body
from msg_tools.messages.camera_info import camera_info_message
from msg_tools.messages.detections import DetectedPerson, people_message
from msg_tools.messages.headers import FRAME_ID, SECOND_NS, START_NS
from msg_tools.messages.images import compressed_image_message, depth_message
from msg_tools.messages.pose_mixtures import MixtureKind, PoseMixture, pose_mixture_message
from msg_tools.messages.states import transforms_message

# World frame; z points up and is 0 on the floor.
WORLD = 'odom'
# Files in the folder of a bag; with two people each has a truth file.
FILES_BESIDE = ('background.png', 'subject.yaml', 'truth.npz', 'truth_a.npz', 'truth_b.npz')
CLICK_SIGMA = 2.0  # px
OF_CLICKS = 5  # identifier of a random stream; `hmt_ros.image` uses others
TAPE = 0.005  # resolution of the measured lengths of a subject, m
MEASURED = (
    'thigh',
    'shin',
    'foot',
    'upper_arm',
    'forearm',
    'hand',
    'hip_width',
    'shoulder_width',
    'trunk',
    'neck_to_head',
)

CROSSING = 'crossing'
PEOPLE = ('a', 'b')
# Difference in depth of the two people, m; maximum angle to the image plane of each walk, rad.
BEFORE = 0.9
TURN = np.radians(12.0)
# Range of statures, as factors on the model's.
STATURES = (0.94, 1.06)
# Noise of keypoints, m on the person; their confidence; minimum number for a detection.
NOISE, CONFIDENCE = 0.02, 0.9
MIN_KEYPOINTS = 5
OF_PEOPLE, OF_DETECTIONS = 6, 7  # identifiers of random streams


@dataclass(frozen=True, eq=False)
class Take:
    """The motion that is rendered.

    Attributes:
        source: name of the motion or of its file.
        poses: (T, d) camera optical frame.
        fps: poses per second.
    """

    source: str
    body: Body
    poses: Array
    fps: float

    def stamp_ns(self, frame: int) -> int:
        """Timestamp of an image, ns."""
        return START_NS + round(frame * SECOND_NS / self.fps)


def write_bag(
    folder: Path,
    take: Take,
    camera: Camera,
    scene: Scene,
    *,
    quality: int = 90,
    with_depth: bool = False,
    progress: bool = False,
) -> None:
    """Renders a motion into a new bag folder and adds the other files.

    Args:
        folder: new folder; its name becomes that of the bag.
        scene: surroundings of the person; its seed is also that of the clicks.

    Raises:
        ValueError: the first image does not show the person.
        BagError: the folder exists or can not be written.
    """
    joints = take.body.joint_positions(take.poses)
    subject = subject_text(take, camera, camera.project(joints[:1])[0], scene.seed)
    messages = RosbagsMessages()
    masks = np.empty((len(take.poses), camera.height, (camera.width + 7) // 8), dtype=np.uint8)
    with (
        BagWriter(folder) as bag,
        show_progress(folder.name, 'images', len(take.poses), quiet=not progress) as bar,
    ):
        bag.add_topic('body', 'hmt_msgs/msg/Body', latched=True)
        bag.write('body', START_NS, message_of_body(messages, take.body, START_NS, FRAME_ID))
        write_camera_place(bag, messages, scene.viewpoint, START_NS)
        for frame, shown in enumerate(render_frames(take.body, take.poses, camera, scene)):
            stamp = take.stamp_ns(frame)
            image = compressed_image_message(messages, shown.image, stamp, FRAME_ID, quality)
            bag.write('image/compressed', stamp, image)
            if with_depth:
                true = np.minimum(shown.depth, scene.depth(camera))
                seen = sensed_depth(true, camera, scene.seed, frame)
                bag.write('depth', stamp, depth_message(messages, seen, stamp, FRAME_ID))
            info = camera_info_message(messages, camera, stamp, FRAME_ID)
            bag.write('camera_info', stamp, info)
            truth = ground_truth(messages, take.body, take.poses[frame], joints[frame], stamp)
            bag.write('ground_truth', stamp, truth)
            masks[frame] = np.packbits(shown.mask, axis=1)
            bar.update()
    (folder / 'subject.yaml').write_text(subject, encoding='utf-8')
    _write_background(folder, camera, scene)
    _write_truth(folder / 'truth.npz', take, joints, camera, scene, masks)


def _write_background(folder: Path, camera: Camera, scene: Scene) -> None:
    """Writes an image of the empty scene."""
    empty = np.rint(scene.background(camera)).astype(np.uint8)
    if not cv2.imwrite(str(folder / 'background.png'), empty):
        raise OSError(f'{folder / "background.png"} can not be written')


def _write_truth(
    path: Path,
    take: Take,
    joints: Array,
    camera: Camera,
    scene: Scene,
    masks: NDArray[np.uint8] | None = None,
) -> None:
    """Writes the ground truth of a motion; silhouettes are optional."""
    silhouettes: dict[str, Any] = {} if masks is None else {'masks': masks}
    count = len(take.poses)
    np.savez_compressed(
        path,
        stamps=np.array([take.stamp_ns(frame) for frame in range(count)]),
        joint_names=np.array(take.body.joint_names),
        joints=joints,
        pixels=camera.project(joints),
        **silhouettes,
        K=camera.matrix,
        fps=np.array(take.fps),
        source=np.array(take.source),
        dof_names=np.array(take.body.dof_names),
        poses=take.poses,
        gravity=np.tile(true_gravity(scene.viewpoint), (count, 1)),
        camera_height=np.full(count, scene.viewpoint.height),
    )


def write_camera_place(
    bag: BagWriter, messages: RosbagsMessages, viewpoint: Viewpoint, stamp_ns: int
) -> None:
    """Writes the pose of a camera in `WORLD` to /tf_static."""
    rotation, position = viewpoint.rotation.T, viewpoint.to_world(np.zeros(3))
    place = transforms_message(
        messages, [WORLD], [FRAME_ID], rotation[None], position[None], stamp_ns
    )
    bag.add_topic('/tf_static', TRANSFORMS_TYPE, latched=True)
    bag.write('/tf_static', stamp_ns, place)


def true_gravity(viewpoint: Viewpoint) -> Array:
    """Direction (3,) of gravity in the camera frame."""
    return np.asarray(viewpoint.rotation @ np.array([0.0, 0.0, -1.0]))


def ground_truth(
    messages: RosbagsMessages, body: Body, pose: Array, joints: Array, stamp_ns: int
) -> Any:
    """hmt_msgs/PoseMixture of a known pose: one component with an empty covariance."""
    content = PoseMixture(
        weights=np.ones(1),
        means=pose[None],
        covariances=None,
        body_model=body.name,
        dof_names=body.dof_names,
        joint_names=body.joint_names,
        joint_positions=joints[None],
        kind=MixtureKind.GROUND_TRUTH,
        stamp_ns=stamp_ns,
        frame_id=FRAME_ID,
        segment_lengths=body.segment_lengths,
    )
    return pose_mixture_message(messages, content)


def subject_text(take: Take, camera: Camera, pixels: Array, seed: int) -> str:
    """Subject file: joints (J, 2) of the first image as a person would click them, and lengths.

    Raises:
        ValueError: fewer than four joints lie in the image.
    """
    clicks = pixels + np.random.default_rng([seed, OF_CLICKS]).normal(0, CLICK_SIGMA, pixels.shape)
    lowest, highest = np.zeros(2), np.array([camera.width - 1, camera.height - 1])
    inside = np.all((clicks >= lowest) & (clicks <= highest), axis=1)
    if inside.sum() < 4:
        raise ValueError(
            f'the first image shows {inside.sum()} joints of the person, wanted 4 at least: '
            f'change --distance, --heading or --fov'
        )
    lines = [
        '# joint centres in the first image, as a person would click them, and the subject',
        f'stamp_ns: {take.stamp_ns(0)}',
        f'sigma_px: {CLICK_SIGMA}',
        "keypoints:  # name: [u, v] in pixels; left and right are the person's own",
    ]
    for name, click, seen in zip(take.body.joint_names, clicks, inside):
        if seen:
            lines.append(f'  {name}: [{click[0]:.1f}, {click[1]:.1f}]')
    lines.append(f'segment_lengths_m:  # as measured with a tape, to {1000 * TAPE:.0f} mm')
    for name in MEASURED:
        rounded = max(round(take.body.segment_lengths[name] / TAPE), 1) * TAPE
        lines.append(f'  {name}: {rounded:.3f}')
    return '\n'.join(lines) + '\n'


def new_bag_folder(target: Path, *, overwrite: bool) -> AbstractContextManager[Path]:
    """New folder for the bag; it replaces the target only after everything is written."""
    files = (f'{target.absolute().name}.mcap', *FILES_BESIDE)
    return FolderKind('a bag', 'metadata.yaml', files).new(target, overwrite=overwrite)


def crossing_takes(
    body: Body, duration: float, fps: float, seed: int, viewpoint: Viewpoint
) -> list[Take]:
    """Motions of two people whose paths cross in the middle of the image at half time."""
    rng = np.random.default_rng([seed, OF_PEOPLE])
    first = rng.choice([-1.0, 1.0])
    takes = []
    for number, name in enumerate(PEOPLE):
        side = first if number == 0 else -first
        own = body.with_stature(body.stature * rng.uniform(*STATURES))
        heading = side * 0.5 * np.pi + rng.uniform(-TURN, TURN)
        poses = procedural_motion(
            'walk', own, duration, fps, 2 * seed + number, heading=heading, viewpoint=viewpoint
        )
        depth = (0.5 if number == 0 else -0.5) * BEFORE
        poses[:, :3] += viewpoint.rotation @ np.array([0.0, depth, 0.0])
        takes.append(Take(f'{CROSSING}, seed {seed}, person {name}', own, poses, fps))
    return takes


def write_people(
    folder: Path,
    takes: Sequence[Take],
    camera: Camera,
    scene: Scene,
    *,
    quality: int = 90,
    progress: bool = False,
) -> None:
    """Renders people, called a, b and so on, into a new bag folder.

    The arguments are those of `write_bag`.

    Raises:
        BagError: the folder exists or can not be written.
    """
    messages = RosbagsMessages()
    rng = np.random.default_rng([scene.seed, OF_DETECTIONS])
    count, names = len(takes[0].poses), ascii_lowercase[: len(takes)]
    joints = [take.body.joint_positions(take.poses) for take in takes]
    with (
        BagWriter(folder) as bag,
        show_progress(folder.name, 'images', count, quiet=not progress) as bar,
    ):
        write_camera_place(bag, messages, scene.viewpoint, takes[0].stamp_ns(0))
        for frame in range(count):
            stamp = takes[0].stamp_ns(frame)
            poses = [take.poses[frame] for take in takes]
            image, owners = render_people(
                [take.body for take in takes], poses, camera, scene, frame
            )
            bag.write('camera_info', stamp, camera_info_message(messages, camera, stamp, FRAME_ID))
            found = [
                detection(take.body, pose, camera, owners == number, rng)
                for number, (take, pose) in enumerate(zip(takes, poses, strict=True))
            ]
            people = [DetectedPerson('', x) for x in found if x.seen.sum() >= MIN_KEYPOINTS]
            shuffled = [people[i] for i in rng.permutation(len(people))]
            message = people_message(messages, shuffled, stamp, FRAME_ID)
            bag.write('detections', stamp, message)
            picture = compressed_image_message(messages, image, stamp, FRAME_ID, quality)
            bag.write('image/compressed', stamp, picture)
            for name, take, places in zip(names, takes, joints, strict=True):
                truth = ground_truth(messages, take.body, take.poses[frame], places[frame], stamp)
                bag.write(f'humans/bodies/{name}/ground_truth', stamp, truth)
            bar.update()
    _write_background(folder, camera, scene)
    for name, take, places in zip(names, takes, joints, strict=True):
        _write_truth(folder / f'truth_{name}.npz', take, places, camera, scene)


def detection(
    body: Body, pose: Array, camera: Camera, own: Array, rng: np.random.Generator
) -> Keypoints:
    """COCO keypoints of a person as a detector would see them.

    Args:
        body, pose: body and pose (d,) of the person.
        own: (H, W) mask of the pixels that show the person.
    """
    scheme, skeleton = schemes()['coco17'], body.skeleton
    marks = [x for x in zip(scheme.names, scheme.landmarks, strict=True) if x[1].joint]
    at = skeleton.joint_index([mark.joint for _, mark in marks])
    offsets = np.array([mark.offset for _, mark in marks]) * body.stature / USUAL_STATURE
    frames = forward(skeleton, pose[None])
    local = skeleton.joint_offsets[at] + offsets
    points = frames.points(skeleton.joint_segments[at], local)[:, :, 0]
    exact = camera.project(points)
    pixels = exact + rng.normal(0.0, NOISE, exact.shape) * (camera.fx / points[:, 2:])
    # A keypoint on the outline of the person is visible.
    near = cv2.dilate(own.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    column, row = np.nan_to_num(np.round(exact), nan=-1.0).astype(int).T
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    seen = inside & near[np.where(inside, row, 0), np.where(inside, column, 0)]
    names = tuple(name for name, _ in marks)
    unknown = np.full((len(names), 2, 2), np.nan)
    found = Keypoints(names, pixels, unknown, np.full(len(names), CONFIDENCE))
    kept = np.where(seen, CONFIDENCE, 0.0)
    return replace(found, confidences=kept)
