"""Message types for use without ROS, and an interface to make messages of `rosbags` or of ROS.

The types are from ROS 2 Jazzy and hmt_msgs. The .msg files in `hmt_msgs/` are the only definition
of hmt_msgs: colcon generates the classes of the nodes from them, and this module generates the
classes that `rosbags` serialises.

Offline code uses the classes of `rosbags`, which have numpy arrays and need a value for every
field. Nodes use the classes that ROS generates, which have sequences of type `array.array`.
Functions that convert arrays to messages get a `MessageFactory` and work for both.
"""

from __future__ import annotations

import array
from collections.abc import Callable, Iterable
from functools import cache, partial
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from msg_tools.messages.definitions import Types, check_types, types_of_definition

if TYPE_CHECKING:
    from rosbags.interfaces.typing import Typesdict


@cache
def typestore() -> Typestore:
    """All types that the project reads and writes; always the same object."""
    store = get_typestore(Stores.ROS2_JAZZY)
    with resources.as_file(resources.files('msg_tools') / 'hmt_msgs' / 'msg') as folder:
        store.register(_types_in('hmt_msgs', folder))
    return store


def _types_in(package: str, folder: Path) -> Typesdict:
    """The types of the .msg files in a folder."""
    types: Typesdict = {}
    for file in sorted(folder.glob('*.msg')):
        types.update(get_types_from_msg(file.read_text('utf-8'), f'{package}/msg/{file.stem}'))
    return types


def register_definitions(package: str, folder: Path) -> None:
    """Adds the messages of another package to `typestore()`.

    Raises:
        ValueError: a file can not be parsed.
    """
    try:
        types, store = _types_in(package, folder), typestore()
        store.register({name: x for name, x in types.items() if name not in store.fielddefs})
    except Exception as error:
        # The parser reads untrusted text here, and its exceptions are not documented.
        raise ValueError(f'the messages of {package} in {folder} can not be understood') from error


def typestore_of_definition(msgtype: str, encoding: str, definition: str) -> Typestore:
    """Types for messages that come with their definition, such as messages of a bag.

    A bag may contain unknown types, or older versions of known types; its messages must be read
    with the definitions in the bag.

    Args:
        msgtype: type, for example 'sensor_msgs/msg/Image'.
        encoding: encoding of the definition, 'ros2msg'; for a known type any other value selects
            the known definition.
        definition: text of the definition, including the definitions of nested types.

    Returns:
        The types; `typestore()` itself if it agrees with the definition.

    Raises:
        ValueError: the type is unknown and the definition is invalid, or too large to be used.
    """
    known = typestore()
    ours = msgtype in known.fielddefs
    types: Types = {}
    if encoding == 'ros2msg' and (definition.strip() or not ours):
        try:
            types = types_of_definition(definition, msgtype)
        except ValueError:
            if not ours:
                raise
    if not types and not ours:
        raise ValueError(
            f"the type is not known, and its definition is {encoding[:20]!r}, wanted 'ros2msg'"
        )
    changed: Any = {
        name: ([], types[name]) for name in types if not _same_fields(name, types, known)
    }
    if not changed:
        return known
    check_types({name: types[name] for name in changed}, known.fielddefs)
    own = Typestore()
    own.fielddefs.update(
        {name: fields for name, fields in known.fielddefs.items() if name not in changed}
    )
    own.types.update({name: cls for name, cls in known.types.items() if name not in changed})
    try:
        own.register(changed)
    except Exception as error:
        # The exceptions of the code generator are not documented.
        raise ValueError('its definition can not be used') from error
    return own


def _same_fields(name: str, types: Types, known: Typestore) -> bool:
    """Whether a type has the same fields as the known type of the same name.

    Names are compared without case, because CameraInfo had D, K, R, P in early ROS 2 releases.
    """
    ours: Any = known.fielddefs.get(name, ((), ()))[1]
    return [(field.lower(), kind) for field, kind in types[name]] == [
        (field.lower(), kind) for field, kind in ours
    ]


def adopted(value: Any, types: Typestore) -> Any:
    """Converts a message, read with an older definition, to its type in `typestore()`.

    Missing fields are zero or empty.

    Args:
        value: the message, or the value of one of its fields.
        types: types with which the message was read.

    Raises:
        ValueError: the type in `typestore()` lacks a field of the message.
    """
    if isinstance(value, list):
        return [adopted(item, types) for item in value]
    msgtype = getattr(value, '__msgtype__', None)
    if msgtype is None or types is typestore():
        return value
    fields, known = types.fielddefs[msgtype][1], typestore().fielddefs[msgtype][1]
    if any(field not in known for field in fields):
        raise ValueError('it was recorded with another definition of this type')
    values = {name: adopted(getattr(value, name), types) for name, _ in fields}
    return RosbagsMessages().create(msgtype, **values)


_POINT = 'geometry_msgs/msg/Point'


