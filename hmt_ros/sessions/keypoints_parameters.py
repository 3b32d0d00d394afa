"""Parameters of the keypoints node."""

from __future__ import annotations

from dataclasses import dataclass

from hmt_ros.sessions.declared_parameters import (
    NEXT_CONFIGURE,
    ImageNodeParameters,
    parameter_field,
)


@dataclass(frozen=True)
class KeypointsParameters(ImageNodeParameters):
    """All parameters of the keypoints node.

    Attributes:
        publish_mask: If true, the node also publishes the mask of the person.
    """

    publish_mask: bool = parameter_field(False, NEXT_CONFIGURE)
