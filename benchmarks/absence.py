"""absence: whether a visible person is ever taken for nobody, and an empty scene for somebody.

film       a clip is played back and forth at several rates, from two offsets. With `gaps` every
           fourth second is lost. No image may have the state NOBODY.
empty      the empty scene with the noise of the clip's own pixels, for 2 s before, between and
           after two passes of the clip. From 1 s on the state has to be NOBODY.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.clips import Clip, find_clips, index_back_and_forth, read_clip, table
from benchmarks.command import add_choice, benchmark_parser, run_stages, show, told
from hmt_ros.body import load_body
from hmt_ros.image.background import BackgroundModel
from hmt_ros.tracking import Status, Tracker, TrackerSettings, read_subject

RATES = (30.0, 10.0, 5.0, 2.7, 1.0)  # images a second
SECONDS, QUICK_SECONDS = 20.0, 6.0
EMPTY = 2.0  # s of the empty scene each time
LATE = 1.0  # s after which it has to be noticed
GAP, EVERY = 1.0, 4.0  # s
STAGES = ('film', 'empty')
Case = dict[str, Any]
Film = Iterator[tuple[float, NDArray[np.uint8], bool]]


def main(argv: list[str]) -> int:
    """Runs the benchmark."""
    parser = benchmark_parser('absence', __doc__, quick='two clips, two rates, a few seconds')
    add_choice(parser, STAGES)
    parser.add_argument('--folder', type=Path, metavar='DIR', help='that holds the clips')
    parser.add_argument('--clips', nargs='+', metavar='NAME', help='some of the clips')
    parser.add_argument(
        '--rates', nargs='+', type=float, default=RATES, metavar='HZ', help='images a second'
    )
    parser.add_argument(
        '--hypotheses', type=int, metavar='K', help='fewer modes and candidates than by default'
    )
    options = parser.parse_args(argv)
    result = measure(
        options.folder, options.clips, options.rates, options.hypotheses,
        only=options.only, quick=options.quick,
    )  # fmt: skip
    return show(result, as_text, as_json=options.json)


def measure(
    folder: Path | None = None,
    clips: Sequence[str] | None = None,
    rates: Sequence[float] = RATES,
    hypotheses: int | None = None,
    *,
    only: Sequence[str] = STAGES,
    quick: bool = False,
) -> dict[str, Any]:
    """Counts of wrong states by clip and rate.

    Args:
        folder: that holds the clips; None: the development clips.
        clips: names of some of them; None: all.
        rates: of the images, Hz.
        hypotheses: number of modes; None: default settings.
        only: stages.
        quick: whether few clips and seconds are enough.

    Raises:
        ValueError: there are no such clips.
    """
    found, _ = find_clips(folder)
    chosen = [path for path in found if clips is None or path.name in clips]
    if not chosen:
        raise ValueError(f'no clip is called {" or ".join(clips or ())}')
    settings, seconds = TrackerSettings(), SECONDS
    if quick:
        chosen, rates, seconds = chosen[:2], rates[-2:], QUICK_SECONDS
    if hypotheses is not None:
        settings = replace(settings, max_hypotheses=hypotheses, candidates=2 * hypotheses)

    def films() -> list[dict[str, Any]]:
        return [
            {'clip': clip.name, 'rate': rate, 'gaps': gaps, 'offset': offset}
            | count_film(clip, settings, rate, seconds, offset, gaps=gaps)
            for clip in map(read_clip, told('absence', chosen, lambda path: path.name))
            for rate in rates
            for gaps in (False, True)
            for offset in (0.0, 0.5)
        ]

    def empties() -> list[dict[str, Any]]:
        return [
            {'clip': clip.name, 'rate': rate} | count_empty(clip, settings, rate)
            for clip in map(read_clip, told('absence', chosen, lambda path: path.name))
            for rate in rates
        ]

    return run_stages('absence', {'film': films, 'empty': empties}, only)


def count_film(
    clip: Clip, settings: TrackerSettings, rate: float, seconds: float, offset: float, *, gaps: bool
) -> dict[str, Any]:
    """States of a clip that is played back and forth.

    Args:
        clip: the person is in view in all of it.
        settings: of the tracker.
        rate: images a second, at most the clip's.
        seconds: how long.
        offset: of the first image after the start, as a fraction of the interval.
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
            yield t, clip.images[index], True

    return _counted(clip, settings, film())


