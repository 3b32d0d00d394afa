"""One HTML page that shows the mixtures of a bag, and needs nothing but a browser.

Data, style and program stand in the page itself. Positions are whole numbers of a step, about the
middle of all: 16 bits each, in base64. What stands in the data is told by `page_data`.
"""

from __future__ import annotations

import base64
import html
import json
from dataclasses import dataclass
from importlib import resources
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmt_ros.app.bag_scores import TopicScores
from hmt_ros.app.evaluate import as_json
from hmt_ros.app.report.film_strip import FilmStrip
from hmt_ros.app.report.pictures import BONES, LEFT, RIGHT
from hmt_ros.app.report.recorded_mixtures import Layer, RecordedMixtures, Trajectories, Window
from hmt_ros.app.report.recorded_track import mode_errors
from hmt_ros.app.truth import Truth
from hmt_ros.body import Camera
from hmt_ros.evaluation.pose_scores import LOST, ORIGIN
from hmt_ros.inference.calibration import coverage

Array = NDArray[np.float64]

# Positions are told no finer than this, m, and px as a share of the width of the image.
FINEST = 5e-4
_PIXEL = 1 / 8000
_NOWHERE = -(2**15)  # a pixel of a point that can not be seen
_LARGEST = 2**15 - 1
PROBABILITIES = np.arange(1, 20) / 20
_SIDES = {LEFT: 'left', RIGHT: 'right'}
_SCRIPTS = ('data.js', 'view.js', 'charts.js', 'report.js')


@dataclass(frozen=True, eq=False)
class Content:
    """What a page shows.

    Attributes:
        title: of the page.
        stamps: (T,) ns, of all that is shown, increasing.
        mixtures: at these stamps.
        images: at some of them.
        truth: None: not known.
        scores: by topic; empty: the truth is not known.
        notes: sentences about what is not shown.
    """

    title: str
    stamps: list[int]
    mixtures: RecordedMixtures
    images: FilmStrip
    truth: Truth | None
    scores: dict[str, TopicScores]
    notes: list[str]