class MessageFactory(Protocol):
    """Makes messages by the name of their type, for example 'hmt_msgs/msg/PoseMixture'."""

    def create(self, msgtype: str, **fields: Any) -> Any:
        """Makes a message; fields that are not given are zero or empty (identity for quaternions).

        Numpy arrays are converted to the type of the field.
        """

    def points(self, positions: NDArray[np.float64]) -> list[Any]:
        """Makes a geometry_msgs/Point for each position (N, 3), faster than `create`."""


class RosbagsMessages:
    """Makes messages of `typestore()`, for bags and all other use without ROS."""

    def create(self, msgtype: str, **fields: Any) -> Any:
        """See `MessageFactory.create`.

        Raises:
            TypeError: the type has no such field.
        """
        defaults = _defaults(msgtype)
        if not fields.keys() <= defaults.keys():
            unknown = fields.keys() - defaults.keys()
            raise TypeError(f'{msgtype} has no field {sorted(unknown)[0]!r}')
        for name, (default, dtype) in defaults.items():
            if name not in fields:
                fields[name] = default()
            elif dtype is not None:
                fields[name] = np.ascontiguousarray(fields[name], dtype=dtype)
        return typestore().types[msgtype](**fields)

    def points(self, positions: NDArray[np.float64]) -> list[Any]:
        """See `MessageFactory.points`."""
        point = typestore().types[_POINT]
        return [point(x, y, z) for x, y, z in positions.tolist()]


class GeneratedMessages:
    """Makes messages of the classes that ROS generates.

    Args:
        classes: classes in use, for example `[hmt_msgs.msg.PoseMixture, std_msgs.msg.Header]`.
    """

    def __init__(self, classes: Iterable[type]) -> None:
        self._classes = {
            f'{cls.__module__.partition(".")[0]}/msg/{cls.__name__}': cls for cls in classes
        }
        self._kinds = {
            name: cls.get_fields_and_field_types()  # type: ignore[attr-defined]
            for name, cls in self._classes.items()
        }

    def create(self, msgtype: str, **fields: Any) -> Any:
        """See `MessageFactory.create`.

        Raises:
            KeyError: the class of the type was not given.
        """
        kinds = self._kinds[msgtype]
        for name, value in fields.items():
            kind = kinds.get(name, '')
            if isinstance(value, np.ndarray) and kind.startswith('sequence<'):
                fields[name] = _sequence(value, kind)
            elif kind == 'octet' and isinstance(value, int):
                fields[name] = bytes([value])
        return self._classes[msgtype](**fields)

    def points(self, positions: NDArray[np.float64]) -> list[Any]:
        """See `MessageFactory.points`."""
        point = self._classes[_POINT]
        return [point(x=x, y=y, z=z) for x, y, z in positions.tolist()]


_TYPE_CODES = {
    'boolean': '?',
    'octet': 'B',
    'uint8': 'B',
    'int8': 'b',
    'uint16': 'H',
    'int16': 'h',
    'uint32': 'I',
    'int32': 'i',
    'uint64': 'Q',
    'int64': 'q',
    'float': 'f',
    'double': 'd',
}


def _sequence(value: NDArray[Any], kind: str) -> Any:
    """Converts to `array.array`, which generated classes accept without checking each element."""
    code = _TYPE_CODES[kind.removeprefix('sequence<').removesuffix('>').partition(',')[0]]
    result = array.array(code)
    result.frombytes(np.ascontiguousarray(value, dtype=code).tobytes())
    return result


_ZEROS: dict[str, Callable[[], Any]] = {
    'bool': bool,
    'string': str,
    'float32': float,
    'float64': float,
}


@cache
def _defaults(msgtype: str) -> dict[str, tuple[Callable[[], Any], str | None]]:
    """Default factory of each field, and the dtype if the field is an array of numbers."""
    result: dict[str, tuple[Callable[[], Any], str | None]] = {}
    fields: Any = typestore().fielddefs[msgtype][1]
    for name, (kind, detail) in fields:
        if kind == Nodetype.NAME:
            result[name] = partial(RosbagsMessages().create, str(detail)), None
        elif kind == Nodetype.BASE:
            result[name] = _ZEROS.get(str(detail[0]), int), None
        else:
            (element_kind, element), length = detail
            count = int(length) if kind == Nodetype.ARRAY else 0
            if element_kind == Nodetype.NAME:
                make = partial(RosbagsMessages().create, str(element))
                result[name] = _list_default(make, count), None
            elif element[0] == 'string':
                result[name] = _list_default(str, count), None
            else:
                dtype = {'char': 'uint8', 'byte': 'uint8'}.get(element[0], element[0])
                result[name] = partial(np.zeros, count, dtype), dtype
    if msgtype == 'geometry_msgs/msg/Quaternion':
        result['w'] = (lambda: 1.0), None
    return result


def _list_default(element: Callable[[], Any], count: int) -> Callable[[], list[Any]]:
    return lambda: [element() for _ in range(count)]
