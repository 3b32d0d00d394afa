"""absence: whether a visible person is ever taken for nobody, and an empty scene for somebody.

film       a clip is played back and forth at several rates, from two offsets. With `gaps` every
           fourth second is lost. No image may have the state NOBODY.
empty      the empty scene with the noise of the clip's own pixels, for 2 s before, between and
           after two passes of the clip. From 1 s on the state has to be NOBODY. A detector sees
           nobody in it.
scenes     real videos of a place that is empty, then visited. No track may start while it is
           empty; 1 s after somebody has left, the state has to be NOBODY. With images alone a box
           in the empty place starts a track, which has to end within 1 s.

Clips of a moving camera have no image of the empty scene: they are only in `film`.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.clips import (
    Clip,
    development_folder,
    find_clips,
    index_back_and_forth,
    read_clip,
    read_detections,
    read_messages,
    rows_at_rate,
    table,
)
from benchmarks.command import add_choice, benchmark_parser, run_stages, show, told
from benchmarks.runs import IMAGES, INPUTS, KEYPOINTS, keypoints_only, new_tracker, subject_of
from hmt_ros.body import load_body
from hmt_ros.image.background import BackgroundModel
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.tracking import Status, Tracker, TrackerSettings
from msg_tools.messages.camera_info import camera_from_info
from msg_tools.messages.headers import time_ns
from msg_tools.messages.images import decode_image

RATES = (30.0, 10.0, 5.0, 2.7, 1.0)  # images a second
SECONDS, QUICK_SECONDS = 20.0, 6.0
EMPTY = 2.0  # s of the empty scene each time
LATE = 1.0  # s after which it has to be noticed
GAP, EVERY = 1.0, 4.0  # s
STAGES = ('film', 'empty', 'scenes')
NOBODY_SEEN = Keypoints((), np.empty((0, 2)), np.empty((0, 2, 2)), np.empty(0))
Case = dict[str, Any]
# Time, s, image, and its index in the clip; None: of the empty scene.
Film = Iterator[tuple[float, NDArray[np.uint8], int | None]]


@dataclass(frozen=True)
class Scene:
    """A real video of a place that somebody visits.

    Attributes:
        name: of its folder.
        empty: first and last image but one of the times without anybody.
        whole: the same of the times at which the person is in full view.
    """

    name: str
    empty: tuple[tuple[int, int], ...]
    whole: tuple[tuple[int, int], ...]


# As seen by eye. A second person comes into `park_walk` after these images.
SCENES = (
    Scene('park_walk', ((0, 33),), ((64, 174),)),
    Scene('leaflet', ((0, 59), (200, 226)), ((72, 190),)),
)


def main(argv: list[str]) -> int:
    """Runs the benchmark."""
    parser = benchmark_parser('absence', __doc__, quick='two clips, two rates, a few seconds')
    add_choice(parser, STAGES)
    parser.add_argument('--folder', type=Path, metavar='DIR', help='that holds the clips')
    parser.add_argument('--clips', nargs='+', metavar='NAME', help='some of the clips')
    parser.add_argument(
        '--rates', nargs='+', type=float, default=RATES, metavar='HZ', help='images a second'
    )
    parser.add_argument('--inputs', nargs='+', choices=INPUTS, default=(IMAGES,))
    parser.add_argument(
        '--hypotheses', type=int, metavar='K', help='fewer modes and candidates than by default'
    )
    options = parser.parse_args(argv)
    result = measure(
        options.folder, options.clips, options.rates, options.hypotheses,
        inputs=options.inputs, only=options.only, quick=options.quick,
    )  # fmt: skip
    return show(result, as_text, as_json=options.json)


def measure(
    folder: Path | None = None,
    clips: Sequence[str] | None = None,
    rates: Sequence[float] = RATES,
    hypotheses: int | None = None,
    *,
    inputs: Sequence[str] = (IMAGES,),
    only: Sequence[str] = STAGES,
    quick: bool = False,
) -> dict[str, Any]:
    """Counts of wrong states by inputs, clip and rate.

    Args:
        folder: that holds the clips; None: the development clips.
        clips: names of some of them; None: all.
        rates: of the images, Hz.
        hypotheses: number of modes; None: default settings.
        inputs: what the tracker is given, some of `INPUTS`.
        only: stages.
        quick: whether few clips and seconds are enough.

    Raises:
        ValueError: there are no such clips.
    """
    found, _ = find_clips(folder, moving=True)
    chosen = [path for path in found if clips is None or path.name in clips]
    base = development_folder() if folder is None else folder
    scenes = [
        scene
        for scene in SCENES
        if (base / scene.name).is_dir() and (clips is None or scene.name in clips)
    ]
    if not chosen and not scenes:
        raise ValueError(f'no clip is called {" or ".join(clips or ())}')
    settings, seconds = TrackerSettings(), SECONDS
    if quick:
        chosen, scenes, rates, seconds = chosen[:2], scenes[:1], rates[-2:], QUICK_SECONDS
    if hypotheses is not None:
        settings = replace(settings, max_hypotheses=hypotheses, candidates=2 * hypotheses)

    def read() -> Iterator[Clip]:
        return map(read_clip, told('absence', chosen, lambda path: path.name))

    def films() -> list[Case]:
        return [
            {'inputs': given, 'clip': clip.name, 'rate': rate, 'gaps': gaps, 'offset': offset}
            | count_film(clip, settings, rate, seconds, offset, inputs=given, gaps=gaps)
            for clip in read()
            for given in inputs
            for rate in rates
            for gaps in (False, True)
            for offset in (0.0, 0.5)
        ]

    def empties() -> list[Case]:
        return [
            {'inputs': given, 'clip': clip.name, 'rate': rate}
            | count_empty(clip, settings, rate, inputs=given)
            for clip in read()
            if clip.background is not None
            for given in inputs
            for rate in rates
        ]

    def visits() -> list[Case]:
        return [
            {'inputs': given, 'clip': scene.name, 'rate': rate}
            | count_scene(base / scene.name, scene, settings, rate, inputs=given)
            for scene in told('absence', scenes, lambda scene: scene.name)
            for given in inputs
            for rate in rates
        ]

    return run_stages('absence', {'film': films, 'empty': empties, 'scenes': visits}, only)


def count_film(
    clip: Clip,
    settings: TrackerSettings,
    rate: float,
    seconds: float,
    offset: float,
    *,
    inputs: str = IMAGES,
    gaps: bool,
) -> Case:
    """States of a clip that is played back and forth.

    Args:
        clip: the person is in view in all of it.
        settings: of the tracker.
        rate: images a second, at most the clip's.
        seconds: how long.
        offset: of the first image after the start, as a fraction of the interval.
        inputs: what the tracker is given, one of `INPUTS`.
        gaps: whether every fourth second is lost.
    """
    interval = (clip.stamps[1] - clip.stamps[0]) * 1e-9
    # The start is that of the subject's image.
    times = [0.0, *((i + offset) / rate for i in range(1, int(seconds * rate)))]
    if gaps:
        times = [t for t in times if t % EVERY < EVERY - GAP]

    def film() -> Film:
        for t in times:
            index = index_back_and_forth(round(t / interval), len(clip.images))
            yield t, clip.images[index], index

    return _counted(clip, settings, film(), inputs)


def count_empty(
    clip: Clip, settings: TrackerSettings, rate: float, *, inputs: str = IMAGES
) -> Case:
    """States of two passes of a clip, with the empty scene before, between and after them."""
    rng = np.random.default_rng(0)
    interval = (clip.stamps[1] - clip.stamps[0]) * 1e-9
    background, sigma = clip.background, noise_of(clip)
    assert background is not None
    length = len(clip.images) * interval

    def film() -> Film:
        for start, here in (
            (-EMPTY, False), (0.0, True), (length, False),
            (length + EMPTY, True), (2 * length + EMPTY, False),
        ):  # fmt: skip
            for i in range(int((length if here else EMPTY) * rate)):
                t = i / rate
                if here:
                    index = min(round(t / interval), len(clip.images) - 1)
                    yield start + t, clip.images[index], index
                else:
                    noisy = background + rng.normal(0.0, sigma, background.shape)
                    yield start + t, np.clip(np.rint(noisy), 0, 255).astype(np.uint8), None

    return _counted(clip, settings, film(), inputs)


def count_scene(
    folder: Path, scene: Scene, settings: TrackerSettings, rate: float, *, inputs: str = IMAGES
) -> Case:
    """States of a real video of a place that is empty at first."""
    info, messages = read_messages(folder)
    stamps = [time_ns(message.header.stamp) for message in messages]
    first = decode_image(messages[0])
    height, width = first.shape[:2]
    body = load_body('human37')
    seen = {} if inputs == IMAGES else read_detections(folder).keypoints
    camera = camera_from_info(info, (width, height))
    if inputs == IMAGES:
        tracker = Tracker(body, camera, settings, BackgroundModel.from_image(first))
        tracker.reset(box=(2 * width // 5, height // 10, 3 * width // 5, 9 * height // 10))
    else:
        tracker = Tracker(body, camera, _settings_for(inputs, settings))
    counts = Counts(tracks=1 if inputs == IMAGES else 0)
    last = max(end for _, end in (*scene.empty, *scene.whole))
    for i in rows_at_rate(stamps[:last], rate):
        tracker.step(decode_image(messages[i]), stamps[i], seen.get(stamps[i]))
        empty = any(start <= i < end for start, end in scene.empty)
        whole = any(start <= i < end for start, end in scene.whole)
        counts.add(tracker, 1e-9 * stamps[i], here=whole, empty=empty)
    return counts.result()


def noise_of(clip: Clip) -> float:
    """Standard deviation of the noise of a pixel, grey levels, from two images of a clip."""
    first, second = (clip.images[i].astype(float) for i in (0, 1))
    return float(np.median(np.abs(second - first))) / 0.6745 / np.sqrt(2.0)


class Counts:
    """Counts of states: of images of the person, and of the late ones of the empty scene.

    Args:
        tracks: number of tracks that are started on purpose.
    """

    def __init__(self, tracks: int = 0) -> None:
        self._person, self._late = Counter[str](), Counter[str]()
        self._since: float | None = None
        self._least, self._tracks, self._started = 1.0, tracks, 0

    def add(self, tracker: Tracker, t: float, *, here: bool, empty: bool) -> None:
        """Counts the state at a time t, s, at which the person is in view, or nobody is."""
        if empty:
            self._started += max(tracker.track_id - self._tracks, 0)
        self._tracks = max(tracker.track_id, self._tracks)
        if here:
            self._person[tracker.estimate.status.value] += 1
            self._least = min(self._least, tracker.estimate.existence_probability)
        self._since = (t if self._since is None else self._since) if empty else None
        if self._since is not None and t - self._since >= LATE - 1e-6:
            self._late[tracker.estimate.status.value] += 1

    def result(self) -> Case:
        """The counts by name."""
        late, person = self._late, self._person
        unnoticed = late.total() - late[Status.NOBODY.value] - late[Status.WAITING.value]
        return {
            'images': person.total(),
            'nobody': person[Status.NOBODY.value],
            'lost': person[Status.LOST.value],
            'tracks': self._tracks,
            'least_probability': self._least,
            'empty': late.total(),
            'unnoticed': unnoticed,
            'started': self._started,
        }


def _counted(clip: Clip, settings: TrackerSettings, film: Film, inputs: str) -> Case:
    """Counts of the states of a film."""
    body = load_body('human37')
    first = subject_of(clip, body).stamp_ns
    detected = None if inputs == IMAGES else read_detections(clip.folder).keypoints
    tracker = new_tracker(clip, body, _settings_for(inputs, settings), 0)
    counts = Counts()
    for t, image, index in film:
        keypoints = None
        if detected is not None:
            keypoints = NOBODY_SEEN if index is None else detected[clip.stamps[index]]
        if index is not None and (view := clip.views.get(clip.stamps[index])) is not None:
            rotation, position = view
            tracker.set_camera(position, rotation)
        tracker.step(image, first + round(1e9 * t), keypoints)
        counts.add(tracker, t, here=index is not None, empty=index is None)
    return counts.result()


def _settings_for(inputs: str, settings: TrackerSettings) -> TrackerSettings:
    return keypoints_only(settings) if inputs == KEYPOINTS else settings


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """Tables of what `measure` has counted, summed over clips and offsets."""
    parts = []
    if 'film' in result:
        head = [
            'inputs', 'images/s', 'lost seconds', 'clips', 'images', 'NOBODY', 'LOST',
            'new tracks', 'of clips',
        ]  # fmt: skip
        rows = []
        for (inputs, rate, gaps), cases in _grouped(result['film'], 'inputs', 'rate', 'gaps'):
            total = _summed(cases)
            wrong = sorted({x['clip'] for x in cases if x['nobody']})
            numbers = [
                len({x['clip'] for x in cases}), total['images'], total['nobody'], total['lost'],
                total['tracks'] - len(cases),
            ]  # fmt: skip
            lost = 'every fourth' if gaps else 'none'
            rows.append([inputs, f'{rate:g}', lost, *map(str, numbers), ', '.join(wrong) or '-'])
        parts.append(table([head, *rows], left=3, markdown=markdown))
    for stage in ('empty', 'scenes'):
        if not result.get(stage):
            continue
        head = [
            'inputs', 'images/s', 'clips', 'images', 'NOBODY', 'empty images', 'not NOBODY',
            'tracks of nobody', 'of clips',
        ]  # fmt: skip
        rows = []
        for (inputs, rate), cases in _grouped(result[stage], 'inputs', 'rate'):
            total, wrong = _summed(cases), sorted(x['clip'] for x in cases if _is_wrong(x))
            keys = ('images', 'nobody', 'empty', 'unnoticed', 'started')
            numbers = [len(cases), *(total[key] for key in keys)]
            rows.append([inputs, f'{rate:g}', *map(str, numbers), ', '.join(wrong) or '-'])
        parts.append(table([head, *rows], left=2, markdown=markdown))
    return '\n\n'.join(parts)


def _is_wrong(case: Case) -> bool:
    return bool(case['nobody'] or case['unnoticed'] or case['started'])


def _grouped(cases: list[Case], *keys: str) -> list[tuple[tuple[Any, ...], list[Case]]]:
    """Cases by the values of some keys, in their order."""
    result: dict[tuple[Any, ...], list[Case]] = {}
    for case in cases:
        result.setdefault(tuple(case[key] for key in keys), []).append(case)
    return list(result.items())


def _summed(cases: list[Case]) -> Counter[str]:
    result = Counter[str]()
    for case in cases:
        result.update({key: value for key, value in case.items() if type(value) is int})
    return result


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
