"""Writes the bag of the demonstration from rendered images, with keypoints of MediaPipe Pose.

    python pack.py MOTION.npz FOLDER BAG

Sensor noise is added. /tf_static contains the camera's pose, as on a robot.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np

from hmt_learning.app.rendered_bag import (
    Take,
    ground_truth,
    subject_text,
    true_gravity,
    write_camera_place,
)
from hmt_learning.motion.viewpoint import Viewpoint
from hmt_ros.body import Camera, load_body
from hmt_ros.detectors.blazepose import BlazePose
from msg_tools import BagWriter, RosbagsMessages
from msg_tools.messages.camera_info import camera_info_message
from msg_tools.messages.headers import FRAME_ID, START_NS
from msg_tools.messages.images import compressed_image_message, decode_image
from msg_tools.messages.keypoints import keypoints_message, positions_message

NOISE, QUALITY = 1.5, 80


def main(argv: list[str]) -> int:
    """Writes the bag, `background.png`, `subject.yaml` and `truth.npz`."""
    motion, images, target = np.load(argv[0]), Path(argv[1]), Path(argv[2])
    body = load_body('human37')
    body = body.with_segment_lengths(dict(zip(body.skeleton.length_names, motion['lengths'])))
    empty = cv2.imread(str(images / 'empty.png'))
    width, height = motion['size'].tolist()
    focal = 0.5 * width / np.tan(motion['half_angle'])
    camera = Camera(focal, focal, 0.5 * (width - 1), 0.5 * (height - 1), width, height)
    viewpoint = Viewpoint(*motion['place'].tolist())
    joints = viewpoint.to_camera(motion['joints'])
    stamps = START_NS + np.round(np.arange(len(joints)) * 1e9 / motion['fps']).astype(np.int64)
    pixels = camera.project(joints)
    # The person counts as absent if no joint is in the image.
    seen = ((pixels > -0.5) & (pixels < np.array([width, height]) - 0.5)).all(2).any(1)
    messages, detector, rng = RosbagsMessages(), BlazePose(), np.random.default_rng(0)
    with BagWriter(target) as bag:
        write_camera_place(bag, messages, viewpoint, START_NS)
        for number, stamp in enumerate(stamps.tolist()):
            image = cv2.imread(str(images / f'{number:04d}.png')).astype(np.float64)
            image = np.clip(np.rint(image + rng.normal(0.0, NOISE, image.shape)), 0, 255)
            message = compressed_image_message(
                messages, image.astype(np.uint8), stamp, FRAME_ID, QUALITY
            )
            bag.write('image/compressed', stamp, message)
            info = camera_info_message(messages, camera, stamp, FRAME_ID)
            bag.write('camera_info', stamp, info)
            found = detector.detect(decode_image(message), stamp)
            if found is not None:
                keypoints = keypoints_message(messages, found, stamp, FRAME_ID)
                bag.write('keypoints', stamp, keypoints)
                lifted = positions_message(messages, found, stamp, FRAME_ID)
                bag.write('keypoints_3d', stamp, lifted)
            if seen[number]:
                true = ground_truth(messages, body, motion['poses'][number], joints[number], stamp)
                bag.write('ground_truth', stamp, true)
    take = Take(str(motion['motion']), body, motion['poses'], float(motion['fps']))
    subject = subject_text(take, camera, pixels[0], 0)
    (target / 'subject.yaml').write_text(subject, 'utf-8')
    cv2.imwrite(str(target / 'background.png'), empty)
    np.savez_compressed(
        target / 'truth.npz',
        stamps=stamps,
        joint_names=motion['joint_names'],
        joints=np.where(seen[:, None, None], joints, np.nan),
        pixels=pixels,
        K=camera.matrix,
        fps=motion['fps'],
        scenes=motion['scenes'],
        until=stamps[0] + np.round(motion['until'] * 1e9).astype(np.int64),
        gravity=np.tile(true_gravity(viewpoint), (len(joints), 1)),
        camera_height=np.full(len(joints), viewpoint.height),
    )
    return 0


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
