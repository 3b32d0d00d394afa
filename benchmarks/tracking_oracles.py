"""Oracles: gain of the tracker if one of its inputs were exact, one at a time.

true 2D landmarks      exact projections of the true landmarks, with full confidence; on real clips
                       of the joints and the face in the truth, other landmarks from the detector
true 2D, weight 1 ...  the same with keypoints weighted more than the usual 0.5; if that helps, the
                       depth information of an image was discounted, otherwise keypoints lack it
no constant 2D errors  the median error of each landmark over a clip, at the person, is removed
true depths            one pose with the true depths, instead of the mixture of the experts
true depths, weight 1  the same with ten times the weight of the experts
true lengths           lengths between the true joints
true sides             keypoints of arms and legs with exchanged sides are corrected
true heading           scores of the heaviest mode among those that face the right way
experts, weight 0.3    the experts' depths with three times the weight
no experts, no depths  keypoints without the experts; also without the detector's own 3D

The floor is the error of the body model at the poses nearest to the truth, with the true lengths
and with the initial lengths of a track. It is due to definitions of joints, and to lengths.

Errors are relative to the pelvis; if the truth has no pelvis, to the middle of the hips; if it has
no hips, to the middle of the shoulders. They are split into the components along and across the
line of sight of each true joint.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from benchmarks.clips import Clip, read_clip, read_detections, table, with_file
from benchmarks.machine import description
from benchmarks.real_clips import BEAM, DESKS
from benchmarks.runs import (
    BOTH,
    GIVEN,
    KEPT,
    KEYPOINTS,
    Run,
    changed,
    in_processes,
    keypoints_only,
    name_of,
    stepped,
)  # fmt: skip
from benchmarks.tracking_means import CHOSEN
from benchmarks.truth_fits import SHOULDERS, best_poses, with_true_lengths
from hmt_ros.body import Body, load_body
from hmt_ros.body.kinematics import forward
from hmt_ros.body.model_file import conditioned_covariance
from hmt_ros.body.skeleton import other_side
from hmt_ros.evaluation.pose_scores import EVALUATED_JOINTS, HIPS, ORIGIN
from hmt_ros.experts.pose_encoding import ray_rotations
from hmt_ros.image.background import BackgroundModel
from hmt_ros.image.keypoint_schemes import landmarks, noise_of
from hmt_ros.image.lifted_poses import LiftedPoses, from_positions
from hmt_ros.image.terms import keypoints as keypoint_term
from hmt_ros.image.terms.keypoints import LIFTED_WEIGHT, Keypoints
from hmt_ros.tracking import Tracker, TrackerSettings, read_subject
from hmt_ros.tracking.initialisation import start_from_keypoints

Array = NDArray[np.float64]

REAL = (BEAM, *DESKS)
OTHERS = ('dab', 'drill', 'laugh', 'orbit', 'traffic', 'turns', 'window')
GROUPS = {'Real clips': REAL, 'Clips C': CHOSEN, 'Clips O': OTHERS}
INPUTS = (BOTH, KEYPOINTS)
QUICK = 6  # number of images with --quick
# Number of initial headings for the fit of the body to the truth.
HEADINGS = 8
# Standard deviations of true depths and of true lengths, m.
DEPTH_SIGMA, LENGTH_SIGMA = 0.03, 0.001
ARM = ('shoulder', 'elbow', 'wrist', 'hand')
LEG = ('hip', 'knee', 'ankle', 'toe')


@dataclass(frozen=True, eq=False)
class Given:
    """Inputs of a tracker for a clip.

    Attributes:
        clip: clip with its truth.
        real: whether the clip is real; joints of its truth are landmarks of detectors.
        body: body model before any image of the person.
        settings: settings of the tracker.
        keypoints: detected keypoints by timestamp.
        fitted: body with the true lengths, and its poses (d,) nearest to the truth by timestamp.
        lengths_known: whether the body's lengths are the person's.
        depths: depths by timestamp, which replace those of experts and detector.
        depth_weight: factor on the energy of depths.
    """

    clip: Clip
    real: bool
    body: Body
    settings: TrackerSettings
    keypoints: Mapping[int, Keypoints]
    fitted: tuple[Body, dict[int, Array]]
    lengths_known: bool = False
    depths: Mapping[int, LiftedPoses] | None = None
    depth_weight: float = LIFTED_WEIGHT


class ToldTracker(Tracker):
    """A tracker that uses given depths instead of the experts'."""

    told: Mapping[int, LiftedPoses] | None = None

    def _lifted(self, keypoints: Keypoints | None, stamp: int) -> Keypoints | None:
        if self.told is None or keypoints is None:
            return super()._lifted(keypoints, stamp)
        return replace(keypoints, lifted=self.told.get(stamp))


