from __future__ import annotations

import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hmt_learning.training.predictor_learning import Described, described, learned_predictor
from hmt_learning.training.training_set import TrainingSettings, procedural_sequence, training_set
from hmt_ros.body import Body, Camera, load_body
from hmt_ros.body.rasterisation import render_silhouettes
from hmt_ros.evaluation.pose_scores import EVALUATED_JOINTS
from hmt_ros.experts import LocalExperts, NearestNeighbours
from hmt_ros.experts.descriptor.contour import NoSilhouetteError
from hmt_ros.experts.pose_predictor import BY_EXPERTS, WITHOUT_PROPAGATION, PosePredictor
from test.forged_models import write_forged

CAMERA = Camera(400.0, 400.0, 199.5, 149.5, 400, 300)


@pytest.fixture(scope='module')
def body() -> Body:
    return load_body('human37')


@pytest.fixture(scope='module')
def training(body: Body) -> Described:
    sequences = [procedural_sequence('walk', body, 5.0, seed) for seed in (1, 2)]
    settings = TrainingSettings(samples=600, elevation_spread=3.0, dressed=0.0, cut=0.0)
    pairs = training_set(body, sequences, settings)
    return described(body, pairs, codebook_size=25, components=30)


@pytest.fixture(scope='module')
def predictor(body: Body, training: Described) -> PosePredictor:
    return learned_predictor(
        body, training, LocalExperts(n_neighbours=20), LocalExperts(n_neighbours=20)
    )


@pytest.fixture(scope='module')
def clip(body: Body) -> tuple[np.ndarray, np.ndarray]:
    """Poses and masks of a walk outside the training data."""
    poses = procedural_sequence('walk', body, 1.2, 9).poses[::2].copy()
    poses[:, :3] += [0.3, 0.0, 4.2] - poses[:, :3].mean(0)
    return poses, render_silhouettes(body, poses, CAMERA)


