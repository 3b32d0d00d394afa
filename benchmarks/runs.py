"""Runs of the tracker over clips, in parallel processes and cached until the code changes.

A run is defined by a clip, inputs, a seed and changed settings. Its results are stored as arrays in
`build/benchmarks/tracking`, under a name that depends on the run, the code and the clip, so that an
interrupted benchmark continues where it stopped. A small JSON file next to each record identifies
the run, so that records of another checkout can be compared (`records_of`).
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import sys
import time
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import MISSING, asdict, dataclass, field, fields, is_dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from benchmarks.clips import ROOT, Clip, at_rate, read_clip, read_detections
from hmt_ros.app.progress import show_progress
from hmt_ros.body import Body, load_body
from hmt_ros.evaluation.pose_scores import (
    EVALUATED_JOINTS,
    ORIGIN,
    joint_mixtures,
    marginal_regions,
    origin_joints,
    score,
)
from hmt_ros.image.background import BackgroundModel
from hmt_ros.image.likelihood import OFF
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.image.terms.registry import TERMS
from hmt_ros.inference import GaussianMixture
from hmt_ros.tracking import (
    Lagged,
    LaggedWeights,
    Tracker,
    TrackerSettings,
    read_subject,
)
from hmt_ros.tracking.laplace_approximation import Likelihood
from msg_tools.files.new_folder import new_file

Item = TypeVar('Item')
Result = TypeVar('Result')
IMAGES, BOTH, KEYPOINTS = 'images', 'images + keypoints', 'keypoints'
INPUTS = (IMAGES, BOTH, KEYPOINTS)
SUBJECT = 'subject'
STARTS = (SUBJECT, KEYPOINTS)
UNKNOWN, GIVEN = 'unknown', 'given'
GRAVITIES = (UNKNOWN, GIVEN)
KEPT = ROOT / 'build' / 'benchmarks' / 'tracking'
# Joints of a record: the origin, then the scored joints.
JOINTS = (ORIGIN, *EVALUATED_JOINTS)
# Frame rate of most clips, Hz.
USUAL_RATE = 30.0
# Number of images for the warm-up.
WARMING = 2
# Number of later images that determine the lagged weights of the modes.
LAG = 10
# Identifier of a random stream.
OF_BLIND_CONTROL = 5


@dataclass(frozen=True)
class Run:
    """One run.

    Attributes:
        folder: folder of the clip.
        inputs: inputs of the tracker, one of `INPUTS`.
        seed: seed of the tracker.
        changes: settings of the tracker that differ from the defaults, as path and value.
        limit: maximum number of images, before `rate` leaves some out; None means all.
        start: source of the initial pose, one of `STARTS`.
        rate: maximum number of images per second; 0 means all images of the clip.
        gravity: whether the direction of gravity is given with each image, one of `GRAVITIES`.
    """

    folder: Path
    inputs: str
    seed: int
    changes: tuple[tuple[str, Any], ...] = ()
    limit: int | None = None
    start: str = SUBJECT
    rate: float = 0.0
    gravity: str = UNKNOWN

    @property
    def clip(self) -> str:
        """Name of the clip."""
        return self.folder.name

    @property
    def identity(self) -> dict[str, Any]:
        """Identity of the run, independent of the code and the clip's folder, for JSON."""
        changes = [[name, value] for name, value in sorted(self.changes, key=lambda x: x[0])]
        return {**asdict(self), 'folder': None, 'clip': self.clip, 'changes': changes}