# The oracles.


def _true_landmarks(given: Given, weight: float | None = None) -> Given:
    found = dict(given.keypoints)
    for stamp, (places, offsets) in _landmark_places(given).items():
        said, known = given.keypoints[stamp], np.isfinite(places).all(1)
        pixels, sure, noise = said.pixels.copy(), said.confidences.copy(), said.noise
        assert noise is not None
        assert said.landmarks is not None
        pixels[known], sure[known] = given.clip.camera.project(places[known]), 1.0
        exact = np.hypot(noise_of(np.ones(1)), [landmarks()[x].sigma for x in said.landmarks])
        found[stamp] = replace(
            said, pixels=pixels, confidences=sure, offsets=offsets,
            noise=np.where(known, exact, noise),
        )  # fmt: skip
    changes = () if weight is None else (('likelihood.keypoints.weight', weight),)
    return replace(given, keypoints=found, settings=changed(changes))


def _without_constant_errors(given: Given) -> Given:
    camera, every = given.clip.camera, _landmark_places(given)
    said = [given.keypoints[stamp] for stamp in every]
    places = np.array([x for x, _ in every.values()])
    depths = places[..., 2:]
    sizes = np.reshape([camera.magnification(z) for z in depths.ravel().tolist()], depths.shape)
    errors = [x.pixels - camera.project(p) for x, p in zip(said, places, strict=True)]
    off = np.ma.masked_invalid(np.array(errors) / sizes)
    constant = np.asarray(np.ma.median(off, axis=0).filled(np.nan))
    found = dict(given.keypoints)
    for stamp, one, size in zip(every, said, sizes, strict=True):
        known = np.isfinite(size * constant).all(1)
        own = one.offsets
        assert own is not None
        found[stamp] = replace(
            one,
            pixels=np.where(known[:, None], one.pixels - size * constant, one.pixels),
            offsets=np.where(known[:, None], every[stamp][1], own),
        )
    return replace(given, keypoints=found)


def _landmark_places(given: Given) -> dict[int, tuple[Array, Array]]:
    """True positions (n, 3) of landmarks, NaN if unknown, and offsets (n, 3), by timestamp."""
    body, poses = given.fitted
    names, result = given.clip.truth.joint_names, {}
    for stamp in given.keypoints.keys() & poses.keys():
        said, true = given.keypoints[stamp], given.clip.truth.joints[stamp]
        assert said.landmarks is not None
        assert said.offsets is not None
        offsets, places = said.offsets.copy(), np.full((len(said.names), 3), np.nan)
        segments = body.skeleton.joint_segments[body.skeleton.joint_index(said.names)]
        turns = forward(body.skeleton, poses[stamp][None]).rotations()[0, segments]
        for i, (joint, mark) in enumerate(zip(said.names, said.landmarks, strict=True)):
            if given.real and mark in names:
                places[i] = true[names.index(mark)]
                offsets[i] *= mark != joint
            elif not given.real and joint in names:
                places[i] = true[names.index(joint)] + turns[i] @ offsets[i]
        places[~(places[:, 2] > 0)] = np.nan
        result[stamp] = places, offsets
    return result


