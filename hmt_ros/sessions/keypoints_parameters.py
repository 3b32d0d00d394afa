"""Parameters of the keypoints node.

`hmt_ros/config/keypoints_node.yaml` lists them with their defaults; it is written by

    python -m hmt_ros.sessions.keypoints_parameters > hmt_ros/config/keypoints_node.yaml
"""

from __future__ import annotations

import sys
from dataclasses import dataclass

from hmt_ros.sessions.declared_parameters import (
    NEXT_CONFIGURE,
    ImageNodeParameters,
    parameter_field,
)
from hmt_ros.sessions.parameter_file import parameter_file_text


@dataclass(frozen=True)
class KeypointsParameters(ImageNodeParameters):
    """All parameters of the keypoints node.

    Attributes:
        publish_mask: If true, the node also publishes the mask of the person.
    """

    publish_mask: bool = parameter_field(False, NEXT_CONFIGURE)


if __name__ == '__main__':
    sys.stdout.write(parameter_file_text('keypoints_node', KeypointsParameters()))
