"""composites: people from several clips cross in one image; do they keep their identities?

Each person is cut from a clip with the true mask and pasted in order of depth, at least
`LEAST_HEIGHT` px high; while the clip plays, each drifts to the initial position of another. Clips,
positions and directions are drawn from a seed. The detector of the package finds them, and
`replay --people` tracks them, without a background.

same        share of images with at least `LEAST_SEEN` of a person's mask in which the detector
            gives the person the identity that was most frequent in the first second
tracked     the same share for tracks
exchanged   share of these images in which a person has the identity of another person
false       number of identities that match nobody in most of their images
missed      share of the images in stretches of more than a second without a detection
mm          distance of the joints of the heaviest mode from the truth, relative to the pelvis, in
            axes along the line of sight; alone: with only this person pasted
"""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from benchmarks.clips import (
    Clip,
    development_folder,
    index_back_and_forth,
    read_clip,
    rows_at_rate,
    table,
)
from benchmarks.command import benchmark_parser, run_benchmark
from benchmarks.experts import true_masks
from benchmarks.machine import description
from benchmarks.people import tracks_in
from benchmarks.runs import in_processes
from hmt_ros.app.replay.one_bag import replay_bag
from hmt_ros.app.replay.options import ReplayOptions
from hmt_ros.body import Camera
from hmt_ros.detectors.people import PeopleDetector
from hmt_ros.evaluation.pose_scores import EVALUATED_JOINTS
from hmt_ros.experts.pose_encoding import ray_rotations
from hmt_ros.inference.arrays import Array, Image
from hmt_ros.sessions.keypoints_session import detected_people
from msg_tools import BagWriter, RosbagsMessages
from msg_tools.messages.camera_info import camera_info_message
from msg_tools.messages.detections import people_message
from msg_tools.messages.headers import FRAME_ID, SECOND_NS, START_NS
from msg_tools.messages.images import encode_jpeg, jpeg_message

# Clips in which a fixed camera sees the whole person.
CLIPS = (
    'charleston', 'dab', 'drill', 'kick', 'laugh', 'shoot', 'signals', 'traffic', 'turns', 'walk',
    'wander', 'window',
)  # fmt: skip
SIZES = {2: (640, 480), 4: (1280, 720)}
CAMERA_RATE, RATES = 30.0, (30.0, 8.0)
SEEDS, QUICK_RATE = 10, 4.0
FOCAL = 600.0
DURATION, WAIT, END = (
    5.0,
    1.0,
    0.5,
)  # duration of a composite, and times at rest at its start and end, s
LEAST_HEIGHT, MOST_HEIGHT = 150.0, 260.0  # px
LEAST_SEEN = 0.3
# Maximum distance of a trunk from the true one for a match, in heights of the person.
MATCH = 0.2
TRUNK = ('left_shoulder', 'right_shoulder', 'left_hip', 'right_hip')
QUALITY = 90  # JPEG quality


@dataclass(frozen=True, eq=False)
class Shown:
    """A person in a composite.

    Attributes:
        clip: name of the clip.
        joints: (T, J, 3) true positions in the frame of the clip's camera, m.
        pixels: (T, J, 2) true positions in the image, px.
        seen: (T,) visible share of the mask.
        heights: (T,) height of the mask, px.
    """

    clip: str
    joint_names: tuple[str, ...]
    joints: Array
    pixels: Array
    seen: Array
    heights: Array


@dataclass(frozen=True, eq=False)
class Composite:
    """Images of several people.

    Attributes:
        stamps: (T,) timestamps, ns.
        images: (T,) images, BGR.
    """

    camera: Camera
    stamps: list[int]
    images: list[Image]
    people: list[Shown]


