"""Parameters of the BME node, which are the settings of offline replay as well.

`hmt_ros/config/bme_node.yaml` lists them with their defaults; it is written by

    python -m hmt_ros.sessions.bme_parameters > hmt_ros/config/bme_node.yaml
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field

from hmt_ros.image.background import BackgroundSettings
from hmt_ros.sessions.declared_parameters import (
    AT_LAUNCH,
    AT_ONCE,
    EFFECT,
    LIMITS,
    NEXT_CONFIGURE,
    parameter_field,
)
from hmt_ros.sessions.filter_parameters import BACKGROUND_LIMITS, TRANSPORTS
from hmt_ros.sessions.parameter_file import parameter_file_text


@dataclass(frozen=True)
class BmeParameters:
    """All parameters of the BME node.

    Attributes:
        model_file: trained model, as `train` writes it; empty: the small one that comes with the
            package.
        background_file: image of the empty scene, as the camera sees it; empty: learned from the
            first images.
        background_images: so many images of the empty scene are learned from where there is no
            background_file.
        stature: of the person, m; 0: that of the model.
        least_height: silhouettes that are not as high are nobody, px.
        propagate: whether the poses in the image before are taken into account.
        longest_interval: after a longer time without a person the images before count no more, s.
        max_hypotheses: components of a prediction at most.
        reset_on_time_jump: whether an image that is older than the one before is taken as the first
            of a new sequence; otherwise such images are skipped.
        image_transport: 'raw' (topic image) or 'compressed' (topic image/compressed).
        queue_size: images that wait at most; when the node is late the oldest are dropped.
        status_interval: a line on the console says every so many seconds what the node does, while
            messages come, s; 0: never.
        autostart: whether the node configures and activates itself; otherwise it waits for its
            lifecycle services.
        background: settings of the background subtraction.
    """

    model_file: str = parameter_field('', NEXT_CONFIGURE)
    background_file: str = parameter_field('', NEXT_CONFIGURE)
    background_images: int = parameter_field(30, AT_ONCE, (1, 10_000))
    stature: float = parameter_field(0.0, NEXT_CONFIGURE, (0.0, 3.0))
    least_height: int = parameter_field(40, AT_ONCE, (1, 10_000))
    propagate: bool = parameter_field(False, AT_ONCE)
    longest_interval: float = parameter_field(0.5, AT_ONCE, (0.0, 60.0))
    max_hypotheses: int = parameter_field(5, AT_ONCE, (1, 64))
    reset_on_time_jump: bool = parameter_field(False, AT_ONCE)
    image_transport: str = parameter_field('raw', NEXT_CONFIGURE)
    queue_size: int = parameter_field(5, AT_ONCE, (1, 1000))
    status_interval: int = parameter_field(1, AT_ONCE, (0, 3600))
    autostart: bool = parameter_field(True, AT_LAUNCH)
    background: BackgroundSettings = field(
        default_factory=BackgroundSettings,
        metadata={EFFECT: NEXT_CONFIGURE, LIMITS: BACKGROUND_LIMITS},
    )

    def __post_init__(self) -> None:
        if self.image_transport not in TRANSPORTS:
            raise ValueError(
                f'image_transport must be one of {TRANSPORTS}, saw {self.image_transport!r}'
            )


if __name__ == '__main__':
    sys.stdout.write(parameter_file_text('bme_node', BmeParameters()))