@dataclass(frozen=True, eq=False)
class Record:
    """Results of a run, and the truth, for T images with a posterior, K modes and J joints.

    Attributes:
        stamps: (T,) timestamps, ns.
        joints: (T, K, J, 3) positions in each mode, m, camera frame; NaN for missing modes.
        weights: (T, K) weights of the modes; 0 for missing modes.
        point: (T, J, 3) positions in the point estimate, m.
        blind: (T,) minimum error over the heaviest mode and draws from it, K in total, m.
        levels: (T,) probability levels of the true positions of all joints together.
        joint_levels: (T, J) probability levels of the true position of each scored joint.
        log_densities: (T,) log densities of the true positions.
        evaluations: (T,) number of likelihood evaluations.
        seconds: (T,) duration of each step, s.
        images: (1,) number of images of the run.
        true: (T, J, 3) true positions, m, camera frame; NaN for a joint without truth.
        contact: (T, 2) whether the left and the right foot have stood since the previous image;
            empty if unknown.
        views: (T, 3, 4) rotation and position of the camera in the world; identity if the clip
            has no camera motion.
        cpu_seconds: (T,) processor time of each step, summed over threads, s; empty if unknown.
        statuses: (N,) status of the tracker in each image of the run; empty if unknown.
        lagged: (T, K) weights of the modes given the next `LAG` images; empty if unknown.
        absolute_levels: (T, J) probability levels of each scored joint's true position in the
            camera frame; empty if unknown.
        volumes: (T, J) volumes of the 90 % regions in the camera frame, m^3; empty if unknown.
    """

    stamps: NDArray[np.int64]
    joints: NDArray[np.float64]
    weights: NDArray[np.float64]
    point: NDArray[np.float64]
    blind: NDArray[np.float64]
    levels: NDArray[np.float64]
    joint_levels: NDArray[np.float64]
    log_densities: NDArray[np.float64]
    evaluations: NDArray[np.float64]
    seconds: NDArray[np.float64]
    images: NDArray[np.int64]
    true: NDArray[np.float64]
    contact: NDArray[np.bool_]
    views: NDArray[np.float64]
    cpu_seconds: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    statuses: NDArray[np.str_] = field(default_factory=lambda: np.zeros(0, dtype='<U1'))
    lagged: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 0)))
    absolute_levels: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 0)))
    volumes: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 0)))


def keypoints_only(settings: TrackerSettings) -> TrackerSettings:
    """The settings with all image terms switched off."""
    off: dict[str, Any] = {term.name: OFF for term in TERMS}
    likelihood = replace(settings.likelihood, **off)
    return replace(settings, likelihood=likelihood, flow_weight=0.0)


def new_tracker(
    clip: Clip, body: Body, settings: TrackerSettings, seed: int, *, with_subject: bool = True
) -> Tracker:
    """A tracker that starts from the subject file of a clip, or from its inputs."""
    background = None if clip.background is None else BackgroundModel.from_image(clip.background)
    tracker = Tracker(body, clip.camera, settings, background, seed)
    if with_subject:
        tracker.reset(read_subject(clip.subject, body))
    return tracker


def begun(
    clip: Clip,
    inputs: str,
    seed: int = 0,
    settings: TrackerSettings | None = None,
    *,
    with_subject: bool = True,
) -> tuple[Tracker, dict[int, Keypoints]]:
    """A tracker for one of `INPUTS`, and its keypoints by timestamp.

    Raises:
        ValueError: the tracker needs keypoints, but the clip has none.
    """
    settings = settings or TrackerSettings()
    if inputs == KEYPOINTS:
        settings = keypoints_only(settings)
    keypoints = {} if inputs == IMAGES else read_detections(clip.folder).keypoints
    tracker = new_tracker(clip, load_body('human37'), settings, seed, with_subject=with_subject)
    return tracker, keypoints


class Step(NamedTuple):
    """Result of the tracker for an image, with wall time and processor time, s."""

    stamp: int
    posterior: GaussianMixture | None
    likelihood: GaussianMixture | None
    seconds: float
    cpu_seconds: float


def stepped(
    clip: Clip, tracker: Tracker, keypoints: Mapping[int, Keypoints], *, gravity: str = UNKNOWN
) -> Iterator[Step]:
    """Runs a tracker over the images of a clip, and yields a result after each.

    Args:
        clip: clip with images, and views if the camera moves.
        tracker: tracker before its first image.
        keypoints: keypoints by timestamp.
        gravity: one of `GRAVITIES`; images without known gravity get none.
    """
    for stamp, image in zip(clip.stamps, clip.images, strict=True):
        start, cpu_start = time.perf_counter(), time.process_time()
        if stamp in clip.views:
            rotation, position = clip.views[stamp]
            tracker.set_camera(position, rotation)
        if gravity == GIVEN and stamp in clip.ups:
            tracker.set_gravity(clip.ups[stamp])
        found = tracker.step(image, stamp, keypoints.get(stamp))
        yield Step(stamp, *found, time.perf_counter() - start, time.process_time() - cpu_start)


