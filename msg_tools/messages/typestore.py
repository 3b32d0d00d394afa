"""Message types for work without ROS: those of ROS 2 Jazzy and hmt_msgs.

The .msg files in `hmt_msgs/` are the one definition: colcon generates the classes of the nodes from
them, and this module the classes that `rosbags` serialises.
"""

from __future__ import annotations

import re
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING

from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

if TYPE_CHECKING:
    from rosbags.interfaces.typing import Typesdict

# Stands before each of the IDL files that a bag strings together.
_IDL_HEADER = re.compile(r'^={80}\nIDL: .*\n', re.MULTILINE)

# What ROS 2 makes of a message without fields.
_NO_FIELDS = 'uint8 structure_needs_at_least_one_member'


@cache
def typestore() -> Typestore:
    """All types that the project reads and writes; the same object every time."""
    store = get_typestore(Stores.ROS2_JAZZY)
    types: Typesdict = {}
    folder = resources.files('msg_tools') / 'hmt_msgs' / 'msg'
    for file in sorted(folder.iterdir(), key=lambda file: file.name):
        if file.name.endswith('.msg'):
            name = f'hmt_msgs/msg/{file.name.removesuffix(".msg")}'
            types.update(get_types_from_msg(file.read_text('utf-8'), name))
    store.register(types)
    return store


def typestore_of_definition(msgtype: str, encoding: str, definition: str) -> Typestore:
    """Types for messages that carry their own definition, as those of a bag do.

    A bag may hold types that nobody else knows, or an older version of a known one; its messages
    have to be read with its own definition.

    Args:
        msgtype: for example 'sensor_msgs/msg/Image'.
        encoding: 'ros2msg', 'ros2idl', or '' when there is no definition.
        definition: text of the definition, with those of the nested types.

    Returns:
        `typestore()` itself when it agrees with the definition.

    Raises:
        ValueError: the type is not known and the definition can not be understood.
    """
    if not msgtype:
        raise ValueError('the bag does not tell the type')
    known = typestore()
    types: Typesdict = {}
    if encoding == 'ros2msg' and not definition.strip() and msgtype not in known.fielddefs:
        definition = _NO_FIELDS
    if definition.strip():
        try:
            if encoding == 'ros2msg':
                types = get_types_from_msg(definition, msgtype)
            elif encoding == 'ros2idl':
                for part in _IDL_HEADER.split(definition):
                    if part.strip():
                        types.update(get_types_from_idl(part))
        except Exception as error:
            # The parser meets any text here, and does not say what it may raise.
            if msgtype not in known.fielddefs:
                raise ValueError(f'its {encoding} definition can not be parsed') from error
    if msgtype not in types and msgtype not in known.fielddefs:
        raise ValueError('the type is not known, and the bag does not define it')
    changed = {name for name in types if not _same_fields(name, types, known)}
    if not changed:
        return known
    own = Typestore()
    own.fielddefs.update(
        {name: fields for name, fields in known.fielddefs.items() if name not in changed}
    )
    own.types.update({name: cls for name, cls in known.types.items() if name not in changed})
    try:
        own.register({name: types[name] for name in changed})
    except Exception as error:
        raise ValueError(f'its {encoding} definition can not be used') from error
    return own


def _same_fields(name: str, types: Typesdict, known: Typestore) -> bool:
    """Whether a definition has the fields of the known one; constants do not matter on the wire.

    Names are compared without case: the first ROS 2 releases wrote D, K, R, P in CameraInfo.
    """
    if name not in known.fielddefs:
        return False
    return [(field.lower(), kind) for field, kind in types[name][1]] == [
        (field.lower(), kind) for field, kind in known.fielddefs[name][1]
    ]
