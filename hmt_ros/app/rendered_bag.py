"""Rendered bags: images of a moving person, with ground truth, as a bag and files beside it.

The bag has the topics `/image/compressed`, `/camera_info`, `/ground_truth` (hmt_msgs/PoseMixture)
and `/body` (hmt_msgs/Body, latched), and `/depth` (sensor_msgs/Image, 16UC1) on request. Its folder
also has the files that replay and evaluate need: `background.png` (the empty scene), `subject.yaml`
(joints as clicked in the first image) and `truth.npz` (joints, pixels, silhouettes, gravity and the
height of the camera). `/tf_static` tells where the camera is in `odom`, as a robot would.
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hmt_ros.app.progress import show_progress
from hmt_ros.body import Body, Camera
from hmt_ros.body.camera import Viewpoint
from hmt_ros.inference.arrays import Array
from hmt_ros.rendering.depth_sensor import sensed_depth
from hmt_ros.rendering.renderer import render_frames
from hmt_ros.rendering.scene import Scene
from hmt_ros.sessions.transform_buffer import TRANSFORMS_TYPE
from msg_tools import BagWriter, RosbagsMessages
from msg_tools.files.new_folder import FolderKind
from msg_tools.messages.bodies import message_of_body
from msg_tools.messages.camera_info import camera_info_message
from msg_tools.messages.depth_images import depth_message
from msg_tools.messages.headers import SECOND_NS
from msg_tools.messages.images import compressed_image_message
from msg_tools.messages.pose_mixtures import MixtureKind, PoseMixture, pose_mixture_message
from msg_tools.messages.states import transforms_message

FRAME_ID = 'camera_optical_frame'
# The world, z up and 0 on the floor.
WORLD = 'odom'
START_NS = 1_700_000_000 * SECOND_NS  # stamp of the first image
# Of two people each has an own file of the truth.
FILES_BESIDE = ('background.png', 'subject.yaml', 'truth.npz', 'truth_a.npz', 'truth_b.npz')
CLICK_SIGMA = 2.0  # px
OF_CLICKS = 5  # stream of random numbers of a seed; `hmt_ros.image` uses others
TAPE = 0.005  # resolution of the measured lengths of a subject, m
MEASURED = (
    'thigh', 'shin', 'foot', 'upper_arm', 'forearm', 'hand', 'hip_width', 'shoulder_width', 'trunk',
    'neck_to_head',
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Take:
    """The motion that is rendered.

    Attributes:
        source: name of the motion or of its file.
        body: body of the poses.
        poses: (T, d) camera optical frame.
        fps: poses per second.
    """

    source: str
    body: Body
    poses: Array
    fps: float

    def stamp_ns(self, frame: int) -> int:
        """Stamp of an image."""
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
    """Renders a motion into a new bag folder, with its files beside.

    Args:
        folder: new folder; its name becomes that of the bag.
        take: the motion.
        camera: camera of the images.
        scene: surroundings of the person; its seed is also that of the clicks.
        quality: JPEG quality of the images, 1 to 100.
        with_depth: whether a depth camera sees the scene as well.
        progress: whether to show progress on stderr.

    Raises:
        ValueError: the first image does not show the person.
        BagError: the folder exists or can not be written.
    """
    joints = take.body.joint_positions(take.poses)
    pixels = camera.project(joints)
    subject = subject_text(take, camera, pixels[0], scene.seed)
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
    empty = np.rint(scene.background(camera)).astype(np.uint8)
    if not cv2.imwrite(str(folder / 'background.png'), empty):
        raise OSError(f'{folder / "background.png"} can not be written')
    np.savez_compressed(
        folder / 'truth.npz',
        stamps=np.array([take.stamp_ns(frame) for frame in range(len(take.poses))]),
        joint_names=np.array(take.body.joint_names),
        joints=joints,
        pixels=pixels,
        masks=masks,
        K=camera.matrix,
        fps=np.array(take.fps),
        source=np.array(take.source),
        dof_names=np.array(take.body.dof_names),
        poses=take.poses,
        gravity=np.tile(true_gravity(scene.viewpoint), (len(take.poses), 1)),
        camera_height=np.full(len(take.poses), scene.viewpoint.height),
    )


def write_camera_place(
    bag: BagWriter, messages: RosbagsMessages, viewpoint: Viewpoint, stamp_ns: int
) -> None:
    """Writes where a camera stands in `WORLD`, on /tf_static."""
    rotation, position = viewpoint.rotation.T, viewpoint.to_world(np.zeros(3))
    place = transforms_message(
        messages, [WORLD], [FRAME_ID], rotation[None], position[None], stamp_ns
    )
    bag.add_topic('/tf_static', TRANSFORMS_TYPE, latched=True)
    bag.write('/tf_static', stamp_ns, place)


def true_gravity(viewpoint: Viewpoint) -> Array:
    """Its direction (3,) in the frame of a camera."""
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
    """A folder for the bag, which replaces the target when all is written, or never."""
    files = (f'{target.absolute().name}.mcap', *FILES_BESIDE)
    return FolderKind('a bag', 'metadata.yaml', files).new(target, overwrite=overwrite)
