"""Clips with known truth: a bag of images, with subject file, empty scene and truth."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hmt_ros.app.import_video.frames import Selection, open_source
from hmt_ros.app.truth import read_truth
from hmt_ros.body import Camera, load_body
from hmt_ros.evaluation.track_scores import Truth
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.sessions.camera_file import read_camera
from hmt_ros.sessions.image_inputs import DEPTH
from msg_tools import BagReader
from msg_tools.files.array_file import read_archive
from msg_tools.messages.camera_info import camera_from_info
from msg_tools.messages.headers import time_ns
from msg_tools.messages.images import decode_image

# Joints that the detector and the body models share.
JOINTS_OF_DETECTOR = tuple(
    f'{side}_{name}'
    for name in ('shoulder', 'elbow', 'wrist', 'hip', 'knee', 'ankle', 'toe')
    for side in ('left', 'right')
)
ROOT = Path(__file__).resolve().parents[1]
COMPRESSED = 'sensor_msgs/msg/CompressedImage'
IMAGES = (COMPRESSED, 'sensor_msgs/msg/Image')


@dataclass(frozen=True, eq=False)
class Clip:
    """Images of one person.

    Attributes:
        folder: folder of the files.
        camera: camera of the images.
        stamps: (T,) timestamps, ns.
        images: (T,) images, BGR.
        truth: true positions of the joints.
        pixels: timestamp -> (J, 2) true image positions of the joints of `truth`.
        background: image of the empty scene; None if the camera moves.
        views: timestamp -> true rotation (3, 3) and position (3,) of a moving camera in the world,
            m, in the role of odometry. Empty if the camera is fixed or its motion unknown.
        ups: timestamp -> (3,) true unit vector against gravity, camera frame; empty if unknown.
    """

    folder: Path
    camera: Camera
    stamps: list[int]
    images: list[NDArray[np.uint8]]
    truth: Truth
    pixels: dict[int, NDArray[np.float64]]
    background: NDArray[np.uint8] | None
    views: dict[int, tuple[NDArray[np.float64], NDArray[np.float64]]] = field(default_factory=dict)
    ups: dict[int, NDArray[np.float64]] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Name of the clip."""
        return self.folder.name

    @property
    def subject(self) -> Path:
        """The subject file."""
        return self.folder / 'subject.yaml'


def at_rate(clip: Clip, rate: float) -> Clip:
    """A clip at a lower rate, with some images left out.

    Args:
        clip: clip with all its images.
        rate: maximum number of images per second; see `rows_at_rate`.
    """
    rows = rows_at_rate(clip.stamps, rate)
    return replace(
        clip, stamps=[clip.stamps[i] for i in rows], images=[clip.images[i] for i in rows]
    )


def rows_at_rate(stamps: Sequence[int], rate: float) -> list[int]:
    """Indices of the images kept at a lower rate; the first image is always kept.

    An image is kept if it is 1 / rate after the last kept one, or earlier by at most half the
    interval between two images.

    Args:
        stamps: (T,) timestamps of the images, ns.
        rate: images per second; 0, or a rate not below that of the images, keeps all.
    """
    if rate <= 0 or len(stamps) < 2:
        return list(range(len(stamps)))
    least = 1e9 / rate - 0.5 * float(np.median(np.diff(stamps)))
    rows = [0]
    for i in range(1, len(stamps)):
        if stamps[i] - stamps[rows[-1]] >= least:
            rows.append(i)
    return rows


def index_back_and_forth(number: int, count: int) -> int:
    """Index of the number-th shown item, if `count` items are shown back and forth."""
    turn = max(2 * count - 2, 1)
    return min(number % turn, turn - number % turn)


def find_clips(
    folder: Path | None, *, moving: bool = False, quick: bool = False
) -> tuple[list[Path], str]:
    """Folders of clips with truth, and a description of their source.

    Args:
        folder: folder of the clips; None means the development data or, if missing, the bags of
            this repository.
        moving: whether to include clips without an image of the empty scene.
        quick: whether one short clip of this repository is enough if no folder is given.

    Raises:
        ValueError: no clip was found.
    """
    if folder is not None:
        return _clips_in(folder, moving), str(folder)
    if quick:
        return [ROOT / 'bags' / 'reach'], 'bags/reach'
    shared = development_folder()
    if shared.is_dir():
        return _clips_in(shared, moving), 'development clips'
    source = f'bags/ of the repository, as {shared.resolve()} is absent'
    return _clips_in(ROOT / 'bags', moving), source


