"""depth: what depth images bring to the tracker, on rendered clips.

People of other statures and other flesh than the model's move before a camera that also measures
depth, with the noise and the holes of a sensor. Motions are made, and recorded ones of the
development data where it is there. The track starts from joints that were clicked in the first
image; lengths are unknown.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.clips import ROOT, Clip, read_clip, table
from benchmarks.command import benchmark_parser, show, told
from benchmarks.machine import best_time, description
from benchmarks.runs import Record, recorded
from benchmarks.tracking_scores import scores_of
from hmt_ros.app.make_bag import MotionOptions, motion_of
from hmt_ros.app.rendered_bag import write_bag
from hmt_ros.body import Body, Camera, load_body
from hmt_ros.body.camera import Viewpoint
from hmt_ros.body.kinematics import forward
from hmt_ros.body.shape import ShapeSpace
from hmt_ros.image.background import BackgroundModel
from hmt_ros.image.likelihood import ImageLikelihood
from hmt_ros.image.observation import observe
from hmt_ros.rendering.scene import Scene
from hmt_ros.tracking import Subject, Tracker, TrackerSettings, read_subject
from msg_tools import BagReader
from msg_tools.messages.images import decode_depth

MADE = ('walk', 'reach', 'dance')
RECORDED = ('cmu_06_15_shoot.bvh', 'cmu_14_washwindow.bvh', 'cmu_15_wander.bvh', 'fair_dab.bvh')
CAMERA = Camera(530.0, 530.0, 319.5, 239.5, 640, 480)
VIEW = Viewpoint(distance=3.5, height=1.2)
FPS, SECONDS, QUICK_SECONDS = 30.0, 2.0, 0.2
# Standard deviations of a rendered person from the model: stature and radii, as shares.
STATURE, FLESH = 0.05, 0.08
RAW = 'sensor_msgs/msg/Image'
# Stream of random numbers of a seed; rendering uses others.
OF_PERSON = 11
# Wanted of the error of the heaviest mode on made clips, with depth over without.
WANTED = 0.70


@dataclass(frozen=True, eq=False)
class DepthClip:
    """A rendered clip with depth images (T, H, W), m, and the joints clicked in its first image."""

    clip: Clip
    depths: list[NDArray[np.float32]]
    subject: Subject


def main(argv: list[str]) -> int:
    """Runs the benchmark."""
    parser = benchmark_parser('depth', __doc__, quick='one clip of a few images')
    parser.add_argument(
        '--seeds', type=int, default=2, metavar='N', help='number of people a made motion (2)'
    )
    options = parser.parse_args(argv)
    result = measure(options.seeds, quick=options.quick)
    return show(result, as_text, as_json=options.json)


def measure(seeds: int = 2, *, quick: bool = False) -> dict[str, Any]:
    """Scores by clip without and with depth, and what the term costs."""
    folder = ROOT.parent / 'shared' / 'mocap' / 'dev'
    files = [folder / name for name in RECORDED if (folder / name).is_file()]
    cases: list[tuple[str, Path | None, int]] = [
        (name, None, seed) for name in MADE for seed in range(seeds)
    ]
    cases += [(file.stem, file, 0) for file in files]
    found = []
    for name, file, seed in told('depth', cases[:1] if quick else cases, lambda case: case[0]):
        entry: dict[str, Any] = {'clip': f'{name} {seed}' if file is None else name}
        entry['made'] = file is None
        with made_clip(name, file, seed, QUICK_SECONDS if quick else SECONDS) as made:
            for key, use in (('without', False), ('with', True)):
                entry[key] = _scores(follow(made, seed, use_depth=use))
        found.append(entry)
    result: dict[str, Any] = {'machine': description(), 'clips': found, 'means': {}}
    for key, wanted in (('made', True), ('recorded', False)):
        chosen = [entry for entry in found if entry['made'] == wanted]
        if chosen:
            result['means'][key] = {
                way: {
                    score: float(np.mean([entry[way][score] for entry in chosen]))
                    for score in chosen[0][way]
                }
                for way in ('without', 'with')
            }
    of_made = result['means']['made']
    result['ratio'] = of_made['with']['heaviest_mm'] / of_made['without']['heaviest_mm']
    result['speed'] = _speed(0.1 if quick else 1.0)
    return result


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """A table for people."""
    shown = {
        'heaviest_mm': ('heaviest, mm', '.0f'),
        'absolute_mm': ('absolute, mm', '.0f'),
        'start_mm': ('first image, mm', '.0f'),
        'joint_coverage_90': ('in 90 % regions', '.0%'),
    }
    head = ['clip', *(f'{title}' for title, _ in shown.values())]
    rows = [head]
    lines = [(entry['clip'], entry) for entry in result['clips']]
    lines += [(f'mean of {key}', entry) for key, entry in result['means'].items()]
    for name, entry in lines:
        cells = [
            f'{format(entry["without"][key], form)} -> {format(entry["with"][key], form)}'
            for key, (_, form) in shown.items()
        ]
        rows.append([name, *cells])
    speed, ratio = result['speed'], result['ratio']
    verdict = 'met' if ratio <= WANTED else 'missed'
    return '\n\n'.join(
        [
            table(rows, markdown=markdown),
            f'Heaviest mode of made clips, with depth over without: {ratio:.2f}, wanted at most '
            f'{WANTED:g}: {verdict}.',
            f'One pass over {speed["poses"]} poses with derivatives: {speed["with_ms"]:.2f} ms '
            f'with depth, {speed["without_ms"]:.2f} ms without.',
        ]
    )


@contextmanager
def made_clip(name: str, file: Path | None, seed: int, seconds: float) -> Iterator[DepthClip]:
    """Renders a person in a motion, made or of a file."""
    rng = np.random.default_rng([seed, OF_PERSON])
    stature = None
    if file is None:
        stature = float(load_body('human37').stature * (1.0 + STATURE * rng.normal()))
    options = MotionOptions(
        name=name, mocap=file, body='human37', stature=stature, duration=seconds, start=0.0,
        fps=FPS, heading=None, seed=seed,
    )  # fmt: skip
    take = motion_of(options, VIEW)
    person = replace(take, body=_other_flesh(take.body, rng))
    with TemporaryDirectory() as work:
        folder = Path(work) / 'clip'
        write_bag(folder, person, CAMERA, Scene(viewpoint=VIEW, seed=seed), with_depth=True)
        with BagReader(folder) as bag:
            messages = [stored.message for stored in bag.messages([bag.find_topic([RAW]).name])]
        subject = replace(read_subject(folder / 'subject.yaml', person.body), segment_lengths={})
        yield DepthClip(read_clip(folder), [decode_depth(each) for each in messages], subject)


def follow(made: DepthClip, seed: int, *, use_depth: bool) -> Record:
    """What the tracker says of a clip."""
    clip = made.clip
    assert clip.background is not None
    background = BackgroundModel.from_image(clip.background)
    tracker = Tracker(load_body('human37'), clip.camera, TrackerSettings(), background, seed)
    tracker.reset(made.subject)
    bodies, mixtures, points = [], [], []
    for stamp, image, depth in zip(clip.stamps, clip.images, made.depths, strict=True):
        posterior, _ = tracker.step(image, stamp, depth=depth if use_depth else None)
        assert posterior is not None
        bodies.append(tracker.estimate.body)
        mixtures.append(posterior)
        points.append(tracker.estimate.point_estimate)
    nothing = [0.0] * len(bodies)
    return recorded(clip, bodies, mixtures, points, clip.stamps, nothing, nothing, seed)


def _scores(record: Record) -> dict[str, float]:
    scores = scores_of(record)
    rows, heaviest = np.arange(len(record.stamps)), record.weights.argmax(1)
    off = np.linalg.norm(record.joints[rows, heaviest] - record.true, axis=2)
    absolute = 1e3 * np.nanmean(off, axis=1)
    keys = ('heaviest_mm', 'best_mm', 'joint_coverage_90', 'coverage_90')
    return {
        **{key: float(scores[key]) for key in keys},
        'absolute_mm': float(absolute.mean()),
        'start_mm': float(absolute[0]),
    }


def _other_flesh(body: Body, rng: np.random.Generator) -> Body:
    """The body with radii that differ from the model's, alike on both sides."""
    space = ShapeSpace(body)
    change = np.zeros(space.size)
    names = space.names[space.lengths :]
    radii = np.array([name.endswith(('_width', '_depth')) for name in names])
    change[space.lengths :] = np.where(radii, FLESH * rng.normal(size=len(names)), 0.0)
    return space.moved(change)


def _speed(seconds: float, poses: int = 32) -> dict[str, float]:
    body, rng = load_body('human37'), np.random.default_rng(0)
    with made_clip('walk', None, 0, 0.1) as made:
        image, pose = made.clip.images[0], body.prior_mean.copy()
        pose[:3] = made.clip.truth.joints[made.clip.stamps[0]][0]
        assert made.clip.background is not None
        silhouette = BackgroundModel.from_image(made.clip.background).silhouette(image)
    near = np.clip(pose + 0.1 * rng.normal(size=(poses, len(pose))), body.lower, body.upper)
    frames = forward(body.skeleton, near)
    likelihood = ImageLikelihood(body, CAMERA)
    result: dict[str, float] = {'poses': poses}
    for key, depth in (('without_ms', None), ('with_ms', made.depths[0])):
        seen = observe(image, silhouette, depth=depth)

        def run(seen: Any = seen) -> Any:
            return likelihood.energies(frames, seen)

        result[key] = 1e3 * best_time(run, seconds=seconds)
    return result


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
