"""A tracker keeps only as much of an image as it needs for the next ones."""

from __future__ import annotations

import gc
import tracemalloc

import numpy as np

from hmt_ros.body import Camera, load_body
from hmt_ros.image.background import BackgroundModel
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.tracking import Status, Subject, Tracker, TrackerSettings

START = 10**9
SMALL = Camera(110.0, 110.0, 59.5, 44.5, 120, 90)
# A small search, because the memory kept of an image does not depend on it.
SETTINGS = TrackerSettings(candidates=8, max_hypotheses=4, searched_chains=1, combinations=32)
# Bytes that a track may grow by between the two numbers of images: less than seven of its
# images take. Caches of the bodies that a track learns are full after about a hundred images.
FIRST, LAST, BOUND = 160, 320, 200_000


def test_a_track_does_not_grow(filmed):
    body = load_body('human32')
    poses, images, empty = filmed('walk', 1.6, SMALL)
    pixels = SMALL.project(body.joint_positions(poses[:1]))[0]
    n = len(pixels)
    seen = Keypoints(body.joint_names, pixels, np.tile(np.eye(2), (n, 1, 1)), np.ones(n))
    tracker = Tracker(body, SMALL, SETTINGS, BackgroundModel.from_image(empty))
    tracker.reset(Subject(START, seen, dict(body.segment_lengths)))
    taken, turn = {}, len(poses) - 1
    tracemalloc.start()
    try:
        for i in range(LAST):
            # Forwards to the end of the film and back.
            t = turn - abs(i % (2 * turn) - turn)
            tracker.step(images[t], START + 10**8 * i)
            if i + 1 in (FIRST, LAST):
                gc.collect()
                taken[i + 1], _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert tracker.estimate.status is Status.TRACKING
    assert taken[LAST] - taken[FIRST] < BOUND, taken
