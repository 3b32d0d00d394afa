"""Model of a person (skeleton, kinematics, flesh, limits, priors) and of the camera."""

from __future__ import annotations

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.model_file import load_body, model_names, named_body

__all__ = ['Body', 'Camera', 'load_body', 'model_names', 'named_body']
