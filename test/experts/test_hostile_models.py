"""Corrupt models with a valid checksum are either refused when read or able to predict."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from hmt_ros.body.angle_mixture import AngleMixture
from hmt_ros.body.learned_file import checked_model, named_faults, write_model
from hmt_ros.experts.conditional_density import ConditionalDensity, stored_model
from test.experts.hostile_models import BODY, check_predictions, models
from test.forged_models import arrays_of, forged, mutations

# Number of mutations tried of each model.
TRIED = 120
MODELS = models()


def reader(model):
    """The function that makes a model of the same kind from arrays."""
    if isinstance(model, AngleMixture):
        return partial(AngleMixture.from_arrays, skeleton=BODY.skeleton)
    return stored_model if isinstance(model, ConditionalDensity) else type(model).from_arrays


def saved(model, path):
    """The file of a model."""
    if hasattr(model, 'save'):
        return model.save(path)
    size = model.dynamics.state_dimension if hasattr(model, 'dynamics') else 0
    return write_model(path, model, reader(model), model.card, np.zeros(size))


def loaded(arrays, read):
    """The model, or None and the reason for the refusal; only a ValueError is a refusal."""
    try:
        with named_faults('model'):
            return checked_model(arrays, read), ''
    except ValueError as fault:
        return None, str(fault)


@pytest.mark.parametrize('name', MODELS)
def test_nonsense_is_refused_or_predicts(name, tmp_path):
    model = MODELS[name]
    read = reader(model)
    arrays = arrays_of(saved(model, tmp_path / 'model'))
    check_predictions(checked_model(arrays, read))
    rng = np.random.default_rng(0)
    every = list(mutations(arrays, rng))
    refused = 0
    for i in rng.permutation(len(every))[:TRIED]:
        what, changes = every[i]
        found, fault = loaded(forged(arrays, changes, read), read)
        refused += found is None
        assert len(fault) < 300, what
        assert fault.isprintable(), what
        assert 'secret' not in fault, what
        if found is not None:
            with np.errstate(all='ignore'):
                check_predictions(found)
    assert refused > TRIED / 3
