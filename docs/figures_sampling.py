"""Draws the figures of sampling.md: flips, distances of minima, and a dance.

python docs/figures_sampling.py     minutes

All figures except the distances need the development data.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

for _name in ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS'):
    os.environ.setdefault(_name, '1')
DOCS = Path(__file__).resolve().parent
sys.path.insert(0, str(DOCS.parent))

import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402
from body_pictures import (  # noqa: E402
    PAGE_STYLE,
    add_body,
    add_skeleton,
    box_of,
    frame_above,
    frame_image,
    from_above,
)
from matplotlib.axes import Axes  # noqa: E402

from benchmarks import kjs  # noqa: E402
from benchmarks.clips import Clip, read_clip, with_file  # noqa: E402
from benchmarks.runs import IMAGES, UNKNOWN, Seen, tracked  # noqa: E402
from hmt_ros.app.report.skeletons import save_picture  # noqa: E402
from hmt_ros.body import Body, load_body  # noqa: E402
from hmt_ros.body.kinematics import forward  # noqa: E402
from hmt_ros.evaluation.pose_scores import origin_joints, relative_positions  # noqa: E402
from hmt_ros.flips import enumerate_flips  # noqa: E402
from hmt_ros.inference.bounded_newton import Status  # noqa: E402
from hmt_ros.tracking.proposals.sampling import covariance_scaled_samples  # noqa: E402

SHOWN = {
    ('both arms, left calf', ''): 'kinematic jumps: both arms, left calf',
    ('CSS', '8'): 'CSS, scale 8',
}
SAMPLES, MINIMA, DARK = '#b8c4cf', '#c8553d', '#1f3a5f'
FARTHEST = (5.0, 320.0)
BINS = 32
# Clip of a dance for the strip, as in the paper; clips for the jumps, and poses of each.
DANCE, COLUMNS = 'charleston', 8
JUMPED, POSES = ('walk', 'signals', 'laugh'), 12
JUMPS, SCALE = 'both arms, left calf', 4.0
FLIPPED = 'signals'
ARMS = ('right_arm', 'left_arm')
# Minimum distance of distinct leaves, m.
SAME = 1e-3


def main() -> int:
    """Draws all figures whose data are available."""
    plt.switch_backend('Agg')
    with plt.rc_context(PAGE_STYLE):
        draw_distances()
        try:
            folders = with_file(sorted({DANCE, *JUMPED, FLIPPED}), None, 'truth.npz')
        except FileNotFoundError as error:
            print(f'figures of clips: skipped, {error}')  # noqa: T201
            return 0
        clips = {folder.name: read_clip(folder) for folder in folders}
        seen = {name: tracked(clip, IMAGES, UNKNOWN) for name, clip in clips.items()}
        draw_flips(seen[FLIPPED])
        draw_jumps({name: seen[name] for name in JUMPED})
        draw_strip(clips[DANCE], seen[DANCE])
    return 0


def draw_distances() -> None:
    """Draws the distances of minima from the start (KJS 6)."""
    body = load_body('human34')
    setting = kjs.setting_of(body, kjs.chosen_pose(body))
    figure, axes = plt.subplots(
        2, 2, figsize=(8.4, 4.6), dpi=110, sharex='col', sharey='row', layout='constrained'
    )
    rows = iter(axes)
    for found in kjs.all_samples(setting, 2000, 0, 1):
        title = SHOWN.get((found.sampler, found.scale))
        if title is None:
            continue
        row = next(rows)
        converged = found.optimised.status == Status.CONVERGED
        samples = kjs.distances_from(setting, found.optimised.x[converged])
        minima = kjs.distances_from(setting, found.optimised.x[found.minima])
        for axis, every, distinct, farthest in zip(row, samples, minima, FARTHEST, strict=True):
            bins = np.linspace(0.0, farthest, BINS + 1)
            axis.hist(
                np.minimum(every, farthest), bins, color=SAMPLES,
                label=f'{len(every)} samples, optimised',
            )  # fmt: skip
            axis.hist(
                np.minimum(distinct, farthest), bins, color=MINIMA, rwidth=0.6,
                label=f'{len(distinct)} distinct minima',
            )  # fmt: skip
        row[0].set_title(title, loc='left')
        row[0].set_ylabel('number')
        row[0].legend(frameon=False, loc='upper right')
        row[0].set_ylim(top=1.35 * row[0].get_ylim()[1])
    axes[1, 0].set_xlabel('distance from the start, m and rad together')
    axes[1, 1].set_xlabel('distance from the start, standard deviations')
    save(figure, 'sampling_distances.png')


# Flips of an arm.


def draw_flips(seen: Sequence[Seen]) -> None:
    """Draws the joints of an arm (KJS 3), and its interpretation tree at a tracked pose (KJS 2)."""
    body, pose, chain = max(
        ((x.body, heaviest(x), chain) for x in seen for chain in ARMS), key=telling
    )
    reached, pruned = leaves(body, pose, chain)
    figure, axes = plt.subplots(1, 3, figsize=(8.4, 3.6), dpi=110, layout='constrained')
    draw_limb(axes[0], body, chain)
    given = reached[0]
    views = (
        (axes[1], lambda line: line[:, :2] / line[:, 2:], 'from the camera: all the same'),
        (axes[2], lambda line: line[:, [0, 2]] - given[0, [0, 2]], 'from above'),
    )
    for axis, view, title in views:
        for line in pruned:
            axis.plot(*view(line).T, ls=':', color='#777777', lw=1.6, marker='.', ms=5)
        for line in reached[1:]:
            axis.plot(*view(line).T, color=MINIMA, lw=1.4, marker='o', ms=4)
        axis.plot(*view(given).T, color=DARK, lw=2.6, marker='o', ms=5)
        axis.set_title(title)
        axis.set_aspect('equal', adjustable='datalim')
        axis.margins(0.15)
    axes[1].invert_yaxis()
    axes[1].set(xlabel='x / z', ylabel='y / z')
    axes[2].set(xlabel='to the right of the shoulder, m', ylabel='away from the camera, m')
    for name, colour, style in (
        ('pose', DARK, '-'), (f'{len(reached) - 1} flips', MINIMA, '-'),
        (f'{len(pruned)} beyond limits', '#777777', ':'),
    ):  # fmt: skip
        axes[2].plot([], [], color=colour, ls=style, label=name)
    figure.legend(
        *axes[2].get_legend_handles_labels(), loc='outside lower center', ncols=3, frameon=False
    )
    print(f'{FLIPPED}, {chain}: {len(reached)} leaves, {len(pruned)} pruned')  # noqa: T201
    save(figure, 'sampling_flips.png')


def heaviest(one: Seen) -> np.ndarray:
    """The heaviest mode (d,) of an image."""
    return np.asarray(one.posterior.means[one.posterior.weights.argmax()])


def telling(arm: tuple[Body, np.ndarray, str]) -> float:
    """Score of an arm as an example: leaves within and beyond the limits, all visible."""
    reached, pruned = leaves(*arm)
    if len(reached) < 3 or len(pruned) == 0:
        return 0.0
    links = np.diff(reached[0], axis=0)
    depths = np.ptp(reached[:, :, 2], axis=0)[1:]
    return float(np.abs(links[:, 0]).min() * depths.min())


def leaves(body: Body, pose: np.ndarray, chain: str) -> tuple[np.ndarray, np.ndarray]:
    """Joints (L, K + 1, 3) of all poses of a K-link chain with one image, and poses beyond limits.

    The first leaf is the given pose.
    """

    def joints(poses: np.ndarray) -> np.ndarray:
        return body.joint_positions(poses)[:, body.skeleton.chain_joints[chain]]

    flipped = joints(enumerate_flips(body, pose, chain)[0])
    given = flipped[0]
    tree = [given[:1]]
    for start, end in pairwise(given):
        length, ray = np.linalg.norm(end - start), end / np.linalg.norm(end)
        grown = []
        for line in tree:
            along, apart = ray @ line[-1], line[-1] @ line[-1] - length**2
            root = along**2 - apart
            if root >= 0:
                grown += [np.vstack([line, (along + s * np.sqrt(root)) * ray]) for s in (-1, 1)]
        tree = grown
    beyond = [x for x in tree if np.abs(flipped - x).max((1, 2)).min() > SAME]
    return flipped, np.array(beyond).reshape(-1, *given.shape)


def draw_limb(axes: Axes, body: Body, chain: str) -> None:
    """Draws a half-bent limb with the axes of its joints, in an oblique view (KJS 3)."""
    skeleton = body.skeleton
    pose = np.zeros(body.dimension)
    names = [name for name in skeleton.dof_names if name.endswith('elbow')]
    pose[skeleton.dof_index(names)] = np.radians(50.0)
    pose = np.clip(pose, body.lower, body.upper)
    frames = forward(skeleton, pose[None])
    view = np.array([[0.8, 0.6, 0.0], [0.2, -0.25, 0.95]])
    joints = body.joint_positions(pose[None])[0, skeleton.chain_joints[chain]]
    base = limb_axes(joints)
    flat = (joints - joints[0]) @ base.T @ view.T
    axes.plot(*flat.T, color='#9a9a9a', lw=5, solid_capstyle='round', zorder=1)
    axes.plot(*flat.T, 'o', color='black', ms=5, zorder=2)
    for letter, dof in zip('abcefg', skeleton.chain_dofs[chain], strict=True):
        origin = (frames.dof_origins[dof, :, 0] - joints[0]) @ base.T @ view.T
        arrow = 0.12 * frames.axes[dof, :, 0] @ base.T @ view.T
        axes.annotate(
            '', origin + arrow, origin, arrowprops={'arrowstyle': '->', 'color': DARK, 'lw': 1.3}
        )
        axes.text(*(origin + 1.35 * arrow), letter, color=DARK, ha='center', va='center')
    for point, title in zip(flat, ('spherical', 'hinge', 'two angles'), strict=False):
        axes.text(point[0] + 0.04, point[1], title, va='center')
    axes.set(title='a limb and its angles', xticks=[], yticks=[])
    axes.set_aspect('equal', adjustable='datalim')
    # Invisible points that extend the picture.
    axes.plot([-0.3, 0.35], [-0.55, 0.22], alpha=0.0)
    for spine in axes.spines.values():
        spine.set_visible(False)


def limb_axes(joints: np.ndarray) -> np.ndarray:
    """Axes (3, 3) of a limb in rows: bending axis, forwards, and up along its first link."""
    up = joints[0] - joints[1]
    up /= np.linalg.norm(up)
    across = np.cross(up, joints[2] - joints[1])
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(up, across), up])


# Jumps at tracked poses.


def draw_jumps(seen: dict[str, Sequence[Seen]]) -> None:
    """Draws minima found by jumps and CSS at tracked poses, and raw costs (as KJS, table 1)."""
    figure, axes = plt.subplots(1, 3, figsize=(8.4, 3.2), dpi=110, layout='constrained')
    styles = zip(seen.items(), ((DARK, 'o'), (MINIMA, 's'), ('#6b8f71', '^')), strict=True)
    rows = []
    for (name, every), (colour, marker) in styles:
        chosen = np.linspace(0, len(every) - 1, POSES).astype(int)
        found = np.array([jumps_at(every[i], int(i)) for i in chosen])
        rows.append(found)
        number, minima, random, cost, random_cost = found.T
        style: dict[str, Any] = {'color': colour, 'ls': '', 'marker': marker, 'ms': 5}
        axes[0].plot(number, minima, label=name, **style)
        axes[1].plot(random / number, minima / number, label=name, **style)
        axes[2].plot(random_cost, cost, label=name, **style)
    axes[0].plot([8, 1000], [8, 1000], color='#999999', lw=0.8, zorder=0)
    axes[1].plot([0, 1], [0, 1], color='#999999', lw=0.8, zorder=0)
    axes[0].legend(frameon=False)
    axes[0].set(
        xlabel='leaves', ylabel='distinct minima', xscale='log', yscale='log',
        title='Jumps: arms and a leg',
    )  # fmt: skip
    axes[1].set(
        xlabel=f'CSS, scale {SCALE:g}', ylabel='jumps', xlim=(0, 1.02), ylim=(0, 1.05),
        title='Minima a sample',
    )  # fmt: skip
    axes[2].set(
        xlabel=f'CSS, scale {SCALE:g}', ylabel='jumps', xscale='log', yscale='log',
        title='Cost of raw samples, nats',
    )  # fmt: skip
    every_pose = np.concatenate(rows)
    print(  # noqa: T201
        f'jumps: leaves, minima, minima of CSS: {every_pose[:, :3].sum(0)}; more than CSS at '
        f'{(every_pose[:, 1] > every_pose[:, 2]).sum()} of {len(every_pose)} poses; median costs '
        f'{np.median(every_pose[:, 3:], axis=0)}; by clip {[x[:, :3].sum(0) for x in rows]}'
    )
    save(figure, 'sampling_jumps.png')


def jumps_at(one: Seen, seed: int) -> tuple[float, ...]:
    """Compares jumps with as many samples of CSS at the heaviest mode of an image.

    Returns:
        Number of leaves, distinct minima of jumps and of CSS that explain the image as well, and
        median costs of raw samples of both.
    """
    setting = kjs.setting_of(one.body, heaviest(one))
    least = setting.start.value[0]
    found = kjs.kinematic_jumps(setting, JUMPS)
    drawn = covariance_scaled_samples(
        one.body, setting.start.x, setting.covariance[None], len(found.raw), SCALE,
        np.random.default_rng(seed),
    )[0]  # fmt: skip
    random = kjs.optimise(one.body, setting.energy, drawn)
    alike = [
        (every.value[kjs.minima_of(one.body, every)] - least < kjs.ALIKE).sum()
        for every in (found.optimised, random)
    ]
    costs = setting.energy.energy(drawn, derivatives=False).value - least
    return len(found.raw), *map(float, alike), *map(float, map(np.median, (found.costs, costs)))


# A dance.


def draw_strip(clip: Clip, seen: Sequence[Seen]) -> None:
    """Draws the truth and the heaviest mode in the image, and both from above (KJS 7)."""
    rows = np.linspace(0, len(seen) - 1, COLUMNS).astype(int)
    names = clip.truth.joint_names
    pixels = np.array([clip.pixels[seen[i].stamp] for i in rows])
    boxes = np.array([box_of(x, 0.2) for x in pixels])
    # All images have the same scale.
    middle = boxes.reshape(-1, 2, 2).mean(2, keepdims=True)
    half = 0.5 * np.diff(boxes.reshape(-1, 2, 2), axis=2)
    half = np.where(half > 0, half.max(0), half.min(0))
    boxes = np.concatenate([middle - half, middle + half], axis=2).reshape(-1, 4)
    figure, axes = plt.subplots(
        3, COLUMNS, figsize=(8.4, 5.4), dpi=100, layout='constrained',
        gridspec_kw={'height_ratios': [1.6, 1.6, 1.0]},
    )  # fmt: skip
    for column, i in enumerate(rows):
        one = seen[i]
        pose, truth = heaviest(one), clip.truth.joints[one.stamp]
        left, right, bottom, top = boxes[column].tolist()
        add_skeleton(axes[0, column], pixels[column], names)
        add_body(axes[1, column], one.body, pose, clip.camera)
        add_skeleton(axes[1, column], pixels[column], names, 'black', 0.9)
        for row in (0, 1):
            frame_image(axes[row, column], None, (left, right, bottom, top))
        add_body(axes[2, column], one.body, pose, None)
        origin = truth[[names.index(name) for name in origin_joints(names)]].mean(0)
        add_skeleton(axes[2, column], from_above(truth, origin), names, 'black', 0.9)
        frame_above(axes[2, column])
        axes[2, column].set_xlabel(f'{error_of(one, clip):.0f} mm')
        axes[0, column].set_title(f'{(one.stamp - seen[0].stamp) * 1e-9:.1f} s')
    for row, title in enumerate(('truth', 'heaviest mode', 'from above')):
        axes[row, 0].set_ylabel(title)
    save(figure, 'sampling_strip.png')


def error_of(one: Seen, clip: Clip) -> float:
    """Mean error of the joints of the heaviest mode, mm."""
    scored, origin = clip.truth.evaluated_joints(), origin_joints(clip.truth.joint_names)
    found, true = (
        relative_positions(joints, names, scored, origin)
        for joints, names in (
            (one.body.joint_positions(heaviest(one)[None])[0], one.body.joint_names),
            (clip.truth.joints[one.stamp], clip.truth.joint_names),
        )
    )
    return float(1e3 * np.linalg.norm(found - true, axis=1).mean())


def save(figure: plt.Figure, name: str) -> None:
    """Saves without date and versions, so that equal figures give equal files."""
    save_picture(figure, DOCS / name)
    plt.close(figure)


if __name__ == '__main__':
    sys.exit(main())