def _true_depths(given: Given, weight: float = LIFTED_WEIGHT) -> Given:
    body, poses = given.fitted
    names = given.clip.truth.joint_names
    kinds = {name.rpartition('_')[2] for name in names if name in body.joint_names} | {'hip'}
    if given.real:
        kinds -= {'head', 'toe'}  # defined differently in the body model
    depths = {}
    for stamp, pose in poses.items():
        places = body.joint_positions(pose[None])[0]
        for i, name in enumerate(body.joint_names):
            if name in names and np.isfinite(true := _true(given.clip, stamp, name)).all():
                places[i] = true
        axes = ray_rotations(_middle(places, body.joint_names, HIPS)[None])[0].T
        depths[stamp] = from_positions(
            body.joint_names, places, axes, dict.fromkeys(kinds, DEPTH_SIGMA)
        )
    known = {stamp: one for stamp, one in depths.items() if one is not None}
    return replace(given, depths=known, depth_weight=weight)


def _true_lengths(given: Given) -> Given:
    body, usual = given.fitted[0], given.body.segment_lengths
    rows = np.eye(len(usual))[[usual[x] != body.segment_lengths[x] for x in usual]]
    spread = conditioned_covariance(body.length_covariance, rows, np.full(len(rows), LENGTH_SIGMA))
    return replace(given, body=replace(body, length_covariance=spread), lengths_known=True)


def _true_sides(given: Given) -> Given:
    clip, names = given.clip, given.clip.truth.joint_names
    found = dict(given.keypoints)
    for stamp, said in given.keypoints.items():
        if stamp not in clip.truth.joints:
            continue
        order, marks = np.arange(len(said.names)), said.landmarks
        assert marks is not None
        swapped = []
        for kinds in (ARM, LEG):
            rows = [i for i, x in enumerate(said.names) if x.rpartition('_')[2] in kinds]
            other = [marks.index(other_side(marks[i])) for i in rows]
            at = [names.index(x) if x in names else -1 for x in (said.names[i] for i in rows)]
            true = np.where(np.array(at)[:, None] < 0, np.nan, clip.pixels[stamp][at])
            far = [np.linalg.norm(said.pixels[x] - true, axis=1) for x in (rows, other)]
            swapped.append(bool(np.nansum(far[1]) < np.nansum(far[0])))
            if swapped[-1]:
                order[rows] = other
        if all(swapped):
            order = np.array(
                [marks.index(other_side(x)) if x[0] in 'lr' else i for i, x in enumerate(marks)]
            )
        moved = said[order]
        found[stamp] = replace(
            said, pixels=moved.pixels, covariances=moved.covariances, noise=moved.noise,
            confidences=moved.confidences, positions=moved.positions,
        )  # fmt: skip
    return replace(given, keypoints=found)


def _without_experts(given: Given) -> Given:
    return replace(given, settings=changed((('lifter', ''),)))


def _without_depths(given: Given) -> Given:
    return replace(given, depths={})


PLAIN, HEADING = 'plain', 'true heading'
ORACLES: dict[str, Callable[[Given], Given]] = {
    PLAIN: lambda given: given,
    'true 2D landmarks': _true_landmarks,
    **{f'true 2D, weight {x:g}': partial(_true_landmarks, weight=x) for x in (1.0, 2.0, 4.0)},
    'no constant 2D errors': _without_constant_errors,
    'true depths': _true_depths,
    'true depths, weight 1': partial(_true_depths, weight=1.0),
    'true lengths': _true_lengths,
    'true sides': _true_sides,
    'experts, weight 0.3': lambda given: replace(given, depth_weight=0.3),
    'no experts': _without_experts,
    'no depths': _without_depths,
}
# `inputs` of a run that computes the floors, and names of the floors.
FLOOR = ''
FLOORS = ('floor, true lengths', 'floor, lengths at the start')


