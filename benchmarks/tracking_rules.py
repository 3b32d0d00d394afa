"""What each rule of the tracker brings: the tracker without it, on the same clips and seeds.

A rule is a cue, a correction or a kind of proposal that settings can leave out. Every row of
`RULES` names one, its group, and the settings without it by their path. A rule whose settings the
tracker does not have (any more) is skipped with a line.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from benchmarks.command import told
from benchmarks.runs import BOTH, IMAGES, INPUTS, Run, run_all
from benchmarks.tracker_changes import changed
from benchmarks.tracking_means import difference_entries, grouped, paired
from benchmarks.tracking_scores import scores_of
from hmt_ros.tracking import TrackerSettings

WEIGHTS, CUES, PROPOSALS = 'weights', 'cues', 'proposals'
GROUPS_OF_RULES = (WEIGHTS, CUES, PROPOSALS)
WITH_IMAGES = (IMAGES, BOTH)
# Scores whose differences are told.
COMPARED_SCORES = (
    'heaviest_mm', 'expected_mm', 'best_mm', 'blind_mm', 'negative_log_likelihood', 'weights',
    'wrong_way', 'nobody', 'evaluations', 'cpu_ms',
)  # fmt: skip


@dataclass(frozen=True)
class Rule:
    """One rule.

    Attributes:
        name: of the rule.
        group: one of `GROUPS_OF_RULES`.
        changes: settings of the tracker without the rule, by their path.
        inputs: with which the rule matters, some of `runs.INPUTS`.
    """

    name: str
    group: str
    changes: tuple[tuple[str, Any], ...]
    inputs: tuple[str, ...] = INPUTS


class Plan(NamedTuple):
    """Seeds of the tracker, and rates in images a second, of the runs without rules."""

    seeds: Sequence[int]
    rates: Sequence[float]


SCREEN = Plan((0, 1), (30.0, 3.0))
DECIDE = Plan((0, 1, 2, 3, 4), (30.0, 8.0, 3.0))

RULES = (
    Rule('least_weight', WEIGHTS, (('least_log_weight', -1000.0),)),
    Rule('merging', WEIGHTS, (('hypothesis_merge_distance', 0.0),)),
    Rule('learned_motion', WEIGHTS, (('motion', 'random_walk'),)),
    Rule('coverage', CUES, (('likelihood.coverage.weight', 0.0),), WITH_IMAGES),
    Rule('edges', CUES, (('likelihood.edges.weight', 0.0),), WITH_IMAGES),
    Rule('flow', CUES, (('flow_weight', 0.0),), WITH_IMAGES),
    Rule('keypoints', CUES, (('likelihood.keypoints.weight', 0.0),), (BOTH,)),
    Rule('pose_prior', CUES, (('likelihood.prior_weight', 0.0),)),
    Rule('learned_pose_prior', CUES, (('likelihood.pose_prior', 'angles'),)),
    Rule('self_intersection', CUES, (('likelihood.self_intersection_sigma', float('inf')),)),
    Rule('upright', CUES, (('ground.upright_weight', 0.0),)),
    Rule('floor', CUES, (('ground.floor_weight', 0.0),)),
    Rule('shape', CUES, (('estimate_shape', False),)),
    Rule('limb_search', PROPOSALS, (('searched_chains', 0),)),
    Rule('alternatives', PROPOSALS, (('alternatives', 1),)),
    Rule('kinematic_jumps', PROPOSALS, (('proposals', 'css'),)),
)


def rules_named(names: Sequence[str]) -> list[Rule]:
    """Rules by their names or their groups, in the order of the table; no names: all.

    Raises:
        ValueError: a name is that of no rule and no group.
    """
    known = {*GROUPS_OF_RULES, *(rule.name for rule in RULES)}
    unknown = [name for name in names if name not in known]
    if unknown:
        raise ValueError(f'no rule or group of rules {", ".join(unknown)}')
    return [rule for rule in RULES if not names or {rule.name, rule.group} & {*names}]


def reason_to_skip(rule: Rule) -> str | None:
    """Why the tracker can not be run without a rule; None: it can."""
    try:
        settings = changed(rule.changes)
    except ValueError as error:
        return str(error)
    return 'the tracker does without it' if settings == TrackerSettings() else None


def effects(runs: Sequence[Run], rules: Sequence[Rule], processes: int = 0) -> dict[str, Any]:
    """Scores without each rule minus those of the usual tracker.

    Args:
        runs: of the usual tracker.
        rules: to leave out, one at a time.
        processes: number of processes; 0: one a core.

    Returns:
        `rules`, a list: `rule`, `rule_group`, `changes`, `groups` as from `grouped`, and `paired`,
        the differences of the heaviest mode; `skipped`, why by rule; and what was run: `clips`,
        `seeds`.
    """
    skipped = {rule.name: why for rule in rules if (why := reason_to_skip(rule)) is not None}
    for name, why in skipped.items():
        tqdm.write(f'tracking: {name} is skipped: {why}', file=sys.stderr)
    usual = _scores(runs, processes)
    found = []
    left = [rule for rule in rules if rule.name not in skipped]
    for rule in told('tracking without', left, lambda rule: rule.name):
        mine = [one for one in runs if one.inputs in rule.inputs]
        if not mine:
            continue
        own = _scores([replace(one, changes=rule.changes) for one in mine], processes)
        before = [usual[i] for i, one in enumerate(runs) if one.inputs in rule.inputs]
        entries = difference_entries(mine, own, before, COMPARED_SCORES)
        found.append(
            {
                'rule': rule.name,
                'rule_group': rule.group,
                'changes': [f'{name}={value}' for name, value in rule.changes],
                'groups': grouped(entries),
                'paired': paired(entries, COMPARED_SCORES[0]),
            }
        )
    return {
        'clips': sorted({one.clip for one in runs}),
        'seeds': sorted({one.seed for one in runs}),
        'rules': found,
        'skipped': skipped,
    }


def _scores(runs: Sequence[Run], processes: int) -> list[dict[str, float]]:
    """Only the scores that are compared: records of many runs do not stay in memory."""
    result = []
    for record in run_all(runs, processes):
        scores = scores_of(record)
        result.append({name: float(np.asarray(scores[name])) for name in COMPARED_SCORES})
    return result
