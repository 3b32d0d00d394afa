"""What sessions run before the first message leaves nothing behind but code."""

from __future__ import annotations

import subprocess
import sys

from hmt_ros.compiled_code import compiled_functions
from hmt_ros.sessions.bme_parameters import BmeParameters
from hmt_ros.sessions.bme_session import BmeSession
from hmt_ros.sessions.people_session import PeopleSession
from hmt_ros.sessions.session import FINISH
from hmt_ros.sessions.smoother_parameters import SmootherParameters
from hmt_ros.sessions.smoother_session import MIXTURE, SmootherSession
from hmt_ros.sessions.tracking_parameters import FilterParameters, PeopleParameters
from hmt_ros.sessions.tracking_session import TrackingSession
from hmt_ros.sessions.warm_up import film, likelihoods, warm_up_tracking
from hmt_ros.tracking import Status, Tracker

SESSIONS = [
    (TrackingSession, FilterParameters()),
    (PeopleSession, PeopleParameters()),
    (SmootherSession, SmootherParameters()),
    (BmeSession, BmeParameters()),
]


def test_preparing_estimates_and_publishes_nothing(outputs):
    sessions = [kind(parameters, outputs.append) for kind, parameters in SESSIONS]
    before, counts = [session.state for session in sessions], []
    for _ in range(2):
        warm_up_tracking.cache_clear()
        for session in sessions:
            session.prepare()
        counts.append(compiled_functions().count)
    assert counts[0] == counts[1]
    assert [session.state for session in sessions] == before
    assert outputs == []


def test_the_largest_kernel_is_compiled_once():
    """Arrays of another layout, or that can not be written, would compile it again for 20 s."""
    code = """
from hmt_ros.image.pose_energy_kernel import solve
from hmt_ros.sessions.warm_up import warm_up_tracking
warm_up_tracking()
print(len(solve.signatures))
"""
    run = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True)
    assert run.stdout.split() == ['1']


def test_a_tracker_is_the_same_after_it():
    def tracked() -> list[bytes]:
        shown = film()
        tracker, found = Tracker(shown.body, shown.camera), []
        for t, image in enumerate(shown.images):
            for mixture in tracker.step(image, 10**9 + 10**8 * t, shown.keypoints(t)):
                if mixture is not None:
                    found += [mixture.means.tobytes(), mixture.weights.tobytes()]
        assert tracker.estimate.status is Status.TRACKING
        return found

    before = tracked()
    warm_up_tracking.cache_clear()
    warm_up_tracking()
    assert tracked() == before


def test_a_smoother_is_the_same_after_it(outputs):
    def smoothed(*, prepared: bool) -> list[object]:
        outputs.clear()
        session = SmootherSession(SmootherParameters(), outputs.append)
        if prepared:
            session.prepare()
        for message in likelihoods(film().body):
            assert session.take(MIXTURE, message).faults == ()
        assert session.finish().source == FINISH
        return list(outputs)

    assert smoothed(prepared=True) == smoothed(prepared=False) != []