def errors(body: Body, found: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Pelvis-aligned joint errors (K,) in m."""
    index = body.skeleton.joint_index(['pelvis', *EVALUATED_JOINTS])
    joints, true = (body.joint_positions(x)[:, index] for x in (found, pose[None]))
    joints, true = (x[:, 1:] - x[:, :1] for x in (joints, true))
    return np.linalg.norm(joints - true, axis=2).mean(1)


def test_poses_of_a_new_walk(
    predictor: PosePredictor, body: Body, clip: tuple[np.ndarray, np.ndarray]
) -> None:
    best, depth = [], []
    for pose, mask in zip(*clip, strict=True):
        mixture = predictor.predict(mask, CAMERA)
        assert mixture.weights.sum() == pytest.approx(1.0)
        assert (np.diff(mixture.weights) <= 0).all()
        mixture.cholesky()
        away = errors(body, mixture.means, pose)
        best.append(away.min())
        k = int(away.argmin())
        depth.append((mixture.means[k, 2] - pose[2]) / np.sqrt(mixture.covariances[k, 2, 2]))
    assert np.mean(best) < 0.09
    assert np.abs(depth).mean() < 2.0


@pytest.mark.parametrize('quarters', [1, 2])
def test_a_camera_on_its_side_predicts_as_an_upright_one(
    predictor: PosePredictor, body: Body, clip: tuple[np.ndarray, np.ndarray], quarters: int
) -> None:
    turn = np.linalg.matrix_power(np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]]), quarters)
    level = body.levelled(turn)
    width, height = (300, 400) if quarters == 1 else (400, 300)
    camera = Camera(400.0, 400.0, 0.5 * (width - 1), 0.5 * (height - 1), width, height)
    index = body.skeleton.joint_index(['pelvis', *EVALUATED_JOINTS])
    best = []
    for pose, mask in zip(*clip, strict=True):
        # The image is rotated clockwise about its centre.
        seen = np.ascontiguousarray(np.rot90(mask, -quarters))
        found = predictor.with_body(level).observe(seen, camera).mixture
        joints = level.joint_positions(found.means)[:, index] @ turn
        true = body.joint_positions(pose[None])[:, index]
        away = (joints - joints[:, :1]) - (true - true[:, :1])
        best.append(np.linalg.norm(away[:, 1:], axis=2).mean(1).min())
    # As for the upright camera.
    assert np.mean(best) < 0.09


def test_rule_one_needs_a_model(
    body: Body, training: Described, clip: tuple[np.ndarray, np.ndarray]
) -> None:
    plain = learned_predictor(body, training, NearestNeighbours(5, 'common'))
    mask = clip[1][3]
    alone = plain.predict(mask, CAMERA)
    assert plain.observe(mask, CAMERA, alone, propagation=WITHOUT_PROPAGATION).mixture == alone
    with pytest.raises(ValueError, match='train it with --dynamics'):
        plain.observe(mask, CAMERA, alone, propagation=BY_EXPERTS)
    with pytest.raises(ValueError, match="no propagation 'rule'"):
        plain.observe(mask, CAMERA, alone, propagation='rule')


def test_a_file_brings_it_back(
    predictor: PosePredictor, clip: tuple[np.ndarray, np.ndarray], tmp_path: Path
) -> None:
    path = predictor.save(tmp_path / 'model')
    assert path.name == 'model.npz'
    again = PosePredictor.load(path)
    assert again.body.segment_lengths == predictor.body.segment_lengths
    one, two = (x.predict(clip[1][2], CAMERA) for x in (predictor, again))
    # Stored in half precision.
    np.testing.assert_allclose(two.means[0], one.means[0], atol=0.01)
    assert path.read_bytes() == predictor.save(tmp_path / 'other.npz').read_bytes()
    with zipfile.ZipFile(path) as archive:
        assert all(name.endswith('.npy') for name in archive.namelist())
    np.load(path, allow_pickle=False)


def test_another_person(
    predictor: PosePredictor, body: Body, clip: tuple[np.ndarray, np.ndarray]
) -> None:
    tall = predictor.with_body(body.with_stature(1.2 * body.stature))
    one, two = (x.predict(clip[1][0], CAMERA) for x in (predictor, tall))
    # A larger person with the same silhouette is further away.
    ratio = np.linalg.norm(two.means[0, :3]) / np.linalg.norm(one.means[0, :3])
    assert ratio == pytest.approx(1.2, abs=0.02)


def test_nobody_is_seen(predictor: PosePredictor) -> None:
    with pytest.raises(NoSilhouetteError, match='empty'):
        predictor.predict(np.zeros((300, 400)), CAMERA)


def test_an_image_full_of_somebody_is_like_nobody_learned(predictor: PosePredictor) -> None:
    found = predictor.observe(np.ones((300, 400), np.uint8), CAMERA)
    assert found.support < 0.1
    assert found.place.remarks
    assert np.isfinite(found.mixture.means).all()


def test_several_blobs_are_said(
    predictor: PosePredictor, clip: tuple[np.ndarray, np.ndarray]
) -> None:
    mask = clip[1][0].copy()
    free = 30 if mask[:, :60].sum() == 0 else 340
    mask[20:60, free : free + 30] = True
    found = predictor.observe(mask, CAMERA)
    assert 'left out' in found.place.remarks[0]
    plain = predictor.predict(clip[1][0], CAMERA)
    np.testing.assert_allclose(found.mixture.means, plain.means, atol=1e-9)


def test_a_person_cut_by_the_border(
    predictor: PosePredictor, clip: tuple[np.ndarray, np.ndarray]
) -> None:
    mask = clip[1][0].copy()
    rows = np.flatnonzero(mask.any(1))
    knees = int(rows[0] + 0.75 * len(rows))
    cut = np.roll(mask, 300 - knees, axis=0)
    cut[: 300 - knees] = False
    found = predictor.observe(cut, CAMERA)
    assert any(found.place.cut)
    assert 'bottom' in found.place.remarks[-1]
    whole = predictor.observe(mask, CAMERA)
    spreads = [
        np.sqrt(x.mixture.covariances[0, 2, 2]) / x.mixture.means[0, 2] for x in (found, whole)
    ]
    assert spreads[0] > 2 * spreads[1]


def test_a_mask_of_another_camera(predictor: PosePredictor) -> None:
    with pytest.raises(ValueError, match=r'\(300, 400\)'):
        predictor.predict(np.ones((10, 10)), CAMERA)


def test_nan_in_the_training_data(body: Body, training: Described) -> None:
    descriptors = training.descriptors.copy()
    descriptors[7, 2] = np.nan
    with pytest.raises(ValueError, match='finite'):
        learned_predictor(body, replace(training, descriptors=descriptors), LocalExperts())
    targets = training.targets.copy()
    targets[3] = np.inf
    with pytest.raises(ValueError, match='finite'):
        learned_predictor(body, replace(training, targets=targets), LocalExperts())


def test_fewer_samples_than_neighbours(body: Body, training: Described) -> None:
    few = replace(
        training, descriptors=training.descriptors[:9], targets=training.targets[:9],
        previous=training.previous[:9],
    )  # fmt: skip
    with pytest.raises(ValueError, match='9 samples'):
        learned_predictor(body, few, LocalExperts())


def test_files_that_are_no_predictors(predictor: PosePredictor, tmp_path: Path) -> None:
    path = predictor.save(tmp_path / 'model.npz')
    content = path.read_bytes()
    garbage, cut, empty = (tmp_path / f'{x}.npz' for x in ('garbage', 'cut', 'empty'))
    garbage.write_bytes(b'not a model' * 100)
    cut.write_bytes(content[: len(content) // 2])
    empty.write_bytes(b'')
    for bad in (garbage, cut, empty):
        with pytest.raises(ValueError, match='not a model file') as caught:
            PosePredictor.load(bad)
        assert bad.name in str(caught.value)
        assert '\n' not in str(caught.value)
    with pytest.raises(FileNotFoundError, match='no such model'):
        PosePredictor.load(tmp_path / 'absent.npz')
    with pytest.raises(ValueError, match='it is of another version'):
        PosePredictor.load(write_forged(tmp_path / 'v.npz', path, {'version': np.array(1)}))
    other = NearestNeighbours(1).fit(np.eye(4), np.eye(4)).save(tmp_path / 'nn.npz')
    with pytest.raises(ValueError, match="none of kind 'pose_predictor'"):
        PosePredictor.load(other)
    for changes in ({'descriptor/basis': np.eye(3)}, {'target_basis': None}):
        with pytest.raises(ValueError, match='not a model file that can be used'):
            PosePredictor.load(write_forged(tmp_path / 'd.npz', path, changes))


def test_another_body(predictor: PosePredictor, tmp_path: Path) -> None:
    path = predictor.save(tmp_path / 'model.npz')
    with pytest.raises(ValueError, match='37 degrees of freedom, but human32 has 32'):
        PosePredictor.load(path, load_body('human32'))
    with pytest.raises(ValueError, match='human34'):
        predictor.with_body(load_body('human34'))
    text = str(np.load(path)['parameters']).replace('"human37"', '"nobody"')
    forged = write_forged(tmp_path / 'n.npz', path, {'parameters': np.array(text)})
    with pytest.raises(ValueError, match='for a body that does not ship: give it') as caught:
        PosePredictor.load(forged)
    assert 'nobody' not in str(caught.value)
