"""Fixtures shared by the tests of learning."""

import pytest

from hmt_learning.app import motions


class ThisProcess:
    """A substitute for a pool of processes, each of which takes a second to start."""

    def __init__(self, *_):
        pass

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def map(self, work, items, **_):
        return map(work, items)


@pytest.fixture
def read_here(monkeypatch):
    """Function after which commands read motions in this process."""
    return lambda: monkeypatch.setattr(motions, 'ProcessPoolExecutor', ThisProcess)
