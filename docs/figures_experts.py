"""Draws the figures of experts.md and experts_figures.md: BME fig. 2, 6 to 12 and 16.

python docs/figures_experts.py     minutes

All except the toy need the motion capture; the real person also needs a detector and the clips.
"""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

for _name in ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS'):
    os.environ.setdefault(_name, '1')
DOCS = Path(__file__).resolve().parent
sys.path.insert(0, str(DOCS.parent))

import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402
from body_pictures import PAGE_STYLE, add_body, box_of, frame_image  # noqa: E402
from matplotlib.axes import Axes  # noqa: E402
from PIL import Image as Picture  # noqa: E402

from benchmarks.clips import development_folder, read_messages  # noqa: E402
from benchmarks.experts import BEST_OF, detected_masks  # noqa: E402
from hmt_learning.app.train import write_report  # noqa: E402
from hmt_learning.training.predictor_learning import described  # noqa: E402
from hmt_learning.training.training_set import (  # noqa: E402
    PoseSequence,
    TrainingSettings,
    motion_files,
    recorded_sequence,
    seen_from,
    training_set,
)
from hmt_ros.app.report.skeletons import save_picture  # noqa: E402
from hmt_ros.body import Body, Camera, load_body  # noqa: E402
from hmt_ros.detectors.registry import DETECTORS, USUAL_DETECTOR  # noqa: E402
from hmt_ros.evaluation.pose_scores import EVALUATED_JOINTS, ORIGIN  # noqa: E402
from hmt_ros.experts import (  # noqa: E402
    ConditionalDensity,
    ConditionalExperts,
    JointExperts,
    load_predictor,
)
from hmt_ros.experts.descriptor.silhouette_descriptor import silhouette_parts  # noqa: E402
from hmt_ros.experts.pose_predictor import PosePredictor  # noqa: E402
from msg_tools.messages.camera_info import camera_from_info  # noqa: E402
from msg_tools.messages.headers import time_ns  # noqa: E402
from msg_tools.messages.images import decode_image  # noqa: E402

EXPERTS = 5
COLOURS = ('#c8553d', '#1f3a5f', '#e0a458', '#588157', '#7b5e9a')
GREY = '#b8c4cf'
LIGHTEST = 0.02  # minimum weight of a drawn branch

# Training motions, and number of silhouettes, for the figures on ambiguity.
LEARNED = (
    'cmu_02_01_walk',
    'cmu_02_03_run',
    'cmu_13_29_exercise',
    'cmu_60_12_salsa',
    'cmu_10_01_kick',
)
SILHOUETTES = 2500
# Motions of people outside the training data: name, and heading, degrees.
STRIPS = {
    'walk': ('cmu_06_01_walk', 70.0),
    'run': ('cmu_run_c', 70.0),
    'turns': ('cmu_06_10_turns', 0.0),
    'conversation': ('cmu_14_19_laugh', 20.0),
}
PICTURES = 6
VIEW = 640.0  # focal length of the pictures, px
ANGLES = {'left_knee': 'left knee', 'right_elbow': 'right elbow'}
REAL, REAL_PICTURES = 'park_walk', 6


