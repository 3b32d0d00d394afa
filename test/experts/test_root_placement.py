from __future__ import annotations

import numpy as np
import pytest

from hmt_learning.motion.procedural_motion import procedural_motion
from hmt_learning.motion.viewpoint import Viewpoint
from hmt_ros.body import Body, Camera, load_body
from hmt_ros.body.rasterisation import render_silhouettes
from hmt_ros.experts.descriptor.contour import PersonBlob, person_blob
from hmt_ros.experts.pose_encoding import PoseEncoding
from hmt_ros.experts.root_placement import place_roots, placed_gaussians

CAMERA = Camera(660.0, 660.0, 319.5, 239.5, 640, 480)


@pytest.fixture(scope='module')
def body() -> Body:
    return load_body('human37')


@pytest.fixture(scope='module')
def poses(body: Body) -> np.ndarray:
    return procedural_motion('dance', body, 3.0, 4.0, 5, viewpoint=Viewpoint(4.0, 1.4, 0.1))


def seen(body: Body, poses: np.ndarray, camera: Camera = CAMERA) -> list[PersonBlob]:
    return [person_blob(m) for m in render_silhouettes(body, poses, camera)]


def small(encoding: PoseEncoding) -> np.ndarray:
    return 1e-6 * np.eye(encoding.size)[None]


def test_the_root_of_a_known_posture_is_found(body: Body, poses: np.ndarray) -> None:
    encoding = PoseEncoding(body)
    for pose, place in zip(poses, seen(body, poses), strict=True):
        target = encoding.encode(pose[None])
        found = place_roots(encoding, CAMERA, place, target, small(encoding))
        # A pixel of the box is 0.4 % of its height, and thus of the depth.
        np.testing.assert_allclose(found.roots[0], pose[:3], atol=0.035)
        assert not any(place.cut)


def test_off_the_axis_and_through_a_distorting_lens(body: Body, poses: np.ndarray) -> None:
    camera = Camera(300.0, 300.0, 319.5, 239.5, 640, 480, (-0.2, 0.05, 0.0, 0.0))
    encoding = PoseEncoding(body)
    target = encoding.encode(poses[:1])
    root = np.array([[1.7, 0.3, 3.2]])
    pose = encoding.decode(target, root)
    place = seen(body, pose, camera)[0]
    found = place_roots(encoding, camera, place, target, small(encoding))
    np.testing.assert_allclose(found.roots, root, atol=0.06)


def test_several_postures_are_placed_each_for_itself(body: Body, poses: np.ndarray) -> None:
    encoding = PoseEncoding(body)
    targets = encoding.encode(poses)
    place = seen(body, poses[:1])[0]
    covariances = np.repeat(small(encoding), len(poses), axis=0)
    together = place_roots(encoding, CAMERA, place, targets, covariances)
    alone = place_roots(encoding, CAMERA, place, targets[4:5], covariances[:1])
    np.testing.assert_allclose(together.roots[4], alone.roots[0], atol=1e-3)


def test_derivative_of_the_root_by_the_posture(body: Body, poses: np.ndarray) -> None:
    encoding = PoseEncoding(body)
    target = encoding.encode(poses[:1])
    place = seen(body, poses[:1])[0]
    found = place_roots(encoding, CAMERA, place, target, small(encoding))
    knee = body.dof_names.index('left_knee')
    step = np.zeros((1, encoding.size))
    step[0, [0, knee]] = 1e-4
    sides = [
        place_roots(encoding, CAMERA, place, target + sign * step, small(encoding)).roots[0]
        for sign in (1, -1)
    ]
    numeric = (sides[0] - sides[1]) / 2
    np.testing.assert_allclose(found.by_targets[0] @ step[0], numeric, atol=3e-6)


def test_a_cut_person_is_said_and_widens_the_depth(body: Body, poses: np.ndarray) -> None:
    encoding = PoseEncoding(body)
    pose = poses[:1].copy()
    pose[0, :3] = [0.0, 0.75, 2.6]  # the feet are below the image
    place = seen(body, pose)[0]
    assert place.cut == (False, False, False, True)
    target = encoding.encode(pose)
    covariance = 0.05**2 * np.eye(encoding.size)[None]
    found = place_roots(encoding, CAMERA, place, target, covariance, size_spread=0.0)
    whole = pose.copy()
    whole[0, :3] = [0.0, 0.1, 4.0]
    uncut = place_roots(
        encoding, CAMERA, seen(body, whole)[0], encoding.encode(whole), covariance, size_spread=0.0
    )
    relative = [float(np.sqrt(x.covariances[0, 2, 2]) / x.roots[0, 2]) for x in (found, uncut)]
    assert relative[0] > 1.5 * relative[1]
    np.testing.assert_allclose(found.roots[0], pose[0, :3], atol=0.5)


def test_a_person_cut_on_all_sides_keeps_a_wide_covariance(body: Body, poses: np.ndarray) -> None:
    encoding = PoseEncoding(body)
    place = PersonBlob(np.ones((480, 640), np.uint8), 0, 0, (True,) * 4, 0)
    target = encoding.encode(poses[:1])
    found = place_roots(encoding, CAMERA, place, target, small(encoding))
    assert np.isfinite(found.roots).all()
    assert np.sqrt(found.covariances[0, 2, 2]) > 0.25 * found.roots[0, 2]


def test_the_size_of_persons_spreads_the_depth(body: Body, poses: np.ndarray) -> None:
    encoding = PoseEncoding(body)
    target = encoding.encode(poses[:1])
    place = seen(body, poses[:1])[0]
    exact, loose = (
        place_roots(encoding, CAMERA, place, target, small(encoding), size_spread=s)
        for s in (0.0, 0.06)
    )
    added = loose.covariances[0] - exact.covariances[0]
    root = exact.roots[0]
    np.testing.assert_allclose(added, 0.06**2 * np.outer(root, root), rtol=1e-9)


def test_samples_of_the_placed_gaussian_have_the_box(body: Body, poses: np.ndarray) -> None:
    encoding = PoseEncoding(body)
    target = encoding.encode(poses[:1])
    covariance = 0.02**2 * np.eye(encoding.size)
    place = seen(body, poses[:1])[0]
    found = place_roots(encoding, CAMERA, place, target, covariance[None], size_spread=0.0)
    means, spreads = placed_gaussians(encoding, target, covariance[None], found)
    mean, spread = means[0], spreads[0]
    np.testing.assert_allclose(mean[:3], found.roots[0])
    np.linalg.cholesky(spread)
    samples = np.random.default_rng(0).multivariate_normal(mean, spread, 40)
    boxes = np.array([x.box for x in seen(body, np.clip(samples, body.lower, body.upper))])
    height = place.box[3] - place.box[1]
    # Independently placed samples would spread by the assumed noise, 2 %.
    assert np.abs(boxes.mean(0) - place.box).max() < 0.02 * height
    assert boxes.std(0).max() < 0.04 * height


def test_a_body_without_flesh_is_refused(body: Body, poses: np.ndarray) -> None:
    from dataclasses import replace

    bare = replace(body, shapes=(), growth=())
    encoding = PoseEncoding(bare)
    place = seen(body, poses[:1])[0]
    with pytest.raises(ValueError, match='no flesh'):
        place_roots(encoding, CAMERA, place, encoding.encode(poses[:1]), small(encoding))