# A run.


@dataclass(frozen=True)
class OracleRun(Run):
    """A run with an oracle.

    Attributes:
        oracle: one of `ORACLES`; empty for the floors of a clip.
    """

    oracle: str = ''


@lru_cache(maxsize=1)
def given_of(folder: Path, limit: int | None) -> Given:
    """Inputs of the plain tracker for a clip, or for its first images, and the truth."""
    clip, body = read_clip(folder, limit), load_body('human37')
    real = folder.name in REAL
    own = _with_lengths(body, clip, real)
    stamps = [stamp for stamp in clip.stamps if stamp in clip.truth.joints]
    poses = dict(zip(stamps, _at_truth(own, clip, stamps, real), strict=True))
    keypoints = read_detections(folder).keypoints
    return Given(clip, real, body, TrackerSettings(), keypoints, (own, poses))


def _with_lengths(body: Body, clip: Clip, real: bool) -> Body:
    """The body with the true lengths; for real clips those between scored joints."""
    if not real:
        return with_true_lengths(body, clip)
    truth = _scored_truth(clip)
    result = with_true_lengths(body, replace(clip, truth=truth))
    if {*HIPS, 'neck'} <= {*truth.joint_names}:
        every, names = np.array(list(truth.joints.values())), truth.joint_names
        up = _middle(every, names, ('neck',)) - _middle(every, names, HIPS)
        above = _middle(every, names, SHOULDERS) - _middle(every, names, ('neck',))
        far = np.linalg.norm(up, axis=1)
        rest = result.joint_positions(body.prior_mean[None])[0]
        usual = _middle(rest, body.joint_names, ('neck',)) - _middle(rest, body.joint_names, HIPS)
        more = {
            'trunk': body.segment_lengths['trunk'] + float(far.mean() - np.linalg.norm(usual)),
            'shoulder_rise': float(((above * up).sum(1) / far).mean()),
        }
        result = result.with_segment_lengths(more)
    return result


def _scored_truth(clip: Clip) -> Any:
    names = clip.truth.joint_names
    scored = tuple(x for x in names if x in EVALUATED_JOINTS)
    rows = [names.index(x) for x in scored]
    joints = {stamp: x[rows] for stamp, x in clip.truth.joints.items()}
    return replace(clip.truth, joint_names=scored, joints=joints)


def _at_truth(body: Body, clip: Clip, stamps: list[int], real: bool) -> Array:
    """Poses (T, d) of a body nearest to the truth."""
    if real:
        clip = replace(clip, truth=_scored_truth(clip))
    starts = np.tile(body.prior_mean, (HEADINGS, 1))
    starts[:, :3] = np.nanmean([clip.truth.joints[x] for x in stamps], axis=(0, 1))
    turn = body.dof_names.index('root_z')
    starts[:, turn] = np.linspace(-np.pi, np.pi, HEADINGS, endpoint=False)
    return best_poses(body, clip, stamps, starts)


def scores_of_run(one: OracleRun) -> dict[str, dict[str, Any]]:
    """Scores of a run by table row; some runs have two rows."""
    given = given_of(one.folder, one.limit)
    if not one.oracle:
        poses = given.fitted[1]
        clip, usual = given.clip, given.body
        if clip.subject.is_file():
            usual = start_from_keypoints(usual, clip.camera, read_subject(clip.subject, usual)).body
        begun = _at_truth(usual, clip, [*poses], given.real)
        bodies = given.fitted[0], usual
        return {
            name: _scores(given.clip, {
                stamp: (body, pose[None], np.ones(1))
                for stamp, pose in zip(poses, every, strict=True)
            })
            for name, body, every in zip(FLOORS, bodies, (poses.values(), begun), strict=True)
        }  # fmt: skip
    return scores_with(ORACLES[one.oracle](given), one)