class Seen(NamedTuple):
    """Result of the tracker for an image with a tracked person."""

    stamp: int
    body: Body
    posterior: GaussianMixture
    likelihood: Likelihood
    point: NDArray[np.float64]


def tracked(clip: Clip, inputs: str, gravity: str, seed: int = 0) -> list[Seen]:
    """Results of the tracker for the images of a clip; arguments as for `Run`."""
    tracker, keypoints = begun(clip, inputs, seed)
    return [
        Seen(
            one.stamp,
            tracker.estimate.body,
            one.posterior,
            tracker.estimate.likelihood,
            tracker.estimate.point_estimate,
        )
        for one in stepped(clip, tracker, keypoints, gravity=gravity)
        if one.posterior is not None and one.likelihood is not None
    ]


def run(one: Run) -> Record:
    """Runs the tracker.

    Raises:
        ValueError: the clip can not be read, or lacks what the run needs.
    """
    clip = at_rate(read_clip(one.folder, one.limit), one.rate)
    tracker, keypoints = begun(
        clip, one.inputs, one.seed, changed(one.changes), with_subject=one.start == SUBJECT
    )
    return follow(clip, tracker, one.seed, keypoints, gravity=one.gravity)


def follow(
    clip: Clip,
    tracker: Tracker,
    seed: int,
    keypoints: Mapping[int, Keypoints],
    *,
    gravity: str = UNKNOWN,
) -> Record:
    """Results of a tracker for the images of a clip, with the truth.

    Args:
        clip, tracker, keypoints, gravity: as for `stepped`.
        seed: seed of the blind control and of the regions.

    Raises:
        ValueError: gravity is to be given, but the clip does not contain it.
    """
    if gravity == GIVEN and not clip.ups:
        raise ValueError(f'{clip.folder}: truth.npz has neither gravity nor up')
    kept: list[Step] = []
    bodies: list[Body] = []
    mixtures: list[GaussianMixture] = []
    points, evaluations, statuses = [], [], []
    lagged, later = LaggedWeights(LAG), list[Lagged]()
    for one in stepped(clip, tracker, keypoints, gravity=gravity):
        statuses.append(tracker.estimate.status.value)
        if one.posterior is None:
            continue
        later += lagged.update(one.stamp, one.posterior, tracker.estimate.origins)
        if one.stamp in clip.truth.joints:
            kept.append(one)
            bodies.append(tracker.estimate.body)
            mixtures.append(one.posterior)
            points.append(tracker.estimate.point_estimate)
            evaluations.append(float(tracker.estimate.evaluations))
    record = recorded(clip, bodies, mixtures, points, [one.stamp for one in kept], seed)
    return replace(
        record,
        evaluations=np.array(evaluations),
        seconds=np.array([one.seconds for one in kept]),
        cpu_seconds=np.array([one.cpu_seconds for one in kept]),
        statuses=np.array(statuses),
        lagged=_lagged_weights([*later, *lagged.finish()], record),
    )


def _lagged_weights(later: Sequence[Lagged], record: Record) -> NDArray[np.float64]:
    """Lagged weights (T, K) of the modes of a record."""
    by_stamp = {one.stamp: one.posterior.weights for one in later}
    result = np.zeros_like(record.weights)
    for row, stamp in zip(result, record.stamps, strict=True):
        own = by_stamp[int(stamp)]
        row[: len(own)] = own
    return result