def composite(
    folder: Path, seed: int, count: int, rate: float, shown: Sequence[int] | None = None
) -> Composite:
    """A composite of `count` people.

    Args:
        shown: indices of the people to paste; None means all.
    """
    rng = np.random.default_rng([seed, count])
    names = rng.permutation(CLIPS)[:count].tolist()
    width, height = SIZES[count]
    camera = Camera(FOCAL, FOCAL, 0.5 * (width - 1), 0.5 * (height - 1), width, height)
    clips = [read_clip(folder / name) for name in names]
    # Lanes from left to right; each person starts in one and ends in another.
    lanes = (np.arange(count) + 0.5) / count * width
    start, end = rng.permutation(count), rng.permutation(count)
    while (start == end).any():
        end = rng.permutation(count)
    cuts = [_Cut.of(clip, rng, camera) for clip in clips]
    empty = clips[0].background
    assert empty is not None
    background = cv2.resize(empty, (width, round(width * 0.75)))[:height]
    number = round(DURATION * CAMERA_RATE)
    stamps = [START_NS + round(i * SECOND_NS / CAMERA_RATE) for i in range(number)]
    rows = rows_at_rate(stamps, rate)
    chosen = range(count) if shown is None else shown
    order = sorted(chosen, key=lambda i: -cuts[i].depth)
    images, seen = [], np.zeros((count, len(rows)))
    pixels = np.empty((count, len(rows)), dtype=object)
    for column, t in enumerate(rows):
        image, owner = background.copy(), np.full((height, width), -1)
        share = np.clip((t / CAMERA_RATE - WAIT) / (DURATION - WAIT - END), 0.0, 1.0)
        whole = np.zeros(count)
        for i in order:
            at = lanes[start[i]] + share * (lanes[end[i]] - lanes[start[i]])
            whole[i] = cuts[i].paste(image, owner, i, t, at)
            pixels[i, column] = cuts[i].pixels(t, at)
        seen[:, column] = [(owner == i).sum() / max(whole[i], 1.0) for i in range(count)]
        images.append(image)
    people = [
        Shown(
            clips[i].name,
            clips[i].truth.joint_names,
            np.array([cuts[i].joints(t) for t in rows]),
            np.array([*pixels[i]]),
            seen[i],
            np.array([cuts[i].height(t) for t in rows]),
        )
        for i in chosen
    ]
    return Composite(camera, [stamps[i] for i in rows], images, people)


@dataclass(frozen=True, eq=False)
class _Cut:
    """A person cut from a clip, at the scale of the composite."""

    clip: Clip
    masks: list[NDArray[np.uint8]]
    scale: float
    floor: float
    depth: float

    @classmethod
    def of(cls, clip: Clip, rng: np.random.Generator, camera: Camera) -> _Cut:
        masks = true_masks(clip)
        assert masks is not None
        rows = [np.nonzero(x.any(1))[0] for x in masks]
        usual = float(np.median([np.ptp(x) + 1 for x in rows if len(x)]))
        scale = rng.uniform(LEAST_HEIGHT, MOST_HEIGHT) / usual
        scale = max(scale, LEAST_HEIGHT / min(np.ptp(x) + 1 for x in rows if len(x)))
        depth = float(np.median([x[:, 2].mean() for x in clip.truth.joints.values()]))
        depth *= camera.fx / (scale * clip.camera.fx)
        lowest = max(x.max() for x in rows if len(x)) * scale
        floor = min(0.5 * camera.height * (1.0 + 1.4 / depth), camera.height - 4.0) - lowest
        return cls(clip, masks, scale, floor, depth)

    def _row(self, t: int) -> int:
        return index_back_and_forth(t, len(self.clip.images))

    def _shift(self, t: int, at: float) -> Array:
        first = np.nonzero(self.masks[0].any(0))[0]
        return np.array([at - self.scale * 0.5 * (first.min() + first.max()), self.floor])

    def paste(self, image: Image, owner: NDArray[Any], number: int, t: int, at: float) -> float:
        """Pastes the person; returns the area of the mask."""
        row, shape = self._row(t), image.shape[1::-1]
        shift = self._shift(t, at)
        matrix = np.array([[self.scale, 0, shift[0]], [0, self.scale, shift[1]]])
        how = cv2.INTER_AREA if self.scale < 1 else cv2.INTER_LINEAR
        mask = cv2.warpAffine(self.masks[row], matrix, shape, flags=cv2.INTER_NEAREST)
        seen = cv2.warpAffine(self.clip.images[row], matrix, shape, flags=how)
        image[mask > 0] = seen[mask > 0]
        owner[mask > 0] = number
        return float(self.masks[row].sum() * self.scale**2)

    def pixels(self, t: int, at: float) -> Array:
        """True positions (J, 2) of the joints, px."""
        stamp = self.clip.stamps[self._row(t)]
        return self.scale * self.clip.pixels[stamp] + self._shift(t, at)

    def joints(self, t: int) -> Array:
        """True positions (J, 3)."""
        return self.clip.truth.joints[self.clip.stamps[self._row(t)]]

    def height(self, t: int) -> float:
        """Height of the person, px."""
        rows = np.nonzero(self.masks[self._row(t)].any(1))[0]
        return self.scale * float(np.ptp(rows) + 1) if len(rows) else 1.0


