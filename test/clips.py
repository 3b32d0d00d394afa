"""Clips of the development data, where it is available."""

from typing import Any, NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from hmt_ros.app.truth import read_truth
from hmt_ros.body import load_body
from hmt_ros.image.terms.keypoints import Keypoints
from msg_tools import BagReader
from msg_tools.messages.camera_info import camera_from_info
from msg_tools.messages.headers import time_ns
from msg_tools.messages.images import decode_image


class Clip(NamedTuple):
    """Images by stamp, the camera, an empty scene or None, truth, keypoints and views by stamp."""

    camera: Any
    images: dict[int, np.ndarray]
    background: np.ndarray | None
    truth: Any
    keypoints: dict[int, Keypoints]
    views: dict[int, tuple[np.ndarray, np.ndarray]]


def read_clip(folder, count):
    """The first images of a clip, with MediaPipe's keypoints."""
    with BagReader(folder) as bag:
        info = next(bag.messages([bag.find_topic(['sensor_msgs/msg/CameraInfo']).name])).message
        topic = bag.find_topic(['sensor_msgs/msg/CompressedImage', 'sensor_msgs/msg/Image']).name
        messages = [x.message for x, _ in zip(bag.messages([topic]), range(count), strict=False)]
    images = {time_ns(x.header.stamp): decode_image(x) for x in messages}
    height, width = next(iter(images.values())).shape[:2]
    empty, body, views = folder / 'background.png', load_body('human37'), {}
    with np.load(folder / 'truth.npz') as content:
        if 'camera_quaternion' in content:
            turns = Rotation.from_quat(content['camera_quaternion']).as_matrix()
            both = zip(turns, content['camera_position'], strict=True)
            views = dict(zip(content['stamps'].tolist(), both, strict=True))
    with np.load(folder / 'keypoints_mediapipe.npz') as content:
        names = tuple(str(name) for name in content['landmark_names'])
        unknown = np.full((len(names), 2, 2), np.nan)
        keypoints = {
            stamp: Keypoints(names, pixels, unknown, np.nan_to_num(sure), world).named_for(
                body, 'mediapipe33'
            )[0]
            for stamp, pixels, sure, world in zip(
                content['stamps'].tolist(),
                *(content[x].astype(float) for x in ('pixels', 'visibility', 'world')),
                strict=True,
            )
        }
    return Clip(
        camera_from_info(info, (width, height)),
        images,
        cv2.imread(str(empty)) if empty.is_file() else None,
        read_truth(folder / 'truth.npz'),
        keypoints,
        views,
    )