def recorded(
    clip: Clip,
    bodies: list[Body],
    mixtures: list[GaussianMixture],
    points: list[NDArray[np.float64]],
    stamps: list[int],
    seed: int,
) -> Record:
    """Mixtures and point estimates (T,) with their scores against the truth of a clip.

    T is 0 if nobody was found in any image. Times and numbers of evaluations are set to 0.
    """
    origin = origin_joints(clip.truth.joint_names)
    scored = clip.truth.evaluated_joints()
    which = [JOINTS.index(name) for name in scored]
    true = true_joints(clip, stamps)
    relative_truth = true[:, which] - true[:, :1]
    k = max(map(len, mixtures), default=1)
    joints = np.full((len(stamps), k, len(JOINTS), 3), np.nan)
    weights = np.zeros((len(stamps), k))
    point = np.empty((len(stamps), len(JOINTS), 3))
    blind = np.empty(len(stamps))
    contact, views = feet_and_views(clip, stamps)
    record = Record(
        np.array(stamps, dtype=np.int64),
        joints,
        weights,
        point,
        blind,
        np.empty(0),
        np.empty((0, len(scored))),
        np.empty(0),
        np.zeros(len(stamps)),
        np.zeros(len(stamps)),
        np.array([len(clip.images)]),
        true,
        contact,
        views,
    )
    if not bodies:
        return record
    rng = np.random.default_rng([seed, OF_BLIND_CONTROL])
    found, absolute = [], []
    # The body changes only while its flesh is fitted, so kinematics are computed in batches.
    first = 0
    for i in range(1, len(bodies) + 1):
        if i == len(bodies) or bodies[i] is not bodies[first]:
            body = bodies[first]
            found += joint_mixtures(body, mixtures[first:i], scored, origin=origin)
            absolute += joint_mixtures(body, mixtures[first:i], scored, origin=())
            for t in range(first, i):
                mixture, n = mixtures[t], len(mixtures[t])
                heaviest = mixture[np.argsort(-mixture.weights, kind='stable')[:1]]
                drawn = np.concatenate([heaviest.means, heaviest.sample(n - 1, rng)])
                poses = np.concatenate([mixture.means, drawn, points[t][None]])
                placed = joints_of(body, poses, clip)
                joints[t, :n], weights[t, :n] = placed[:n], mixture.normalised().weights
                point[t] = placed[-1]
                relative = placed[n:-1, which] - placed[n:-1, :1]
                blind[t] = np.linalg.norm(relative - relative_truth[t], axis=2).mean(1).min()
            first = i
    scores = score(found, relative_truth, scored, seed=seed)
    absolute_levels, volumes = marginal_regions(absolute, true[:, which], seed=seed)
    assert scores.levels is not None
    assert scores.joint_levels is not None
    assert scores.log_densities is not None
    return replace(
        record,
        levels=scores.levels,
        joint_levels=scores.joint_levels,
        log_densities=scores.log_densities,
        absolute_levels=absolute_levels,
        volumes=volumes,
    )


def true_joints(clip: Clip, stamps: Sequence[int]) -> NDArray[np.float64]:
    """True positions (T, J, 3) of `JOINTS`; NaN for a joint without truth."""
    names = clip.truth.joint_names
    every = np.array([clip.truth.joints[stamp] for stamp in stamps])
    every = every.reshape(-1, len(names), 3)
    result = np.full((len(stamps), len(JOINTS), 3), np.nan)
    for j, name in enumerate(JOINTS):
        if name in names:
            result[:, j] = every[:, names.index(name)]
    result[:, 0] = every[:, [names.index(name) for name in origin_joints(names)]].mean(1)
    return result


def joints_of(body: Body, poses: NDArray[np.float64], clip: Clip) -> NDArray[np.float64]:
    """Positions (N, J, 3) of `JOINTS`; the first is the origin as defined by the clip's truth."""
    every = body.joint_positions(poses)
    result: NDArray[np.float64] = every[:, body.skeleton.joint_index([*JOINTS])]
    centre = body.skeleton.joint_index([*origin_joints(clip.truth.joint_names)])
    result[:, 0] = every[:, centre].mean(1)
    return result