def development_folder() -> Path:
    """Folder of the development clips, which may be missing."""
    return Path(os.environ.get('HMT_SHARED', ROOT / '..' / 'shared')) / 'video'


def with_file(names: Sequence[str], clips: Path | None, file: str) -> list[Path]:
    """Folders of clips that a benchmark requires.

    Args:
        names: names of the clips.
        clips: folder of the clips; None means the development clips.
        file: name of a file that each must have.

    Raises:
        FileNotFoundError: a clip is missing or lacks the file.
    """
    folder = clips or development_folder()
    lacking = [name for name in names if not (folder / name / file).is_file()]
    if lacking:
        raise FileNotFoundError(
            f'{folder} lacks {file} of {", ".join(lacking)} (set HMT_SHARED, or --clips)'
        )
    return [folder / name for name in names]


def _clips_in(folder: Path, moving: bool) -> list[Path]:
    wanted = ['metadata.yaml', 'truth.npz', 'subject.yaml', 'background.png'][: 3 if moving else 4]
    found = [
        path
        for path in (sorted(folder.iterdir()) if folder.is_dir() else [])
        if all((path / name).is_file() for name in wanted)
    ]
    if not found:
        raise ValueError(f'{folder} has no folder with {", ".join(wanted)}')
    return found


def read_messages(
    folder: Path, kinds: Sequence[str] = IMAGES, frames: int | None = None
) -> tuple[Any, list[Any]]:
    """Calibration and image messages in the bag of a clip, or its first `frames` images.

    Raises:
        ValueError: the bag can not be read or lacks these topics.
    """
    with BagReader(folder) as bag:
        # The bag may also contain depth images.
        named = [name for name, topic in bag.topics.items() if topic.msgtype in kinds]
        pictures = [name for name in named if name.strip('/') != DEPTH]
        topic = bag.find_topic(kinds, pictures[0] if len(pictures) == 1 else None).name
        info = next(bag.messages([bag.find_topic(['sensor_msgs/msg/CameraInfo']).name])).message
        return info, [stored.message for stored in islice(bag.messages([topic]), frames)]


def read_clip(folder: Path, frames: int | None = None) -> Clip:
    """Reads a clip, or its first frames, from a bag, or from a video with its camera.

    Raises:
        ValueError: files can not be read or are inconsistent.
    """
    of_video = not (folder / 'metadata.yaml').is_file()
    camera, stamps, images, truth = (_video if of_video else _bag)(folder, frames)
    background, empty = None, folder / 'background.png'
    if empty.is_file() and (background := cv2.imread(str(empty))) is None:
        raise ValueError(f'{empty} is no image')
    with np.load(folder / 'truth.npz') as content:
        pixels = dict(zip(map(int, content['stamps']), np.array(content['pixels']), strict=True))
        ups = {stamp: ground.up for stamp, ground in truth.ground.items()}
        if 'up' in content:
            ups = dict.fromkeys(pixels, np.array(content['up']))
        views = {}
        if background is None and 'camera_quaternion' in content:
            turns = Rotation.from_quat(content['camera_quaternion']).as_matrix()
            views = dict(
                zip(pixels, zip(turns, content['camera_position'], strict=True), strict=True)
            )
    return Clip(
        folder,
        camera,
        stamps,
        images,
        truth,
        pixels,
        None if background is None else np.asarray(background, dtype=np.uint8),
        views=views,
        ups=ups,
    )


Content = tuple[Camera, list[int], list[NDArray[np.uint8]], Truth]


class PartialTruth(Truth):
    """Truth in which joints may be missing in some images, as NaN."""

    def __post_init__(self) -> None:
        """Skips all checks."""


def _bag(folder: Path, frames: int | None) -> Content:
    info, messages = read_messages(folder, frames=frames)
    images = [decode_image(message) for message in messages]
    camera = camera_from_info(info, _size(images[0]))
    stamps = [time_ns(message.header.stamp) for message in messages]
    return camera, stamps, images, read_truth(folder / 'truth.npz')


