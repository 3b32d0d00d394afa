"""Definitions: the same fields as in rosbags, and limits before code is generated."""

import numpy as np
import pytest
from rosbags.typesys.store import Typestore

from msg_tools.files.budget import Budget, BudgetError
from msg_tools.messages import cdr
from msg_tools.messages.definitions import check_types, extent_of, types_of_definition
from msg_tools.messages.message_types import typestore, typestore_of_definition

X = 'a/msg/X'


def test_definitions_of_all_known_types():
    known = typestore()
    for name in known.fielddefs:
        text, _ = known.generate_msgdef(name, ros_version=2)
        types = types_of_definition(text, name)
        assert types == {each: known.fielddefs[each][1] for each in types}, name
        check_types(types, known.fielddefs)
        assert typestore_of_definition(name, 'ros2msg', text) is known


def test_msg_lines():
    text = (
        '# comment\n@optional\nstring<=10[<=3] names # = 5\nHeader header\nfloat64[3] x [1, 2, 3]\n'
        'string FULL = "a # b"\nint32 COUNT=3\ntime stamp\nother/Y[] y\nZ z\n\n'
        '====\nMSG: other/Y\n\n===\nMSG: a/Z\nbool on true\n'
    )
    types = types_of_definition(text, X)
    assert types == {
        X: [
            ('names', (4, ((1, ('string', 10)), 3))),
            ('header', (2, 'std_msgs/msg/Header')),
            ('x', (3, ((1, ('float64', 0)), 3))),
            ('stamp', (2, 'builtin_interfaces/msg/Time')),
            ('y', (4, ((2, 'other/msg/Y'), 0))),
            ('z', (2, 'a/msg/Z')),
        ],
        'other/msg/Y': [('structure_needs_at_least_one_member', (1, ('uint8', 0)))],
        'a/msg/Z': [('on', (1, ('bool', 0)))],
    }


def nested(levels, field='{} x'):
    names = [f'a/T{i}' for i in range(levels)]
    parts = [f'{field.format(name)}\n===\nMSG: {name}\n' for name in names]
    return ''.join(parts) + 'uint8 x\n'


@pytest.mark.parametrize(
    ('encoding', 'text', 'error'),
    [
        ('ros2msg', 'string[1000000000] x', 'more than 250 messages in fixed arrays'),
        ('ros2msg', 'uint8[1000000000] x', 'fixed arrays of more than 800000 bytes'),
        ('ros2msg', nested(5, '{}[50] x'), 'fixed arrays of more than 800000 bytes'),
        ('ros2msg', 'a/Y[251] y\nMSG: a/Y\nuint8 x', 'more than 250 messages'),
        ('ros2msg', 'uint8[0] x', 'an array of length 0'),
        ('ros2msg', f'uint8[{"9" * 5000}] x', 'line 1 of its definition is no field'),
        ('ros2msg', '\n'.join(f'uint8 x{i}' for i in range(1000)), 'more than 1000 fields'),
        ('ros2msg', 'uint8 x\n' + '\n'.join(f'MSG: a/T{i}' for i in range(999)), '1000 fields'),
        ('ros2msg', '#' * 65_537, 'more than 65536 characters'),
        ('ros2msg', nested(20), 'nested deeper than 20 levels'),
        ('ros2msg', nested(19, '{}[] x'), None),
        ('ros2msg', 'a/X x', 'nested deeper than 20 levels'),
        ('ros2msg', 'a/X[] x', 'nested deeper than 20 levels'),
        ('ros2msg', 'a/Y y\nMSG: a/Y\na/X[] x', 'nested deeper than 20 levels'),
        ('ros2msg', 'a/Y y', 'a/msg/Y is not defined'),
        ('ros2msg', 'int8 x = 1; import os', None),
        ('ros2msg', 'int8 x:int=__import__("os")', None),
        ('ros2msg', 'int8 x\nMSG: a/Y"""\nimport os\nint8 y', 'a type named'),
        ('ros2msg', 'int8 x\nMSG: a/Y:pass\nint8 y', 'a type named'),
        ('ros2msg', 'int8 __init__', 'line 1 of its definition is no field'),
        ('ros2msg', 'wstring x', 'a/msg/wstring is not defined'),
        ('ros2idl', '', "its definition is 'ros2idl', wanted 'ros2msg'"),
    ],
)
def test_definitions_that_are_refused_before_code_is_generated(monkeypatch, encoding, text, error):
    registered = []
    monkeypatch.setattr(Typestore, 'register', lambda self, types: registered.append(types))
    if error is None:
        typestore_of_definition(X, encoding, text)
        assert registered
        return
    with pytest.raises(ValueError, match=error):
        typestore_of_definition(X, encoding, text)
    assert registered == []


def test_a_known_type_keeps_our_definition_where_that_of_a_bag_can_not_be_parsed():
    name = 'sensor_msgs/msg/CameraInfo'
    for text in ('#' * 65_537, '!!'):
        assert typestore_of_definition(name, 'ros2msg', text) is typestore()
    with pytest.raises(ValueError, match='more than 250 messages'):
        typestore_of_definition(name, 'ros2msg', 'string[1000000000] x')


def count(value):
    """Number of values in a message or field; an array of numbers is one value."""
    if isinstance(value, list):
        return 1 + sum(map(count, value))
    name = getattr(value, '__msgtype__', None)
    fields = typestore().fielddefs[name][1] if name else ()
    return 1 + sum(count(getattr(value, field)) for field, _ in fields)


def test_the_extent_of_a_type_bounds_the_values_of_its_messages(messages):
    point = messages.create('geometry_msgs/msg/Point')
    marker = messages.create(
        'visualization_msgs/msg/Marker', points=[point] * 5, text='abc', ns='n'
    )
    image = messages.create('sensor_msgs/msg/CompressedImage', data=np.zeros(77, np.uint8))
    mixture = messages.create(
        'hmt_msgs/msg/PoseMixture',
        dof_names=['a', 'bcd'],
        components=[messages.create('hmt_msgs/msg/PoseComponent', mean=np.zeros(3))],
    )
    array = messages.create('visualization_msgs/msg/MarkerArray', markers=[marker, marker])
    for message in (point, marker, image, mixture, array):
        length = len(cdr.serialise(message)) - 4
        extent = extent_of((2, message.__msgtype__), typestore().fielddefs, {})
        assert count(message) <= extent.values + extent.density * length
        assert length >= extent.size


def test_a_budget_pays_for_values_and_not_for_arrays_of_numbers(messages):
    budget = Budget(0)
    image = messages.create('sensor_msgs/msg/Image', data=np.zeros(10**6, np.uint8))
    data = cdr.serialise(image)
    for _ in range(200):
        cdr.deserialise(data, image.__msgtype__, None, budget)
    names = messages.create('sensor_msgs/msg/JointState', name=[''] * 100_000)
    data = cdr.serialise(names)
    with pytest.raises(BudgetError, match='it has more than'):
        [cdr.deserialise(data, names.__msgtype__, None, budget) for _ in range(20)]