# Scores.


def owners_of(made: Composite, places: Sequence[dict[str, Array]]) -> NDArray[Any]:
    """Identity (P, T) of each person in each image; empty if none matches.

    Args:
        places: for each image, the trunks (4, 2) by identity, px.
    """
    result = np.full((len(made.people), len(made.stamps)), '', dtype=object)
    for t, known in enumerate(places):
        costs = np.full((len(made.people), len(known)), np.inf)
        for i, person in enumerate(made.people):
            true = person.pixels[t][[person.joint_names.index(x) for x in TRUNK]]
            for j, trunk in enumerate(known.values()):
                away = np.linalg.norm(trunk - true, axis=1)
                costs[i, j] = np.median(away) / person.heights[t]
        names = [*known]
        rows, columns = linear_sum_assignment(np.minimum(costs, 1.0))
        for i, j in zip(rows, columns, strict=True):
            if costs[i, j] < MATCH:
                result[i, t] = names[j]
    return result


def shares(made: Composite, owners: NDArray[Any]) -> tuple[float, float, list[str]]:
    """Shares of images with a person's own identity and another's, and the own identities."""
    seconds = (np.array(made.stamps) - made.stamps[0]) / SECOND_NS
    seen = np.array([x.seen > LEAST_SEEN for x in made.people])
    own = []
    for row, visible in zip(owners, seen, strict=True):
        first = Counter(x for x in row[visible & (seconds <= WAIT)] if x).most_common(1)
        own.append(first[0][0] if first else '-')
    same = owners == np.array(own, dtype=object)[:, None]
    others = np.array([[x in own for x in row] for row in owners]) & ~same
    return float(same[seen].mean()), float(others[seen].mean()), own


def missed(made: Composite, owners: NDArray[Any]) -> float:
    """Share of the images in stretches of more than a second without a detection."""
    lost = total = 0
    for row, person in zip(owners, made.people, strict=True):
        times = [t for t in range(len(row)) if person.seen[t] > LEAST_SEEN]
        total += len(times)
        stretch: list[int] = []
        for t in [*times, None]:
            if t is not None and not row[t]:
                stretch.append(t)
                continue
            if stretch and made.stamps[stretch[-1]] - made.stamps[stretch[0]] > SECOND_NS:
                lost += len(stretch)
            stretch = []
    return lost / max(total, 1)


def of_composite(work: tuple[int, int, float, bool]) -> dict[str, Any]:
    """Scores of a composite; given are seed, number of people, rate, and whether to track each."""
    seed, count, rate, alone = work
    made = composite(development_folder(), seed, count, rate)
    with tempfile.TemporaryDirectory() as folder:
        found, tracks = tracked(made, Path(folder))
    owners = owners_of(made, found)
    used = Counter(name for image in found for name in image)
    right = Counter(name for name in owners.ravel() if name)
    same, exchanged, _ = shares(made, owners)
    places = [
        {
            name: made.camera.project(joints[stamp][0][[names.index(x) for x in TRUNK]])
            for name, (names, joints) in tracks.items()
            if stamp in joints
        }
        for stamp in made.stamps
    ]
    of_tracks = owners_of(made, places)
    together, _, own = shares(made, of_tracks)
    errors = [
        error(person, made, tracks.get(name)) for person, name in zip(made.people, own, strict=True)
    ]
    result = {
        'people': count,
        'rate': rate,
        'same': same,
        'tracked': together,
        'exchanged': exchanged,
        'false': sum(right[name] < 0.5 * times for name, times in used.items()),
        'missed': missed(made, owners),
        'mm': errors,
    }
    if alone:
        result['alone'] = [_error_alone(seed, count, rate, i) for i in range(count)]
    return result


def _error_alone(seed: int, count: int, rate: float, number: int) -> float:
    made = composite(development_folder(), seed, count, rate, [number])
    with tempfile.TemporaryDirectory() as folder:
        found, tracks = tracked(made, Path(folder))
    _, _, (name,) = shares(made, owners_of(made, found))
    return error(made.people[0], made, tracks.get(name))


