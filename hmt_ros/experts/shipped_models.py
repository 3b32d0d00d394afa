"""Trained predictors by name, as bodies are by theirs."""

from __future__ import annotations

from pathlib import Path

from hmt_ros.experts.pose_predictor import PosePredictor

FOLDER = Path(__file__).resolve().parent / 'models'
# Trained from procedural motions: `train --motions procedural`.
SHIPPED = 'procedural'


def load_predictor(model: str | Path = SHIPPED) -> PosePredictor:
    """A predictor by the name of a model that ships, or from a file that `train` wrote.

    Raises:
        FileNotFoundError: neither.
        ValueError: not such a file, of another version or of another body.
    """
    known = sorted(path.stem for path in FOLDER.glob('*.npz'))
    if str(model) in known:
        return PosePredictor.load(FOLDER / f'{model}.npz')
    if not Path(model).is_file():
        raise FileNotFoundError(f'{model}: no such model; wanted a file, or one of {known}')
    return PosePredictor.load(model)
