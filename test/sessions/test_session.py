"""What all sessions have in common."""

import math

import numpy as np
import pytest

from hmt_ros.sessions.session import entropy


@pytest.mark.parametrize(
    ('weights', 'nats'),
    [([1.0], 0.0), ([0.25] * 4, math.log(4)), ([0.5, 0.5, 0.0], math.log(2)), ([], math.nan)],
)
def test_entropy_of_weights(weights, nats):
    assert np.isclose(entropy(np.array(weights)), nats, rtol=1e-15, atol=0, equal_nan=True)
