"""Images stored by the filter for the smoother of its process, and windows refined on them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hmt_ros.app.replay.command import main as replay
from hmt_ros.body import Camera
from hmt_ros.image.image_sequence import SeenImage
from hmt_ros.image.likelihood import ImageLikelihood
from hmt_ros.image.observation import Observation
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.sessions import smoother_session
from hmt_ros.sessions.declared_parameters import with_values
from hmt_ros.sessions.seen_images import SeenImages, size_of
from hmt_ros.sessions.smoother_parameters import SmootherParameters
from hmt_ros.sessions.smoother_session import MIXTURE, SmootherSession
from msg_tools import BagReader
from msg_tools.messages.cdr import serialise
from msg_tools.messages.trajectory_mixtures import trajectory_mixture_of

REACH = Path(__file__).resolve().parents[2] / 'bags' / 'reach'
CAMERA = Camera(500.0, 500.0, 319.5, 239.5, 640, 480)
COUNT = 4


@pytest.fixture
def seen(likelihoods):
    """Images in which the person is a little to the right of the modes."""
    body = likelihoods.body
    likelihood = ImageLikelihood(body, CAMERA)
    names = tuple(name for name in body.joint_names if name.startswith(('left', 'right')))
    at = [body.joint_names.index(name) for name in names]
    result = []
    for index in range(COUNT):
        pose = likelihoods.mixture(index).means[0].copy()
        pose[0] += 0.1
        pixels = CAMERA.project(body.joint_positions(pose[None])[0][at])
        covariances = np.tile(4.0 * np.eye(2), (len(at), 1, 1))
        keypoints = Keypoints(names, pixels, covariances, np.ones(len(at)))
        result.append(SeenImage(likelihood, Observation(keypoints=keypoints)))
    return result


@pytest.fixture
def smoother(outputs, monkeypatch, random_walk, likelihoods):
    """A session that has smoothed some mixtures, and its shared image store."""

    def make(seen=(), **values):
        monkeypatch.setattr(smoother_session, 'motion_prior', random_walk)
        parameters = with_values(SmootherParameters(), values)
        one, images = SmootherSession(parameters, outputs.append), SeenImages()
        one.share(images)
        for index in range(COUNT):
            if index < len(seen):
                images.add(likelihoods.stamp(index), seen[index])
            one.take(MIXTURE, likelihoods.message(index))
        return one

    return make


def evidence(stamp, size):
    return stamp, SeenImage(None, Observation(evidence={'coverage': (np.zeros(size),)}))


def test_the_newest_are_kept_as_far_as_memory_allows():
    images = SeenImages(most_mb=1.0)
    images.add(*evidence(1, 10))
    assert images.of([1]) == [None]
    images.wanted = 3
    for stamp in range(1, 6):
        images.add(*evidence(stamp, 10))
    assert [one is not None for one in images.of(range(1, 6))] == [False, False, True, True, True]
    images.add(*evidence(6, 60_000))
    assert [one is not None for one in images.of([4, 5, 6])] == [True, True, True]
    # Two of these exceed a megabyte, one does not.
    images.add(*evidence(7, 80_000))
    assert [one is not None for one in images.of([5, 6, 7])] == [False, False, True]
    images.add(*evidence(8, 200_000))
    assert images.of([7, 8]) == [None, None]
    images.add(9, None)
    # A step back in time starts a new sequence.
    images.add(*evidence(20, 10))
    images.add(*evidence(10, 10))
    assert [one is not None for one in images.of([10, 20])] == [True, False]


def test_only_evidence_is_kept():
    whole = np.zeros((480, 640), dtype=bool)
    images = SeenImages()
    images.wanted = 1
    observation = Observation(silhouette=whole, foreground=whole, others=whole)
    images.add(1, SeenImage(None, observation))
    kept = images.of([1])[0].observation
    assert kept.silhouette is kept.foreground is kept.others is None
    assert size_of(observation) == 3 * whole.nbytes
    assert size_of(kept) == 0


def test_a_window_is_refined_on_images(smoother, seen, likelihoods):
    told = []
    one = smoother(seen)
    content = trajectory_mixture_of(one.smooth_span(notify=told.append))
    assert told == ['motions are refined on 4 images']
    assert len(content.free_energy) >= 1
    plain = trajectory_mixture_of(smoother(seen, refine_on_images='never').smooth_span())
    assert len(plain.free_energy) == 0
    body = likelihoods.body
    at = [body.joint_names.index(name) for name in seen[0].observation.keypoints.names]

    def misses(found):
        """Mean distance of the heaviest motion from the keypoints, px."""
        joints = body.joint_positions(found.means[0])[:, at]
        pixels = np.array([CAMERA.project(one) for one in joints])
        wanted = np.array([one.observation.keypoints.pixels for one in seen])
        return np.linalg.norm(pixels - wanted, axis=2).mean()

    assert misses(content) < 0.2 * misses(plain)
    again = smoother(seen).smooth_span()
    assert serialise(again) == serialise(smoother(seen).smooth_span())


def test_a_smoother_alone_says_that_it_has_no_images(smoother, seen):
    told = []
    one = smoother()
    alone = one.smooth_span(notify=told.append)
    assert 'smoothed without images: 4 of 4 are not kept, as the filter runs in another' in told[0]
    without = smoother(refine_on_images='never')
    assert serialise(alone) == serialise(without.smooth_span(notify=told.append))
    assert told[1] == 'smoothed without images, as refine_on_images says'
    smoother(seen[:3]).smooth_span(notify=told.append)
    assert '1 of 4 are not kept' in told[2]


def test_at_the_end_the_last_window_is_published(smoother, seen, outputs):
    one = smoother(seen, refine_on_images='end')
    handled = one.finish()
    assert [topic for topic, _ in handled.published][:1] == ['trajectory_mixture']
    assert 'motions are refined on 4 images' in handled.events
    with pytest.raises(ValueError, match='refine_on_images must be one of'):
        SmootherParameters(refine_on_images='now')


def test_replay_ends_with_a_window_that_is_refined(tmp_path):
    words = ['--subject', str(REACH / 'subject.yaml'), '--quiet', '--set']
    words += ['smoother.refine_on_images=end', '--background', str(REACH / 'background.png')]
    assert replay([str(REACH), '-o', str(tmp_path / 'out'), *words]) == 0
    with BagReader(tmp_path / 'out') as bag:
        every = [trajectory_mixture_of(x.message) for x in bag.messages(['/trajectory_mixture'])]
    *others, last = every
    assert all(len(one.free_energy) == 0 for one in others)
    assert len(last.free_energy) >= 1
    assert len(last.stamps_ns) > len(others[-1].stamps_ns)
    assert last.stamps_ns[-1] >= others[-1].stamps_ns[-1]
