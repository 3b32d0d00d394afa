"""The ground: prior knowledge, and its estimate from a track."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from hmt_learning.motion.procedural_motion import procedural_motion
from hmt_learning.motion.viewpoint import Viewpoint
from hmt_ros.body import load_body
from hmt_ros.body.ground_terms import GroundSettings, sole_points, soles
from hmt_ros.body.kinematics import forward
from hmt_ros.image.likelihood import LikelihoodSettings
from hmt_ros.image.observation import Observation
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference.error_model import ERRORS
from hmt_ros.tracking import KnownGround, Subject, Tracker, TrackerSettings
from hmt_ros.tracking.ground import GroundEstimator
from hmt_ros.tracking.hypotheses import Modes, new_hypotheses
from hmt_ros.tracking.posterior import Posterior
from hmt_ros.tracking.settings import AXIS_SIGMA
from test.image.drawn_rooms import ROOM_CAMERA, drawn, room, turn

RATE = 30.0
PITCHED = Viewpoint(distance=3.5, height=1.4, pitch=np.radians(20.0))
OFF = GroundSettings(0.0, 0.0)


@pytest.fixture(scope='module')
def body():
    return load_body('human37')


@pytest.fixture(scope='module')
def reaching(body) -> np.ndarray:
    """Poses (90, d) of a person who stands on both feet and reaches for things."""
    return procedural_motion('reach', body, 3.0, RATE, 1, viewpoint=PITCHED)


@pytest.fixture(scope='module')
def walking(body) -> np.ndarray:
    return procedural_motion('walk', body, 3.0, RATE, 1, viewpoint=PITCHED)


def up_of(view: Viewpoint) -> np.ndarray:
    return view.rotation @ np.array([0.0, 0.0, 1.0])


def single(pose: np.ndarray, velocity: np.ndarray | None = None) -> Modes:
    """One mode, its own ancestor."""
    start, d = new_hypotheses(pose[None], np.zeros(1)), len(pose)
    velocities = np.zeros((1, d)) if velocity is None else velocity[None]
    one = np.eye(d)[None]
    return replace(
        Modes.blank(1, pose.size),
        **vars(start),
        velocities=velocities,
        covariances=one,
        filtered=one,
        state_covariances=one,
    )


def after(estimator: GroundEstimator, body, poses: np.ndarray) -> GroundEstimator:
    for pose in poses:
        estimator.update(body, single(pose), 1.0, 1.0 / RATE)
    return estimator


def resting(body, plane, poses, rate: float, *, still: bool = True) -> list[list[float]]:
    """Probabilities that the left and the right foot rest, image by image."""
    modes, found, estimator, shown = None, [], GroundEstimator(), GroundEstimator()
    estimator.plane, estimator.still, shown.still = plane, still, True
    for pose in poses:
        modes = estimator.with_contacts(body, single(pose), modes, 1.0 / rate)
        found.append(list(shown.by_foot(modes).values()))
    return found


def degrees_between(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b, -1.0, 1.0))))


@pytest.mark.parametrize(
    ('values', 'said'),
    [
        ({'up': np.array([0.0, -9.81, 0.0])}, 'up must be a unit vector'),
        ({'up': np.array([0.0, -1.0])}, 'up must be a unit vector'),
        ({'up': np.array([0.0, np.nan, 1.0])}, 'up must be a unit vector'),
        ({'camera_height': 0.0}, 'camera_height must be a positive number of metres, saw 0.0'),
        ({'camera_height': np.nan}, 'camera_height must be a positive number'),
    ],
)
def test_what_is_no_ground_is_refused(values, said):
    with pytest.raises(ValueError, match=said):
        KnownGround(**values)


def test_what_is_known_is_the_estimate():
    up = up_of(PITCHED)
    ground = GroundEstimator(KnownGround(up, 1.4)).estimate
    assert ground.up == pytest.approx(up)
    assert ground.height == 1.4
    assert ground.plane == pytest.approx([*up, 1.4])
    # The floor under the world's origin.
    assert ground.plane @ [*PITCHED.translation, 1.0] == pytest.approx(0.0)


@pytest.mark.parametrize('name', ['reaching', 'walking'])
def test_the_height_of_the_camera_is_found(name, body, request):
    poses = request.getfixturevalue(name)
    found = after(GroundEstimator(KnownGround(up_of(PITCHED))), body, poses).estimate
    assert found.height == pytest.approx(1.4, abs=0.04)
    assert 0.03 < found.height_sigma < 0.08


def test_a_floor_is_measured_where_its_height_was_given(body, reaching):
    up = up_of(PITCHED)
    sure = KnownGround(up, 1.4, np.radians(0.5))
    assert after(GroundEstimator(sure), body, reaching[:5]).plane.measured
    assert not after(GroundEstimator(KnownGround(up)), body, reaching[:5]).plane.measured
    # Two degrees are 12 cm at the person; the soles are more precise.
    assert not after(GroundEstimator(KnownGround(up, 1.4)), body, reaching[:5]).plane.measured
    # Without the vertical, the camera height hardly determines the floor at the feet.
    assert not after(GroundEstimator(KnownGround(None, 1.4)), body, reaching[:5]).plane.measured


def test_the_vertical_is_found_slowly_and_never_surely(body, reaching):
    estimator = GroundEstimator()
    truth = up_of(PITCHED)
    errors = [degrees_between(estimator.estimate.up, truth)]
    for _ in range(3):
        after(estimator, body, reaching)
        errors.append(degrees_between(estimator.estimate.up, truth))
    assert errors[0] == pytest.approx(20.0, abs=0.1)
    assert errors[-1] < 10.0
    assert all(a > b - 0.5 for a, b in pairwise(errors))
    assert estimator.estimate.up_sigma >= AXIS_SIGMA * 0.99
    # At the person, the floor is still under the soles.
    feet, plane = soles(body), estimator.plane
    points = forward(body.skeleton, reaching[-1:]).points(feet.segments, feet.local)[..., 0]
    assert (points @ plane.up + plane.height).min() == pytest.approx(
        0.0, abs=2 * plane.height_sigma
    )


def looked(estimator: GroundEstimator, *pitches: float | None) -> GroundEstimator:
    """The estimator after images of rooms at these camera pitches, deg; None is a grey image."""
    for second, pitch in enumerate(pitches):
        grey = np.full((ROOM_CAMERA.height, ROOM_CAMERA.width, 3), 120, np.uint8)
        image = grey if pitch is None else drawn(room(), turn(np.radians(pitch), 0.0))
        estimator.update_by_lines(image, ROOM_CAMERA, 1_000_000_000 * second)
    return estimator


def pitch_of(estimator: GroundEstimator) -> float:
    return float(np.degrees(np.arcsin(-estimator.estimate.up[2])))


def test_the_lines_of_the_scene_tell_the_vertical_and_the_track_no_more(body, reaching):
    estimator = GroundEstimator()
    assert not estimator.vertical_known
    looked(estimator, 15.0, None)
    assert estimator.vertical_known
    assert pitch_of(estimator) == pytest.approx(15.0, abs=1.0)
    assert np.degrees(estimator.estimate.up_sigma) < 2.0
    before = estimator.estimate.up
    after(estimator, body, reaching)
    assert np.array_equal(estimator.estimate.up, before)
    estimator.reset()  # another person, the same scene
    assert np.array_equal(estimator.estimate.up, before)
    estimator.forget_scene()
    assert not estimator.vertical_known


def test_a_vertical_that_jumps_is_believed_at_the_second_look():
    estimator = looked(GroundEstimator(), 5.0, 30.0)
    assert pitch_of(estimator) == pytest.approx(5.0, abs=1.0)
    estimator.update_by_lines(
        drawn(room(), turn(np.radians(30.0), 0.0)), ROOM_CAMERA, 1_500_000_000
    )
    assert pitch_of(estimator) == pytest.approx(5.0, abs=1.0)  # too soon
    estimator.update_by_lines(
        drawn(room(), turn(np.radians(30.0), 0.0)), ROOM_CAMERA, 2_100_000_000
    )
    assert pitch_of(estimator) == pytest.approx(30.0, abs=1.0)


def pitched(degrees: float, sigma: float = 2.0) -> KnownGround:
    up = turn(np.radians(degrees), 0.0) @ [0.0, -1.0, 0.0]
    return KnownGround(up, up_sigma=np.radians(sigma))


def test_a_given_vertical_is_refined_by_lines_that_agree():
    alone = looked(GroundEstimator(), 15.0).estimate
    for sigma in (0.5, 2.0, 8.0):
        found = looked(GroundEstimator(pitched(13.5, sigma)), 15.0).estimate
        # Two measurements of one angle give their precision-weighted mean.
        precise = np.array([np.radians(sigma), alone.up_sigma]) ** -2.0
        between = precise[1] / precise.sum()
        angle = degrees_between(found.up, pitched(13.5).up)
        assert angle == pytest.approx(
            between * degrees_between(alone.up, pitched(13.5).up), abs=0.3
        )
        assert found.up_sigma == pytest.approx(precise.sum() ** -0.5, rel=0.1)


@pytest.mark.parametrize(('given', 'seen'), [(40.0, (None, None)), (-30.0, (0.0,))])
def test_a_given_vertical_is_followed_where_the_lines_say_nothing_or_once(given, seen):
    estimator = looked(GroundEstimator(pitched(given)), *seen)
    assert pitch_of(estimator) == pytest.approx(given)
    assert not estimator.contradicted


def test_a_given_vertical_that_is_wrong_is_contradicted_and_followed():
    """An inertial sensor is mounted with a rotation of 30 degrees."""
    estimator = GroundEstimator(pitched(30.0))
    looked(estimator, 0.0, 0.0)
    assert estimator.contradicted
    assert pitch_of(estimator) == pytest.approx(30.0)
    assert np.degrees(estimator.estimate.up_sigma) == pytest.approx(2.0)
    estimator.forget_scene()  # another scene can agree with it
    assert not estimator.contradicted
    looked(estimator, 0.0, 0.0)
    assert estimator.contradicted
    estimator.set_gravity([0.0, -1.0, 0.0])
    for second in (3, 5):
        estimator.update_by_lines(drawn(room(), np.eye(3)), ROOM_CAMERA, 1_000_000_000 * second)
    assert not estimator.contradicted
    assert pitch_of(estimator) == pytest.approx(0.0, abs=1.0)


@pytest.mark.parametrize('degrees', [15.0, 90.0, 180.0, -90.0])
def test_a_camera_on_its_side_sees_the_lines_of_an_upright_one(degrees):
    upright, rolled = turn(np.radians(15.0), 0.0), turn(0.0, np.radians(degrees))
    up = rolled @ upright @ [0.0, -1.0, 0.0]
    estimator = GroundEstimator(KnownGround(up))
    for second in range(2):
        image = drawn(room(), rolled @ upright)
        estimator.update_by_lines(image, ROOM_CAMERA, 1_000_000_000 * second)
    assert not estimator.contradicted
    assert degrees_between(estimator.estimate.up, up) < 1.0
    assert np.degrees(estimator.estimate.up_sigma) < 1.5  # the lines agree
    assert estimator.level == pytest.approx(rolled, abs=0.03)


def standing(names: tuple[str, ...], down: bool) -> Keypoints:
    pixels = np.array([[100.0, 200.0 if down == ('hip' in name) else 100.0] for name in names])
    return Keypoints(names, pixels, np.tile(np.eye(2), (len(names), 1, 1)), np.ones(len(names)))


@pytest.mark.parametrize('hangs', [False, True])
def test_the_person_tells_a_camera_that_hangs_from_an_accelerometer(hangs):
    names = ('left_shoulder', 'right_shoulder', 'left_hip', 'right_hip')
    estimator = GroundEstimator(KnownGround(np.array([0.0, 1.0, 0.0])))
    assert not estimator.reversed
    estimator.update_sign_by_keypoints(standing(names, down=not hangs))
    assert estimator.reversed != hangs
    assert estimator.estimate.up == pytest.approx([0.0, 1.0 if hangs else -1.0, 0.0])
    # Half a trunk is no evidence, and gravity that points down in the image is kept.
    half = GroundEstimator(KnownGround(np.array([0.0, 1.0, 0.0])))
    half.update_sign_by_keypoints(standing(names[1:], down=True))
    assert not half.reversed
    usual = GroundEstimator(KnownGround(np.array([0.0, -1.0, 0.0])))
    usual.update_sign_by_keypoints(standing(names, down=False))
    assert not usual.reversed


def test_a_person_who_lies_by_the_given_vertical_contradicts_an_unusual_one(body, reaching):
    ahead, tilted = np.array([0.0, 0.0, 1.0]), up_of(Viewpoint(pitch=np.radians(40.0)))
    assert after(GroundEstimator(KnownGround(ahead)), body, reaching[:40]).contradicted
    # The true vertical, and a person who lies in front of a level camera, are no contradiction.
    assert not after(GroundEstimator(KnownGround(up_of(PITCHED))), body, reaching).contradicted
    assert not after(GroundEstimator(KnownGround(tilted)), body, reaching).contradicted
    lying = reaching.copy()
    lying[:, body.dof_names.index('root_y')] += np.radians(80.0)
    usual = after(GroundEstimator(KnownGround(up_of(PITCHED))), body, lying)
    assert not usual.contradicted


@pytest.mark.parametrize('rate', [10.0, 30.0, 60.0])
def test_contacts_are_those_of_a_walker(body, rate):
    """Sole points at rest in the motion are detected as resting, swinging ones are not."""
    poses = procedural_motion('walk', body, 3.0, rate, 1, viewpoint=PITCHED)
    plane = GroundEstimator(KnownGround(up_of(PITCHED), 1.4)).plane
    found = resting(body, plane, poses, rate)
    # A foot is as fast as its slowest point.
    points = sole_points(body, poses).reshape(len(poses), 2, 2, 3)
    speed = rate * np.linalg.norm(np.diff(points, axis=0), axis=3).min(2)
    late = slice(round(0.15 * rate), None)
    rests, speed = (np.array(found)[1:] > 0.5)[late], speed[late]
    stands, swings = speed < 0.05, speed > 0.8
    assert stands.mean() > 0.2
    assert swings.mean() > 0.2
    assert rests[stands].mean() > 0.9
    assert rests[swings].mean() < 0.2


@pytest.mark.parametrize('rate', [3.0, 10.0, 30.0, 120.0])
def test_feet_rest_at_any_rate(body, rate):
    """Poses of a standing person have errors as in tracks."""
    poses = procedural_motion('reach', body, 4.0, rate, 1, viewpoint=PITCHED)
    rng, kept = np.random.default_rng(0), np.exp(-1.0 / (rate * ERRORS['image'].time))
    error = 0.008 * rng.normal(size=3)
    for pose in poses:
        pose[:3] += error
        error = kept * error + 0.008 * np.sqrt(1.0 - kept**2) * rng.normal(size=3)
    plane = GroundEstimator(KnownGround(up_of(PITCHED), 1.4)).plane
    found = np.array(resting(body, plane, poses, rate))
    assert (found[len(found) // 4 :] > 0.5).mean() > 0.9


def test_before_a_camera_that_moves_only_heights_tell_of_contact(body, reaching):
    plane = GroundEstimator(KnownGround(up_of(PITCHED), 1.4)).plane
    pose, slid, aloft = reaching[0].copy(), reaching[0].copy(), reaching[0].copy()
    slid[:3] += 0.3 * np.cross(up_of(PITCHED), [0.0, 0.0, 1.0])
    aloft[:3] += 0.3 * up_of(PITCHED)
    rests = {
        (name, still): min(resting(body, plane, [pose, other], RATE, still=still)[1])
        for name, other in (('stays', pose), ('slides', slid), ('rises', aloft))
        for still in (True, False)
    }
    assert rests['slides', True] < 0.5 < rests['stays', True]
    assert rests['slides', False] == pytest.approx(rests['stays', False])
    assert rests['rises', False] < 0.5 < rests['slides', False]


def test_the_lean_is_measured_against_gravity_and_not_against_the_camera(body, camera, reaching):
    """A pose rotated together with the vertical has the same energy."""
    settings = TrackerSettings(likelihood=LikelihoodSettings(self_intersection_sigma=np.inf))
    level = procedural_motion('reach', body, 0.1, RATE, 1, viewpoint=Viewpoint(3.5, 1.4))
    pitched = procedural_motion('reach', body, 0.1, RATE, 1, viewpoint=PITCHED)
    costs, leaning = [], []
    for view, poses in ((Viewpoint(3.5, 1.4), level), (PITCHED, pitched)):
        known = KnownGround(up_of(view), 1.4)
        term = Posterior(body, camera, settings, ground=GroundEstimator(known)).of_image(
            Observation()
        )
        costs.append(term.energy(poses[:1], np.arange(1)).value)
        tipped = poses[:1].copy()
        tipped[:, body.skeleton.dof_index(('root_x',))] -= np.radians(30)
        leaning.append(term.energy(tipped, np.arange(1)).value)
    assert costs[0] == pytest.approx(costs[1], rel=0.02)
    assert leaning[0] > costs[0] + 1.0
    assert leaning[1] > costs[1] + 1.0


@pytest.mark.parametrize('ground', [GroundSettings(), OFF])
def test_a_tracker_knows_its_ground(ground, human32, camera, motion, keypoints_of):
    """A body reaches for things in front of a level camera 1.2 m above the floor."""
    likelihood = LikelihoodSettings.of_terms(keypoints=LikelihoodSettings().keypoints)
    settings = TrackerSettings(
        candidates=8, max_hypotheses=4, likelihood=likelihood, estimate_shape=False, ground=ground,
    )  # fmt: skip
    up = np.array([0.0, -1.0, 0.0])
    black = np.zeros((camera.height, camera.width, 3), np.uint8)
    subject = Subject(0, keypoints_of(human32, motion[0]), dict(human32.segment_lengths))
    errors = []
    for known in (None, KnownGround(up, 1.2)):
        tracker = Tracker(human32, camera, settings, known_ground=known)
        tracker.reset(subject)
        for t in range(4):
            tracker.step(black, t * 100_000_000, keypoints_of(human32, motion[t], 1.0, t))
        assert tracker.estimate.contacts == {}  # no background: the camera may move
        found = human32.joint_positions(tracker.estimate.point_estimate[None])[0]
        errors.append(
            np.linalg.norm(found - human32.joint_positions(motion[3:4])[0], axis=1).mean()
        )
        assert tracker.estimate.ground.up == pytest.approx(up, abs=0.15)
        if known is not None:
            assert tracker.estimate.ground.plane == pytest.approx([*up, 1.2])
        elif ground.on:
            assert tracker.estimate.ground.height == pytest.approx(1.2, abs=0.2)
    assert max(errors) < 0.12
    tracker.set_gravity(up_of(PITCHED), 1.3)
    tracker.step(black, 400_000_000, keypoints_of(human32, motion[4], 1.0, 4))
    assert tracker.estimate.ground.up == pytest.approx(up_of(PITCHED))
    assert tracker.estimate.ground.height == pytest.approx(1.3)
