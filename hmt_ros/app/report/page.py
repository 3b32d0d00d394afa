"""One HTML page that shows the mixtures in a bag, and needs only a browser.

Data, style and program are in the page itself. Positions are 16-bit multiples of a step, relative
to the centre of all positions, in base64. `page_data` describes the data.
"""

from __future__ import annotations

import base64
import html
import json
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import resources
from typing import Any

import numpy as np

from hmt_ros.app.evaluate import as_json
from hmt_ros.app.report.detector import Detector
from hmt_ros.app.report.images import FilmStrip
from hmt_ros.app.report.mixtures import (
    Layer,
    Moment,
    RecordedMixtures,
    Window,
    ground_at,
    heights_of,
    intervals,
)
from hmt_ros.app.report.pictures import PROBABILITIES
from hmt_ros.app.report.skeletons import LEFT_COLOUR, RIGHT_COLOUR, bones_of
from hmt_ros.evaluation.pose_scores import LOST_ERROR, ORIGIN, origin_joints
from hmt_ros.evaluation.track_scores import TrackScores, Truth, mode_errors
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.calibration import coverage
from msg_tools.messages.ground import GroundState

# Quantisation steps: minimum for positions, and step for regions, m; for pixels, in image widths.
MIN_POSITION_STEP, _REGION_STEP = 5e-4, 1e-4
_PIXEL_STEP = 1 / 8000
_NAN_CODE = -(2**15)  # code of NaN and of invisible pixels
_MAX_CODE = 2**15 - 1
_SIDES = {LEFT_COLOUR: 'left', RIGHT_COLOUR: 'right'}
_SCRIPTS = ('data.js', 'view.js', 'charts.js', 'report.js')


@dataclass(frozen=True, eq=False)
class Content:
    """The content of a page.

    Attributes:
        title: title of the page.
        stamps: (T,) increasing times to show, ns.
        mixtures: mixtures at these times.
        images: images at some of these times.
        truth: true joint positions; None if unknown.
        scores: scores by topic; empty without truth.
        notes: lines of text about contents that the page leaves out.
        grounds: floor and contacts by stamp; empty if unknown.
        detector: skeletons from a detector of 3D keypoints; None if missing.
    """

    title: str
    stamps: list[int]
    mixtures: RecordedMixtures
    images: FilmStrip
    truth: Truth | None
    scores: dict[str, TrackScores]
    notes: list[str]
    grounds: dict[int, GroundState] = field(default_factory=dict)
    detector: Detector | None = None


def data_size(mixtures: RecordedMixtures) -> int:
    """Approximate upper bound on the size of the mixtures in a page, bytes."""
    size = 0
    for layer in mixtures.layers:
        # Base64 of 6 bytes per position and 4 per pixel; weight and error as text.
        each = len(layer.joint_names) * 10 * 4 // 3 + 16
        for moment in layer.mixtures.values():
            # Probabilities as text.
            size += len(moment.weights) * each + 8 * (1 + len(moment.cues))
            # Base64 of 6 bytes per interval; identities as text.
            size += 8 * moment.marginals.shape[2] + 8 * len(moment.weights)
            # Base64 of 2 bytes per number of a region.
            size += 8 * moment.regions.size // 3
    for topic in mixtures.trajectories:
        for window in topic.mixtures.values():
            ways = 0 if window.joint_paths is None else window.joint_paths[..., 0].size
            size += 8 * ways + 10 * len(window.weights) + 20 * len(window.free_energy)
            size += 24 * len(window.stamps_ns)
    return size


def page_html(content: Content) -> str:
    """Returns the text of the page."""
    folder = resources.files('hmt_ros.app.report').joinpath('page')
    parts = {
        'title': html.escape(content.title),
        'style': folder.joinpath('report.css').read_text('utf-8'),
        'script': '\n'.join(folder.joinpath(name).read_text('utf-8') for name in _SCRIPTS),
        # Escape "<", so that no JSON string ends the HTML element around the data.
        'data': json.dumps(page_data(content), separators=(',', ':'), allow_nan=False).replace(
            '<', '\\u003c'
        ),
    }
    page = folder.joinpath('report.html').read_text('utf-8')
    for name, text in parts.items():
        page = page.replace(f'<!-- {name} -->', text)
    return page


