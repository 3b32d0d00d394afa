"""Scenes of the soak test: parameters, topics and endless valid messages for each node."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from benchmarks.clips import COMPRESSED, ROOT, index_back_and_forth, read_messages
from hmt_learning.motion.viewpoint import Viewpoint
from hmt_ros.body import load_body
from hmt_ros.inference import GaussianMixture
from hmt_ros.sessions.bme_parameters import BmeParameters
from hmt_ros.sessions.bme_session import BmeSession
from hmt_ros.sessions.camera_session import CAMERA_INFO, IMAGE
from hmt_ros.sessions.image_inputs import DETECTIONS, IMAGE_TYPE, KEYPOINTS, MASK, PREDICTION
from hmt_ros.sessions.people_session import PeopleSession
from hmt_ros.sessions.session import Session
from hmt_ros.sessions.smoother_parameters import SmootherParameters
from hmt_ros.sessions.smoother_session import MIXTURE, SmootherSession
from hmt_ros.sessions.tracking_parameters import FilterParameters, PeopleParameters
from hmt_ros.sessions.tracking_session import TrackingSession
from hmt_ros.sessions.transform_buffer import TF, TF_STATIC, TRANSFORMS, TRANSFORMS_TYPE
from hmt_ros.tracking import TrackerSettings
from msg_tools import RosbagsMessages
from msg_tools.messages.detections import PEOPLE_2D, DetectedPerson, people_message
from msg_tools.messages.headers import header_message, time_ns
from msg_tools.messages.images import decode_image, image_message
from msg_tools.messages.keypoints import keypoints_of
from msg_tools.messages.pose_mixtures import MixtureKind, PoseMixture, pose_mixture_message
from msg_tools.messages.states import transforms_message

PERSON = 'person_node'
STEP_NS = 100_000_000  # interval between two messages
CLIP = ROOT / 'bags' / 'reach'
_SMALL = TrackerSettings(max_hypotheses=2, candidates=4)


@dataclass(frozen=True, eq=False)
class Scene:
    """A node and its messages.

    Attributes:
        node: name of the node.
        parameters: parameters of the node.
        session: class that processes its messages.
        inputs: topic and type by source.
        sensors: topics with best-effort delivery, unless a player asks for better.
        prelude: source and message of each message that must come first.
        pictures: messages of the counted source, which are repeated.
        others: a valid message of each other source.
        start_ns: timestamp of the first message.
        variants: other parameters, with which more inputs are used.
        together: nodes that run in one process with this one; empty if it runs alone.
    """

    node: str
    parameters: Any
    session: type[Session[Any, Any]]
    inputs: Mapping[str, tuple[str, str]]
    sensors: tuple[str, ...]
    prelude: tuple[tuple[str, Any], ...]
    pictures: tuple[Any, ...]
    others: Mapping[str, Any]
    start_ns: int
    variants: tuple[Mapping[str, Any], ...]
    together: tuple[str, ...] = ()

    @property
    def title(self) -> str:
        """Name of the node, or of the process of several nodes."""
        return PERSON if self.together else self.node

    def message(self, index: int) -> Any:
        """A message of the counted source; timestamps grow with the index."""
        picture = self.pictures[index_back_and_forth(index, len(self.pictures))]
        return stamped(picture, self.stamp(index))

    def stamp(self, index: int) -> int:
        """Timestamp of a message, ns."""
        return self.start_ns + index * STEP_NS

    def valid(self, image_transport: str = '') -> dict[str, Any]:
        """A valid message of each source; images with the given transport."""
        message = self.message(0)
        if image_transport == 'raw':
            picture, header = decode_image(message), message.header
            message = image_message(
                RosbagsMessages(), picture, time_ns(header.stamp), str(header.frame_id)
            )
        return {**self.others, self.session.COUNTED: message}


def stamped(message: Any, stamp_ns: int) -> Any:
    """The same message with another timestamp; transforms keep theirs."""
    if not hasattr(message, 'header'):
        return message
    header = header_message(RosbagsMessages(), stamp_ns, str(message.header.frame_id))
    return replace(message, header=header)


@cache
def scenes() -> dict[str, Scene]:
    """Scenes of all nodes, and of the filter in one process with others."""
    person = replace(_filter(), together=('filter_node', 'smoother_node'))
    return {scene.title: scene for scene in (_filter(), _smoother(), _bme(), _people(), person)}


@cache
def _clip() -> tuple[Any, tuple[Any, ...]]:
    info, images = read_messages(CLIP, [COMPRESSED])
    return info, tuple(images)


_CAMERA = {
    CAMERA_INFO: ('camera_info', 'sensor_msgs/msg/CameraInfo'),
    IMAGE: ('image/compressed', 'sensor_msgs/msg/CompressedImage'),
}
_CAMERA_TOPICS = ('/image/compressed', '/camera_info')


def _filter() -> Scene:
    info, images = _clip()
    start, frame = time_ns(images[0].header.stamp), str(images[0].header.frame_id)
    return Scene(
        'filter_node',
        FilterParameters(
            subject_file=str(CLIP / 'subject.yaml'),
            background_file=str(CLIP / 'background.png'),
            image_transport='compressed',
            gravity_frame='world',
            floor_in_gravity_frame=True,
            tracker=_SMALL,
        ),
        TrackingSession,
        {
            **_CAMERA,
            KEYPOINTS: ('keypoints', 'hmt_msgs/msg/Keypoints2D'),
            MASK: ('mask', IMAGE_TYPE),
            PREDICTION: ('pose_prediction', 'hmt_msgs/msg/PoseMixture'),
            **{source: (f'/{source}', TRANSFORMS_TYPE) for source in TRANSFORMS},
        },
        (*_CAMERA_TOPICS, '/keypoints', '/mask'),
        # Images need not wait for a static transform.
        ((CAMERA_INFO, info), (TF_STATIC, _transform('world', frame, 0))),
        images,
        {
            CAMERA_INFO: info,
            KEYPOINTS: _keypoints(start),
            MASK: _mask(images[0]),
            PREDICTION: _mixture(0, MixtureKind.PREDICTION),
            TF_STATIC: _transform('world', frame, 0),
            TF: _transform('world', 'robot', start),
        },
        start,
        (
            {},
            {'subject_file': '', 'image_transport': 'raw', 'reset_on_time_jump': True},
            {'subject_file': '', 'use_keypoints': True, 'reset_on_time_jump': True},
            {'subject_file': '', 'background_file': '', 'reset_on_time_jump': True},
            {'subject_file': '', 'use_predictions': True, 'input_timeout': 0.0},
            {'subject_file': '', 'gravity_frame': 'robot', 'input_timeout': 0.0},
        ),
    )


def _people() -> Scene:
    info, images = _clip()
    start, frame = time_ns(images[0].header.stamp), str(images[0].header.frame_id)
    keypoints = keypoints_of(_keypoints(start))
    people = [DetectedPerson(name, keypoints, None) for name in ('anna', 'p1')]
    found = people_message(RosbagsMessages(), people, start, frame)
    return Scene(
        'people_node',
        PeopleParameters(image_transport='compressed', input_timeout=0.0, tracker=_SMALL),
        PeopleSession,
        {**_CAMERA, DETECTIONS: ('detections', PEOPLE_2D)},
        (*_CAMERA_TOPICS, '/detections'),
        ((CAMERA_INFO, info),),
        images,
        {CAMERA_INFO: info, DETECTIONS: found},
        start,
        ({}, {'image_transport': 'raw', 'reset_on_time_jump': True}, {'max_people': 1}),
    )


def _bme() -> Scene:
    info, images = _clip()
    return Scene(
        'bme_node',
        BmeParameters(background_file=str(CLIP / 'background.png'), image_transport='compressed'),
        BmeSession,
        _CAMERA,
        _CAMERA_TOPICS,
        ((CAMERA_INFO, info),),
        images,
        {CAMERA_INFO: info},
        time_ns(images[0].header.stamp),
        (
            {},
            {'image_transport': 'raw', 'reset_on_time_jump': True},
            {'max_hypotheses': 3, 'reset_on_time_jump': True},
            {'background_file': ''},
        ),
    )


def _smoother() -> Scene:
    return Scene(
        'smoother_node',
        SmootherParameters(window_length=8, queue_size=5),
        SmootherSession,
        {MIXTURE: ('likelihood_mixture', 'hmt_msgs/msg/PoseMixture')},
        (),
        (),
        tuple(_mixture(index, MixtureKind.LIKELIHOOD) for index in range(10)),
        {},
        10**18,
        ({}, {'reset_on_time_jump': True}, {'body_model': 'human37', 'fixed_lag': 0.0}),
    )


def _mixture(index: int, kind: MixtureKind) -> Any:
    """A mixture of two modes of a person who raises a forearm."""
    body = load_body('human37')
    means = np.tile(body.prior_mean, (2, 1))
    means[:, 2] = 4.0
    elbow = body.dof_names.index('left_elbow')
    means[:, elbow] = (0.5 + 0.05 * index, 1.3 + 0.05 * index)
    covariances = np.tile(1e-3 * np.eye(body.dimension), (2, 1, 1))
    mixture = GaussianMixture(np.array([0.6, 0.4]), means, covariances)
    content = PoseMixture.of_body(
        body, mixture, kind, 10**18, 'lens', error_share=0.4, error_time=0.05
    )
    return pose_mixture_message(RosbagsMessages(), content)


def _transform(parent: str, child: str, stamp_ns: int) -> Any:
    """A frame 1.2 m above another, with the z axis level."""
    rotation = Viewpoint(height=1.2).rotation.T
    return transforms_message(
        RosbagsMessages(), [parent], [child], rotation[None], [[0.0, 0.0, 1.2]], stamp_ns
    )


def _keypoints(stamp_ns: int) -> Any:
    messages = RosbagsMessages()
    names = ('left_hip', 'right_hip', 'left_shoulder', 'right_shoulder', 'head')
    return messages.create(
        'hmt_msgs/msg/Keypoints2D',
        header=header_message(messages, stamp_ns, 'lens'),
        names=list(names),
        u=np.linspace(200.0, 240.0, len(names)),
        v=np.linspace(100.0, 200.0, len(names)),
    )


def _mask(image: Any) -> Any:
    """Mask of a person in the middle of an image."""
    mask = np.zeros(decode_image(image).shape[:2], np.uint8)
    mask[mask.shape[0] // 4 : -8, mask.shape[1] // 3 : -mask.shape[1] // 3] = 255
    stamp, frame = time_ns(image.header.stamp), str(image.header.frame_id)
    return image_message(RosbagsMessages(), mask, stamp, frame)
