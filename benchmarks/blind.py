"""Answers for a person in view without subject file, empty scene or detector.

Every clip with a pelvis in its truth is played back and forth to filter and experts as in `replay`;
the person is in view from the first image.

blind      images only
still      images only; at first the person stands still for 2 s
subject    with a subject file
visit      the empty scene is visible for the first 2 s
detector   with the keypoints of MediaPipe

    nobody     number of images with the answer NOBODY
    missed     number of images with the answer TRACKING or LOST and a joint outside the keep-out
               space
    off        number of images with the answer TRACKING in which the distance of the pelvis is
               wrong by more than 15 %
    tracking   share of TRACKING in the images later than 1 s after the start
    error      error of the heaviest mode's joints relative to the pelvis, while TRACKING
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.clips import (
    LANDMARK_NAMES,
    Clip,
    find_clips,
    index_back_and_forth,
    read_clip,
    read_messages,
    table,
)
from benchmarks.command import add_choice, benchmark_parser, run_benchmark
from benchmarks.machine import description
from benchmarks.runs import in_processes
from hmt_ros.app.replay.options import NodeParameters
from hmt_ros.app.replay.tracks import OfflineTrack
from hmt_ros.body.keep_out import Capsules
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.sessions.bme_parameters import BmeParameters
from hmt_ros.sessions.camera_session import CAMERA_INFO, IMAGE
from hmt_ros.sessions.image_inputs import KEYPOINTS
from hmt_ros.sessions.track_messages import TOPICS
from hmt_ros.sessions.tracking_parameters import FilterParameters
from msg_tools import RosbagsMessages
from msg_tools.files.array_file import read_archive
from msg_tools.messages.cdr import deserialise
from msg_tools.messages.headers import SECOND_NS, time_ns
from msg_tools.messages.images import image_message
from msg_tools.messages.keep_out import KeepOutState, keep_out_of
from msg_tools.messages.keypoints import keypoints_message, keypoints_of

RATES = (15.0, 8.0, 2.0, 0.5)  # images per second
IMAGES, QUICK = 30, 12  # number of images of a run
BEFORE, LATE, FAR = 2.0, 1.0, 0.15  # see the text above; s, s, share
BLIND, STILL, SUBJECT, VISIT, DETECTOR = CASES = ('blind', 'still', 'subject', 'visit', 'detector')
NOISE = 2.0  # noise of a scene shown before the clip, grey levels
_FRAME = 'camera_optical_frame'
_SAID = ('keep_out', 'pose_mixture')


class Work(NamedTuple):
    """A clip, the case, the rate in images per second, and the number of images."""

    folder: Path
    case: str
    rate: float
    images: int = IMAGES


class Answer(NamedTuple):
    """Answer for an image of the clip.

    Attributes:
        time: time since the first image, s.
        state: state of the keep-out space.
        missed: whether a true joint lies outside the keep-out space.
        off: relative error of the distance of the pelvis; NaN without a pose.
        error: mean error of the heaviest mode's joints relative to the pelvis, m; NaN without pose.
        existence: probability that a person is present; NaN if unknown.
    """

    time: float
    state: KeepOutState
    missed: bool
    off: float
    error: float
    existence: float


def answers_of(work: Work) -> list[Answer]:
    """Answers of filter and experts for the images of a clip.

    Raises:
        ValueError: the clip can not be read, or lacks what the case needs.
    """
    clip, messages = read_clip(work.folder), RosbagsMessages()
    given: dict[str, Any] = {}
    if work.case == SUBJECT:
        given['subject_file'] = str(clip.subject)
    if work.case == DETECTOR:
        given['use_keypoints'] = True
    keypoints = _keypoints_of(clip) if work.case == DETECTOR else {}
    predicting = None if given else BmeParameters()
    filtering = FilterParameters(use_predictions=predicting is not None, **given)
    said: dict[str, Any] = {}

    def write(topic: str, _: int, data: bytes) -> None:
        if topic in _SAID:
            said[topic] = deserialise(data, TOPICS[topic].msgtype)

    track = OfflineTrack(NodeParameters(filtering, None, predicting), write)
    track.take(CAMERA_INFO, read_messages(work.folder, frames=1)[0])
    start = clip.stamps[0]
    for i, image in enumerate(_shown_before(clip, work)):
        stamp = start - round((BEFORE + 1e-3 - i / work.rate) * SECOND_NS)
        track.take(IMAGE, image_message(messages, image, stamp, _FRAME))
    answers = []
    every = SECOND_NS * (len(clip.stamps) - 1) / (clip.stamps[-1] - clip.stamps[0]) / work.rate
    for i in range(work.images):
        index = index_back_and_forth(round(i * every), len(clip.stamps))
        stamp, seen = start + round(i * SECOND_NS / work.rate), clip.stamps[index]
        said.clear()
        if keypoints:
            track.take(KEYPOINTS, keypoints_message(messages, keypoints[seen], stamp, _FRAME))
        track.take(IMAGE, image_message(messages, clip.images[index], stamp, _FRAME))
        joints = clip.truth.joints.get(seen)
        if 'keep_out' in said and joints is not None:
            true = dict(zip(clip.truth.joint_names, joints, strict=True))
            answers.append(_answer(said, i / work.rate, true))
    return answers


def _keypoints_of(clip: Clip) -> dict[int, Keypoints]:
    """Keypoints by timestamp, from a file or otherwise from the bag."""
    file = clip.folder / 'keypoints_mediapipe.npz'
    if file.is_file():
        content = read_archive(file)
        names = tuple(str(x) for x in content.get('landmark_names', LANDMARK_NAMES))
        unknown = np.full((len(names), 2, 2), np.nan)
        rows = zip(content['pixels'].astype(float), content['visibility'], strict=True)
        seen = [Keypoints(names, p, unknown, np.nan_to_num(v.astype(float))) for p, v in rows]
        return dict(zip(map(int, content['stamps']), seen, strict=True))
    _, stored = read_messages(clip.folder, ('hmt_msgs/msg/Keypoints2D',))
    return {time_ns(one.header.stamp): keypoints_of(one, 0.0) for one in stored}


def _shown_before(clip: Clip, work: Work) -> list[NDArray[np.uint8]]:
    """Images for the 2 s before the first one of the clip."""
    scenes = {STILL: clip.images[0], VISIT: clip.background}
    scene = scenes.get(work.case)
    if scene is None:
        return []
    rng, count = np.random.default_rng(0), max(round(BEFORE * work.rate), 4)
    noisy = (scene + rng.normal(0.0, NOISE, scene.shape) for _ in range(count))
    return [np.clip(image, 0, 255).astype(np.uint8) for image in noisy]


def _answer(said: dict[str, Any], time: float, true: dict[str, NDArray[np.float64]]) -> Answer:
    space, off, error = keep_out_of(said['keep_out']), np.nan, np.nan
    held = Capsules(space.starts, space.ends, space.radii)
    known = np.array([joint for joint in true.values() if np.isfinite(joint).all()])
    missed = len(space.radii) > 0 and not bool(held.contain(known).all())
    mixture = said.get('pose_mixture')
    if mixture is not None and len(mixture.components):
        places = mixture.components[0].joint_positions
        own = {
            name: np.array([p.x, p.y, p.z])
            for name, p in zip(mixture.joint_names, places, strict=True)
        }
        distances = [np.linalg.norm(joints['pelvis']) for joints in (own, true)]
        off = abs(float(distances[0] / distances[1]) - 1.0)
        relative = [own[x] - own['pelvis'] - true[x] + true['pelvis'] for x in true if x in own]
        error = float(np.nanmean(np.linalg.norm(relative, axis=1)))
    return Answer(time, space.state, missed, off, error, space.existence_probability)


def measure(
    clips: Path | None = None,
    cases: tuple[str, ...] = CASES,
    rates: tuple[float, ...] = RATES,
    *,
    quick: bool = False,
) -> dict[str, Any]:
    """Counts over all clips, by case and rate.

    Raises:
        ValueError: there are no clips, or one can not be read.
    """
    folders, source = find_clips(clips, moving=True, quick=quick)
    if clips is None and not quick:
        folders += [x for x in find_clips(Path('bags'))[0] if x not in folders]
    folders = [x for x in folders if 'pelvis' in read_clip(x, 1).truth.joint_names]
    if quick:
        folders, rates = folders[:1], rates[:1]
    work = [
        Work(folder, case, rate, QUICK if quick else IMAGES)
        for case in cases for rate in rates for folder in folders
        if not (case == VISIT and not (folder / 'background.png').is_file())
        and not (case == DETECTOR and not _has_keypoints(folder))
    ]  # fmt: skip
    found = in_processes(answers_of, work, 1 if quick else 0, 'blind')
    rows = []
    for case in cases:
        for rate in rates:
            own = [x for one, x in zip(work, found, strict=True) if one[1:3] == (case, rate)]
            if own:
                rows.append({'case': case, 'rate': rate, **_counted([y for x in own for y in x])})
    return {'machine': description(), 'source': source, 'rows': rows}


def _has_keypoints(folder: Path) -> bool:
    return (folder / 'keypoints_mediapipe.npz').is_file() or folder.name == 'living_room'


def _counted(answers: list[Answer]) -> dict[str, Any]:
    tracking = [x for x in answers if x.state is KeepOutState.TRACKING]
    told = [x for x in answers if x.state in (KeepOutState.TRACKING, KeepOutState.LOST)]
    late = [x for x in answers if x.time > LATE]
    return {
        'images': len(answers),
        'nobody': sum(x.state is KeepOutState.NOBODY for x in answers),
        'told': len(told),
        'missed': sum(x.missed for x in told),
        'tracking': len(tracking),
        'off': sum(x.off > FAR for x in tracking),
        'share': sum(x.state is KeepOutState.TRACKING for x in late) / max(len(late), 1),
        'error_mm': 1e3 * float(np.mean([x.error for x in tracking])) if tracking else np.nan,
    }


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """Human-readable table."""
    head = ['case', 'images a second', 'nobody', 'missed', 'off', 'tracking', 'error, mm']
    rows = [
        [
            one['case'],
            f'{one["rate"]:g}',
            f'{one["nobody"]} of {one["images"]}',
            f'{one["missed"]} of {one["told"]}',
            f'{one["off"]} of {one["tracking"]}',
            f'{100 * one["share"]:.0f} %',
            f'{one["error_mm"]:.0f}' if one['tracking'] else '-',
        ]
        for one in result['rows']
    ]
    return table([head, *rows], markdown=markdown)


def main(argv: list[str]) -> int:
    """Runs the benchmark."""
    parser = benchmark_parser('blind', __doc__, quick=f'{QUICK} images of one clip')
    add_choice(parser, CASES, 'CASE')
    parser.add_argument('--clips', type=Path, help='folder of the clips')
    parser.add_argument('--rates', type=float, nargs='+', default=RATES, help='images a second')
    options = parser.parse_args(argv)
    return run_benchmark(
        'blind',
        lambda: measure(
            options.clips, tuple(options.only), tuple(options.rates), quick=options.quick
        ),
        as_text,
        as_json=options.json,
    )