def feet_and_views(clip: Clip, stamps: list[int]) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Contact and views of a record."""
    contact, views = np.zeros((0, 2), dtype=np.bool_), np.tile(np.eye(3, 4), (len(stamps), 1, 1))
    with np.load(clip.folder / 'truth.npz') as content:
        row = {int(stamp): t for t, stamp in enumerate(content['stamps'])}
        rows = [row[stamp] for stamp in stamps]
        if 'contact' in content:
            stands = content['contact'].astype(np.bool_)
            # A foot stands if it stood in all images since the previous used one.
            before = [*rows[:1], *rows[:-1]]
            since = [stands[a : b + 1].all(0) for a, b in zip(before, rows, strict=True)]
            contact = np.array(since, dtype=np.bool_).reshape(-1, 2)
        if 'camera_quaternion' in content:
            views[:, :, :3] = Rotation.from_quat(content['camera_quaternion'][rows]).as_matrix()
            views[:, :, 3] = content['camera_position'][rows]
    return contact, views


# Many runs.


def run_all(runs: Sequence[Run], processes: int = 0, kept: Path = KEPT) -> list[Record]:
    """Records of many runs, computed in parallel or read from the cache.

    Args:
        runs: wanted runs.
        processes: number of processes with one thread each; 0 means one per core, 1 this process.
        kept: folder of the records.
    """
    kept.mkdir(parents=True, exist_ok=True)
    paths = {one: kept / f'{name_of(one)}.npz' for one in runs}
    missing = [one for one in dict.fromkeys(runs) if read_record(paths[one]) is None]
    if len(missing) < len(runs) and missing:
        tqdm.write(f'tracking: {len(runs) - len(missing)} runs are kept', file=sys.stderr)
    # The longest first, so that no core waits long at the end.
    missing.sort(key=lambda one: -_length(one))
    in_processes(_run_and_keep, [(one, paths[one]) for one in missing], processes, 'tracking')
    records = []
    for one in runs:
        record = read_record(paths[one])
        if record is None:
            raise ValueError(f'{paths[one]} was written and can not be read')
        records.append(record)
    return records


def in_processes(
    work: Callable[[Item], Result], items: Sequence[Item], processes: int, what: str
) -> list[Result]:
    """Applies a function to items in processes of one thread each, with a progress bar.

    The first error stops it; items not yet begun are cancelled.

    Args:
        work: function defined in a module.
        items: picklable arguments.
        processes: number of processes; 0 means one per core, 1 this process.
        what: label of the progress bar.
    """
    if processes == 1 or not items:
        return [work(item) for item in items]
    cores = sorted(os.sched_getaffinity(0))
    context = multiprocessing.get_context('spawn')
    turn = context.Value('i', 0)
    count = min(processes or len(cores), len(items))
    with (
        show_progress(what, 'runs', len(items)) as bar,
        ProcessPoolExecutor(count, context, _own_a_core, (turn, cores)) as pool,
    ):
        jobs = [pool.submit(work, item) for item in items]
        try:
            for job in as_completed(jobs):
                job.result()
                bar.update()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
        return [job.result() for job in jobs]


def _own_a_core(turn: Any, cores: list[int]) -> None:
    with turn.get_lock():
        mine = cores[turn.value % len(cores)]
        turn.value += 1
    os.sched_setaffinity(0, {mine})
    cv2.setNumThreads(1)


def _run_and_keep(item: tuple[Run, Path]) -> None:
    one, path = item
    _warm_up(one)
    record = run(one)
    with new_file(path.with_suffix('.json')) as file:
        file.write(json.dumps(one.identity).encode())
    with new_file(path) as file:
        np.savez_compressed(file, **{x.name: getattr(record, x.name) for x in fields(record)})


# Not empty once this process has run a tracker.
_warm: list[bool] = []


def _warm_up(one: Run) -> None:
    """Runs a few images once per process, so that loading does not count in the times."""
    if not _warm:
        run(replace(one, limit=WARMING, rate=0.0))
        _warm.append(True)


def read_record(path: Path) -> Record | None:
    """Reads a stored record; None if it is missing or damaged.

    Fields with defaults may be missing in records of older checkouts.
    """
    try:
        with np.load(path) as content:
            wanted = [
                x.name for x in fields(Record) if x.name in content or x.default_factory is MISSING
            ]
            return Record(**{name: content[name] for name in wanted})
    except (OSError, EOFError, KeyError, ValueError, zipfile.BadZipFile, zlib.error):
        return None


def records_of(runs: Sequence[Run], folder: Path) -> list[Record | None]:
    """The newest record of each run in a folder of records, of any version of the code.

    Args:
        runs: wanted runs.
        folder: records of another checkout; the result is None for runs without a record.

    Raises:
        ValueError: the folder contains no records.
    """
    index: dict[str, list[Path]] = {}
    for path in sorted(folder.glob('*.json'), key=lambda path: -path.stat().st_mtime_ns):
        index.setdefault(_normalised(path.read_text('utf-8')), []).append(path)
    index.pop('', None)
    if not index:
        raise ValueError(f'{folder} has no records of runs')
    result = []
    for one in runs:
        found = index.get(_normalised(json.dumps(one.identity)), [])
        kept = (read_record(path.with_suffix('.npz')) for path in found)
        result.append(next((record for record in kept if record is not None), None))
    return result


def _normalised(text: str) -> str:
    """Canonical text of the identity of a run; empty if the text is damaged.

    Entries missing in files of older checkouts get their defaults; runs of older checkouts over
    smaller images are left out.
    """
    usual = {x.name: x.default for x in fields(Run) if x.default is not MISSING}
    try:
        told = json.loads(text)
        if told.pop('size', 1.0) != 1.0:
            return ''
        return json.dumps({**usual, **told}, sort_keys=True)
    except (AttributeError, TypeError, ValueError):
        return ''


def name_of(one: Run) -> str:
    """Name of the record of a run, which depends on code, clip and settings."""
    files = [path for path in sorted(one.folder.iterdir()) if path.is_file()]
    seen = [(path.name, path.stat().st_size) for path in files]
    text = repr((code_digest(), seen, {**asdict(one), 'folder': one.clip}))
    words = (one.clip, one.inputs.replace(' + ', '_'), str(one.seed))
    return '-'.join((*words, hashlib.sha256(text.encode()).hexdigest()[:16]))


@lru_cache(maxsize=1)
def code_digest() -> str:
    """Hash of the code and data on which a record depends."""
    digest = hashlib.sha256()
    layers = ('body', 'core', 'evaluation', 'experts', 'flips', 'image', 'inference', 'tracking')
    for path in sorted(
        path
        for layer in layers
        for path in (ROOT / 'hmt_ros' / layer).rglob('*')
        if path.suffix in ('.py', '.yaml', '.npz', '.h', '.cpp')
    ):
        digest.update(path.read_bytes())
    for name in ('clips.py', 'runs.py'):
        digest.update((ROOT / 'benchmarks' / name).read_bytes())
    return digest.hexdigest()


def _length(one: Run) -> int:
    share = min(one.rate, USUAL_RATE) / USUAL_RATE if one.rate > 0 else 1.0
    return int(share * sum(path.stat().st_size for path in one.folder.glob('*.mcap')))


# Settings of the tracker that differ from the defaults, named by their path, such as
# `likelihood.edges.weight`.


def changed(changes: Sequence[tuple[str, Any]]) -> TrackerSettings:
    """Default settings with changes, named by paths such as `likelihood.edges.weight`.

    Raises:
        ValueError: a setting does not exist or has another type.
    """
    settings: Any = TrackerSettings()
    for path, value in changes:
        settings = _with_value(settings, path.split('.'), value, path)
    result: TrackerSettings = settings
    return result


def _with_value(settings: Any, names: list[str], value: Any, path: str) -> Any:
    known = [field.name for field in fields(settings)] if is_dataclass(settings) else []
    if names[0] not in known:
        raise ValueError(f'no setting {path!r}: {names[0]!r} is none of {", ".join(known)}')
    own = getattr(settings, names[0])
    if names[1:]:
        return replace(settings, **{names[0]: _with_value(own, names[1:], value, path)})
    if isinstance(own, float) and isinstance(value, int):
        value = float(value)
    if not isinstance(value, type(own)):
        raise ValueError(f'{path} is a {type(own).__name__}, saw {value!r}')
    return replace(settings, **{names[0]: value})


def parsed_changes(words: Sequence[str]) -> tuple[tuple[str, Any], ...]:
    """Changes from words such as `max_hypotheses=4`.

    Raises:
        ValueError: a word has another form, or its setting does not exist.
    """
    result = []
    for word in words:
        name, equals, value = word.partition('=')
        if not equals:
            raise ValueError(f'wanted SETTING=VALUE, saw {word!r}')
        result.append((name, yaml.safe_load(value)))
    changed(result)
    return tuple(result)
