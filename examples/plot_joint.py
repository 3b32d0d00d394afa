#!/usr/bin/env python3
"""Draws the height of a joint over time, with its uncertainty, from a bag; needs no ROS.

    python examples/plot_joint.py build/demo/reach -o height.png --joint right_wrist

Every mode is a dot, darker if more probable; the line is the mean over all modes, the band two
standard deviations. Heights are relative to the pelvis, along the y axis of the image.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from msg_tools import BagReader
from msg_tools.messages.pose_mixtures import pose_mixture_of

SIZE, MARGIN = (480, 900), 60
BAND, LINE = (235, 215, 190), (160, 90, 20)


def heights(
    bag: Path, joint: str, topic: str
) -> tuple[list[float], list[Any], list[Any], list[Any]]:
    """Time, s, and heights, variances and weights of all modes, for each image."""
    times: list[float] = []
    places: list[Any] = []
    variances: list[Any] = []
    weights: list[Any] = []
    with BagReader(bag) as opened:
        for stored in opened.messages([topic]):
            content = pose_mixture_of(stored.message)
            relative = content.joint_covariances_relative
            if not len(content.weights) or relative is None:
                continue
            at, root = (content.joint_names.index(name) for name in (joint, 'pelvis'))
            times.append(content.stamp_ns * 1e-9)
            positions = content.joint_positions
            places.append(positions[:, root, 1] - positions[:, at, 1])
            variances.append(relative[:, at, 1, 1])
            weights.append(content.weights)
    if not times:
        raise SystemExit(f'{bag}: no poses with covariances on {topic}')
    return times, places, variances, weights


def draw(
    times: list[float], places: list[Any], variances: list[Any],
    weights: list[Any], title: str,
) -> Any:  # fmt: skip
    """The picture, (H, W, 3) BGR."""
    mean = np.array([w @ x for x, w in zip(places, weights, strict=True)])
    spread = np.sqrt(
        [w @ (v + (x - m) ** 2)
         for x, v, w, m in zip(places, variances, weights, mean, strict=True)]
    )  # fmt: skip
    low, high = (mean - 2 * spread).min() - 0.05, (mean + 2 * spread).max() + 0.05
    height, width = SIZE
    picture = np.full((height, width, 3), 255, np.uint8)

    def pixels(t: Any, y: Any) -> Any:
        across = (np.asarray(t) - times[0]) / max(times[-1] - times[0], 1e-9)
        up = (np.asarray(y) - low) / (high - low)
        columns = MARGIN + across * (width - 2 * MARGIN)
        rows = height - MARGIN - up * (height - 2 * MARGIN)
        return np.stack([columns, rows], -1).round().astype(np.int32)

    upper, lower = pixels(times, mean + 2 * spread), pixels(times, mean - 2 * spread)
    cv2.fillPoly(picture, [np.concatenate([upper, lower[::-1]])], BAND)
    for time, each, probable in zip(times, places, weights, strict=True):
        for place, weight in zip(each, probable, strict=True):
            shade = int(230 * (1.0 - weight))
            cv2.circle(
                picture, pixels([time], [place])[0].tolist(), 2, (shade,) * 3, -1, cv2.LINE_AA
            )
    cv2.polylines(picture, [pixels(times, mean)], False, LINE, 2, cv2.LINE_AA)
    for tick in np.linspace(low, high, 5):
        (_, row) = pixels([times[0]], [tick])[0]
        text(picture, f'{tick:.2f} m', (4, int(row) + 4))
    text(picture, title, (MARGIN, 30))
    text(picture, f'{times[-1] - times[0]:.1f} s', (width - MARGIN - 20, height - 20))
    return picture


def text(picture: Any, words: str, place: tuple[int, int]) -> None:
    """Writes text into the picture."""
    cv2.putText(picture, words, place, cv2.FONT_HERSHEY_SIMPLEX, 0.45, (60,) * 3, 1, cv2.LINE_AA)


def main(arguments: list[str] | None = None) -> int:
    """Draws the picture."""
    parser = argparse.ArgumentParser(description=__doc__.partition('\n')[0])
    parser.add_argument('bag', type=Path)
    parser.add_argument('-o', '--output', type=Path, required=True)
    parser.add_argument('--joint', default='right_wrist')
    parser.add_argument('--topic', default='pose_mixture')
    given = parser.parse_args(arguments)
    found = heights(given.bag, given.joint, given.topic)
    picture = draw(*found, f'{given.joint} above the pelvis')
    if not cv2.imwrite(str(given.output), picture):
        raise SystemExit(f'{given.output} can not be written')
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
