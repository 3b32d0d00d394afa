"""MediaPipe Pose in a process of its own: images from stdin, landmarks to stdout.

    python mediapipe_worker.py [--mask]

`hmt_ros.detectors.mediapipe_pose` starts it with an interpreter that has MediaPipe; it imports
nothing of this package. All numbers are little-endian. It says one line when it is ready. Then, for
each image, it reads a `REQUEST` and the pixels (height, width, 3), BGR, and writes a `REPLY`; if
somebody was seen, `LANDMARKS` rows of u, v, visibility, x, y, z as float64; and with --mask, the
mask (height, width) as bytes. It ends with its input.
"""

from __future__ import annotations

import os
import struct
import sys
from typing import Any, BinaryIO

import numpy as np

READY = b'mediapipe is ready\n'
# Height and width, px; whether the image does not follow the one before.
REQUEST = struct.Struct('<II?')
# Whether somebody was seen.
REPLY = struct.Struct('<?')
LANDMARKS = 33
# A pixel of the mask belongs to the person from this probability on.
PERSON = 0.5


def main(argv: list[str]) -> int:
    """Answers images until there are no more; returns 0, or 1 without MediaPipe."""
    with_mask = '--mask' in argv
    # What libraries print must not stand between the answers.
    replies = os.fdopen(os.dup(sys.stdout.fileno()), 'wb')
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    try:
        import mediapipe

        # The weights of this model are in the wheel.
        pose = mediapipe.solutions.pose.Pose(model_complexity=1, enable_segmentation=with_mask)
    except (ImportError, AttributeError, OSError) as error:
        sys.stderr.write(f'{type(error).__name__}: {error}\n')
        return 1
    with pose:
        replies.write(READY)
        replies.flush()
        while answer(pose, sys.stdin.buffer, replies, with_mask):
            pass
    return 0


def answer(pose: Any, requests: BinaryIO, replies: BinaryIO, with_mask: bool) -> bool:
    """Answers one image; returns whether there was one."""
    head = requests.read(REQUEST.size)
    if len(head) < REQUEST.size:
        return False
    height, width, anew = REQUEST.unpack(head)
    pixels = requests.read(3 * height * width)
    if len(pixels) < 3 * height * width:
        return False
    if anew:
        pose.reset()
    image = np.frombuffer(pixels, np.uint8).reshape(height, width, 3)
    found = pose.process(np.ascontiguousarray(image[..., ::-1]))
    seen = found.pose_landmarks is not None and found.pose_world_landmarks is not None
    replies.write(REPLY.pack(seen))
    if seen:
        replies.write(rows(found, width, height).astype('<f8').tobytes())
        if with_mask:
            replies.write((found.segmentation_mask >= PERSON).astype(np.uint8).tobytes())
    replies.flush()
    return True


def rows(found: Any, width: int, height: int) -> np.ndarray[Any, Any]:
    """The landmarks (33, 6): u, v, px; visibility; x, y, z, m."""
    # MediaPipe counts from the edge of the first pixel, and in units of the image.
    return np.array(
        [
            (p.x * width - 0.5, p.y * height - 0.5, p.visibility, w.x, w.y, w.z)
            for p, w in zip(found.pose_landmarks.landmark, found.pose_world_landmarks.landmark)
        ],
        dtype=np.float64,
    )


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
