"""Draws the figures of smoothing.md: those of VMS, for tracked clips.

python docs/figures_smoothing.py     two minutes

The figures of the clips need the development data; that of bags/reach does not.
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
    APART,
    DEMONSTRATION,
    DESK,
    TIMES,
    UPPER,
    ClipTrajectories,
    clip_trajectories,
    upper_distances,
)
from matplotlib.axes import Axes  # noqa: E402
from matplotlib.ticker import MaxNLocator  # noqa: E402

from benchmarks.clips import with_file  # noqa: E402
from benchmarks.runs import BOTH, IMAGES, KEYPOINTS  # noqa: E402
from hmt_ros.app.report.skeletons import save_picture  # noqa: E402

# Clips of the development data, and the inputs of the tracker for each.
CLIPS = {'exercise': BOTH, 'laugh': IMAGES, DESK: KEYPOINTS}
LINES = {
    'exercise': ('#1f3a5f', '-'),
    'laugh': ('#c8553d', '--'),
    DESK: ('#6b8f71', ':'),
    DEMONSTRATION: ('#8a6fb0', '-.'),
}
# File names of the film strips, by clip.
STRIPS = {'exercise': 'smoothing_strip.png', 'laugh': 'smoothing_optima.png'}
SPECTRUM = (1, 8, TIMES)
DARK, LIGHT, ACCENT = '#1f3a5f', '#9db4c8', '#c8553d'
PAIR = (DARK, ACCENT)
COLUMNS = 6
# Minimum share of a motion's paths through a mode that it visits.
WELL = 0.15
# Half the width of torso and arms from above, m; minimum width of a part of an image, relative to
# its height.
REACH, LEAST_WIDTH = 0.7, 0.75
# Number of trajectories sampled from the posterior, and seed.
DRAWN, SEED = 64, 0


def main() -> int:
    """Draws all figures whose data are available."""
    plt.switch_backend('Agg')
    demonstration = clip_trajectories(DEMONSTRATION, IMAGES)
    with plt.rc_context(PAGE_STYLE):
        draw_samples(demonstration)
        try:
            with_file([*CLIPS], None, 'truth.npz')
        except FileNotFoundError as error:
            print(f'figures of clips: skipped, {error}')  # noqa: T201
            return 0
        found = [clip_trajectories(name, inputs) for name, inputs in CLIPS.items()]
        draw_clips([*found, demonstration])
        for one in found:
            if one.clip.name in STRIPS:
                draw_pair(one, STRIPS[one.clip.name])
    return 0


# Curves of the clips.


def draw_clips(found: Sequence[ClipTrajectories]) -> None:
    """Draws visited modes, paths compared with optima, and numbers of trajectories."""
    figure, axes = plt.subplots(len(found), 1, figsize=(8.4, 9.6), dpi=100, layout='constrained')
    for ax, one in zip(axes, found, strict=True):
        draw_network(ax, one)
    axes[-1].set_xlabel('image')
    shown = axes[0].get_legend_handles_labels()
    legend = figure.legend(*shown, loc='outside upper center', ncols=3, frameon=False)
    for handle in legend.legend_handles[: len(shown[0]) - 3]:
        handle.set(sizes=[40.0], linewidths=[1.0])
    save(figure, 'smoothing_network.png')

    figure, axes = plt.subplots(
        2, len(found), figsize=(8.4, 4.9), dpi=110, layout='constrained', sharex='col'
    )
    for column, one in zip(axes.T, found, strict=True):
        draw_arm(column, one)
    axes[0, 0].set_ylabel('bent by, degrees')
    axes[1, 0].set_ylabel('depth from the shoulders, m')
    shown = axes[0, 0].get_legend_handles_labels()
    figure.legend(*shown, loc='outside upper center', ncols=3, frameon=False)
    save(figure, 'smoothing_angles.png')

    figure, axes = plt.subplots(2, 2, figsize=(8.4, 6.4), dpi=110, layout='constrained')
    for one in found:
        draw_numbers(axes, one)
    axes[0, 0].set(
        xlabel='motion (filled: refined on images)', ylabel='degrees (m as rad)', ylim=(0, None),
        title='Difference of a variable, modes to optimum',
    )  # fmt: skip
    axes[0, 1].axhline(0, color='black', lw=0.5)
    axes[0, 1].set(
        xlabel='motion (filled: refined on images)',
        ylabel='nats',
        title='-log likelihood an image, optimum minus modes',
    )
    axes[1, 0].set(
        xlabel='rank / size',
        ylabel='1 / rad², 1 / m²',
        ylim=(None, 1e11),
        title='Eigenvalues of the Hessian',
    )
    axes[1, 1].set(xlabel='iteration', ylabel='nats', title='Free energy, from its start')
    axes[1, 0].legend(title=f'largest / smallest / 1000, {SPECTRUM} images', frameon=False)
    shown = axes[1, 1].get_legend_handles_labels()
    figure.legend(*shown, loc='outside upper center', ncols=4, frameon=False)
    for ax in (*axes[0], axes[1, 1]):
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    save(figure, 'smoothing_trajectories.png')


def draw_network(axes: Axes, found: ClipTrajectories) -> None:
    """Draws the modes of each image by the depth of a joint; visited ones are filled (VMS 2)."""
    names = found.body.joint_names
    away = upper_distances(found.body, found.optima.means)[found.pair].max(0)
    joint = names.index(UPPER[int(away.argmax())])
    motions, counts = found.origins[[*found.pair]], []
    for t, (one, nodes) in enumerate(zip(found.modes, found.paths_through.T, strict=True)):
        seen = np.isin(np.arange(len(one.mixture)), nodes)
        depths = found.joints(one.mixture.means)[:, joint, 2]
        counts.append((len(seen), int(seen.sum())))
        smoothed = found.weights[t]
        own = np.where(seen[:, None], found.found.shares[t][:, motions] * smoothed[:, None], 0.0)
        a, b = (own > WELL * own.sum(0)).T
        kinds = (
            ('mode that no path visits', 8.0 * ~seen, 'white', '#aaaaaa'),
            (
                'mode that paths visit, larger if heavier',
                (10 + 250 * smoothed) * seen,
                LIGHT,
                LIGHT,
            ),
            ('visited by motion A', 14.0 * a, DARK, DARK),
            ('visited by motion B', 50.0 * b, 'none', ACCENT),
        )
        for label, sizes, face, edge in kinds:
            axes.scatter(
                np.full(len(seen), t), depths, s=sizes, color=face, edgecolors=edge,
                linewidths=np.where(sizes > 0, 1.0, 0.0), label=label if t == 0 else None,
            )  # fmt: skip
    i, j = found.pair
    depths = found.joints(found.optima.means)[:, :, joint, 2]
    axes.plot(depths[i], color=DARK, lw=1.2, zorder=3, label='optimum A')
    axes.plot(depths[j], color=ACCENT, lw=1.2, zorder=3, label='optimum B')
    axes.plot(found.truth[:, joint, 2], color='black', ls=':', lw=1.4, zorder=4, label='truth')
    modes, visited = np.mean(counts, axis=0)
    seen = f'{visited:.1f} of {modes:.1f} modes an image are visited'
    title = f'{found.clip.name}, {found.inputs}: {seen}'
    axes.set_title(title, loc='left')
    axes.set(ylabel=f'depth of\n{names[joint].replace("_", " ")}, m', xlim=(-1, TIMES))
    print(f'network {title}')  # noqa: T201


def draw_arm(axes: np.ndarray, found: ClipTrajectories) -> None:
    """Draws bending and end depth of the arm that refinement moves most (VMS 3, 4)."""
    best, names = found.pair[0], found.body.joint_names
    modes, optimum = (found.joints(poses[best]) for poses in (found.paths, found.optima.means))
    arms = [
        [names.index(f'{side}_{name}') for name in ('shoulder', 'elbow', 'wrist')]
        for side in ('left', 'right')
    ]
    arm = max(arms, key=lambda arm: np.abs(modes - optimum)[:, arm[2], 2].max())
    lines = (
        (modes, {'color': LIGHT, 'marker': '.', 'ms': 4, 'lw': 0.9, 'label': 'modes'}),
        (optimum, {'color': DARK, 'lw': 1.6, 'label': 'optimum'}),
        (found.truth, {'color': ACCENT, 'ls': ':', 'lw': 1.8, 'label': 'truth'}),
    )
    for joints, style in lines:
        axes[0].plot(found.seconds, bending(joints[:, arm]), **style)
        axes[1].plot(found.seconds, joints[:, arm[2], 2], **style)
    axes[0].set_title(f'{found.clip.name}: {names[arm[1]].replace("_", " ")}')
    axes[1].set(title=names[arm[2]].replace('_', ' '), xlabel='s')


def bending(joints: np.ndarray) -> np.ndarray:
    """Angles (T,) at the middle of three joints (T, 3, 3), degrees; 0 is straight."""
    first, second = joints[:, 1] - joints[:, 0], joints[:, 2] - joints[:, 1]
    cosine = (first * second).sum(1)
    cosine /= np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1)
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def draw_numbers(axes: np.ndarray, found: ClipTrajectories) -> None:
    """Draws differences, likelihoods, eigenvalues and free energy of a clip (VMS 5 to 8)."""
    colour, line = LINES[found.clip.name]
    style: dict[str, Any] = {'color': colour, 'ls': line, 'lw': 1.4, 'label': found.clip.name}
    moved = np.degrees(np.abs(found.optima.means - found.paths).mean((1, 2)))
    gains = (found.observed(found.optima.means) - found.observed(found.paths)) / len(found.modes)
    rank = np.arange(1, len(moved) + 1)
    for ax, values in zip(axes[0], (moved, gains), strict=True):
        ax.plot(rank, values, color=colour, ls=line, lw=0.8)
        for own, face in ((found.refined, colour), (~found.refined, 'white')):
            ax.scatter(rank[own], values[own], color=face, edgecolors=colour, s=26, zorder=3)
    spectra = [found.spectrum(images) for images in SPECTRUM]
    ratios = ', '.join(f'{values[0] / values[-1] / 1e3:.0f}' for values in spectra)
    for values, width in zip(spectra, (0.8, 1.4, 2.2), strict=True):
        label = f'{found.clip.name}: {ratios}' if width > 2 else None
        share = np.linspace(0, 1, len(values))
        axes[1, 0].semilogy(share, values, **{**style, 'lw': width, 'label': label})
    descent = found.descent()
    fallen = descent.held_out - descent.held_out[0]
    axes[1, 1].plot(fallen, marker='.', **style)
    print(  # noqa: T201
        f'{found.clip.name}: {found.refined.sum()} refined of {len(moved)} motions, moved by '
        f'{moved.round(1)} degrees, -log likelihood {gains.round(2)} nats an image; eigenvalues '
        f'{ratios}; free energy {fallen.round(1)}'
    )


# Film strips.


def draw_pair(found: ClipTrajectories, file: str) -> None:
    """Draws the two likely optima that differ longest, over images and from above (VMS 9)."""
    pair = [*found.pair]
    weights, logs = found.optima.weights[pair], found.optima.log_joint[pair]
    titles = [f'optimum {name},\n{100 * x:.0f} %' for name, x in zip('AB', weights, strict=True)]
    draw_strip(found, found.optima.means[pair], titles, file)
    print(f'weights {weights.round(2)}, log p(X, R) of B {logs[1] - logs[0]:+.1f}')  # noqa: T201


def draw_samples(found: ClipTrajectories) -> None:
    """Draws the two posterior samples with the largest distance (VMS 10)."""
    drawn = found.optima.sample(DRAWN, np.random.default_rng(SEED))
    away = upper_distances(found.body, drawn).mean((2, 3))
    both = np.unravel_index(int(np.argmax(away)), away.shape)
    titles = ['one sample', 'another sample']
    draw_strip(found, drawn[[*both]], titles, 'smoothing_samples.png')
    print(f'mean distances: median {np.median(away[away > 0]):.3f}, {away[both]:.3f} m')  # noqa: T201


def spread(images: np.ndarray, shown: int) -> list[int]:
    """Evenly spaced images; the one nearest to `shown` is replaced by it."""
    chosen = images[np.rint(np.linspace(0, len(images) - 1, COLUMNS)).astype(int)]
    chosen[np.abs(chosen - shown).argmin()] = shown
    return sorted(int(i) for i in chosen)


def draw_strip(
    found: ClipTrajectories, poses: np.ndarray, titles: Sequence[str], file: str
) -> None:
    """Draws two trajectories (2, T, d) over images in which they differ, and from above."""
    away = upper_distances(found.body, poses)[0, 1]
    between = np.flatnonzero(away.max(1) > APART)
    columns = spread(between, int(away.max(1).argmax()))
    print(  # noqa: T201
        f'{file}: {UPPER[int(away.max(0).argmax())]} apart by {away.max():.2f} m, '
        f'{len(between)} of {len(away)} images beyond {APART} m'
    )
    clip, names = found.clip, found.body.joint_names
    lower = [i for i, name in enumerate(names) if name not in (*UPPER, 'pelvis')]
    shown = np.concatenate([found.body.joint_positions(one[columns]) for one in poses])
    left, right, bottom, top = box_of(clip.camera.project(shown.reshape(-1, 3)))
    more = max(0.0, LEAST_WIDTH * (bottom - top) - (right - left)) / 2
    box = left - more, right + more, bottom, top
    heights = [(box[2] - box[3]) / (box[1] - box[0])] * 3 + [1.0]
    figure, axes = plt.subplots(
        4, len(columns), figsize=(8.4, 1.36 * sum(heights) + 0.3), dpi=90, layout='constrained',
        gridspec_kw={'height_ratios': heights},
    )  # fmt: skip
    # Images of the development data are not published; true joints are drawn instead.
    by_stamp = (
        dict(zip(clip.stamps, clip.images, strict=True)) if clip.name == DEMONSTRATION else {}
    )
    # Joints of both trajectories and the truth; unknown ones are not drawn.
    above = np.array([*found.joints(poses), found.truth])[..., [0, 2]]
    above[:, :, lower] = np.nan
    for column, index in enumerate(columns):
        axes[0, column].set_title(f'{found.seconds[index]:.2f} s')
        for row, axis in enumerate(axes[:3, column]):
            if row:
                add_body(axis, found.body, poses[row - 1, index], clip.camera, alpha=0.75)
            stamp = found.modes[index].stamp_ns
            if stamp not in by_stamp:
                add_skeleton(axis, clip.pixels[stamp], clip.truth.joint_names, 'black', 0.9)
            frame_image(axis, by_stamp.get(stamp), box)
        for every, colour, width in zip(above, (*PAIR, 'black'), (3.4, 1.7, 0.9), strict=True):
            add_skeleton(axes[3, column], every[index], names, colour, width)
        frame_above(axes[3, column])
        axes[3, column].set(xlim=(-REACH, REACH), ylim=(-REACH, REACH))
    labels = ('image' if by_stamp else 'truth', *titles, 'from above')
    for axis, label, colour in zip(axes[:, 0], labels, ('black', *PAIR, 'black'), strict=True):
        axis.set_ylabel(label, color=colour)
    save(figure, file)


def save(figure: plt.Figure, name: str) -> None:
    """Saves without date and versions, so that equal figures give equal files."""
    save_picture(figure, DOCS / name)
    plt.close(figure)


if __name__ == '__main__':
    sys.exit(main())
