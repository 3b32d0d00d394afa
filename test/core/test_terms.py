"""The image terms in the core, with invalid arguments."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_ros.body import Camera, load_body
from hmt_ros.body.kinematics import forward, tree_of
from hmt_ros.core import RECORDED, record_residuals
from hmt_ros.image.sampling import ImageMap
from hmt_ros.image.surface import flesh_table_of
from hmt_ros.image.terms.depth import DepthInputs
from hmt_ros.image.terms.edges import ORIENTATIONS, EdgeInputs
from hmt_ros.image.terms.image_term import Weighting
from hmt_ros.image.terms.registry import TERMS, Model
from hmt_ros.image.terms.silhouette import CoverageInputs, Outline

CAMERA = Camera(100.0, 100.0, 31.5, 23.5, 64, 48)
POSES, SAMPLES = 2, 9


@pytest.fixture
def model():
    body = load_body('human32')
    flesh = flesh_table_of(body)
    every = np.ones(len(flesh.part_segments), np.bool_)
    return Model(tree_of(body.skeleton), flesh, CAMERA.lens, every, every, 0)


@pytest.fixture
def frames(model):
    body = load_body('human32')
    poses = np.zeros((POSES, body.dimension))
    poses[:, 2] = 3.0
    return forward(body.skeleton, poses).by_pose()


@pytest.fixture
def inputs():
    """A round outline, and maps that are 1 everywhere."""
    angles = np.linspace(0.0, 2.0 * np.pi, SAMPLES, endpoint=False)
    normals = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    outline = Outline(12.0 * normals + [31.5, 23.5], normals, np.ones(SAMPLES))
    term = Weighting(10.0, 1.5, 3.0, 30.0)
    costs = np.zeros((POSES, SAMPLES))
    coverage = CoverageInputs(term, outline, np.full((1, SAMPLES), np.inf), costs)
    ones = ImageMap(np.ones((ORIENTATIONS, 48, 64), np.float32))
    return coverage, EdgeInputs(term, ones), DepthInputs(term, ImageMap(3.0 * ones.values[:1]))


def recorded(model, inputs, frames):
    room = 1 + 6 * len(model.flesh.ring_parts) + 2 * SAMPLES
    result = np.zeros((len(frames[0]), room, RECORDED))
    record_residuals(model, inputs, *frames, result)
    return result


def test_all_terms_leave_residuals(model, inputs, frames):
    assert len(inputs) == len(TERMS)
    residuals = recorded(model, inputs, frames)
    assert (residuals[:, 0, 0] > len(model.flesh.ring_parts)).all()
    assert (inputs[0].costs > 0).all()
    assert np.array_equal(residuals[0], residuals[1])
    # With too little space only the first ones are returned.
    few = np.zeros((POSES, 11, RECORDED))
    record_residuals(model, inputs, *frames, few)
    assert (few[:, 0, 0] == 10).all()
    assert np.array_equal(few[:, 1:], residuals[:, 1:11])


@pytest.mark.parametrize('value', [np.nan, np.inf, -np.inf, 1e300])
def test_frames_and_outlines_without_sense(model, inputs, frames, value):
    for which in range(2):
        wrong = [array.copy() for array in frames]
        wrong[which][..., 0] = value
        assert (recorded(model, inputs, wrong)[:, 0, 0] >= 0).all()
    coverage = inputs[0]._replace(outline=inputs[0].outline._replace(
        pixels=np.full((SAMPLES, 2), value)
    ))  # fmt: skip
    # Edges and depths are counted as before.
    assert (recorded(model, (coverage, *inputs[1:]), frames)[:, 0, 0] > 0).all()
    term = Weighting(10.0, value, value, value, value)
    found = recorded(model, tuple(x._replace(term=term) for x in inputs), frames)
    assert (found[:, 0, 0] >= 0).all()


def test_maps_are_as_large_as_bilinear_values_need(model, inputs, frames):
    coverage, edges, depth = inputs
    small = ImageMap(np.ones((ORIENTATIONS, 2, 2), np.float32), -5, 1000)
    recorded(model, (coverage, edges._replace(distances=small), depth), frames)
    row = ImageMap(np.ones((ORIENTATIONS, 1, 9), np.float32))
    with pytest.raises(ValueError, match=r'inputs\[1\]\.distances\.values: wanted two rows'):
        recorded(model, (coverage, edges._replace(distances=row), depth), frames)
    few = ImageMap(small.values[1:])
    with pytest.raises(ValueError, match=r'inputs\[1\]\.distances\.values: wanted shape'):
        recorded(model, (coverage, edges._replace(distances=few), depth), frames)


def test_samples_and_poses_must_fit(model, inputs, frames):
    coverage, *others = inputs
    for change, message in (
        ({'costs': coverage.costs[:1].copy()}, 'costs: wanted no row, or one for each pose'),
        ({'costs': coverage.costs[:, 1:].copy()}, 'costs: wanted shape'),
        ({'explained': np.zeros((3, SAMPLES))}, 'explained: wanted one row'),
        ({'explained': np.zeros((1, SAMPLES + 1))}, 'explained: wanted shape'),
        ({'outline': coverage.outline._replace(beliefs=np.ones(1))}, 'outline.beliefs'),
    ):
        with pytest.raises(ValueError, match=message):
            recorded(model, (coverage._replace(**change), *others), frames)
    with pytest.raises(TypeError, match='inputs: wanted a tuple of 3'):
        recorded(model, inputs[:2], frames)
    coverage.costs.setflags(write=False)
    with pytest.raises(TypeError, match=r'costs: .* that can be written, .* read-only'):
        recorded(model, inputs, frames)


@pytest.mark.parametrize('term', range(len(TERMS)))
def test_factors_of_segments_must_fit(model, inputs, frames, term):
    ones = np.ones(len(model.tree.parents))

    def weighed(factors):
        own = inputs[term]._replace(term=inputs[term].term._replace(segments=factors))
        return recorded(model, (*inputs[:term], own, *inputs[term + 1 :]), frames)

    assert np.array_equal(weighed(ones), recorded(model, inputs, frames))
    assert not np.array_equal(weighed(2.0 * ones), recorded(model, inputs, frames))
    for factors in (ones[1:].copy(), -ones, np.nan * ones, np.inf * ones):
        with pytest.raises(ValueError, match=r'inputs\.term\.segments: wanted'):
            weighed(factors)
    with pytest.raises(TypeError, match=r'term\.segments: wanted'):
        weighed(ones.astype(np.float32))


def test_frames_and_lists_must_fit(model, inputs, frames):
    columns, origins = frames
    with pytest.raises(ValueError, match='columns: wanted shape'):
        recorded(model, inputs, (columns[:, 1:].copy(), origins))
    with pytest.raises(ValueError, match='origins: wanted shape'):
        recorded(model, inputs, (columns, origins[:1]))
    for residuals in (np.zeros((POSES, 0, RECORDED)), np.full((POSES, 2, RECORDED), np.nan)):
        with pytest.raises(ValueError, match='residuals'):
            record_residuals(model, inputs, columns, origins, residuals)
    with pytest.raises(ValueError, match=r'model\.traced'):
        recorded(model._replace(traced=model.traced[1:]), inputs, frames)
    segments = model.flesh.part_segments + 100
    with pytest.raises(ValueError, match=r'model\.flesh\.part_segments'):
        recorded(model._replace(flesh=model.flesh._replace(part_segments=segments)), inputs, frames)
