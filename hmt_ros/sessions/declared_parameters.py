"""Settings dataclasses as ROS parameters.

A dataclass defines the parameters of a node. Its docstring describes them, and its checks reject
inconsistent values. A field made by `parameter_field` is a parameter. A field with
`nested_parameters` contains settings of a library class, and lists which settings are parameters.
All other fields can only be set by a program.
"""

from __future__ import annotations

import dataclasses
import difflib
import inspect
import re
import textwrap
from array import array
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cache
from typing import Any, ClassVar, TypeVar

from hmt_ros.image.keypoint_schemes import AUTO, JOINTS, Scheme, schemes

# A tuple represents a list of numbers.
Value = bool | int | float | str | tuple[float, ...]
Limits = tuple[float, float] | None
Settings = TypeVar('Settings')

AT_ONCE = 'at once'
NEXT_TRACK = 'next track'
NEXT_WINDOW = 'next window'
NEXT_CONFIGURE = 'next configure'
AT_LAUNCH = 'at launch'
EFFECTS = {
    AT_ONCE: 'A new value takes effect at once.',
    NEXT_TRACK: 'A new value takes effect when the next track starts, for example after ~/reset.',
    NEXT_WINDOW: 'A new value takes effect with the next window, for example after a jump in time.',
    NEXT_CONFIGURE: 'A new value takes effect when the node is next configured.',
    AT_LAUNCH: 'The value can only be set at launch.',
}

FRACTION = (0.0, 1.0)

TRANSPORTS = ('raw', 'compressed')
MAX_TIMEOUT = 60.0  # s
MAX_VALUE_LENGTH = 4096  # characters of a string, or entries of a list
# Value of `source` for messages of this package.
OWN_SOURCE = 'keypoints'

# Default scheme for the order of keypoints without names.
USUAL_ORDER = 'coco17'

# Keys of the metadata of a field that is a parameter or contains parameters.
_EFFECT, _LIMITS = 'effect', 'limits'


def parameter_field(default: Value, effect: str, limits: Limits = None) -> Any:
    """A dataclass field that is a ROS parameter.

    Args:
        default: default value of the parameter.
        effect: when a new value takes effect; one of `EFFECTS`.
        limits: lowest and highest value; None: no limits.
    """
    return dataclasses.field(default=default, metadata={_EFFECT: effect, _LIMITS: {'': limits}})


def nested_parameters(effect: str, parameters: Mapping[str, Limits]) -> Mapping[str, Any]:
    """Metadata of a field that holds settings of a library class, some of which are parameters.

    Args:
        effect: when new values take effect; one of `EFFECTS`.
        parameters: the settings that are parameters, each mapped to its limits or None.
    """
    return {_EFFECT: effect, _LIMITS: parameters}


def check_choices(settings: Any, **choices: tuple[str, ...]) -> None:
    """Raises ValueError if a field of the settings does not have an allowed value."""
    for name, values in choices.items():
        if (value := getattr(settings, name)) not in values:
            raise ValueError(f'{name} must be one of {values}, saw {value!r}')


@dataclass(frozen=True)
class NodeParameters:
    """Parameters that all nodes have.

    Attributes:
        reset_on_time_jump: If true, the estimate restarts after two consecutive messages that are
            older than the newest one before them; if false, after three that are at least a second
            older. Other old messages are skipped. The default is the value of use_sim_time.
        queue_size: Maximum number of messages that wait for an estimate; when the node is late, the
            oldest are dropped.
        autostart: If true, the node configures and activates itself; if false, it waits for its
            lifecycle services.
        file_folders: Folders, separated by ':', that must contain all files that parameters name at
            run time; if empty, the share folder of the package, the user's home and the working
            folder. Files named at launch may be anywhere.
    """

    reset_on_time_jump: bool = parameter_field(False, AT_ONCE)
    queue_size: int = parameter_field(5, AT_ONCE, (1, 1000))
    autostart: bool = parameter_field(True, AT_LAUNCH)
    file_folders: str = parameter_field('', AT_LAUNCH)