def scores_with(given: Given, one: OracleRun) -> dict[str, dict[str, Any]]:
    """Scores of a run with given inputs, by table row."""
    with patch.object(keypoint_term, 'LIFTED_WEIGHT', given.depth_weight):
        modes = _tracked(given, one)
    result = {one.oracle: _scores(given.clip, modes)}
    if one.oracle == PLAIN:
        result[HEADING] = _scores(given.clip, modes, right_way=True)
    return result


Modes = dict[int, tuple[Body, Array, Array]]


def _tracked(given: Given, one: OracleRun) -> Modes:
    """Body, poses (K, d) and weights (K,) by timestamp."""
    clip, settings = given.clip, given.settings
    if one.inputs == KEYPOINTS:
        settings = keypoints_only(settings)
    background = None if clip.background is None else BackgroundModel.from_image(clip.background)
    tracker = ToldTracker(given.body, clip.camera, settings, background, one.seed)
    tracker.told = given.depths
    if clip.subject.is_file():
        subject = read_subject(clip.subject, given.body)
        if given.lengths_known:
            subject = replace(subject, segment_lengths={}, stature=None)
        tracker.reset(subject)
    steps = stepped(clip, tracker, given.keypoints, gravity=one.gravity)
    return {
        step.stamp: (tracker.estimate.body, step.posterior.means, step.posterior.weights)
        for step in steps
        if step.posterior is not None and step.stamp in clip.truth.joints
    }


def _true(clip: Clip, stamp: int, name: str) -> Array:
    place: Array = clip.truth.joints[stamp][clip.truth.joint_names.index(name)]
    return place


def _middle(places: Array, names: Sequence[str], of: Sequence[str]) -> Array:
    result: Array = places[..., [names.index(x) for x in of], :].mean(-2)
    return result


def _scores(clip: Clip, modes: Modes, *, right_way: bool = False) -> dict[str, Any]:
    """Errors of modes, mm, means over the images.

    Also the errors of the heaviest mode in `lean` of the trunk towards the camera, degrees, and in
    the length `shin`, mm, estimated minus true; NaN if unknown.
    """
    truth = clip.truth
    names = [x for x in EVALUATED_JOINTS if x in truth.joint_names]
    origin = next(
        x for x in ((ORIGIN,), HIPS, SHOULDERS) if {*x} <= {*truth.joint_names}
    )  # fmt: skip
    rows: list[list[float]] = []
    by_joint = []
    for stamp, (body, poses, weights) in modes.items():
        true = np.array([_true(clip, stamp, x) for x in names])
        own = body.joint_positions(poses)
        middles = [
            _middle(own, body.joint_names, origin)[:, None],
            _middle(truth.joints[stamp], truth.joint_names, origin),
        ]
        own = own[:, body.skeleton.joint_index(names)]
        off = own - middles[0] - true + middles[1]
        errors = np.nanmean(np.linalg.norm(off, axis=2), axis=1)
        allowed = np.ones(len(errors), dtype=np.bool_)
        if right_way:
            ahead = (_across(own, names) * _across(true[None], names)).sum(1) > 0
            allowed = ahead if ahead.any() else allowed
        best = int(np.where(allowed, weights, -1.0).argmax())
        rays = true / np.linalg.norm(true, axis=1, keepdims=True)
        along = (off[best] * rays).sum(1)
        across = np.linalg.norm(off[best] - along[:, None] * rays, axis=1)
        by_joint.append(np.linalg.norm(off[best], axis=1))
        lean, shin = (a - b for a, b in zip(_build(own[best], names), _build(true, names)))
        rows.append([
            1e3 * errors[best], 1e3 * errors[allowed].min(), 1e3 * np.nanmean(np.abs(along)),
            1e3 * np.nanmean(across), lean, shin,
        ])  # fmt: skip
    known = (
        np.array(rows).reshape(-1, len(SCORES)).mean(0) if rows else np.full(len(SCORES), np.nan)
    )
    joints = 1e3 * np.nanmean(by_joint, axis=0) if rows else np.full(len(names), np.nan)
    return {
        **dict(zip(SCORES, map(float, known), strict=True)),
        'images': [len(rows), len(truth.joints)],
        'by_joint': dict(zip(names, map(float, joints), strict=True)),
    }