def tracked(
    made: Composite, folder: Path
) -> tuple[list[dict[str, Array]], dict[str, tuple[tuple[str, ...], dict[int, Array]]]]:
    """Trunks in each image by detected identity, and tracks, see `tracks_in`."""
    detector, messages = PeopleDetector(max(len(made.people), 2)), RosbagsMessages()
    found = []
    with BagWriter(folder / 'made') as bag:
        for stamp, image in zip(made.stamps, made.images, strict=True):
            people = detector.detect(image, stamp)
            rows = [[x.keypoints.names.index(name) for name in TRUNK] for x in people]
            found.append({x.name: x.keypoints.pixels[row] for x, row in zip(people, rows)})
            jpeg = jpeg_message(messages, encode_jpeg(image, QUALITY), stamp, FRAME_ID)
            bag.write('image/compressed', stamp, jpeg)
            info = camera_info_message(messages, made.camera, stamp, FRAME_ID)
            bag.write('camera_info', stamp, info)
            detections = people_message(messages, detected_people(people), stamp, FRAME_ID)
            bag.write('detections', stamp, detections)
    options = ReplayOptions(quiet=True, people=True, keep_going=True)
    replay_bag(folder / 'made', folder / 'tracked', options, lambda text: None)
    return found, tracks_in(folder / 'tracked')


def error(
    person: Shown, made: Composite, track: tuple[tuple[str, ...], dict[int, Array]] | None
) -> float:
    """Mean distance of the joints of a track from the truth, mm; NaN without a track."""
    if track is None:
        return float('nan')
    names, joints = track
    wanted = ('pelvis', *EVALUATED_JOINTS)
    own, true = ([of.index(x) for x in wanted] for of in (names, person.joint_names))
    away = []
    for t, stamp in enumerate(made.stamps):
        if stamp in joints and person.seen[t] > LEAST_SEEN:
            found, right = joints[stamp][0][own], person.joints[t][true]
            # In axes along the line of sight, because pasting elsewhere does not change the view.
            one, other = ((x - x[:1]) @ ray_rotations(x[:1])[0] for x in (found, right))
            away.append(np.linalg.norm(one[1:] - other[1:], axis=1).mean())
    return 1e3 * float(np.mean(away)) if away else float('nan')


def measure(
    seeds: int = SEEDS, rates: Sequence[float] = RATES, *, quick: bool = False
) -> dict[str, Any]:
    """Scores by number of people and rate.

    Raises:
        FileNotFoundError: the clips are missing.
    """
    if not development_folder().is_dir():
        raise FileNotFoundError(f'{development_folder()}: no such folder (set HMT_SHARED)')
    counts = (2,) if quick else tuple(SIZES)
    work = [
        (seed, count, rate, not quick)
        for count in counts
        for rate in ((QUICK_RATE,) if quick else rates)
        for seed in range(1 if quick else seeds)
    ]
    rows = in_processes(of_composite, work, 1 if quick else 0, 'composites')
    return {'machine': description(), 'rows': rows}


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """Human-readable table."""
    head = [
        'people', 'images a second', 'composites', 'same', 'tracked', 'exchanged', 'false',
        'missed', 'mm', 'mm, alone',
    ]  # fmt: skip
    rows = [head]
    for key in dict.fromkeys((x['people'], x['rate']) for x in result['rows']):
        own = [x for x in result['rows'] if (x['people'], x['rate']) == key]
        means = {
            name: float(np.mean([x[name] for x in own]))
            for name in ('same', 'tracked', 'exchanged', 'false', 'missed')
        }
        errors = np.concatenate([x['mm'] for x in own])
        alone = np.concatenate([x.get('alone', np.full(len(x['mm']), np.nan)) for x in own])
        both = np.isfinite(errors) & np.isfinite(alone) if np.isfinite(alone).any() else errors > 0
        told = f'{alone[both].mean():.0f}' if np.isfinite(alone[both]).all() else '-'
        rows.append(
            [
                str(key[0]),
                f'{key[1]:g}',
                str(len(own)),
                *(f'{100 * means[x]:.1f} %' for x in ('same', 'tracked', 'exchanged')),
                f'{means["false"]:.1f}',
                f'{100 * means["missed"]:.1f} %',
                f'{errors[both].mean():.0f}',
                told,
            ]
        )
    return table(rows, markdown=markdown)


def main(argv: list[str]) -> int:
    """Runs the benchmark."""
    parser = benchmark_parser('composites', __doc__, quick='one composite, 4 images a second')
    parser.add_argument('--seeds', type=int, default=SEEDS, help=f'number of seeds ({SEEDS})')
    parser.add_argument(
        '--rates', type=float, nargs='+', default=RATES, help='images a second (30 8)'
    )
    options = parser.parse_args(argv)
    return run_benchmark(
        'composites',
        lambda: measure(options.seeds, options.rates, quick=options.quick),
        as_text,
        as_json=options.json,
    )