@dataclass(frozen=True)
class ImageNodeParameters(NodeParameters):
    """Parameters of the nodes that subscribe to images.

    Attributes:
        image_transport: Transport of the images: 'raw' (topic image) or 'compressed' (topic
            image/compressed).
        queue_size: Maximum number of complete images that wait while the node is late; the oldest
            are dropped, so 1 keeps the newest.
    """

    queue_size: int = parameter_field(1, AT_ONCE, (1, 1000))
    image_transport: str = parameter_field('raw', NEXT_CONFIGURE)

    def __post_init__(self) -> None:
        check_choices(self, image_transport=TRANSPORTS)


@dataclass(frozen=True)
class CameraNodeParameters(ImageNodeParameters):
    """Parameters of the nodes that estimate from the images of a calibrated camera.

    Attributes:
        use_mask: If true, masks from a segmenter replace background subtraction, and each image
            waits for the mask with its stamp.
        source: Type of the keypoint messages: 'keypoints' (hmt_msgs/Keypoints2D on the topic
            keypoints), or on the topic detections 'skeleton2d' (hri_msgs/Skeleton2D), 'yolo'
            (yolo_msgs/DetectionArray) or 'floats' (std_msgs/Float32MultiArray).
        person_id: Detector's identity of the tracked person; if empty, the largest person is
            tracked at first, then the person nearest to the last position.
        keypoint_scheme: Keypoint scheme: 'auto' (recognised by the names, or 'coco17' order for
            'yolo' and 'floats'), 'joints' (joints of the body model), 'coco17', 'halpe26',
            'body25', 'mediapipe33', 'h36m17', 'skeleton2d', 'smpl24', 'mhr70', or another name in
            docs/keypoints.md.
        input_timeout: Maximum time that an image waits for each input with its stamp, s, measured
            by the stamps of later messages. A later input of the same kind ends the wait.
    """

    use_mask: bool = parameter_field(False, AT_ONCE)
    source: str = parameter_field(OWN_SOURCE, NEXT_CONFIGURE)
    person_id: str = parameter_field('', AT_ONCE)
    keypoint_scheme: str = parameter_field(AUTO, AT_ONCE)
    input_timeout: float = parameter_field(0.5, AT_ONCE, (0.0, MAX_TIMEOUT))

    # Allowed values of `source`.
    SOURCES: ClassVar[tuple[str, ...]] = (OWN_SOURCE, 'skeleton2d', 'yolo', 'floats')

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choices(self, source=self.SOURCES, keypoint_scheme=(AUTO, JOINTS, *schemes()))

    @property
    def order(self) -> Scheme:
        """The scheme that gives the order of keypoints without names."""
        return schemes().get(self.keypoint_scheme) or schemes()[USUAL_ORDER]


@dataclass(frozen=True)
class DeclaredParameter:
    """A ROS parameter that a settings dataclass declares.

    Attributes:
        name: name of the parameter and of its field.
        default: default value, which has the type of the parameter.
        description: description for users, in one or more sentences.
        limits: lowest and highest value; None: no limits.
        effect: when a new value takes effect; one of `EFFECTS`.
        path: names of the nested fields that contain the value, outermost first.
    """

    name: str
    default: Value
    description: str
    limits: Limits
    effect: str
    path: tuple[str, ...]

    @property
    def bounds(self) -> str:
        """Lowest and highest value in words; '' without limits."""
        if self.limits is None:
            return ''
        digits = '.0f' if isinstance(self.default, int) else 'g'
        return ' to '.join(format(limit, digits) for limit in self.limits)

    def checked(self, value: Any) -> Value:
        """Check a value from a file or a command line, and convert it to the parameter's type.

        Raises:
            ValueError: the value has the wrong type or exceeds the limits.
        """
        wanted: Any = type(self.default)
        if hasattr(value, '__len__') and len(value) > MAX_VALUE_LENGTH:
            raise ValueError(
                f'{self.name} has the length {len(value)}, the limit is {MAX_VALUE_LENGTH}'
            )
        if wanted is tuple:
            return self._numbers(value)
        if wanted is float and type(value) is int:
            value = float(value)
        if type(value) is not wanted:
            raise ValueError(f'{self.name} must be a {_NAMES[wanted]}, saw {value!r}')
        if self.limits is not None and not self.limits[0] <= value <= self.limits[1]:
            low, high = self.limits
            raise ValueError(f'{self.name} must lie between {low:g} and {high:g}, saw {value!r}')
        return wanted(value)

    def _numbers(self, value: Any) -> tuple[float, ...]:
        """Convert a list of numbers to a tuple; ROS passes an empty list as None."""
        numbers = () if value is None else value
        # Lists in ROS may also contain bytes, integers or strings.
        if not isinstance(numbers, list | tuple | array) or not all(
            type(number) in (int, float) for number in numbers
        ):
            raise ValueError(f'{self.name} must be a list of numbers, saw {value!r}')
        return tuple(map(float, numbers))


