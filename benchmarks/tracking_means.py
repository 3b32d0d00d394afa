"""Combined scores of runs: by clip, means over clips, and paired differences.

An entry contains the scores of one clip, input, rate and knowledge of gravity, by seed, and their
means over the seeds. Clips have three groups: those on which settings of the tracker were chosen,
the others, and those excluded from means.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from benchmarks.runs import GRAVITIES, INPUTS, Run
from benchmarks.tracking_scores import interval, interval_over_seeds
from hmt_ros.evaluation.pose_scores import EVALUATED_JOINTS

# Clips on which settings of the tracker were chosen.
CHOSEN = ('walk', 'charleston', 'wander', 'shoot', 'signals', 'scoop', 'kick', 'follow')
# Clips excluded from means: this one plays four times too fast.
APART = ('exercise',)
OF_CHOSEN, OF_OTHERS, OF_APART = (
    'Clips that settings were chosen on', 'Other clips', 'Clips that are in no mean',
)  # fmt: skip
GROUPS = (OF_CHOSEN, OF_OTHERS, OF_APART)
DETECTOR = 'MediaPipe 3D'
BY_JOINT = 'by_joint_90'
# Keys that identify an entry, in addition to the clip.
CONDITIONS = ('inputs', 'rate', 'gravity')
Key = tuple[str, str, float, str]


def group_of(clip: str) -> str:
    """The group of a clip, one of `GROUPS`."""
    if clip in APART:
        return OF_APART
    return OF_CHOSEN if clip in CHOSEN else OF_OTHERS


def key_of(one: Run) -> Key:
    """Clip, input, rate and gravity of a run."""
    return one.clip, one.inputs, one.rate, one.gravity


def by_clip(runs: Iterable[Run], scores: Iterable[Any]) -> dict[Key, list[tuple[Run, Any]]]:
    """Runs with their scores, by clip, input, rate and gravity."""
    result: dict[Key, list[tuple[Run, Any]]] = {}
    for one, found in zip(runs, scores, strict=True):
        result.setdefault(key_of(one), []).append((one, found))
    return result


def entry_of(key: Key, scores: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Scores of a clip by seed, and their means; None if unknown."""
    clip, given, rate, gravity = key
    numbers = {
        name: [_known(one[name]) for one in scores] for name in scores[0] if name != BY_JOINT
    }
    result: dict[str, Any] = {'clip': clip, 'inputs': given, 'rate': rate, 'gravity': gravity}
    result['by_seed'] = numbers
    for name, values in numbers.items():
        known = [value for value in values if value is not None]
        result[name] = float(np.mean(known)) if len(known) == len(values) else None
    if BY_JOINT in scores[0]:
        shares = np.mean([one[BY_JOINT] for one in scores], axis=0)
        result[BY_JOINT] = dict(zip(EVALUATED_JOINTS, map(_known, shares), strict=True))
    return result


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def grouped(entries: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Entries by `GROUPS`, with means over the clips of groups that have means."""
    result = []
    for title in GROUPS:
        mine = [entry for entry in entries if group_of(entry['clip']) == title]
        mine.sort(key=lambda entry: (entry['clip'], _rank(entry)))
        if mine:
            averaged = [] if title == OF_APART else mine
            result.append({'group': title, 'clips': mine, 'means': means_of(averaged)})
    return result


def _rank(entry: dict[str, Any]) -> tuple[float, int, int]:
    """Sort key: all images first, then decreasing rates; inputs in their order within a rate."""
    rate = entry['rate']
    given = (*INPUTS, DETECTOR).index(entry['inputs'])
    return -(rate if rate > 0 else np.inf), given, GRAVITIES.index(entry['gravity'])


def by_input(entries: Sequence[dict[str, Any]]) -> list[list[dict[str, Any]]]:
    """Entries grouped by rate, input and gravity."""
    ranks = sorted({_rank(entry) for entry in entries})
    return [[entry for entry in entries if _rank(entry) == rank] for rank in ranks]


def means_of(entries: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Means over the clips by rate, input and gravity, with intervals; see `interval`."""
    result = []
    for mine in by_input(entries):
        means: dict[str, Any] = {name: mine[0][name] for name in CONDITIONS}
        for name in mine[0]['by_seed']:
            means[name] = interval(_by_seed(mine, name))
        if BY_JOINT in mine[0]:
            shares = np.array([[*entry[BY_JOINT].values()] for entry in mine], dtype=float)
            known = np.isfinite(shares)
            sums = np.where(known, shares, 0.0).sum(0)
            means[BY_JOINT] = {
                name: float(total / count) if count else None
                for name, total, count in zip(EVALUATED_JOINTS, sums, known.sum(0), strict=True)
            }
        result.append(means)
    return result


def _by_seed(entries: Sequence[dict[str, Any]], name: str) -> np.ndarray[Any, Any]:
    return np.array([entry['by_seed'][name] for entry in entries], dtype=float)


def difference_entries(
    runs: Sequence[Run],
    own: Sequence[dict[str, Any]],
    usual: Sequence[dict[str, Any]],
    names: Sequence[str],
) -> list[dict[str, Any]]:
    """Entries of paired differences.

    Args:
        runs: compared runs, with equal numbers of seeds for each clip, input, rate and gravity.
        own, usual: scores of the runs, and the scores to subtract.
        names: names of the scores.
    """
    differences = [
        {name: a[name] - b[name] for name in names} for a, b in zip(own, usual, strict=True)
    ]
    return [
        entry_of(key, [scores for _, scores in found])
        for key, found in by_clip(runs, differences).items()
    ]


def paired(entries: Sequence[dict[str, Any]], name: str) -> list[dict[str, Any]]:
    """Paired differences of one score, by group, rate, input and gravity.

    Args:
        entries: entries of differences.
        name: name of the score.

    Returns:
        By group, rate, input and gravity: `group`, `inputs`, `rate`, `gravity`, `clips` (their
        number), `difference` (mean, lower and upper end over clips and seeds), and the clips whose
        own interval over the seeds lies wholly `above` or `below` 0, see `interval_over_seeds`.
        Clips excluded from means have no difference.
    """
    result = []
    for title in GROUPS:
        ours = [entry for entry in entries if group_of(entry['clip']) == title]
        for mine in by_input(ours):
            values = _by_seed(mine, name)
            ends = {
                entry['clip']: found
                for entry, own in zip(mine, values, strict=True)
                if (found := interval_over_seeds(own)) is not None
            }
            result.append(
                {
                    'group': title,
                    **{name: mine[0][name] for name in CONDITIONS},
                    'clips': len(mine),
                    'difference': (None,) * 3 if title == OF_APART else interval(values),
                    'above': [clip for clip, (low, _) in ends.items() if low > 0],
                    'below': [clip for clip, (_, high) in ends.items() if high < 0],
                }
            )
    return result