def toy(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Inputs x = y + 0.3 sin(2 pi y) + noise and targets y uniform in (0, 1), (N, 1) each."""
    rng = np.random.default_rng(seed)
    y = rng.uniform(0.0, 1.0, count)
    x = y + 0.3 * np.sin(2.0 * np.pi * y) + 0.05 * rng.standard_normal(count)
    return x[:, None], y[:, None]


def main() -> int:
    """Draws the figures."""
    plt.switch_backend('Agg')
    draw_toy()
    plt.rcParams.update(PAGE_STYLE)
    mocap = development_folder().parent / 'mocap'
    if not (mocap / 'dev').is_dir():
        sys.stderr.write(f'the other figures need motion capture in {mocap.resolve()}\n')
        return 0
    body, predictor = load_body('human37'), load_predictor()
    draw_ambiguity(body, mocap)
    motions = {name: recorded_sequence(_path(mocap, x), body) for name, (x, _) in STRIPS.items()}
    for name, motion in motions.items():
        draw_strip(predictor, motion, STRIPS[name][1], DOCS / f'experts_{name}.png')
    draw_angles(predictor, motions['walk'], STRIPS['walk'][1])
    clip = development_folder() / REAL
    if clip.is_dir() and DETECTORS[USUAL_DETECTOR].is_installed():
        draw_real(predictor, clip)
    return 0


def _path(mocap: Path, name: str) -> Path:
    (path,) = (x for x in motion_files(mocap) if x.stem == name)
    return path


def draw_ambiguity(body: Body, mocap: Path) -> None:
    """Draws affinities (fig. 7) and numbers of clusters (fig. 6)."""
    motions = [recorded_sequence(_path(mocap, name), body) for name in LEARNED]
    pairs = training_set(body, motions, TrainingSettings(samples=SILHOUETTES))
    with tempfile.TemporaryDirectory() as made:
        figures = write_report(Path(made), body, motions, pairs, described(body, pairs))
        for path, _ in figures[:2]:
            picture = Picture.open(path).convert('RGB')
            picture.quantize(256, dither=Picture.Dither.NONE).save(
                DOCS / f'experts_{path.name}', optimize=True
            )


def _predicted(
    predictor: PosePredictor, masks: np.ndarray, poses: np.ndarray
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Predicted poses (K, d), weights (K,) and errors (K,), mm, of silhouettes, heaviest first."""
    body, parts = predictor.body, predictor.descriptor
    scored, pelvis = (body.skeleton.joint_index(x) for x in (EVALUATED_JOINTS, (ORIGIN,)))
    rows = parts.describe([silhouette_parts(mask, parts.points) for mask in masks])
    result = []
    for row, true in zip(rows, poses, strict=True):
        found, weights = predictor.poses_at(row, true[:3], BEST_OF)
        joints = body.joint_positions(np.concatenate([true[None], found]))
        off = joints[:, scored] - joints[:, pelvis]
        errors = 1e3 * np.linalg.norm(off[1:] - off[0], axis=2).mean(1)
        result.append((found, weights, errors))
    return result


def draw_strip(predictor: PosePredictor, motion: PoseSequence, heading: float, path: Path) -> None:
    """Draws silhouettes, true poses, heaviest and best predictions (fig. 8 to 10)."""
    frames = np.linspace(0, len(motion.poses) - 1, PICTURES).astype(int)
    poses, masks = seen_from(predictor.body, motion, heading, boundary_noise=1.0)
    poses, masks = poses[frames], masks[frames]
    found = _predicted(predictor, masks, poses)
    rows = ('silhouette', 'truth', 'heaviest', f'best of {BEST_OF}')
    figure, axes = plt.subplots(
        len(rows), PICTURES, figsize=(8.4, 7.0), layout='constrained', squeeze=False
    )
    camera = Camera(VIEW, VIEW, 200.0, 200.0, 401, 401)
    for column, (mask, true, (modes, weights, errors)) in enumerate(
        zip(masks, poses, found, strict=True)
    ):
        axes[0, column].imshow(mask, cmap='gray_r', interpolation='nearest')
        axes[0, column].set(xticks=[], yticks=[])
        best = int(errors.argmin())
        box = box_of(camera.project(predictor.body.joint_positions(true[None])[0]), 0.15)
        drawn = (true, modes[0], modes[best])
        titles = ('', f'{errors[0]:.0f} mm', f'{errors[best]:.0f} mm, {weights[best]:.2f}')
        for one, pose, title in zip(axes[1:, column], drawn, titles, strict=True):
            frame_image(one, None, box)
            add_body(one, predictor.body, pose, camera)
            one.set_title(title, fontsize=8)
    for one, name in zip(axes[:, 0], rows, strict=True):
        one.set_ylabel(name)
    save_picture(figure, path)


def draw_angles(predictor: PosePredictor, motion: PoseSequence, heading: float) -> None:
    """Draws angles over time: truth, and all modes by their weights (fig. 11)."""
    poses, masks = seen_from(predictor.body, motion, heading, boundary_noise=1.0)
    found = _predicted(predictor, masks, poses)
    figure, axes = plt.subplots(
        len(ANGLES), 1, figsize=(8.4, 4.0), layout='constrained', sharex=True
    )
    times = np.arange(len(poses)) / 30.0
    for one, (name, title) in zip(axes, ANGLES.items(), strict=True):
        angle = predictor.body.dof_names.index(name)
        for t, (modes, weights, _) in zip(times, found, strict=True):
            sizes = 60.0 * weights
            one.scatter(np.full(len(modes), t), np.degrees(modes[:, angle]), sizes, COLOURS[0],
                        alpha=0.4, linewidths=0)  # fmt: skip
        one.plot(times, np.degrees(poses[:, angle]), color=COLOURS[1])
        one.set_ylabel(f'{title}, degrees')
    axes[-1].set_xlabel('s')
    save_picture(figure, DOCS / 'experts_angles.png')


def draw_real(predictor: PosePredictor, folder: Path) -> None:
    """Draws a detector's masks of a real person, and the two heaviest poses (fig. 16)."""
    info, messages = read_messages(folder)
    images = [decode_image(message) for message in messages]
    camera = camera_from_info(info, images[0].shape[1::-1])
    masks = detected_masks(images, [time_ns(message.header.stamp) for message in messages])
    seen = [i for i, mask in enumerate(masks) if mask.any() and not _cut(mask)]
    figure, axes = plt.subplots(
        3, REAL_PICTURES, figsize=(8.4, 5.2), layout='constrained', squeeze=False
    )
    for column, k in enumerate(np.linspace(0, len(seen) - 1, REAL_PICTURES).astype(int)):
        mask = masks[seen[k]]
        found = predictor.observe(
            mask, camera, max_components=BEST_OF, image=images[seen[k]]
        ).mixture
        rows, columns = np.nonzero(mask)
        box = box_of(np.stack([columns, rows], axis=1).astype(np.float64), 0.15)
        frame_image(axes[0, column], np.repeat(255 * (1 - mask[..., None]), 3, axis=2), box)
        for mode, one in enumerate(axes[1:, column]):
            frame_image(one, None, box)
            if mode < len(found):
                add_body(one, predictor.body, found.means[mode], camera)
                one.set_title(f'{found.weights[mode]:.2f}', fontsize=8)
    for one, name in zip(axes[:, 0], ('mask', 'heaviest', 'second'), strict=True):
        one.set_ylabel(name)
    save_picture(figure, DOCS / 'experts_real.png')


def _cut(mask: np.ndarray) -> bool:
    """Whether the image border cuts the person."""
    return bool(mask[[0, -1]].any() or mask[:, [0, -1]].any())


def draw_toy() -> None:
    """Draws the toy problem, in which a mixture follows all branches."""
    plt.rcParams.update({'font.size': 8, 'axes.spines.top': False, 'axes.spines.right': False})
    inputs, targets = toy(250, 0)
    models: dict[str, ConditionalDensity] = {
        'conditional': ConditionalExperts(EXPERTS, seed=0),
        'joint': JointExperts(EXPERTS, seed=0),
        'one regression': ConditionalExperts(1, seed=0),
    }
    figure, axes = plt.subplots(
        2, 3, figsize=(8.4, 4.2), sharex=True, sharey='row', layout='constrained',
        gridspec_kw={'height_ratios': [2, 1]},
    )  # fmt: skip
    test = toy(5000, 1000)
    at = np.linspace(float(inputs.min()), float(inputs.max()), 400)[:, None]
    for column, (name, model) in zip(axes.T, models.items(), strict=True):
        model.fit(inputs, targets)
        score = float(model.log_density(*test).mean())
        column[0].set_title(f'{name}: {score:.2f} nats')
        column[0].scatter(inputs[:, 0], targets[:, 0], s=5, color=GREY, linewidths=0)
        draw(column[0], column[1], at, model)
        column[1].set_xlabel('input')
    axes[0, 0].set_ylabel('target')
    axes[1, 0].set_ylabel('gate')
    figure.savefig(DOCS / 'experts_toy.png', dpi=130)
    plt.close(figure)


def draw(branches: Axes, gates: Axes, at: np.ndarray, model: ConditionalDensity) -> None:
    """Draws means and standard deviations of experts above LIGHTEST, and all weights."""
    weights, means, covariances = model.predict_arrays(at)
    deviations = np.sqrt(covariances[..., 0, 0])
    for i in range(weights.shape[1]):
        colour = COLOURS[i % len(COLOURS)]
        shown = weights[:, i] > LIGHTEST
        mean = np.where(shown, means[:, i, 0], np.nan)
        branches.plot(at[:, 0], mean, color=colour, linewidth=1.4)
        low, high = (mean + sign * 2.0 * deviations[:, i] for sign in (-1.0, 1.0))
        branches.fill_between(at[:, 0], low, high, color=colour, alpha=0.15, linewidth=0)
        gates.plot(at[:, 0], weights[:, i], color=colour, linewidth=1.2)


if __name__ == '__main__':
    sys.exit(main())
