"""Limbs that are put on a wrong edge of a rendered image, and legs that are exchanged."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from hmt_ros.body import Camera
from hmt_ros.body.kinematics import forward
from hmt_ros.flips.interpretation_tree import chain_points, place_chain, rehang_chain
from hmt_ros.image.background import BackgroundModel
from hmt_ros.image.likelihood import ImageLikelihood, LikelihoodSettings
from hmt_ros.image.observation import Observation, observe
from hmt_ros.inference.bounded_newton import Minimum
from hmt_ros.tracking import TrackerSettings
from hmt_ros.tracking.candidates import Candidates
from hmt_ros.tracking.edge_jumps import EdgeJumps
from hmt_ros.tracking.kinematic_jumps import KinematicJumps
from hmt_ros.tracking.limb_votes import NOISE, LimbVotes, displaced, exchanged

LIMBS = ('left_leg', 'right_leg', 'left_arm', 'right_arm')


@pytest.fixture(scope='module')
def film(filmed):
    """Camera, poses and observations of a person who walks by."""
    camera = Camera(660.0, 660.0, 319.5, 239.5, 640, 480)
    poses, images, empty = filmed('walk', 0.6, camera, every=2)
    background = BackgroundModel.from_image(empty)
    seen = [observe(image, background.silhouette(image)) for image in images]
    return SimpleNamespace(camera=camera, poses=poses, seen=seen)


def jumps_of(body, camera, chain) -> EdgeJumps:
    return EdgeJumps(body, camera, LikelihoodSettings(), chain)


def displaced_limb(jumps, pose, share):
    """The pose with a limb shifted sideways in the image by a share of its width; None: can not."""
    body, camera = jumps.body, jumps.camera
    points = chain_points(body, pose[None], jumps.chain)[0]
    pixels = camera.project(points)
    _, _, sideways, joints = jumps._sideways(pose)
    assert np.allclose(joints, pixels)
    pixels[1] += share * sideways[0]
    pixels[2:] += share * sideways[1]
    away = camera.rays(pixels[1:]) * np.linalg.norm(points[1:], axis=1)[:, None]
    placed, _ = place_chain(body, pose[None], jumps.chain, away[None], slack=0.1)
    return placed[0] if len(placed) else None


def gaps_of(jumps, poses, true):
    """Largest distance (N,) of the first two joints of a limb from where they are seen, px."""
    pixels = jumps.camera.project(chain_points(jumps.body, poses, jumps.chain)[:, 1:3])
    wanted = jumps.camera.project(chain_points(jumps.body, true[None], jumps.chain)[0, 1:3])
    return np.linalg.norm(pixels - wanted, axis=2).max(1)


def cases(body, film):
    """(jumps, true pose, observation, pose with the limb on a wrong edge)."""
    for chain in LIMBS:
        jumps = jumps_of(body, film.camera, chain)
        for pose, observation in zip(film.poses, film.seen, strict=True):
            for share in (-1.0, 1.0):
                wrong = displaced_limb(jumps, pose, share)
                if wrong is not None:
                    yield jumps, pose, observation, wrong


def test_the_right_edge_is_among_those_found(human32, film):
    """Limbs a width beside their place: what the image prefers of what is found is nearer."""
    likelihood = ImageLikelihood(human32, film.camera, LikelihoodSettings())
    better, nearer = [], []
    for jumps, pose, observation, wrong in cases(human32, film):
        found = jumps.find(wrong, observation, 4)
        poses = np.repeat(wrong[None], len(found) + 1, axis=0)
        poses[1:, jumps.dofs] = found
        energy = likelihood.energy(poses, observation)[0]
        best = int(energy.argmin())
        gaps = gaps_of(jumps, poses, pose)
        better.append(best > 0)
        nearer.append(gaps[best] < 0.5 * gaps[0])
    assert len(better) > 12
    assert np.mean(better) > 0.8
    assert np.mean(nearer) > 0.6


def proposed(body, film, wrong, observation, votes, chain, **values):
    """Candidates from one mode, whose covariance is that of a limb that may be anywhere near."""
    settings = TrackerSettings(searched_chains=0, **values)
    likelihood = ImageLikelihood(body, film.camera, settings.likelihood)

    def value(poses, seen, textures, which):
        del textures, which
        frames = forward(body.skeleton, poses)
        return likelihood.image_energy(frames, seen, derivatives=False).value

    jumps = KinematicJumps(body, film.camera, settings, value, lambda count: None, votes)
    d = body.dimension
    base = Minimum(
        wrong[None], value(wrong[None], observation, None, None), np.zeros((1, d)),
        np.eye(d)[None], np.ones((1, d), bool), np.zeros(1, np.int8), np.zeros(1, np.int32),
    )  # fmt: skip
    one = np.zeros(1, np.intp)
    sources = Candidates(
        wrong[None], one, np.zeros(1), wrong[None], np.zeros((1, d), bool), None, one
    )
    rng = np.random.default_rng(0)
    covariances = np.diag(np.full(d, 0.3**2))[None]
    return jumps.propose(base, sources, covariances, observation, rng, again=True).poses


def usual_of(body, film, pose, observation):
    """Votes that know what limbs cost where they are."""
    votes = LimbVotes()
    votes.learn({c: jumps_of(body, film.camera, c).residual(pose, observation) for c in LIMBS})
    return votes


def test_limbs_on_wrong_edges_are_proposed_on_the_right_one(human32, film):
    """Where the limb costs more than usual; without a vote for it, or the setting, it is not."""
    found = {0: [], 3: []}
    for jumps, pose, observation, wrong in cases(human32, film):
        for edges, gaps in found.items():
            votes = usual_of(human32, film, pose, observation)
            poses = proposed(
                human32, film, wrong, observation, votes, jumps.chain, edge_jumps=edges
            )
            gaps.append(gaps_of(jumps, poses, pose).min() / gaps_of(jumps, wrong[None], pose)[0])
    without, with_edges = (np.array(found[edges]) for edges in (0, 3))
    assert np.mean(with_edges < 0.5) > np.mean(without < 0.5) + 0.3


def test_exchanged_legs_are_proposed_as_they_are(human32, film):
    pose, observation = film.poses[1], film.seen[1]
    wrong = pose.copy()
    for chain, sibling in (('left_leg', 'right_leg'), ('right_leg', 'left_leg')):
        own = human32.skeleton.chain_dofs[chain]
        hung, _ = rehang_chain(human32, pose[None], pose[None], chain, image_of=sibling)
        wrong[own] = hung[0, own]
    for voted in (False, True):
        votes = usual_of(human32, film, pose, observation)
        # What the legs cost there is told apart from what they usually cost.
        votes.usual |= dict.fromkeys(('left_leg', 'right_leg'), -0.5 * NOISE)
        poses = proposed(human32, film, wrong, observation, votes, 'left_leg', voted_swaps=voted)
        for chain in ('left_leg', 'right_leg'):
            jumps = jumps_of(human32, film.camera, chain)
            assert gaps_of(jumps, wrong[None], pose)[0] > 30
            assert gaps_of(jumps, poses, pose).min() < 8


def test_nothing_is_found_without_edges(human32, film):
    jumps = jumps_of(human32, film.camera, 'left_leg')
    pose, observation = film.poses[0], film.seen[0]
    assert jumps.find(pose, Observation(), 3).shape == (0, 6)
    assert jumps.find(pose, observation, 0).shape == (0, 6)
    for angles in jumps.find(pose, replace(observation, distance=None), 3):
        assert (angles >= human32.lower[jumps.dofs]).all()
        assert (angles <= human32.upper[jumps.dofs]).all()
    behind = pose.copy()
    behind[2] -= 10.0
    assert np.isnan(jumps.residual(behind, observation))
    assert jumps.deviation(behind, np.eye(32)) == (0.0, 0.0)


def test_sideways_deviations_are_those_of_samples(human32, film):
    jumps, pose = jumps_of(human32, film.camera, 'right_arm'), film.poses[0]
    rng = np.random.default_rng(0)
    root = 2e-4 * rng.normal(size=(32, 32))
    covariance = root @ root.T
    own = jumps.dofs
    poses = np.repeat(pose[None], 5000, axis=0)
    poses[:, own] += rng.multivariate_normal(np.zeros(6), covariance[np.ix_(own, own)], 5000)
    pixels = film.camera.project(chain_points(human32, poses, 'right_arm')[:, 2])
    deviation, width = jumps.deviation(pose, covariance)
    sideways = jumps._sideways(pose)[2][1]
    assert width == pytest.approx(np.linalg.norm(sideways)) == pytest.approx(jumps.width(pose))
    assert deviation == pytest.approx((pixels @ (sideways / width)).std(), rel=0.05)


def test_votes_for_limbs():
    votes = LimbVotes()
    assert votes.excess({'left_leg': 0.1, 'left_arm': float('nan')}) == {
        'left_leg': 0.0,
        'left_arm': 0.0,
    }
    votes.learn({'left_leg': 0.1, 'left_arm': float('nan')})
    assert votes.usual == {'left_leg': 0.1}
    twice = 2 * (0.1 + NOISE) - NOISE
    assert votes.excess({'left_leg': twice})['left_leg'] == pytest.approx(1.0)
    assert votes.excess({'left_leg': 0.1 + 0.25 * (0.1 + NOISE)})['left_leg'] == pytest.approx(0.25)
    assert votes.excess({'left_leg': 0.01})['left_leg'] == 0.0
    votes.learn({'left_leg': 100.0})
    assert 0.1 < votes.usual['left_leg'] < 0.11
    assert displaced(10.0, 5.0) == pytest.approx(0.3173, abs=1e-4)
    assert displaced(10.0, 0.0) == 0.0
    assert exchanged([50.0, 0.0], 10.0) == 1.0
    assert exchanged([10.0, 90.0], 10.0) == pytest.approx(np.exp(-0.5))
    assert exchanged([float('nan')], 10.0) == 0.0