_NAMES = {bool: 'truth value', int: 'whole number', float: 'number', str: 'text'}


def declared_parameters(settings: Any) -> list[DeclaredParameter]:
    """The parameters of a settings dataclass; inherited parameters come last.

    Args:
        settings: instance with the default values.
    """
    places = {name: i for i, name in enumerate(vars(type(settings)).get('__annotations__', ()))}
    ordered = sorted(fields(settings), key=lambda field: places.get(field.name, len(places)))
    found = []
    for field in ordered:
        for inner, limits in field.metadata.get(_LIMITS, {}).items():
            owner, name = (
                (getattr(settings, field.name), inner) if inner else (settings, field.name)
            )
            text = described_fields(owner.__class__).get(name, '')
            path = (field.name, inner) if inner else (field.name,)
            effect = field.metadata[_EFFECT]
            found.append(DeclaredParameter(name, getattr(owner, name), text, limits, effect, path))
    return found


def values_of(settings: Any) -> dict[str, Any]:
    """Values of all parameters by name, as in a parameter file: tuples become lists."""
    return {
        p.name: list(p.default) if isinstance(p.default, tuple) else p.default
        for p in declared_parameters(settings)
    }


def with_values(settings: Settings, values: Mapping[str, Any]) -> Settings:
    """Return a copy of the settings with new values of some parameters.

    Raises:
        ValueError: a name is unknown, a value has the wrong type or exceeds its limits, or the
            values are inconsistent.
    """
    known = {parameter.name: parameter for parameter in declared_parameters(settings)}
    for name in values:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            hint = f'; is {near[0]} meant?' if near else ''
            raise ValueError(f'there is no parameter {name}{hint}')
    changes: dict[str, Any] = {}
    for name, value in values.items():
        field, *inner = known[name].path
        checked = known[name].checked(value)
        if inner:
            changes.setdefault(field, {})[inner[0]] = checked
        else:
            changes[field] = checked
    for field, inside in changes.items():
        if isinstance(inside, dict):
            changes[field] = replace(getattr(settings, field), **inside)
    return replace(settings, **changes)  # type: ignore[type-var]


@cache
def described_fields(cls: type) -> dict[str, str]:
    """Descriptions in the docstrings of a class and its bases, as a mapping from name to line."""
    result: dict[str, str] = {}
    for each in reversed(cls.__mro__):
        text = inspect.cleandoc(vars(each).get('__doc__') or '')
        _, _, section = text.partition('Attributes:\n')
        # The section ends before the first line that is not indented.
        block = re.split(r'\n(?=\S)', section, maxsplit=1)[0]
        for entry in re.split(r'\n(?=\S)', textwrap.dedent(block)):
            names, colon, words = entry.partition(':')
            if colon:
                result |= dict.fromkeys(re.split(r',\s*', names), ' '.join(words.split()))
    return result