SCORES = ('heaviest', 'best', 'along', 'across', 'lean', 'shin')


def _across(joints: Array, names: list[str]) -> Array:
    """Vectors (N, 3) from right to left, from the shoulders and, if known, the hips."""
    pairs = [x for x in (SHOULDERS, HIPS) if {*x} <= {*names}]
    sides = [joints[:, names.index(a)] - joints[:, names.index(b)] for a, b in pairs]
    result: Array = np.sum(sides, axis=0)
    return result


def _build(joints: Array, names: list[str]) -> tuple[float, float]:
    """Lean of the trunk towards the camera, degrees, and the length of the shins, mm."""
    if not {*HIPS} <= {*names}:
        return np.nan, np.nan
    low, high = (_middle(joints, names, x) for x in (HIPS, SHOULDERS))
    up = (high - low) / np.linalg.norm(high - low)
    lean = np.degrees(np.arcsin(-up @ low / np.linalg.norm(low)))
    ends = [joints[[names.index(f'{s}_{x}') for s in ('left', 'right')]] for x in ('knee', 'ankle')]
    return float(lean), float(1e3 * np.linalg.norm(ends[0] - ends[1], axis=1).mean())


# All of them.


def measure(
    clips: Path | None = None,
    only: Sequence[str] = (),
    inputs: Sequence[str] = INPUTS,
    seeds: Sequence[int] = (0,),
    processes: int = 0,
    *,
    quick: bool = False,
) -> dict[str, Any]:
    """Scores by group, clip, input and oracle, means over seeds.

    Raises:
        FileNotFoundError: the clips are missing.
        ValueError: a clip can not be read.
    """
    names = [x for group in GROUPS.values() for x in group if x in (only or x)]
    if not names:
        raise ValueError(f'none of the clips {list(only)} has oracles')
    folders = with_file(names[:1] if quick else names, clips, 'truth.npz')
    limit = None
    if quick:
        limit, seeds, processes = QUICK, seeds[:1], 1
    runs = [
        OracleRun(folder, given, seed, limit=limit, gravity=GIVEN, oracle=oracle)
        for folder in folders
        for given, seed, oracle in [
            ('', 0, ''), *((g, s, o) for g in inputs for s in seeds for o in ORACLES)
        ]
    ]  # fmt: skip
    KEPT.mkdir(parents=True, exist_ok=True)
    in_processes(_kept, runs, processes, 'oracles')
    found: dict[tuple[str, str, str], list[dict[str, Any]]] = {}
    for one in runs:
        for oracle, scores in _kept(one).items():
            found.setdefault((one.clip, one.inputs, oracle), []).append(scores)
    entries = [
        {'clip': key[0], 'inputs': key[1], 'oracle': key[2], **_mean_of(scores)}
        for key, scores in found.items()
    ]
    return {'machine': description(), 'seeds': list(seeds), 'oracles': entries}


def _mean_of(scores: Sequence[dict[str, Any]]) -> dict[str, Any]:
    joints = {
        x: float(np.mean([one['by_joint'][x] for one in scores])) for x in scores[0]['by_joint']
    }
    numbers = {x: float(np.mean([one[x] for one in scores])) for x in SCORES}
    return {**numbers, 'images': scores[0]['images'], 'by_joint': joints}


def _kept(one: OracleRun) -> dict[str, dict[str, Any]]:
    """The scores of a run, cached until the code changes."""
    own = hashlib.sha256(Path(__file__).read_bytes()).hexdigest()[:8]
    path = KEPT / f'{name_of(one)}-{own}.oracle'
    if not path.is_file():
        path.write_text(json.dumps(scores_of_run(one)), 'utf-8')
    result: dict[str, dict[str, Any]] = json.loads(path.read_text('utf-8'))
    return result


