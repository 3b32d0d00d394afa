"""A node ends with its owner, and what is no model is refused."""

import numpy as np
import pytest

from hmt_ros.experts.model_file import read_arrays, write_arrays
from test.test_docs import ROOT

MODEL = ROOT / 'hmt_ros' / 'experts' / 'models' / 'silhouettes.npz'


@pytest.mark.ros
def test_a_node_does_not_outlive_its_owner(monkeypatch, executable):
    # Process 1 has not started it.
    monkeypatch.setenv('HMT_ROS_OWNER', '1')
    node = executable('smoother_node', '-p', 'autostart:=false')
    node.process.communicate(timeout=60.0)
    assert node.process.returncode == 0


def test_models_with_numbers_that_are_none_are_refused(tmp_path):
    arrays = read_arrays(MODEL)
    name = next(name for name, values in arrays.items() if values.dtype.kind == 'f')
    arrays[name] = np.full_like(arrays[name], np.nan)
    with pytest.raises(ValueError, match=f'{name} has values that are not finite'):
        read_arrays(write_arrays(tmp_path / 'model', arrays))