def ground_data(grounds: dict[int, GroundState], stamps: Collection[int]) -> dict[str, Any] | None:
    """Data of the ground for the page; None if the ground is unknown at all given stamps.

    Returns:
        `planes`: for each time (a, b, c, d) with a x + b y + c z + d = 0 on the floor, m, camera
        optical frame, or None; `contacts`: for each time the probability of floor contact of the
        left and right foot.
    """
    shown = [grounds.get(stamp) for stamp in stamps]
    planes = [None if one is None else one.plane for one in shown]
    contacts = [{} if one is None else one.contacts for one in shown]
    if all(plane is None for plane in planes) and not any(contacts):
        return None
    return {
        'planes': [
            None if plane is None else [round(float(x), 6) for x in plane] for plane in planes
        ],
        'contacts': [
            {foot.removesuffix('_foot'): round(float(p), 3) for foot, p in one.items()}
            for one in contacts
        ],
    }


def page_data(content: Content) -> dict[str, Any]:
    """The data of the page.

    Positions are `origin + step * int16`, m, in the camera optical frame, with the shape (modes of
    all times in turn, joints, 3) for a layer and (component, time, end, 3) for trajectories. Pixels
    are `int16` times 1/8000 of the width of the image, from the centre of the first pixel; regions
    (see `regions_of`) are `region * int16`, m. -32768 means NaN. The page can align skeletons at
    the centre of the joints in `roots`.
    """
    grid = _Grid.around(content)
    stamps, truth = content.stamps, content.truth
    start = stamps[0]
    return {
        'title': content.title,
        'notes': content.notes,
        'start_ns': str(start),
        'times': [_rounded((stamp - start) * 1e-9, 6) for stamp in stamps],
        'origin': [_rounded(x, 6) for x in grid.origin],
        'step': grid.step,
        'pixel': _PIXEL_STEP,
        'region': _REGION_STEP,
        'lost_mm': 1e3 * LOST_ERROR,
        'layers': [_layer(layer, content, grid) for layer in content.mixtures.layers],
        'trajectories': [
            _trajectories(topic, start, grid) for topic in content.mixtures.trajectories
        ],
        'truth': None if truth is None else _truth(truth, content, grid),
        'detector': None
        if content.detector is None
        else _detector(content.detector, content, grid),
        'ground': ground_data(content.grounds, stamps),
        'images': _images(content),
        'scores': _scores(content),
    }


@dataclass(frozen=True, eq=False)
class _Grid:
    """The grid of points to which positions are rounded, m."""

    origin: Array
    step: float

    @staticmethod
    def around(content: Content) -> _Grid:
        mixtures, truth = content.mixtures, content.truth
        parts = [moment.joints for layer in mixtures.layers for moment in layer.mixtures.values()]
        parts += [
            window.joint_paths
            for topic in mixtures.trajectories
            for window in topic.mixtures.values()
            if window.joint_paths is not None
        ]
        if truth is not None:
            parts += [truth.joints[t] for t in content.stamps if t in truth.joints]
        if content.detector is not None:
            parts += content.detector.joints.values()
        points = np.concatenate([part.reshape(-1, 3) for part in parts or [np.zeros((1, 3))]])
        low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
        step = max(MIN_POSITION_STEP, float((high - low).max()) / (2 * _MAX_CODE))
        return _Grid(np.round(0.5 * (low + high), 6), step)

    def encoded(self, positions: Array) -> str:
        return _base64(_whole((positions - self.origin) / self.step))


