"""Clips with known truth: a bag of images, and beside it subject file, empty scene and truth."""

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

# Joints that the detector and our bodies share.
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
        folder: where the files are.
        camera: that saw it.
        stamps: (T,) ns.
        images: (T,) BGR.
        truth: where the joints were.
        pixels: stamp -> (J, 2) true image positions of the joints of `truth`.
        background: the empty scene; None: the camera moves.
        views: stamp -> true rotation (3, 3) and position (3,) of a camera that moves, in the world,
            m; they stand for odometry. Empty: it stands still, or the clip does not tell.
        ups: stamp -> (3,) true unit vector against gravity, camera frame; empty: the clip does not
            tell it.
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
        """Of the clip."""
        return self.folder.name

    @property
    def subject(self) -> Path:
        """The subject file."""
        return self.folder / 'subject.yaml'


def at_rate(clip: Clip, rate: float) -> Clip:
    """A clip whose images come at a lower rate: some are left out.

    Args:
        clip: with all its images.
        rate: images a second at most; see `rows_at_rate`.
    """
    rows = rows_at_rate(clip.stamps, rate)
    return replace(
        clip, stamps=[clip.stamps[i] for i in rows], images=[clip.images[i] for i in rows]
    )


def rows_at_rate(stamps: Sequence[int], rate: float) -> list[int]:
    """Rows of the images that are kept at a lower rate; the first image is always kept.

    An image is kept when it comes 1 / rate after the last kept one, or at most half the interval
    between two images earlier.

    Args:
        stamps: (T,) of the images, ns.
        rate: images a second; 0, or one that is not below that of the images: all are kept.
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
    """Index of what is shown as the number-th, of so many that are shown to the end and back."""
    turn = max(2 * count - 2, 1)
    return min(number % turn, turn - number % turn)


def find_clips(
    folder: Path | None, *, moving: bool = False, quick: bool = False
) -> tuple[list[Path], str]:
    """Folders of clips with truth, and where they come from.

    Args:
        folder: that holds the clips; None: the development data, and where that is absent the
            bags of this repository.
        moving: whether those are wanted too that have no image of the empty scene.
        quick: whether, without a folder, one short clip of this repository is enough.

    Raises:
        ValueError: no clip is there.
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
    """Where the development clips are, if they are there."""
    return Path(os.environ.get('HMT_SHARED', ROOT / '..' / 'shared')) / 'video'


def with_file(names: Sequence[str], clips: Path | None, file: str) -> list[Path]:
    """Folders of clips that a benchmark can not do without.

    Args:
        names: of the clips.
        clips: folder that holds them; None: the development clips.
        file: that each must have.

    Raises:
        FileNotFoundError: a clip is not there, or lacks the file.
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
    """Calibration and images of a clip as they are in its bag, or the first of them.

    Raises:
        ValueError: a bag that can not be read, or with no such topics.
    """
    with BagReader(folder) as bag:
        # Beside the images there may be depths.
        named = [name for name, topic in bag.topics.items() if topic.msgtype in kinds]
        pictures = [name for name in named if name.strip('/') != DEPTH]
        topic = bag.find_topic(kinds, pictures[0] if len(pictures) == 1 else None).name
        info = next(bag.messages([bag.find_topic(['sensor_msgs/msg/CameraInfo']).name])).message
        return info, [stored.message for stored in islice(bag.messages([topic]), frames)]


def read_clip(folder: Path, frames: int | None = None) -> Clip:
    """Reads a clip, or its first frames, from a bag, or from a video with its camera.

    Raises:
        ValueError: files that can not be read, or that do not fit each other.
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
    """Truth that lacks some joints of some images: they are NaN."""

    def __post_init__(self) -> None:
        """Nothing is checked."""


def _bag(folder: Path, frames: int | None) -> Content:
    info, messages = read_messages(folder, frames=frames)
    images = [decode_image(message) for message in messages]
    camera = camera_from_info(info, _size(images[0]))
    stamps = [time_ns(message.header.stamp) for message in messages]
    return camera, stamps, images, read_truth(folder / 'truth.npz')


def _video(folder: Path, frames: int | None) -> Content:
    """`NAME.mp4` and `camera.yaml`, each image at the stamp of the truth's row."""
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
    """What a detector says of a clip, from `keypoints_mediapipe.npz`.

    Attributes:
        keypoints: by stamp, of the joints that our bodies have.
        names: (J,) joints of its own 3D poses.
        joints: by stamp, (J, 3) m, its own 3D pose relative to the middle of the hips; the axes are
            those of the camera.
    """

    keypoints: dict[int, Keypoints]
    names: tuple[str, ...]
    joints: dict[int, NDArray[np.float64]]


# Landmarks of the detector in its order, for files without their names.
_FACE = (
    'nose', 'left_eye_inner', 'left_eye', 'left_eye_outer', 'right_eye_inner', 'right_eye',
    'right_eye_outer', 'left_ear', 'right_ear', 'mouth_left', 'mouth_right',
)  # fmt: skip
_OF_SIDES = (
    'shoulder', 'elbow', 'wrist', 'pinky', 'index', 'thumb', 'hip', 'knee', 'ankle', 'heel',
    'foot_index',
)  # fmt: skip
LANDMARK_NAMES = (*_FACE, *(f'{side}_{x}' for x in _OF_SIDES for side in ('left', 'right')))
# Landmarks of the detector that have other names than our joints.
LANDMARKS = {'left_foot_index': 'left_toe', 'right_foot_index': 'right_toe'}
SCHEME = 'mediapipe33'


def read_detections(folder: Path, *, lifted: bool = True) -> Detections:
    """Reads the detector's keypoints of a clip.

    Raises:
        ValueError: none are there, or they can not be read.
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
    """A table whose first row is its head; so many columns are aligned to the left."""
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
    """Numbers of a report with four digits that mean something."""
    if isinstance(value, dict):
        return {key: rounded(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [rounded(entry) for entry in value]
    if isinstance(value, (float, np.floating)):
        return float(f'{value:.4g}')
    return value
