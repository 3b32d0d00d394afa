"""Parameters of the filter node, which are the settings of offline replay as well.

`hmt_ros/config/filter_node.yaml` lists them with their defaults; it is written by

    python -m hmt_ros.sessions.filter_parameters > hmt_ros/config/filter_node.yaml
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field

from hmt_ros.image.background import BackgroundSettings
from hmt_ros.sessions.declared_parameters import (
    AT_LAUNCH,
    AT_ONCE,
    EFFECT,
    FLAT,
    LIMITS,
    NEXT_CONFIGURE,
    NEXT_TRACK,
    parameter_field,
)
from hmt_ros.sessions.parameter_file import parameter_file_text
from hmt_ros.tracking import TrackerSettings

TRANSPORTS = ('raw', 'compressed')

_FRACTION = (0.0, 1.0)

# Where a number may be more than a value of the same sign as its default.
_TRACKER_LIMITS = {
    'max_hypotheses': (1, 64),
    'hypothesis_merge_distance': (0.0, 1.0),
    'candidates': (1, 1024),
    'combinations': (1, 65536),
    'alternatives': (1, 64),
    'samples': (1, 65536),
    'rounds': (1, 100),
    'edge_jumps': (0, 64),
    'image_trust': _FRACTION,
    'jump_probability': _FRACTION,
    'edge_probability': _FRACTION,
    'prediction_probability': _FRACTION,
    'facing_trial': (0.0, 60.0),
    'base_iterations': (1, 100),
    'iterations': (1, 100),
    'least_log_weight': (-100.0, 0.0),
    'lost_misfit': _FRACTION,
    'lost_images': (1, 100_000),
    'dynamics.velocity_kept': _FRACTION,
    'dynamics.velocity_gain': _FRACTION,
    'observation.outline_points': (8, 10_000),
    'observation.margin': (1, 10_000),
    'observation.intensity_blur': (0.1, 100.0),
    'search.samples': (3, 65536),
    'search.refined': (1, 1024),
    'search.iterations': (1, 100),
}
BACKGROUND_LIMITS = {
    'shadow_threshold': _FRACTION,
    'smallest_part': _FRACTION,
    'largest_gap': (0.0, 10.0),
}


@dataclass(frozen=True)
class FilterParameters:
    """All parameters of the filter node.

    Attributes:
        subject_file: YAML file with the joints of the person in one image, which starts the track;
            empty: a pose_prediction does, with use_predictions, or ~/reset with a mixture.
        background_file: image of the empty scene, as the camera sees it; empty: learned from the
            images before the track starts.
        body_model: 'human37', 'human34', 'human32', or a YAML file.
        random_seed: of all that is random. The same images give the same numbers.
        reset_on_time_jump: whether an image that is older than the one before starts the track
            anew; otherwise such images are skipped.
        image_transport: 'raw' (topic image) or 'compressed' (topic image/compressed).
        queue_size: images that wait at most; when the node is late the oldest are dropped.
        use_keypoints: whether keypoints are a measurement. An image then waits for the keypoints of
            its stamp.
        keypoint_sigma_px: standard deviation of keypoints that come without a covariance, px.
        keypoints_timeout: an image waits no longer when keypoints of a later stamp, or an image
            that is so much younger, have come, s.
        use_predictions: whether poses that are predicted from the image, by bme_node, start the
            track where there is no subject_file, and are among the hypotheses. An image then waits
            for the prediction of its stamp.
        prediction_timeout: an image waits no longer when a prediction of a later stamp, or an image
            that is so much younger, has come, s.
        overlay_modes: heaviest modes that are drawn on the image; 0: no overlay.
        overlay_quality: of the JPEG pictures of the overlay.
        publish_tf: whether the segments of the heaviest mode are published on /tf.
        frame_prefix: stands before the names of the segments on /tf and in human_description, so
            that several persons differ.
        status_interval: a line on the console says every so many seconds what the node does, while
            messages come, s; 0: never.
        autostart: whether the node configures and activates itself; otherwise it waits for its
            lifecycle services.
        tracker: settings of the tracker.
        background: settings of the background subtraction.
    """

    subject_file: str = parameter_field('', NEXT_TRACK)
    background_file: str = parameter_field('', NEXT_TRACK)
    body_model: str = parameter_field('human37', NEXT_TRACK)
    random_seed: int = parameter_field(0, NEXT_TRACK, (0, 2**31 - 1))
    reset_on_time_jump: bool = parameter_field(False, AT_ONCE)
    image_transport: str = parameter_field('raw', NEXT_CONFIGURE)
    queue_size: int = parameter_field(5, AT_ONCE, (1, 1000))
    use_keypoints: bool = parameter_field(False, AT_ONCE)
    keypoint_sigma_px: float = parameter_field(5.0, AT_ONCE, (0.01, 1000.0))
    keypoints_timeout: float = parameter_field(0.5, AT_ONCE, (0.0, 60.0))
    use_predictions: bool = parameter_field(False, AT_ONCE)
    prediction_timeout: float = parameter_field(0.5, AT_ONCE, (0.0, 60.0))
    overlay_modes: int = parameter_field(3, AT_ONCE, (0, 64))
    overlay_quality: int = parameter_field(85, AT_ONCE, (1, 100))
    publish_tf: bool = parameter_field(True, AT_ONCE)
    frame_prefix: str = parameter_field('', AT_ONCE)
    status_interval: int = parameter_field(1, AT_ONCE, (0, 3600))
    autostart: bool = parameter_field(True, AT_LAUNCH)
    tracker: TrackerSettings = field(
        default_factory=TrackerSettings,
        metadata={FLAT: True, EFFECT: NEXT_TRACK, LIMITS: _TRACKER_LIMITS},
    )
    background: BackgroundSettings = field(
        default_factory=BackgroundSettings,
        metadata={EFFECT: NEXT_TRACK, LIMITS: BACKGROUND_LIMITS},
    )

    def __post_init__(self) -> None:
        if self.image_transport not in TRANSPORTS:
            raise ValueError(
                f'image_transport must be one of {TRANSPORTS}, saw {self.image_transport!r}'
            )
        if not self.body_model:
            raise ValueError("body_model must be a name or a file, saw ''")


if __name__ == '__main__':
    sys.stdout.write(parameter_file_text('filter_node', FilterParameters()))
