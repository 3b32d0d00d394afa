"""Samples on outlines: evenly spaced, with normals against the blurred mask's gradient."""

from __future__ import annotations

import cv2
import numpy as np

from hmt_ros.core import sample_outline
from test.core.arguments import assert_arguments_are_checked

COUNT = 60


def arguments(rng, shape=(60, 80)):
    mask = np.zeros(shape, np.uint8)
    for _ in range(4):
        centre = tuple(int(x) for x in rng.integers(0, shape[::-1]))
        cv2.circle(mask, centre, int(rng.integers(6, 15)), 1, -1)
    contours, _ = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    most = COUNT + 4 * len(contours)
    return {
        'pixels': np.concatenate(contours)[:, 0],
        'ends': np.cumsum([len(c) for c in contours]),
        'mask': mask,
        'unsure': (rng.random(shape) < 0.3).astype(np.uint8),
        'others': (rng.random(shape) < 0.2).astype(np.uint8),
        'count': COUNT,
        'left': 7,
        'top': 5,
        'places': np.empty((most, 2)),
        'normals': np.empty((most, 2)),
        'beliefs': np.empty(most),
    }


def expected(pixels, ends, mask, unsure, others, count, left, top, places, normals, beliefs):
    outlines = np.split(pixels.astype(float), ends[:-1])
    steps = [np.linalg.norm(np.roll(x, -1, axis=0) - x, axis=1) for x in outlines]
    found = []
    for one, step in zip(outlines, steps):
        n = max(round(count * step.sum() / np.concatenate(steps).sum()), 3)
        along = np.concatenate([[0.0], np.cumsum(step)])
        at = (np.arange(n) + 0.5) / n * along[-1]
        closed = np.concatenate([one, one[:1]])
        found.append(np.stack([np.interp(at, along, closed[:, i]) for i in range(2)], axis=1))
    found = np.concatenate(found)
    blurred = cv2.GaussianBlur(mask.astype(np.float64), (0, 0), 2.0)
    column, row = np.round(found).astype(int).T
    slopes = [cv2.Sobel(blurred, cv2.CV_64F, *axis)[row, column] for axis in ((1, 0), (0, 1))]
    out = -np.stack(slopes, axis=1)
    good = np.linalg.norm(out, axis=1) > 1e-3
    found, out = found[good], out[good] / np.linalg.norm(out[good], axis=1)[:, None]
    column, row = np.clip(
        np.round(found + 4.0 * out).astype(int), 0, np.array(mask.shape)[::-1] - 1
    ).T
    belief = np.where(others[row, column], 0.0, np.where(unsure[row, column], 0.3, 1.0))
    return found + 0.5 * out + np.array([left, top]), out, belief


def test_samples_are_even_and_normals_leave_the_silhouette():
    for seed in range(10):
        given = arguments(np.random.default_rng(seed))
        used = sample_outline(*given.values())
        for name, wanted in zip(('places', 'normals', 'beliefs'), expected(**given)):
            assert used == len(wanted)
            np.testing.assert_allclose(given[name][:used], wanted, atol=1e-5)


def test_nobody_else_is_unsure_without_masks():
    given = arguments(np.random.default_rng(1))
    nothing = np.zeros((0, 0), np.uint8)
    used = sample_outline(*(given | {'unsure': nothing, 'others': nothing}).values())
    assert (given['beliefs'][:used] == 1.0).all()


def test_arguments_are_checked():
    given = arguments(np.random.default_rng(2))
    assert_arguments_are_checked(
        sample_outline, given, 'places normals beliefs', free='pixels ends unsure others'
    )
