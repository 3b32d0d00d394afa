"""Draws the figures of smoothing.md: what VMS shows of its sequence, on clips that are tracked.

python docs/figures_smoothing.py     minutes

Those of the clips with known truth need the development data; those of bags/reach do not.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
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
)
from clip_trajectories import (  # noqa: E402
    EVERY,
    TIMES,
    ClipTrajectories,
    clip_trajectories,
    descent,
    pose_covariance,
)
from matplotlib.axes import Axes  # noqa: E402
from matplotlib.ticker import MaxNLocator  # noqa: E402
from scipy.special import logsumexp  # noqa: E402

from benchmarks.clips import ROOT, Clip, read_clip, with_file  # noqa: E402
from benchmarks.runs import IMAGES, UNKNOWN, Seen, tracked  # noqa: E402
from hmt_ros.app.report.skeletons import save_picture  # noqa: E402
from hmt_ros.smoothing.trajectory_refinement import RefinedTrajectories  # noqa: E402
from hmt_ros.smoothing.variational_mixture import VariationalMixture, laplace_masses  # noqa: E402

# A usual motion, one with the arms towards the camera, and one with many explanations.
CLIPS = ('walk', 'signals', 'laugh')
LINES = {'walk': ('#1f3a5f', '-'), 'signals': ('#c8553d', '--'), 'laugh': ('#6b8f71', ':')}
SPECTRUM = (1, 8, TIMES)
# Joints whose depth, and the bending at whose middle one, is drawn.
LIMBS = tuple(
    tuple(f'{side}_{name}' for name in names)
    for names in (('shoulder', 'elbow', 'wrist'), ('hip', 'knee', 'ankle'))
    for side in ('left', 'right')
)
DARK, LIGHT, ACCENT = '#1f3a5f', '#9db4c8', '#c8553d'
REACH, COLUMNS = ROOT / 'bags' / 'reach', 8
# Of the trajectories that are drawn from the posterior.
SAMPLES, SEED = 64, 0


def main() -> int:
    """Draws all figures whose data are there."""
    plt.switch_backend('Agg')
    try:
        folders = with_file(CLIPS, None, 'truth.npz')
    except FileNotFoundError as error:
        print(f'figures of clips: skipped, {error}')  # noqa: T201
        folders = []
    with plt.rc_context(PAGE_STYLE):
        if folders:
            draw_clips([read_clip(folder) for folder in folders])
        draw_reach(read_clip(REACH))
    return 0


# Curves of the clips.


def draw_clips(clips: Sequence[Clip]) -> None:
    """Visiting probabilities, paths against optima, and what trajectories have in numbers."""
    seen = {clip.name: tracked(clip, IMAGES, UNKNOWN)[::EVERY][:TIMES] for clip in clips}
    found = {name: clip_trajectories(one) for name, one in seen.items()}
    free = {name: descent(one) for name, one in found.items()}
    for name, one in found.items():
        print(f'{name}: {summary(one, seen[name], free[name])}')  # noqa: T201

    figure, axes = plt.subplots(len(clips), 1, figsize=(8.4, 5.4), dpi=110, layout='constrained')
    for ax, (name, one) in zip(axes, found.items(), strict=True):
        draw_visiting(ax, name, one)
    axes[-1].set_xlabel('image; its modes stand side by side')
    axes[1].set_ylabel('probability of a visit (odd images downwards)')
    save(figure, 'smoothing_network.png')

    figure, axes = plt.subplots(
        2, len(clips), figsize=(8.4, 4.9), dpi=110, layout='constrained', sharex='col'
    )
    for column, clip in zip(axes.T, clips, strict=True):
        draw_limb(column, clip, found[clip.name])
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc='outside upper center', ncols=3,
                  frameon=False)  # fmt: skip
    save(figure, 'smoothing_angles.png')

    figure, axes = plt.subplots(2, 2, figsize=(8.4, 6.0), dpi=110, layout='constrained')
    for name, one in found.items():
        colour, line = LINES[name]
        style: dict[str, Any] = {'color': colour, 'ls': line, 'lw': 1.4, 'label': name}
        axes[0, 0].plot(distances(one), **style)
        axes[0, 1].plot(np.sort(gains(one)), **style)
        trace = free[name].held_out
        axes[1, 1].plot(trace - trace[0], marker='.', **style)
        spectra = [1.0 / np.linalg.eigvalsh(pose_covariance(one, images)) for images in SPECTRUM]
        ratios = ', '.join(f'{values[0] / values[-1]:.0f}' for values in spectra)
        for values, width in zip(spectra, (0.8, 1.4, 2.2), strict=True):
            share = np.linspace(0, 1, len(values))
            label = f'{name}: {ratios}' if width > 2 else None
            axes[1, 0].semilogy(share, values, **{**style, 'lw': width, 'label': label})
    for ax in axes.flat:
        ax.legend(frameon=False)
    axes[1, 0].legend(title=f'largest / smallest, {SPECTRUM} images', frameon=False)
    axes[1, 1].legend(frameon=False, ncols=2, loc='upper right')
    axes[1, 1].set_ylim(-1.0, 0.9)
    axes[0, 0].set(
        xlabel='trajectory', ylabel='degrees (m as rad)', ylim=(0, None),
        title='Difference of a variable, path to optimum',
    )  # fmt: skip
    axes[0, 1].set(
        xlabel='trajectory, sorted', ylabel='nats',
        title='-log likelihood, optimum minus path',
    )  # fmt: skip
    axes[1, 0].set(
        xlabel='rank / size', ylabel='1 / rad², 1 / m²', ylim=(None, 1e10),
        title='Eigenvalues of the Hessian',
    )  # fmt: skip
    axes[1, 1].set(xlabel='iteration', ylabel='nats', title='Free energy, from its start')
    axes[1, 1].xaxis.set_major_locator(MaxNLocator(integer=True))
    save(figure, 'smoothing_trajectories.png')


def draw_visiting(axes: Axes, name: str, found: ClipTrajectories) -> None:
    """Modes of all images in a row, those of every second image downwards (VMS 2)."""
    values, owners = [], []
    for t, table in enumerate(found.visiting):
        values.append(table * (1 if t % 2 == 0 else -1))
        owners.append(np.full(table.shape[1], t))
    value, owner = np.concatenate(values, axis=1), np.concatenate(owners)
    at = np.arange(value.shape[1])
    for row in value:
        axes.vlines(at, 0, row, color=DARK, lw=0.9, alpha=0.35)
    axes.axhline(0, color='black', lw=0.5)
    times = range(0, len(found.stamps), 5)
    axes.set_xticks([int(np.flatnonzero(owner == t)[0]) for t in times], [str(t) for t in times])
    axes.set(ylim=(-1.05, 1.05), xlim=(-1, len(at)), yticks=(-1, 0, 1), yticklabels=('1', '0', '1'))
    visited = np.mean([(table.max(0) > 0.01).sum() for table in found.visiting])
    modes = np.mean([table.shape[1] for table in found.visiting])
    title = f'{name}: {visited:.1f} of {modes:.1f} modes of an image have more than 1 %'
    axes.set_title(title, loc='left')


def draw_limb(axes: np.ndarray, clip: Clip, found: ClipTrajectories) -> None:
    """The limb that the optimum moves most: its bending, and the depth of its end (VMS 3, 4)."""
    best = int(np.argmin(found.refined.energies))
    names = found.body.joint_names
    path, optimum = found.joints(found.starts[best]), found.joints(found.refined.states[best])
    moved = np.abs(depth(path, names) - depth(optimum, names)).max(0)
    limb = max(LIMBS, key=lambda limb: moved[names.index(limb[2])])
    truth = np.array([clip.truth.joints[stamp] for stamp in found.stamps])
    styles = (
        (path, names, {'color': LIGHT, 'marker': '.', 'ms': 4, 'lw': 0.9, 'label': 'path'}),
        (optimum, names, {'color': DARK, 'lw': 1.6, 'label': 'optimum'}),
        (truth, clip.truth.joint_names, {'color': ACCENT, 'ls': ':', 'lw': 1.6, 'label': 'truth'}),
    )
    for joints, own, style in styles:
        at = [own.index(name) for name in limb]
        axes[0].plot(found.seconds, bending(joints[:, at]), **style)
        axes[1].plot(found.seconds, depth(joints, own)[:, at[2]], **style)
    axes[0].set_title(f'{clip.name}: {limb[1].replace("_", " ")}')
    axes[1].set_title(limb[2].replace('_', ' '))
    axes[1].set_xlabel('s')
    if clip.name == CLIPS[0]:
        axes[0].set_ylabel('bent by, degrees')
        axes[1].set_ylabel('depth from the pelvis, m')


def depth(joints: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """How far joints (T, J) are beyond the middle of the hips, m."""
    hips = joints[:, [names.index('left_hip'), names.index('right_hip')]].mean(1)
    return joints[:, :, 2] - hips[:, 2:]


def bending(joints: np.ndarray) -> np.ndarray:
    """Angles (T,) at the middle one of three joints (T, 3, 3), degrees; 0: straight."""
    first, second = joints[:, 1] - joints[:, 0], joints[:, 2] - joints[:, 1]
    cosine = (first * second).sum(1)
    cosine /= np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1)
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def distances(found: ClipTrajectories) -> np.ndarray:
    """Mean differences (P,) of a variable between path and optimum, degrees (VMS 5)."""
    d = found.sequence.dynamics.dimension
    return np.degrees(np.abs(found.refined.states - found.starts)[..., :d].mean((1, 2)))


def gains(found: ClipTrajectories) -> np.ndarray:
    """-log likelihood (P,) of the images at optima minus that along paths, nats (VMS 6)."""
    return np.asarray(found.refined.observation_energies - found.start_energies)


def summary(found: ClipTrajectories, seen: Sequence[Seen], free: VariationalMixture) -> str:
    """What the page tells of a clip."""
    as_node = clip_trajectories(seen, independent=False)
    d, energies = found.sequence.dynamics.dimension, found.distinct.energies
    spread = []
    for images in SPECTRUM:
        covariance = pose_covariance(found, images)
        middle = images // 2 * d
        own = np.diagonal(covariance)[middle : middle + d][found.body.skeleton.dof_is_rotation]
        spread.append(float(np.degrees(np.sqrt(np.median(own)))))
    rough = [
        np.square(np.diff(x[..., :d], n=2, axis=1)).mean()
        for x in (found.refined.states, found.starts)
    ]
    count, trace = int((energies - energies[0] < 10).sum()), free.held_out
    return (
        f'{len(found.paths)} paths, {len(found.distinct)} optima, {count} of them within 10 nats; '
        f'as the node counts {len(as_node.distinct)}; differ by {distances(found).mean():.1f} '
        f'degrees, roughness {rough[0] / rough[1]:.3f} of that of paths; -log likelihood '
        f'{gains(found).mean():+.1f} nats over {len(seen)} images; median deviation of an angle of '
        f'{", ".join(f"{x:.1f}" for x in spread)} degrees by {SPECTRUM} images; free energy '
        f'{trace[0] - trace.min():.1f} nats in {int(np.argmin(trace))} iterations'
    )


# Film strips of the bag of the repository.


def draw_reach(clip: Clip) -> None:
    """Images, modes of the filter, trajectories and samples (VMS 9, 10)."""
    seen = tracked(clip, IMAGES, UNKNOWN)[::EVERY]
    found = clip_trajectories(seen, through_modes=True)
    d = found.sequence.dynamics.dimension
    log_masses = laplace_masses(found.distinct.energies, found.distinct.factors)
    masses = np.exp(log_masses - logsumexp(log_masses))
    order = np.argsort(-masses, kind='stable')
    distinct, weights = found.distinct[order], masses[order]
    optima = found.joints(distinct.states)
    optima = optima - optima[:, :, :1]
    apart = np.linalg.norm(optima - optima[:1], axis=3)
    other = int(np.argmax(apart.mean((1, 2))))
    filtered = np.array([one.posterior.means[one.posterior.weights.argmax()] for one in seen])
    first, second = (distinct.states[i, :, :d] for i in (0, other))
    difference = apart[other].max(1)
    columns = spread_columns(len(seen), int(np.argmax(difference)))
    bodies = [one.body for one in seen]
    print(  # noqa: T201
        f'reach: {len(distinct)} optima, the weights {np.round(weights, 3)}; number {other + 1} '
        f'differs by {difference.max():.2f} m at {found.seconds[np.argmax(difference)]:.1f} s, '
        f'{1e3 * apart[other].mean():.0f} mm in the mean; all by {apart.max((1, 2)).round(2)} m'
    )
    strips = {
        'heaviest of\nthe filter': filtered,
        f'optimum of\n{100 * weights[0]:.0f} %': first,
        f'optimum of\n{100 * weights[other]:.1f} %': second,
    }
    draw_strip(clip, found, bodies, columns, strips, 'smoothing_strip.png', images=True)

    drawn = samples(found, distinct, weights)
    joints = found.joints(drawn)
    joints = joints - joints[:, :, :1]
    between = np.linalg.norm(joints[:, None] - joints[None], axis=4).mean((2, 3))
    i, j = np.unravel_index(int(np.argmax(between)), between.shape)
    farthest = np.linalg.norm(joints[i] - joints[j], axis=2).max(1)
    median, most = (1e3 * float(x) for x in (np.median(between[between > 0]), between[i, j]))
    print(  # noqa: T201
        f'reach: of {len(drawn)} samples two differ by {median:.0f} mm in the median, '
        f'{most:.0f} mm at most, one joint by {farthest.max():.2f} m'
    )
    strips = {'one sample': drawn[i], 'another sample': drawn[j]}
    draw_strip(clip, found, bodies, columns, strips, 'smoothing_samples.png', images=False)


def spread_columns(count: int, shown: int) -> list[int]:
    """Images over the whole span, of which the nearest is replaced by one that is to be shown."""
    chosen = np.rint(np.linspace(0, count - 1, COLUMNS)).astype(int)
    chosen[np.abs(chosen - shown).argmin()] = shown
    return sorted(int(i) for i in chosen)


def samples(
    found: ClipTrajectories, optima: RefinedTrajectories, weights: np.ndarray
) -> np.ndarray:
    """Trajectories (S, T, d) of the mixture of Gaussians at the optima, weighed by their mass."""
    rng = np.random.default_rng(SEED)
    d = found.sequence.dynamics.dimension
    owners = rng.choice(len(weights), size=SAMPLES, p=weights)
    noise = rng.standard_normal((SAMPLES, *found.starts.shape[1:]))
    drawn = [
        optima.states[i] + optima.factors[i].solve_transposed(z)
        for i, z in zip(owners, noise, strict=True)
    ]
    return np.clip(np.array(drawn)[:, :, :d], found.lower, found.upper)


def draw_strip(
    clip: Clip, found: ClipTrajectories, bodies: Sequence[Any], columns: Sequence[int],
    strips: dict[str, np.ndarray], file: str, *, images: bool,
) -> None:  # fmt: skip
    """Poses over the images, and from above with the truth as a black skeleton."""
    pixels = np.array([clip.pixels[found.stamps[i]] for i in columns])
    box = box_of(pixels)
    rows = 2 * len(strips) + images
    kinds = ['image'] * images + ['image', 'above'] * len(strips)
    heights = [1.4 if kind == 'image' else 0.95 for kind in kinds]
    figure, axes = plt.subplots(
        rows, len(columns), figsize=(8.4, sum(heights) + 0.4), dpi=90, layout='constrained',
        gridspec_kw={'height_ratios': heights},
    )  # fmt: skip
    by_stamp = dict(zip(clip.stamps, clip.images, strict=True))
    names = clip.truth.joint_names
    for column, index in enumerate(columns):
        stamp = found.stamps[index]
        truth = clip.truth.joints[stamp]
        axes[0, column].set_title(f'{found.seconds[index]:.1f} s')
        for row, (title, poses) in enumerate(strips.items()):
            upper, lower = axes[2 * row + images, column], axes[2 * row + images + 1, column]
            add_body(upper, bodies[-1], poses[index], clip.camera, alpha=0.75)
            add_body(lower, bodies[-1], poses[index], None)
            away = truth - truth[names.index('pelvis')]
            add_skeleton(lower, away[:, [0, 2]], names, 'black', 0.9)
            frame_above(lower)
            if column == 0:
                upper.set_ylabel(title)
                lower.set_ylabel('from above')
        for axis, kind in zip(axes[:, column], kinds, strict=True):
            if kind == 'image':
                frame_image(axis, by_stamp[stamp], box)
    if images:
        axes[0, 0].set_ylabel('image')
    save(figure, file)


def save(figure: plt.Figure, name: str) -> None:
    """Without date and versions, so that the same figure is the same file."""
    save_picture(figure, DOCS / name)
    plt.close(figure)


if __name__ == '__main__':
    sys.exit(main())