def _layer(layer: Layer[Moment], content: Content, grid: _Grid) -> dict[str, Any]:
    names, moments, truth = layer.joint_names, layer.mixtures, content.truth
    shown = [moments[stamp].joints for stamp in content.stamps if stamp in moments]
    everything = np.concatenate([np.zeros((0, len(names), 3)), *shown])
    errors = {}
    if truth is not None:
        errors = mode_errors({t: moment.joints for t, moment in moments.items()}, names, truth)
    return {
        'topic': layer.topic,
        'kind': layer.kind,
        **_skeleton(names, content),
        'weights': [
            [_rounded(x, 5) for x in moments[stamp].weights] if stamp in moments else []
            for stamp in content.stamps
        ],
        'errors_mm': [
            [_rounded(1e3 * x, 1) for x in errors[stamp]] if stamp in errors else None
            for stamp in content.stamps
        ]
        if errors
        else None,
        **_beliefs([moments.get(stamp) for stamp in content.stamps]),
        'identities': _identities([moments.get(stamp) for stamp in content.stamps]),
        'bands': _bands(layer, content.stamps),
        'positions': grid.encoded(everything),
        'pixels': _pixels(content.images, everything),
        'regions': _regions([moments[stamp] for stamp in content.stamps if stamp in moments]),
    }


def _regions(moments: Sequence[Moment]) -> str | None:
    """Regions of the joints of all modes; None if some are unknown."""
    known = moments and all(moment.regions.size for moment in moments)
    every = [moment.regions.ravel() / _REGION_STEP for moment in moments]
    return _base64(_whole(np.concatenate(every))) if known else None


def _beliefs(moments: Sequence[Moment | None]) -> dict[str, Any]:
    """Probabilities over time: `existence`, None if unknown, and the `cues` by name."""
    existence = [None if one is None else _probability(one.existence) for one in moments]
    names = dict.fromkeys(name for one in moments if one is not None for name in one.cues)
    return {
        'existence': None if all(p is None for p in existence) else existence,
        'cues': {
            name: [
                None if one is None else _probability(one.cues.get(name, math.nan))
                for one in moments
            ]
            for name in names
        },
    }


def _identities(moments: Sequence[Moment | None]) -> list[list[int]] | None:
    """Identities of the modes at each time; None if no mode has one."""
    result = [[] if one is None else one.identities.astype(int).tolist() for one in moments]
    return result if any(map(any, result)) else None


def _bands(layer: Layer[Moment], stamps: Sequence[int]) -> dict[str, Any] | None:
    """90 % intervals of heights and angles over time; None if covariances are unknown.

    Returns:
        `joints` and `angles`: their names. `values`: `int16` (times, joints and angles, 3) with
        lower end, median and upper end; heights in mm, angles in tenths of a degree.
    """
    names = [*layer.joint_names, *layer.angles]
    values = np.full((len(stamps), len(names), 3), np.nan)
    for t, stamp in enumerate(stamps):
        moment = layer.mixtures.get(stamp)
        if moment is not None and moment.marginals.shape[2] == len(names):
            values[t] = intervals(moment.weights, moment.marginals)
    joints = len(layer.joint_names)
    known = np.isfinite(values).all(axis=(1, 2))
    if not joints or not known.any():
        return None
    values[:, :joints] *= 1e3
    # Unwrap angles, so that they are continuous over time.
    middles = values[known, joints:, 1]
    values[known, joints:] += (np.unwrap(middles, axis=0, period=360.0) - middles)[..., None]
    values[:, joints:] *= 10.0
    joint_names, angles = list(layer.joint_names), list(layer.angles)
    return {'joints': joint_names, 'angles': angles, 'values': _base64(_whole(values))}


def _whole(values: Array) -> Array:
    """Rounds values and clips them to 16-bit integers; NaN becomes `_NAN_CODE`."""
    return np.where(np.isnan(values), _NAN_CODE, np.clip(np.rint(values), -_MAX_CODE, _MAX_CODE))


def _probability(value: float) -> float | None:
    return None if math.isnan(value) else _rounded(value, 3)


def _skeleton(names: tuple[str, ...], content: Content) -> dict[str, Any]:
    origin: tuple[str, ...] = (ORIGIN,)
    if content.truth is not None:
        origin = origin_joints(content.truth.joint_names, content.truth.source)
    return {
        'joints': list(names),
        'roots': [names.index(name) for name in origin if name in names] or [0],
        'bones': [[a, b, _SIDES.get(colour, 'trunk')] for a, b, colour in bones_of(names)],
    }