def data_size(mixtures: RecordedMixtures) -> int:
    """Bytes that mixtures take in a page, rather more than less."""
    size = 0
    for layer in mixtures.layers:
        joints = len(layer.track.joint_names)
        # Positions of 6 bytes and pixels of 4 in base64; weight and error as text.
        size += sum(
            len(moment.weights) * (joints * 10 * 4 // 3 + 16) for moment in layer.track.moments
        )
    for topic in mixtures.trajectories:
        for window in topic.windows:
            ways = 0 if window.ways is None else window.ways[..., 0].size
            size += 8 * ways + 10 * len(window.weights) + 20 * len(window.free_energy)
            size += 24 * len(window.stamps_ns)
    return size


def page_html(content: Content) -> str:
    """The page."""
    folder = resources.files('hmt_ros.app.report').joinpath('page')
    parts = {
        'title': html.escape(content.title),
        'style': folder.joinpath('report.css').read_text('utf-8'),
        'script': '\n'.join(folder.joinpath(name).read_text('utf-8') for name in _SCRIPTS),
        # Nothing in a JSON string may end the element that it stands in.
        'data': json.dumps(page_data(content), separators=(',', ':'), allow_nan=False).replace(
            '<', '\\u003c'
        ),
    }
    page = folder.joinpath('report.html').read_text('utf-8')
    for name, text in parts.items():
        page = page.replace(f'<!-- {name} -->', text)
    return page


def page_data(content: Content) -> dict[str, Any]:
    """The data of the page.

    Positions are `origin + step * int16`, m, in the camera optical frame: of each layer (modes of
    all times in turn, joints, 3), of trajectories (component, time, end, 3). Pixels are `int16`
    times 1/8000 of the width of the image, from the centre of the first pixel.
    """
    grid = _Grid.around(content)
    stamps = content.stamps
    start = stamps[0]
    return {
        'title': content.title,
        'notes': content.notes,
        'start_ns': str(start),
        'times': [_rounded((stamp - start) * 1e-9, 6) for stamp in stamps],
        'origin': [_rounded(x, 6) for x in grid.origin],
        'step': grid.step,
        'pixel': _PIXEL,
        'lost_mm': 1e3 * LOST,
        'layers': [_layer(layer, content, grid) for layer in content.mixtures.layers],
        'trajectories': [
            _trajectories(topic, start, grid) for topic in content.mixtures.trajectories
        ],
        'truth': None if content.truth is None else _truth(content.truth, content, grid),
        'images': _images(content),
        'scores': _scores(content),
    }


@dataclass(frozen=True, eq=False)
class _Grid:
    """Where positions are rounded to."""

    origin: Array
    step: float

    @staticmethod
    def around(content: Content) -> _Grid:
        parts = [
            moment.joints.reshape(-1, 3)
            for layer in content.mixtures.layers
            for moment in layer.track.moments
        ]
        parts += [
            window.ways.reshape(-1, 3)
            for topic in content.mixtures.trajectories
            for window in topic.windows
            if window.ways is not None
        ]
        if content.truth is not None:
            parts += [content.truth.joints[t] for t in content.stamps if t in content.truth.joints]
        points = np.concatenate([np.zeros((1, 3)) if not parts else parts[0], *parts[1:]])
        low, high = points.min(0), points.max(0)
        step = max(FINEST, float((high - low).max()) / (2 * _LARGEST))
        return _Grid(np.round(0.5 * (low + high), 6), step)

    def encoded(self, positions: Array) -> str:
        return _base64(np.rint((positions - self.origin) / self.step))


def _layer(layer: Layer, content: Content, grid: _Grid) -> dict[str, Any]:
    moments = {moment.stamp_ns: moment for moment in layer.track.moments}
    shown = [moments[stamp] for stamp in content.stamps if stamp in moments]
    joints = len(layer.track.joint_names)
    everything = np.concatenate([np.zeros((0, joints, 3)), *(moment.joints for moment in shown)])
    errors = {} if content.truth is None else mode_errors(layer.track, content.truth)
    camera, width = content.images.camera, content.images.size[0]
    return {
        'topic': layer.topic,
        'kind': layer.kind,
        **_skeleton(layer.track.joint_names),
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
        'positions': grid.encoded(everything),
        'pixels': None if camera is None else _pixels(camera, everything, width),
    }


def _skeleton(names: tuple[str, ...]) -> dict[str, Any]:
    return {
        'joints': list(names),
        'root': names.index(ORIGIN) if ORIGIN in names else 0,
        'bones': [
            [names.index(a), names.index(b), _SIDES.get(colour, 'trunk')]
            for a, b, colour in BONES
            if a in names and b in names
        ],
    }


def _pixels(camera: Camera, positions: Array, width: int) -> str:
    with np.errstate(invalid='ignore'):
        pixels = np.rint(camera.project(positions) / (width * _PIXEL))
    hidden = ~(np.abs(pixels) <= _LARGEST).all(-1)
    pixels[hidden] = _NOWHERE
    return _base64(pixels)


def _trajectories(topic: Trajectories, start: int, grid: _Grid) -> dict[str, Any]:
    def described(window: Window) -> dict[str, Any]:
        return {
            'times': [_rounded((stamp - start) * 1e-9, 6) for stamp in window.stamps_ns],
            'weights': [_rounded(x, 5) for x in window.weights],
            'free_energy': [_rounded(x, 4) for x in window.free_energy if np.isfinite(x)],
            'ways': None if window.ways is None else grid.encoded(window.ways),
        }

    return {
        'topic': topic.topic,
        'ends': list(topic.ends),
        'windows': [described(window) for window in topic.windows],
    }


def _truth(truth: Truth, content: Content, grid: _Grid) -> dict[str, Any]:
    known = [stamp in truth.joints for stamp in content.stamps]
    joints = [truth.joints[stamp] for stamp in content.stamps if stamp in truth.joints]
    positions = np.concatenate(
        [np.zeros((0, len(truth.joint_names), 3)), *(x[None] for x in joints)]
    )
    camera, width = content.images.camera, content.images.size[0]
    return {
        'source': truth.source,
        **_skeleton(truth.joint_names),
        'known': known,
        'positions': grid.encoded(positions),
        'pixels': None if camera is None else _pixels(camera, positions, width),
    }


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
                ('together', topic.scores.levels), ('each', topic.scores.joint_levels),
            )
        }  # fmt: skip
    result['probabilities'] = PROBABILITIES.tolist()
    return _finite(result)


def _finite(value: Any) -> Any:
    """JSON has no numbers that are none."""
    if isinstance(value, dict):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, list):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _base64(values: Array) -> str:
    return base64.b64encode(values.astype('<i2').tobytes()).decode('ascii')


def _rounded(value: float, digits: int) -> float:
    return round(float(value), digits)