def _video(folder: Path, frames: int | None) -> Content:
    """Reads `NAME.mp4` and `camera.yaml`; images get the timestamps of the truth's rows."""
    with np.load(folder / 'truth.npz') as content:
        stamps, fps = content['stamps'].tolist()[:frames], float(content['fps'])
        names, joints = content['joint_names'], content['joints'].astype(np.float64)
    shown = open_source(folder / f'{folder.name}.mp4', fps).frames(Selection())
    images = [one.image for one in islice(shown, len(stamps))]
    if len(images) < len(stamps):
        raise ValueError(f'{folder} has {len(images)} images, and a truth of {len(stamps)}')
    by_stamp = dict(zip(stamps, joints, strict=False))
    truth = PartialTruth(folder.name, tuple(map(str, names)), by_stamp)
    return read_camera(folder / 'camera.yaml', _size(images[0])), stamps, images, truth


def _size(image: NDArray[np.uint8]) -> tuple[int, int]:
    height, width = image.shape[:2]
    return width, height


@dataclass(frozen=True, eq=False)
class Detections:
    """Detections of a clip, from `keypoints_mediapipe.npz`.

    Attributes:
        keypoints: keypoints by timestamp, of the joints in the body models.
        names: (J,) joints of the detector's own 3D poses.
        joints: the detector's own 3D pose (J, 3) by timestamp, relative to the middle of the hips,
            in camera axes, m.
    """

    keypoints: dict[int, Keypoints]
    names: tuple[str, ...]
    joints: dict[int, NDArray[np.float64]]


# Landmarks in the detector's order, for files without names.
_FACE = (
    'nose', 'left_eye_inner', 'left_eye', 'left_eye_outer', 'right_eye_inner', 'right_eye',
    'right_eye_outer', 'left_ear', 'right_ear', 'mouth_left', 'mouth_right',
)  # fmt: skip
_OF_SIDES = (
    'shoulder', 'elbow', 'wrist', 'pinky', 'index', 'thumb', 'hip', 'knee', 'ankle', 'heel',
    'foot_index',
)  # fmt: skip
LANDMARK_NAMES = (*_FACE, *(f'{side}_{x}' for x in _OF_SIDES for side in ('left', 'right')))
# Landmarks of the detector with other names in the body models.
LANDMARKS = {'left_foot_index': 'left_toe', 'right_foot_index': 'right_toe'}
SCHEME = 'mediapipe33'


def read_detections(folder: Path, *, lifted: bool = True) -> Detections:
    """Reads the detector's keypoints of a clip.

    Raises:
        ValueError: the keypoints are missing or can not be read.
    """
    try:
        content = read_archive(folder / 'keypoints_mediapipe.npz')
    except OSError as error:
        raise ValueError(f'{folder} has no keypoints_mediapipe.npz ({error.strerror})') from error
    given = tuple(str(name) for name in content.get('landmark_names', LANDMARK_NAMES))
    names = [LANDMARKS.get(name, name) for name in given]
    known = [i for i, name in enumerate(names) if name in JOINTS_OF_DETECTOR]
    own = tuple(names[i] for i in known)
    stamps, found = [int(x) for x in content['stamps']], content['detected'].astype(bool)
    unknown, body = np.full((len(given), 2, 2), np.nan), load_body('human37')
    keypoints, joints = {}, {}
    for t, stamp in enumerate(stamps):
        confidences = np.nan_to_num(content['visibility'][t].astype(float))
        pixels, world = (content[key][t].astype(float) for key in ('pixels', 'world'))
        every = Keypoints(given, pixels, unknown, confidences, world if lifted else None)
        keypoints[stamp] = every.named_for(body, SCHEME)[0]
        if found[t]:
            joints[stamp] = world[known]
    return Detections(keypoints, own, joints)


def table(rows: list[list[str]], *, left: int = 1, markdown: bool = False) -> str:
    """A table as text; the first row is its head, and the first `left` columns are left-aligned."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]

    def line(cells: list[str], separator: str) -> str:
        aligned = [
            cell.ljust(width) if i < left else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(cells, widths, strict=True))
        ]
        return separator.join(aligned)

    if not markdown:
        return '\n'.join(line(row, '  ').rstrip() for row in rows)
    rule = ['-' * width if i < left else '-' * (width - 1) + ':' for i, width in enumerate(widths)]
    return '\n'.join(f'| {line(row, " | ")} |' for row in [rows[0], rule, *rows[1:]])


def rounded(value: Any) -> Any:
    """The numbers of a report, rounded to four significant digits."""
    if isinstance(value, dict):
        return {key: rounded(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [rounded(entry) for entry in value]
    if isinstance(value, (float, np.floating)):
        return float(f'{value:.4g}')
    return value