def count_empty(clip: Clip, settings: TrackerSettings, rate: float) -> dict[str, Any]:
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
                    image = clip.images[min(round(t / interval), len(clip.images) - 1)]
                else:
                    noisy = background + rng.normal(0.0, sigma, background.shape)
                    image = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
                yield start + t, image, here

    return _counted(clip, settings, film())


def noise_of(clip: Clip) -> float:
    """Standard deviation of the noise of a pixel, grey levels, from two images of a clip."""
    first, second = (clip.images[i].astype(float) for i in (0, 1))
    return float(np.median(np.abs(second - first))) / 0.6745 / np.sqrt(2.0)


def _counted(clip: Clip, settings: TrackerSettings, film: Film) -> dict[str, Any]:
    """Counts of states: of the images of the person, and of the late ones of the empty scene."""
    body = load_body('human37')
    subject = read_subject(clip.subject, body)
    assert clip.background is not None
    tracker = Tracker(body, clip.camera, settings, BackgroundModel.from_image(clip.background))
    tracker.reset(subject)
    person, late = Counter[str](), Counter[str]()
    since, least = None, 1.0
    for t, image, here in film:
        tracker.step(image, subject.stamp_ns + round(1e9 * t))
        if here:
            since = None
            person[tracker.status.value] += 1
            least = min(least, tracker.existence_probability)
        else:
            since = t if since is None else since
            if t - since >= LATE - 1e-6:
                late[tracker.status.value] += 1
    unnoticed = sum(late.values()) - late[Status.NOBODY.value] - late[Status.WAITING.value]
    return {
        'images': sum(person.values()),
        'nobody': person[Status.NOBODY.value],
        'lost': person[Status.LOST.value],
        'tracks': tracker.track_id,
        'least_probability': least,
        'empty': sum(late.values()),
        'unnoticed': unnoticed,
    }


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """Tables of what `measure` has counted, summed over clips and offsets."""
    parts = []
    if 'film' in result:
        head = ['images/s', 'lost seconds', 'images', 'NOBODY', 'LOST', 'new tracks', 'of clips']
        rows = []
        for (rate, gaps), cases in _grouped(result['film'], 'rate', 'gaps').items():
            total = _summed(cases)
            wrong = sorted({x['clip'] for x in cases if x['nobody']})
            numbers = [
                total['images'],
                total['nobody'],
                total['lost'],
                total['tracks'] - len(cases),
            ]
            lost = 'every fourth' if gaps else 'none'
            rows.append([f'{rate:g}', lost, *map(str, numbers), ', '.join(wrong) or '-'])
        parts.append(table([head, *rows], left=2, markdown=markdown))
    if 'empty' in result:
        head = ['images/s', 'images', 'NOBODY', 'empty images', 'not NOBODY', 'of clips']
        rows = []
        for (rate,), cases in _grouped(result['empty'], 'rate').items():
            total = _summed(cases)
            wrong = sorted({x['clip'] for x in cases if x['nobody'] or x['unnoticed']})
            numbers = [total[key] for key in ('images', 'nobody', 'empty', 'unnoticed')]
            rows.append([f'{rate:g}', *map(str, numbers), ', '.join(wrong) or '-'])
        parts.append(table([head, *rows], markdown=markdown))
    return '\n\n'.join(parts)


def _grouped(cases: list[Case], *keys: str) -> dict[tuple[Any, ...], list[Case]]:
    """Cases by the values of some keys, in their order."""
    result: dict[tuple[Any, ...], list[Case]] = {}
    for case in cases:
        result.setdefault(tuple(case[key] for key in keys), []).append(case)
    return result


def _summed(cases: list[Case]) -> Counter[str]:
    result = Counter[str]()
    for case in cases:
        result.update({key: value for key, value in case.items() if type(value) is int})
    return result


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