# Tables.

MODES = ('heaviest', 'best')
KINDS = ('neck', 'shoulder', 'elbow', 'wrist', 'hip', 'knee', 'ankle')


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """Human-readable tables, real clips first; mm unless stated otherwise."""
    parts = [f'seeds {", ".join(map(str, result["seeds"]))}; gravity given where it is known; mm']
    entries, given = result['oracles'], dict.fromkeys(x['inputs'] for x in result['oracles'])
    for group, names in GROUPS.items():
        mine = [x for x in entries if x['clip'] in names]
        clips = list(dict.fromkeys(x['clip'] for x in mine))
        for inputs in filter(None, given if mine else ()):
            of = [x for x in mine if x['inputs'] == inputs]
            parts.append(f'{group}, {inputs}: means, and heaviest / best mode of each clip.')
            parts.append(_oracle_table(of, clips, markdown))
            if names == REAL:
                parts.append(f'{group}, {inputs}: along / across the line of sight.')
                parts.append(_oracle_table(of, clips, markdown, ('along', 'across')))
    parts.append(
        'Floors: our body at the pose nearest to the truth, by kind of joint; ours less the true '
        'lean of the trunk towards the camera, degrees, and length of the shins.'
    )
    parts.append(_floor_table(entries, markdown))
    return '\n\n'.join(parts)


def _oracle_table(
    entries: Sequence[dict[str, Any]],
    clips: Sequence[str],
    markdown: bool,
    shown: tuple[str, str] = MODES,
) -> str:
    """Two scores of each clip by oracle; for scores of modes also means over the clips."""
    heads = ('heaviest', 'best', 'along', 'across') if shown == MODES else ()
    rows = [['oracle', *heads, *(['gain'] if heads else []), *clips]]
    usual = _column([x for x in entries if x['oracle'] == PLAIN], 'heaviest')
    for oracle in dict.fromkeys(x['oracle'] for x in entries):
        own = [x for x in entries if x['oracle'] == oracle]
        means = [_cell(_column(own, x)) for x in heads]
        if heads:
            means.append(_cell(usual - _column(own, 'heaviest'), '+.0f'))
        each = [' / '.join(_cell(x[name]) for name in shown) for x in own]
        rows.append([oracle, *means, *each])
    return table(rows, markdown=markdown)


def _floor_table(entries: Sequence[dict[str, Any]], markdown: bool) -> str:
    rows = [['clips', 'poses', 'all', *KINDS, 'lean', 'shin']]
    for name in (*REAL, *list(GROUPS)[1:]):
        for oracle, inputs in (*((x, FLOOR) for x in FLOORS), (PLAIN, BOTH)):
            own = [
                x for x in entries
                if x['clip'] in GROUPS.get(name, (name,))
                and (x['oracle'], x['inputs']) == (oracle, inputs)
            ]  # fmt: skip
            if own:
                joints = [_of_kind(own, kind) for kind in KINDS]
                cells = [_column(own, 'heaviest'), *joints]
                lean, shin = _column(own, 'lean'), _column(own, 'shin')
                rows.append(
                    [name, oracle, *map(_cell, cells), _cell(lean, '+.1f'), _cell(shin, '+.0f')]
                )
    return table(rows, left=2, markdown=markdown)


def _column(entries: Sequence[dict[str, Any]], name: str) -> float:
    return float(np.mean([x[name] for x in entries])) if entries else np.nan


def _of_kind(entries: Sequence[dict[str, Any]], kind: str) -> float:
    found = [x for one in entries for name, x in one['by_joint'].items() if name.endswith(kind)]
    return float(np.mean(found)) if found else np.nan


def _cell(value: float, form: str = '.0f') -> str:
    return format(value, form) if np.isfinite(value) else '-'
