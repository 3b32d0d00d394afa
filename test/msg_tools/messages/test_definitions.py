"""Definitions: the fields that rosbags finds too, and limits before code is generated."""

import contextlib

import numpy as np
import pytest
from rosbags.typesys import get_types_from_idl
from rosbags.typesys.store import Typestore

from msg_tools.files.budget import BudgetError
from msg_tools.messages import cdr
from msg_tools.messages.definitions import check_types, types_of_definition
from msg_tools.messages.message_types import typestore, typestore_of_definition

X = 'a/msg/X'


def test_definitions_of_all_known_types():
    known = typestore()
    for name in known.fielddefs:
        text, _ = known.generate_msgdef(name, ros_version=2)
        types = types_of_definition(text, 'ros2msg', name)
        assert types == {each: known.fielddefs[each][1] for each in types}, name
        check_types(types, known.fielddefs)
        assert typestore_of_definition(name, 'ros2msg', text) is known


def test_msg_lines():
    text = (
        '# comment\n@optional\nstring<=10[<=3] names # = 5\nHeader header\nfloat64[3] x [1, 2, 3]\n'
        'string FULL = "a # b"\nint32 COUNT=3\ntime stamp\nother/Y[] y\nZ z\n\n'
        '====\nMSG: other/Y\n\n===\nMSG: a/Z\nbool on true\n'
    )
    types = types_of_definition(text, 'ros2msg', X)
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


IDL = """
// generated
module a { module msg {
  module X_Constants { const long N = 4; const string T = "a; b {"; const double F = 0.5; };
  typedef double double__9[9]; typedef sequence<a::msg::Y, 5> some;
  @verbatim (language="comment", text="not ( a field; " "nor this")
  struct X { /* nor { this */
    @unit(value="m") double__9 matrix; unsigned long long count; sequence<string> names;
    @key string name; octet data[4];
    sequence<float, 3> floats; some ys; a::msg::Y y; uint8 u;
  };
  struct Y { boolean on; long double_; };
}; };
"""


def test_idl_definitions():
    wanted = {name: fields for name, (_, fields) in get_types_from_idl(IDL).items()}
    header = '=' * 80 + '\nIDL: a/msg/X\n#include "a/msg/Y.idl"\n'
    assert types_of_definition(header + IDL, 'ros2idl', X) == wanted
    check_types(types_of_definition(IDL, 'ros2idl', X), {})
    text = 'const long N = 4; struct X { string<9> x; long y[N]; sequence<string<7>> z; };'
    text = f'module a {{ {text} }};'
    assert types_of_definition(text, 'ros2idl', X) == {
        'a/X': [
            ('x', (1, ('string', 9))),
            ('y', (3, ((1, ('int32', 0)), 4))),
            ('z', (4, ((1, ('string', 7)), 0))),
        ]
    }


def nested(levels, field='{} x'):
    names = [f'a/T{i}' for i in range(levels)]
    parts = [f'{field.format(name)}\n===\nMSG: {name}\n' for name in names]
    return ''.join(parts) + 'uint8 x\n'


def idl(member, constants=''):
    return f'module a {{ module msg {{ {constants} struct X {{ {member}; }}; }}; }};'


@pytest.mark.parametrize(
    ('encoding', 'text', 'error'),
    [
        ('ros2msg', 'string[1000000000] x', 'more than 250 messages in fixed arrays'),
        ('ros2msg', 'uint8[1000000000] x', 'fixed arrays of more than 800000 bytes'),
        ('ros2msg', nested(5, '{}[50] x'), 'fixed arrays of more than 800000 bytes'),
        ('ros2msg', 'a/Y[251] y\nMSG: a/Y\nuint8 x', 'more than 250 messages'),
        ('ros2msg', 'uint8[0] x', 'an array of length 0'),
        ('ros2msg', f'uint8[{"9" * 5000}] x', 'can not be parsed'),
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
        ('ros2msg', 'int8 __init__', 'line 1 is no field'),
        ('ros2msg', 'wstring x', 'a/msg/wstring is not defined'),
        ('ros2idl', idl(f'long x[{"(" * 30}1{")" * 30}]'), 'can not be parsed'),
        ('ros2idl', idl('long x[N]', f'const long N = {"(" * 30}1{")" * 30};'), 'parsed: invalid'),
        ('ros2idl', idl('long x[N]', 'const long N = 1 << 40;'), 'can not be parsed'),
        ('ros2idl', idl(f'{"sequence<" * 25}long{">" * 25} x'), 'can not be parsed'),
        ('ros2idl', idl('long x[1000000]'), 'fixed arrays of more than 800000 bytes'),
        ('ros2idl', idl('long x[2][3]'), 'can not be parsed'),
        ('ros2idl', idl('a::msg::X x'), 'nested deeper than 20 levels'),
        ('ros2idl', 'module a {' * 6000, 'its end is missing'),
        ('ros2idl', '@a("' + '\\\\' * 30_000, 'can not be parsed'),
        ('ros2idl', 'union U switch(long) { case 1: long x; };', 'can not be parsed'),
        ('ros2idl', '};' * 10, 'can not be parsed'),
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
    """Values of a message, or of a field of one; an array of numbers is one."""
    if isinstance(value, list):
        return 1 + sum(map(count, value))
    name = getattr(value, '__msgtype__', None)
    fields = typestore().fielddefs[name][1] if name else ()
    return 1 + sum(count(getattr(value, field)) for field, _ in fields)


def test_the_values_of_messages_are_counted_as_they_are_read(messages):
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
        body = memoryview(cdr.serialise(message))[4:]
        values = cdr._Values(body, '<I', typestore())
        assert values.skip((2, message.__msgtype__), 0) == len(body)
        assert values.count == count(message)
        extent = cdr.extent_of((2, message.__msgtype__), typestore().fielddefs, {})
        assert values.count <= extent.values + extent.density * len(body)
        assert len(body) >= extent.size


def test_a_budget_counts_what_bounds_do_not_settle(messages):
    budget = cdr.ValueBudget(0)
    joints = messages.create('sensor_msgs/msg/JointState', position=np.zeros(100_000))
    data = cdr.serialise(joints)
    for _ in range(200):
        cdr.deserialise(data, joints.__msgtype__, None, budget)
    names = messages.create('sensor_msgs/msg/JointState', name=[''] * 100_000)
    data = cdr.serialise(names)
    for _ in range(20):
        with contextlib.suppress(BudgetError):
            cdr.deserialise(data, names.__msgtype__, None, budget)
    with pytest.raises(BudgetError, match='it unpacks to more than'):
        cdr.deserialise(data, names.__msgtype__, None, budget)
