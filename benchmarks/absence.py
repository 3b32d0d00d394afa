"""absence: whether the tracker misses a visible person or tracks somebody in an empty scene.

Real videos show an empty scene that is then visited. No track is allowed to start while it is
empty; 1 s after the person has left, the state must be NOBODY. With images alone, a box in the
empty scene starts a track, which must end within 1 s.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.clips import read_detections, read_messages, rows_at_rate, table, with_file
from benchmarks.command import benchmark_parser, run_benchmark, told
from benchmarks.machine import description
from benchmarks.runs import IMAGES, INPUTS, KEYPOINTS, keypoints_only
from hmt_ros.body import load_body
from hmt_ros.image.background import BackgroundModel
from hmt_ros.tracking import Status, Tracker, TrackerSettings
from msg_tools.messages.camera_info import camera_from_info
from msg_tools.messages.headers import time_ns
from msg_tools.messages.images import decode_image

RATES = (10.0, 2.7)  # images per second
LATE = 1.0  # maximum time until absence is noticed, s
Case = dict[str, Any]


@dataclass(frozen=True)
class Scene:
    """A real video of a scene that a person visits.

    Attributes:
        name: name of the folder.
        empty: ranges of images, end excluded, without a person.
        whole: ranges of images, end excluded, with the person in full view.
    """

    name: str
    empty: tuple[tuple[int, int], ...]
    whole: tuple[tuple[int, int], ...]


# Annotated by eye. A second person enters `park_walk` after these images.
SCENES = (
    Scene('park_walk', ((0, 33),), ((64, 174),)),
    Scene('leaflet', ((0, 59), (200, 226)), ((72, 190),)),
)


def main(argv: list[str]) -> int:
    """Runs the benchmark."""
    parser = benchmark_parser('absence', __doc__, quick='one video, one rate, images alone')
    parser.add_argument('--clips', type=Path, metavar='DIR', help='folder of the videos')
    parser.add_argument(
        '--rates', nargs='+', type=float, default=RATES, metavar='HZ', help='images a second'
    )
    parser.add_argument('--inputs', nargs='+', choices=INPUTS, default=INPUTS)
    options = parser.parse_args(argv)
    return run_benchmark(
        'absence',
        lambda: measure(options.clips, options.rates, options.inputs, quick=options.quick),
        as_text,
        as_json=options.json,
    )


def measure(
    clips: Path | None = None,
    rates: Sequence[float] = RATES,
    inputs: Sequence[str] = INPUTS,
    *,
    quick: bool = False,
) -> dict[str, Any]:
    """Counts of wrong states by inputs, video and rate.

    Args:
        clips: folder of the videos; None means that of the development data.
        rates: image rates, Hz.
        inputs: inputs of the tracker, some of `INPUTS`.
        quick: one video, one rate, images alone.

    Raises:
        FileNotFoundError: the videos are missing.
    """
    scenes = SCENES
    if quick:
        scenes, rates, inputs = SCENES[:1], rates[-1:], (IMAGES,)
    folders = with_file([scene.name for scene in scenes], clips, 'keypoints_mediapipe.npz')
    cases = [
        {'inputs': given, 'clip': scene.name, 'rate': rate}
        | count_scene(folder, scene, rate, inputs=given)
        for folder, scene in told('absence', zip(folders, scenes, strict=True), lambda x: x[1].name)
        for given in inputs
        for rate in rates
    ]
    return {'machine': description(), 'scenes': cases}


def count_scene(folder: Path, scene: Scene, rate: float, *, inputs: str = IMAGES) -> Case:
    """Counts the states in a real video of a scene that is empty at first."""
    info, messages = read_messages(folder)
    stamps = [time_ns(message.header.stamp) for message in messages]
    first = decode_image(messages[0])
    height, width = first.shape[:2]
    body = load_body('human37')
    seen = {} if inputs == IMAGES else read_detections(folder).keypoints
    camera = camera_from_info(info, (width, height))
    if inputs == IMAGES:
        tracker = Tracker(body, camera, background=BackgroundModel.from_image(first))
        tracker.reset(box=(2 * width // 5, height // 10, 3 * width // 5, 9 * height // 10))
    else:
        settings = TrackerSettings()
        tracker = Tracker(
            body, camera, keypoints_only(settings) if inputs == KEYPOINTS else settings
        )
    counts = Counts(tracks=1 if inputs == IMAGES else 0)
    last = max(end for _, end in (*scene.empty, *scene.whole))
    for i in rows_at_rate(stamps[:last], rate):
        tracker.step(decode_image(messages[i]), stamps[i], seen.get(stamps[i]))
        empty = any(start <= i < end for start, end in scene.empty)
        whole = any(start <= i < end for start, end in scene.whole)
        counts.add(tracker, 1e-9 * stamps[i], here=whole, empty=empty)
    return counts.result()


class Counts:
    """Counts of states in images of the person, and in late images of the empty scene.

    Args:
        tracks: number of tracks started on purpose.
    """

    def __init__(self, tracks: int = 0) -> None:
        self._person, self._late = Counter[str](), Counter[str]()
        self._since: float | None = None
        self._tracks, self._started = tracks, 0

    def add(self, tracker: Tracker, t: float, *, here: bool, empty: bool) -> None:
        """Counts the state at time t, s, given whether the person is in view or the scene empty."""
        if empty:
            self._started += max(tracker.track_id - self._tracks, 0)
        self._tracks = max(tracker.track_id, self._tracks)
        if here:
            self._person[tracker.estimate.status.value] += 1
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
            'empty': late.total(),
            'unnoticed': unnoticed,
            'started': self._started,
        }


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """Human-readable table of the counts, summed over the videos."""
    kinds: dict[tuple[str, float], list[Case]] = {}
    for case in result['scenes']:
        kinds.setdefault((case['inputs'], case['rate']), []).append(case)
    rows = [
        [
            'inputs',
            'images/s',
            'videos',
            'images',
            'NOBODY',
            'empty images',
            'not NOBODY',
            'tracks of nobody',
        ]
    ]
    for (inputs, rate), cases in kinds.items():
        keys = ('images', 'nobody', 'empty', 'unnoticed', 'started')
        numbers = [len(cases), *(sum(case[key] for case in cases) for key in keys)]
        rows.append([inputs, f'{rate:g}', *map(str, numbers)])
    return table(rows, left=2, markdown=markdown)
