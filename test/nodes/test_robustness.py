"""A node ends with its owner, and files that are no models are refused."""

import numpy as np
import pytest

from hmt_ros.experts import load_predictor
from test.forged_models import arrays_of, write_forged
from test.test_docs import ROOT

MODEL = ROOT / 'hmt_ros' / 'experts' / 'models' / 'silhouettes.npz'


@pytest.mark.ros
def test_a_node_does_not_outlive_its_owner(monkeypatch, executable):
    # Process 1 is not its parent.
    monkeypatch.setenv('HMT_ROS_OWNER', '1')
    node = executable('smoother_node', '-p', 'autostart:=false')
    node.process.communicate(timeout=60.0)
    assert node.process.returncode == 0


def test_models_with_numbers_that_are_none_are_refused(tmp_path):
    name = 'descriptor/basis'
    changes = {name: np.full_like(arrays_of(MODEL)[name], np.nan)}
    with pytest.raises(ValueError, match='values that are not finite'):
        load_predictor(write_forged(tmp_path / 'model', MODEL, changes))