def _pixels(images: FilmStrip, positions: Array) -> str | None:
    if images.camera is None:
        return None
    with np.errstate(invalid='ignore'):
        pixels = np.rint(images.camera.project(positions) / (images.size[0] * _PIXEL_STEP))
    hidden = ~(np.abs(pixels) <= _MAX_CODE).all(-1)
    pixels[hidden] = _NAN_CODE
    return _base64(pixels)


def _trajectories(layer: Layer[Window], start: int, grid: _Grid) -> dict[str, Any]:
    def described(window: Window) -> dict[str, Any]:
        return {
            'times': [_rounded((stamp - start) * 1e-9, 6) for stamp in window.stamps_ns],
            'weights': [_rounded(x, 5) for x in window.weights],
            'free_energy': [_rounded(x, 4) for x in window.free_energy if np.isfinite(x)],
            'ways': None if window.joint_paths is None else grid.encoded(window.joint_paths),
        }

    return {
        'topic': layer.topic,
        'ends': list(layer.joint_names),
        'windows': [described(window) for window in layer.mixtures.values()],
    }


def _truth(truth: Truth, content: Content, grid: _Grid) -> dict[str, Any]:
    names = truth.joint_names
    known = [truth.joints[stamp][None] for stamp in content.stamps if stamp in truth.joints]
    return {
        'source': truth.source,
        **_one_each(names, truth.joints, content, grid),
        'pixels': _pixels(content.images, np.concatenate([np.zeros((0, len(names), 3)), *known])),
        'heights': _base64(_whole(1e3 * _true_heights(truth, content))),
    }


def _detector(detector: Detector, content: Content, grid: _Grid) -> dict[str, Any]:
    return {
        'topic': detector.topic,
        **_one_each(detector.joint_names, detector.joints, content, grid),
        'confidences': [
            _probability(detector.confidences.get(stamp, math.nan)) for stamp in content.stamps
        ],
    }


def _one_each(
    names: tuple[str, ...], joints: Mapping[int, Array], content: Content, grid: _Grid
) -> dict[str, Any]:
    """Data of one skeleton over time; `known` marks the times at which the skeleton is known."""
    known = [joints[stamp][None] for stamp in content.stamps if stamp in joints]
    positions = np.concatenate([np.zeros((0, len(names), 3)), *known])
    return {
        **_skeleton(names, content),
        'known': [stamp in joints for stamp in content.stamps],
        'positions': grid.encoded(positions),
    }


def _true_heights(truth: Truth, content: Content) -> Array:
    """Heights (T, J) of the true joints, m; NaN if unknown."""
    result = np.full((len(content.stamps), len(truth.joint_names)), np.nan)
    for t, stamp in enumerate(content.stamps):
        if stamp in truth.joints:
            result[t] = heights_of(truth.joints[stamp], ground_at(content.grounds, stamp))
    return result


def _images(content: Content) -> dict[str, Any] | None:
    images = content.images
    if not images.jpegs:
        return None
    return {
        'width': images.size[0],
        'height': images.size[1],
        'drawn_on': images.camera is None,
        'jpegs': [
            base64.b64encode(images.jpegs[stamp]).decode('ascii') if stamp in images.jpegs else None
            for stamp in content.stamps
        ],
    }


def _scores(content: Content) -> dict[str, Any] | None:
    if content.truth is None or not content.scores:
        return None
    result = as_json(content.scores, content.truth)
    for name, topic in content.scores.items():
        result['topics'][name]['calibration'] = {
            kind: None
            if levels is None
            else [_rounded(coverage(levels, q), 4) for q in PROBABILITIES]
            for kind, levels in (
                ('together', topic.scores.levels),
                ('each', topic.scores.joint_levels),
                ('absolute', topic.scores.absolute_levels),
            )
        }
    result['probabilities'] = PROBABILITIES.tolist()
    return result


def _base64(values: Array) -> str:
    return base64.b64encode(values.astype('<i2').tobytes()).decode('ascii')


def _rounded(value: float, digits: int) -> float:
    return round(float(value), digits)
