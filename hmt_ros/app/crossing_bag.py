"""A rendered bag of several people, such as two who walk past each other, one before the other.

The bag has the topics `/image/compressed`, `/camera_info`, `/detections` (hmt_msgs/People2D: COCO
keypoints of both, without identities), `/tf_static` and `/humans/bodies/a/ground_truth`,
`.../b/ground_truth` (hmt_msgs/PoseMixture). A keypoint that another person hides is not detected,
and somebody of whom fewer than `FEWEST` keypoints are seen is not detected at all. The order of the
people in a message is random. Beside the bag are `background.png`, and `truth_a.npz` and
`truth_b.npz` as those of `rendered_bag`, without masks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from string import ascii_lowercase

import cv2
import numpy as np

from hmt_ros.app.progress import show_progress
from hmt_ros.app.rendered_bag import (
    FRAME_ID,
    Take,
    ground_truth,
    true_gravity,
    write_camera_place,
)
from hmt_ros.body import Body, Camera
from hmt_ros.body.camera import Viewpoint
from hmt_ros.body.kinematics import forward
from hmt_ros.image.keypoint_schemes import schemes
from hmt_ros.image.terms.keypoints import USUAL_STATURE, Keypoints
from hmt_ros.inference.arrays import Array
from hmt_ros.motion.procedural_motion import procedural_motion
from hmt_ros.rendering.renderer import render_people
from hmt_ros.rendering.scene import Scene
from msg_tools import BagWriter, RosbagsMessages
from msg_tools.messages.camera_info import camera_info_message
from msg_tools.messages.detections import DetectedPerson, people_message
from msg_tools.messages.images import compressed_image_message

CROSSING = 'crossing'
PEOPLE = ('a', 'b')
# How far one walks before the other, m, and the most that each turns from walking straight across.
BEFORE = 0.9
TURN = np.radians(12.0)
# Statures, as a share of the model's.
STATURES = (0.94, 1.06)
# Noise of the keypoints, m on the person; their confidence; fewest that are a detection.
NOISE, CONFIDENCE = 0.02, 0.9
FEWEST = 5
OF_PEOPLE, OF_DETECTIONS = 6, 7  # streams of random numbers of a seed


def crossing_takes(
    body: Body, duration: float, fps: float, seed: int, viewpoint: Viewpoint
) -> list[Take]:
    """The motions of two people who cross in the middle of the image at half the time."""
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

    The arguments are those of `rendered_bag.write_bag`.

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
            people = [DetectedPerson('', x) for x in found if x.seen.sum() >= FEWEST]
            shuffled = [people[i] for i in rng.permutation(len(people))]
            message = people_message(messages, shuffled, stamp, FRAME_ID)
            bag.write('detections', stamp, message)
            picture = compressed_image_message(messages, image, stamp, FRAME_ID, quality)
            bag.write('image/compressed', stamp, picture)
            for name, take, places in zip(names, takes, joints, strict=True):
                truth = ground_truth(messages, take.body, take.poses[frame], places[frame], stamp)
                bag.write(f'humans/bodies/{name}/ground_truth', stamp, truth)
            bar.update()
    empty = np.rint(scene.background(camera)).astype(np.uint8)
    if not cv2.imwrite(str(folder / 'background.png'), empty):
        raise OSError(f'{folder / "background.png"} can not be written')
    for name, take, places in zip(names, takes, joints, strict=True):
        np.savez_compressed(
            folder / f'truth_{name}.npz',
            stamps=np.array([take.stamp_ns(frame) for frame in range(count)]),
            joint_names=np.array(take.body.joint_names),
            joints=places,
            pixels=camera.project(places),
            K=camera.matrix,
            fps=np.array(take.fps),
            source=np.array(take.source),
            dof_names=np.array(take.body.dof_names),
            poses=take.poses,
            gravity=np.tile(true_gravity(scene.viewpoint), (count, 1)),
            camera_height=np.full(count, scene.viewpoint.height),
        )


def detection(
    body: Body, pose: Array, camera: Camera, own: Array, rng: np.random.Generator
) -> Keypoints:
    """COCO keypoints of a person as a detector would see them.

    Args:
        body, pose: the person, pose (d,).
        camera: that sees the person.
        own: (H, W) pixels that show the person.
        rng: of the noise.
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
    # What lies on the edge of the person belongs to it.
    near = cv2.dilate(own.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    column, row = np.nan_to_num(np.round(exact), nan=-1.0).astype(int).T
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    seen = inside & near[np.where(inside, row, 0), np.where(inside, column, 0)]
    names = tuple(name for name, _ in marks)
    unknown = np.full((len(names), 2, 2), np.nan)
    found = Keypoints(names, pixels, unknown, np.full(len(names), CONFIDENCE))
    kept = np.where(seen, CONFIDENCE, 0.0)
    return replace(found, confidences=kept)
