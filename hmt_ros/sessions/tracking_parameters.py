"""Parameters of the nodes that track one person or several people, and of offline replay."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import ClassVar

from hmt_ros.sessions.camera_frames import unit_vector
from hmt_ros.sessions.declared_parameters import (
    AT_ONCE,
    FRACTION,
    NEXT_CONFIGURE,
    NEXT_TRACK,
    CameraNodeParameters,
    nested_parameters,
    parameter_field,
)
from hmt_ros.tracking import TrackerSettings
from hmt_ros.tracking.ground import KnownGround

# Number of evaluations per image with which the node keeps up with a camera, chosen by accuracy and
# computing time on tracked clips.
LIVE_BUDGET = 300
# Tracker settings that are parameters, with their limits.
_TRACKER_SETTINGS = {
    'evaluation_budget': (1, 100_000),
    'max_hypotheses': (1, 64),
    'lifter': None,
    'threads': (0, 64),
}


@dataclass(frozen=True)
class FilterParameters(CameraNodeParameters):
    """All parameters of the filter node.

    Attributes:
        subject_file: YAML file with the joints of the person in one image, from which the track
            starts; if empty, other inputs or ~/reset start the track.
        background_file: Image of the scene without people; if empty, the background is learned
            before the track starts, once nothing has moved for two seconds.
        body_model: Body model: 'human37', 'human34', 'human32' or a YAML file.
        random_seed: Seed of all random numbers; the same images and seed give the same results.
        use_keypoints: If true, 2D keypoints are a measurement and start a track if subject_file is
            empty.
        use_keypoints_3d: If true, 3D positions of the keypoints (topic keypoints_3d) are weak
            evidence of depth.
        use_depth: If true, depth images registered to the camera images (topic depth) are a
            measurement.
        use_predictions: If true, predictions of bme_node are pose hypotheses and start a track if
            subject_file is empty.
        gravity: Direction of gravity in the camera optical frame, three numbers of any scale, [0.0,
            1.0, 0.0] for a level camera; if empty, it is estimated from straight lines in the scene
            where possible.
        gravity_sigma: Standard deviation of the parameter gravity, degrees; straight lines in the
            scene refine gravity within it.
        camera_height: Height of the camera above the floor, m; 0 if unknown.
        focal_length_sigma: Relative standard deviation of the focal length in camera_info, which
            makes published depths more uncertain; 0 for a calibrated camera, 0.2 for a guess.
        gravity_frame: Frame whose z axis points up, such as odom or map; gravity from /tf then
            overrides the parameter gravity in every image. If empty, /tf is not used for gravity.
        floor_in_gravity_frame: If true, the plane z = 0 of gravity_frame is the floor and overrides
            camera_height.
        fixed_frame: World-fixed frame, such as odom, to which motion prior, gravity, floor and
            contacts refer; /tf gives the camera's motion in it. If empty, they refer to the camera.
        publish_in_fixed_frame: If true, markers, person_pose and keep_out are in fixed_frame, whose
            z axis must point up, and mixtures in <fixed_frame>_optical; if false, all are in the
            camera frame.
        publish_tf: If true, /tf has the link frames of the point estimate, and camera_upright if
            gravity is known.
        frame_prefix: Prefix of link names on /tf and in human_description; in a namespace, the
            default is the namespace.
        keep_out_probability: Probability that keep_out contains each part of the body, and minimum
            total weight of the modes that it covers.
        stale_time: Time without an answered image after which keep_out becomes STALE and grows, s.
        forecast_rate: Number of forecasts per second on pose_forecast; 0 switches them off.
        forecast_horizon: Maximum time from an image to a forecast, s; it should exceed the time
            until the next image is answered.
        tracker: settings of the tracker.
    """

    subject_file: str = parameter_field('', NEXT_TRACK)
    background_file: str = parameter_field('', NEXT_TRACK)
    body_model: str = parameter_field('human37', NEXT_TRACK)
    random_seed: int = parameter_field(0, NEXT_TRACK, (0, 2**31 - 1))
    use_keypoints: bool = parameter_field(False, AT_ONCE)
    use_keypoints_3d: bool = parameter_field(False, AT_ONCE)
    use_depth: bool = parameter_field(False, AT_ONCE)
    use_predictions: bool = parameter_field(False, AT_ONCE)
    gravity: tuple[float, ...] = parameter_field((), NEXT_TRACK)
    gravity_sigma: float = parameter_field(2.0, NEXT_TRACK, (0.1, 45.0))
    camera_height: float = parameter_field(0.0, NEXT_TRACK, (0.0, 100.0))
    focal_length_sigma: float = parameter_field(0.0, AT_ONCE, FRACTION)
    gravity_frame: str = parameter_field('', NEXT_CONFIGURE)
    floor_in_gravity_frame: bool = parameter_field(False, NEXT_CONFIGURE)
    fixed_frame: str = parameter_field('', NEXT_CONFIGURE)
    publish_in_fixed_frame: bool = parameter_field(False, NEXT_CONFIGURE)
    publish_tf: bool = parameter_field(True, AT_ONCE)
    frame_prefix: str = parameter_field('human/', AT_ONCE)
    keep_out_probability: float = parameter_field(0.99, AT_ONCE, (0.5, 0.9999))
    stale_time: float = parameter_field(0.5, AT_ONCE, (0.05, 3600.0))
    forecast_rate: float = parameter_field(0.0, AT_ONCE, (0.0, 1000.0))
    forecast_horizon: float = parameter_field(0.15, AT_ONCE, (0.0, 10.0))
    tracker: TrackerSettings = field(
        default_factory=lambda: TrackerSettings(evaluation_budget=LIVE_BUDGET),
        metadata=nested_parameters(NEXT_TRACK, _TRACKER_SETTINGS),
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.body_model:
            raise ValueError("body_model must be a name or a file, saw ''")
        if self.use_keypoints_3d and not self.use_keypoints:
            raise ValueError('use_keypoints_3d needs use_keypoints, which is false')
        if self.gravity:
            unit_vector(self.gravity, 'gravity')
        if self.publish_in_fixed_frame and not self.fixed_frame:
            raise ValueError('publish_in_fixed_frame needs the name of fixed_frame, which is empty')
        if self.floor_in_gravity_frame and not self.gravity_frame:
            raise ValueError(
                'floor_in_gravity_frame needs the name of gravity_frame, which is empty'
            )

    @property
    def sources(self) -> tuple[str, ...]:
        """Inputs that may start a track that has no subject_file."""
        used = {
            'keypoints of a person': self.use_keypoints,
            'a mask of a person': self.use_mask,
            'a pose_prediction with components': self.use_predictions,
        }
        return tuple(source for source, use in used.items() if use)

    @property
    def uses_transforms(self) -> bool:
        """Whether the parameters name a frame, so that transforms are needed."""
        return bool(self.gravity_frame or self.fixed_frame)

    @property
    def known_ground(self) -> KnownGround:
        """Gravity and floor from the parameters, without transforms."""
        up = -unit_vector(self.gravity, 'gravity') if self.gravity else None
        return KnownGround(up, self.camera_height or None, math.radians(self.gravity_sigma))


# Values that disable the inputs for a single person, whose messages do not identify the person.
_ONE_PERSON_INPUTS = {
    'subject_file': '',
    'use_predictions': False,
    'use_keypoints_3d': False,
    'person_id': '',
}


@dataclass(frozen=True)
class PeopleParameters(FilterParameters):
    """All parameters of the people node.

    Attributes:
        source: Type of the messages on the topic detections: 'people' (hmt_msgs/People2D), 'yolo'
            (yolo_msgs/DetectionArray), 'boxes' (vision_msgs/Detection2DArray) or 'floats'
            (std_msgs/Float32MultiArray).
        max_people: Maximum number of people who are tracked at the same time; if several appear at
            once, the largest in the image are tracked.
        use_keypoints: If true, keypoints of the detections are a measurement and start tracks; if
            false, only the boxes are used.
        frame_prefix: Prefix of all frame names on /tf and in human_description, before body_<id>/;
            it distinguishes several robots.
    """

    source: str = parameter_field('people', NEXT_CONFIGURE)
    max_people: int = parameter_field(4, AT_ONCE, (1, 20))
    use_keypoints: bool = parameter_field(True, AT_ONCE)
    frame_prefix: str = parameter_field('', AT_ONCE)

    SOURCES: ClassVar[tuple[str, ...]] = ('people', 'yolo', 'boxes', 'floats')

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, unused in _ONE_PERSON_INPUTS.items():
            if getattr(self, name) != unused:
                raise ValueError(
                    f'{name} is {getattr(self, name)!r}, but people_node takes no input of one '
                    f'person: wanted {unused!r}, or filter_node'
                )

    @property
    def sources(self) -> tuple[str, ...]:
        """See `FilterParameters`."""
        return ('detections of people',)
