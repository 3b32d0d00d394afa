"""people: two people cross, one in front of the other; does each keep its own track?

For every seed a bag is rendered (`make-bag crossing`: 320x240, 3 s at 10 Hz, COCO keypoints of both
without identities, none for hidden joints) and replayed (`replay --people`). In the first second a
track is assigned to the person with the nearest pelvis; this must still hold after the crossing.
Errors are those of the joints relative to the pelvis, for the heaviest and for the best mode, means
over both people, mm.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.clips import table
from benchmarks.command import benchmark_parser, show, told
from benchmarks.machine import description
from hmt_learning.app.make_bag import main as make_bag
from hmt_learning.app.rendered_bag import PEOPLE
from hmt_ros.app.replay.one_bag import replay_bag
from hmt_ros.app.replay.options import ReplayOptions
from hmt_ros.app.truth import read_truth
from hmt_ros.evaluation.pose_scores import EVALUATED_JOINTS
from hmt_ros.evaluation.track_scores import Truth
from hmt_ros.inference.arrays import Array
from hmt_ros.sessions.track import BODIES
from msg_tools import BagReader
from msg_tools.messages.pose_mixtures import pose_mixture_of

SEEDS = 10
DURATION, FPS, SIZE = 3.0, 10.0, '320x240'
QUICK_DURATION = 1.0
# Ends of the compared times before and after the crossing, as fractions of the duration.
BEFORE, AFTER = 0.33, 0.75

# Positions (K, J, 3) of the joints of the modes, heaviest first, m, by timestamp.
Joints = dict[int, Array]


def main(argv: list[str] | None = None) -> int:
    """Runs the benchmark."""
    parser = benchmark_parser('people', __doc__, quick=f'one seed, {QUICK_DURATION:g} s')
    parser.add_argument('--seeds', type=int, default=SEEDS, help=f'number of seeds ({SEEDS})')
    parser.add_argument('--keep', type=Path, help='folder in which the bags stay')
    arguments = parser.parse_args(argv)
    amount = (1, QUICK_DURATION) if arguments.quick else (arguments.seeds, DURATION)
    return show(measure(*amount, arguments.keep), as_text, as_json=arguments.json)


def measure(
    seeds: int = SEEDS, duration: float = DURATION, keep: Path | None = None
) -> dict[str, Any]:
    """Scores of the crossings for all seeds; the bags are kept if a folder is given."""
    with tempfile.TemporaryDirectory() as folder:
        place = keep or Path(folder)
        rows = [one_crossing(seed, place, duration) for seed in told('people', range(seeds))]
    return {'machine': description(), 'crossings': rows}


def one_crossing(seed: int, folder: Path, duration: float) -> dict[str, Any]:
    """Scores of one seed."""
    made, tracked = folder / f'crossing{seed}', folder / f'tracked{seed}'
    make_bag(
        ['crossing', '-o', str(made), '--seed', str(seed), '--size', SIZE, '--fps', str(FPS),
         '--duration', str(duration), '--overwrite', '--quiet']
    )  # fmt: skip
    options = ReplayOptions(
        overwrite=True, quiet=True, people=True, background=made / 'background.png',
    )  # fmt: skip
    replay_bag(made, tracked, options, lambda text: None)
    truths = [read_truth(made / f'truth_{name}.npz') for name in PEOPLE]
    return {'seed': seed, **scores(truths, tracks_in(tracked))}


def tracks_in(bag: Path) -> dict[str, tuple[tuple[str, ...], Joints]]:
    """Joint names and joint positions of the modes, by identity."""
    result: dict[str, tuple[tuple[str, ...], Joints]] = {}
    with BagReader(bag) as read:
        topics = [name for name in read.topics if name.endswith('/pose_mixture')]
        for stored in read.messages(topics):
            content = pose_mixture_of(stored.message)
            if len(content.weights):
                name = stored.topic.removeprefix(f'/{BODIES}/').removesuffix('/pose_mixture')
                _, joints = result.setdefault(name, (content.joint_names, {}))
                joints[content.stamp_ns] = content.joint_positions
    return result


def scores(
    truths: list[Truth], tracks: dict[str, tuple[tuple[str, ...], Joints]]
) -> dict[str, Any]:
    """Whether each track stays with its first person, and its errors."""
    stamps = sorted(truths[0].joints)
    early = stamps[: round(BEFORE * len(stamps))]
    late = stamps[round(AFTER * len(stamps)) :]
    owners = {name: _owner(truths, *track, early) for name, track in tracks.items()}
    result: dict[str, Any] = {'tracks': len(tracks)}
    kept, errors = [], {'before': [], 'after': []}
    for number, truth in enumerate(truths):
        own = [track for name, track in tracks.items() if owners[name] == number]
        kept.append(
            bool(own)
            and _owner(truths, *own[0], late) == number
            and all(stamp in own[0][1] for stamp in late)
        )
        for when, chosen in (('before', early), ('after', late)):
            errors[when].append(_errors(truth, *own[0], chosen) if own else np.full(2, np.nan))
    for when, found in errors.items():
        heaviest, best = 1e3 * np.mean(found, axis=0)
        result |= {f'heaviest, {when}, mm': float(heaviest), f'best, {when}, mm': float(best)}
    result['kept'] = all(kept)
    return result


def _owner(
    truths: list[Truth], names: tuple[str, ...], joints: Joints, stamps: list[int]
) -> int | None:
    """Index of the person nearest to a track in most of the images; None without images."""
    place, votes = names.index('pelvis'), np.zeros(len(truths))
    for stamp in stamps:
        if stamp in joints:
            away = [
                np.linalg.norm(
                    joints[stamp][0, place] - truth.joints[stamp][truth.joint_names.index('pelvis')]
                )
                for truth in truths
            ]
            votes[int(np.argmin(away))] += 1
    return int(np.argmax(votes)) if votes.any() else None


def _errors(truth: Truth, names: tuple[str, ...], joints: Joints, stamps: list[int]) -> Array:
    """Mean distance (2,) of the joints from the true ones, of the heaviest and the best mode, m."""
    wanted = ('pelvis', *EVALUATED_JOINTS)
    errors = []
    for stamp in stamps:
        if stamp in joints:
            own = joints[stamp][:, [names.index(x) for x in wanted]]
            true = truth.joints[stamp][[truth.joint_names.index(x) for x in wanted]]
            gap = (own - own[:, :1]) - (true - true[0])
            each = np.linalg.norm(gap[:, 1:], axis=2).mean(1)
            errors.append((each[0], each.min()))
    return np.mean(errors, axis=0) if errors else np.full(2, np.nan)


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """Human-readable table."""
    rows = result['crossings']
    columns = [name for name in rows[0] if name.endswith('mm')]
    lines = [
        [str(row['seed']), 'yes' if row['kept'] else 'no', str(row['tracks']),
         *(f'{row[name]:.0f}' for name in columns)]
        for row in rows
    ]  # fmt: skip
    kept = sum(row['kept'] for row in rows)
    shown = table([['seed', 'kept', 'tracks', *columns], *lines], markdown=markdown)
    return f'{shown}\n\nBoth keep their tracks in {kept} of {len(rows)} crossings.'
