"""The effect of an assumed focal length on published depths."""

import numpy as np
import pytest

from hmt_ros.body import Camera, load_body
from hmt_ros.sessions.camera_session import CAMERA_INFO, IMAGE
from hmt_ros.sessions.focal_length import depth_covariances, usual_camera
from hmt_ros.sessions.track_messages import TOPICS_OF_NODE
from hmt_ros.sessions.tracking_parameters import FilterParameters
from hmt_ros.sessions.tracking_session import TrackingSession
from msg_tools.messages.cdr import deserialise
from msg_tools.messages.keep_out import keep_out_of
from msg_tools.messages.pose_mixtures import pose_mixture_of

SIGMA = 0.2


@pytest.fixture
def told(stub_tracker, subject_file, outputs, small_camera):
    """The last messages of a session with given parameters, by topic."""

    def run(**values):
        given = FilterParameters(subject_file=str(subject_file), **values)
        one = TrackingSession(given, outputs.append)
        one.take(CAMERA_INFO, small_camera.info())
        one.take(IMAGE, small_camera.image(0))
        one.take(IMAGE, small_camera.image(1))
        read = {x.topic: deserialise(x.data, TOPICS_OF_NODE[x.topic].msgtype) for x in outputs}
        found = {
            topic: pose_mixture_of(read[topic])
            for topic in ('pose_mixture', 'likelihood_mixture', 'pose_forecast')
        }
        return {**found, 'keep_out': keep_out_of(read['keep_out'])}

    return run


def test_depths_alone_are_as_uncertain_as_the_focal_length(told):
    """At 4 m: 0.8 m along the optical axis, in poses and joints, now and in predictions."""
    known = told(forecast_rate=20.0)
    guessed = told(forecast_rate=20.0, focal_length_sigma=SIGMA)
    of_joints = np.zeros((3, 3))
    of_joints[2, 2] = (SIGMA * 4.0) ** 2
    for topic in ('pose_mixture', 'pose_forecast'):
        before, after = known[topic], guessed[topic]
        assert np.array_equal(before.mixture.means, after.mixture.means)
        change = after.mixture.covariances - before.mixture.covariances
        wanted = np.zeros_like(change)
        wanted[:, 2, 2] = (SIGMA * 4.0) ** 2
        assert np.allclose(change, wanted)
        change = after.joint_covariances - before.joint_covariances
        assert np.allclose(change, of_joints, atol=1e-6)
    deep = [np.ptp(x['keep_out'].starts[:, 2]) for x in (known, guessed)]
    wide = [np.ptp(x['keep_out'].starts[:, 0]) for x in (known, guessed)]
    # 3.4 standard deviations both ways: 99 % in three dimensions.
    assert deep[1] - deep[0] == pytest.approx(2 * 3.4 * 0.8, rel=0.15)
    assert abs(wide[1] - wide[0]) < 0.2
    # A smoother counts it once, apart from the likelihood, as the error that all images share.
    before, after = (x['likelihood_mixture'] for x in (known, guessed))
    assert np.array_equal(before.mixture.covariances, after.mixture.covariances)
    change = after.shape_covariance - before.shape_covariance
    assert change[2, 2] == pytest.approx((SIGMA * 4.0) ** 2)
    assert np.count_nonzero(change) == 1


def test_it_is_what_another_focal_length_does_to_a_pose():
    """With a longer lens the pose with the same image is deeper in proportion, to first order."""
    body = load_body('human37')
    pose = np.clip(body.prior_mean, body.lower, body.upper)[None]
    pose[:, :3] = 0.3, -0.2, 6.0
    error = 0.01
    deviation = np.sqrt(np.diagonal(depth_covariances(pose, error)[0]))
    moved = pose + deviation
    before = Camera(500.0, 500.0, 319.5, 239.5, 640, 480)
    after = Camera(500.0 * (1 + error), 500.0 * (1 + error), 319.5, 239.5, 640, 480)
    seen = before.project(body.joint_positions(pose))[0]
    same = after.project(body.joint_positions(moved))[0]
    unmoved = after.project(body.joint_positions(pose))[0]
    assert np.abs(same - seen).max() < 0.2 * np.abs(unmoved - seen).max()


@pytest.mark.parametrize('size', [(640, 480), (480, 640)])
def test_the_usual_view_is_along_the_longer_side(size):
    camera = usual_camera(size)
    assert (camera.width, camera.height) == size
    assert camera.fx == camera.fy == pytest.approx(320 / np.tan(np.radians(30)))
