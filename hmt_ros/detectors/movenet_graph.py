"""Translates MoveNet from a graph of TensorFlow.js to ONNX, which OpenCV reads.

The translated graph starts at the scaled image and ends at the convolutions of the four heads; the
selection of cells, which the original graph contains as well, is done in `movenet`. The graph has
few kinds of operations: convolutions fused with bias and activation, sums, and enlargement by a
factor of two. Messages are encoded as protocol buffers: a field consists of its number and type,
then its value, preceded by the length if this varies.
"""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Names of the scaled image and of the heads in the graph; number of channels of each head.
_ROOT = 'StatefulPartitionedCall/'
_INPUT, SIZE = _ROOT + 'sub_1', 256
_HEADS = {
    'kpt_heatmap_0/conv2d_5': 17,
    'center_0/conv2d_4': 1,
    'kpt_regress_0/conv2d_6': 34,
    'kpt_offset_0/conv2d_7': 34,
}
HEADS = tuple(f'{_ROOT}{head}/BiasAdd' for head in _HEADS)
CELLS = 64
_CENTRES = 'ConstantFolding/StatefulPartitionedCall/truediv_2_recip'
_CONVOLUTIONS = ('_FusedConv2D', 'FusedDepthwiseConv2dNative', 'DepthwiseConv2dNative')
# Later operation sets of ONNX make the bounds of Clip inputs; OpenCV 4.6 does not support this.
_IR_VERSION, _OPERATION_SET = 5, 10
_TYPES = {'float32': '<f4', 'int32': '<i4'}
_FLOATS = 1

_Tensor = NDArray[Any]
_Weights = dict[str, _Tensor]


def translated(graph: bytes, weights: bytes) -> tuple[bytes, NDArray[np.float32]]:
    """The network in ONNX, and factors (64, 64) on the probability of a person's centre per cell.

    The network maps the scaled image (1, 3, 256, 256) to the heads (1, C, 64, 64).

    Args:
        graph: JSON of a graph model of TensorFlow.js.
        weights: all weights of the graph, concatenated.
    """
    content = json.loads(graph)
    tensors = _tensors(content['weightsManifest'][0]['weights'], weights)
    nodes = {node['name']: node for node in content['modelTopology']['node']}
    needed, open_ends = {_INPUT}, [*HEADS]
    while open_ends:
        name = open_ends.pop()
        if name not in needed:
            needed.add(name)
            open_ends += nodes[name].get('input', ())
    parts = [_message(2, 'movenet'), _constant('twice', np.array([1, 1, 2, 2], '<f4'))]
    for name, node in nodes.items():
        if name in needed and name != _INPUT and node['op'] != 'Const':
            parts += _nodes_of(node, tensors)
    parts.append(_message(11, _described(_INPUT, 3, SIZE)))
    parts += [_message(12, _described(x, c, CELLS)) for x, c in zip(HEADS, _HEADS.values())]
    operations = _message(1, '') + _message(2, _OPERATION_SET)
    onnx = _message(1, _IR_VERSION) + _message(7, b''.join(parts)) + _message(8, operations)
    return onnx, np.asarray(tensors[_CENTRES][..., 0], np.float32)


def _tensors(manifest: Sequence[Any], content: bytes) -> _Weights:
    """Weights by name; weights in half precision become float32."""
    result, start = {}, 0
    for entry in manifest:
        kept = np.dtype('<f2' if 'quantization' in entry else _TYPES[entry['dtype']])
        count = int(np.prod(entry['shape'], dtype=int))
        values = np.frombuffer(content, kept, count, start).reshape(entry['shape'])
        result[entry['name']] = values.astype(_TYPES[entry['dtype']])
        start += count * kept.itemsize
    return result


def _nodes_of(node: Any, tensors: _Weights) -> list[bytes]:
    """The ONNX nodes and constants that replace a node of the graph."""
    name, inputs = node['name'], node['input']
    if node['op'] in _CONVOLUTIONS:
        return _convolution(node, tensors)
    if node['op'] == 'AddV2':
        return [_node('Add', inputs, name)]
    if node['op'] == 'ResizeBilinear':
        how = {'mode': 'linear', 'coordinate_transformation_mode': 'half_pixel'}
        return [_node('Resize', [inputs[0], '', 'twice'], name, **how)]
    raise ValueError(f'the graph has the operation {node["op"]}, which is not known')


def _convolution(node: Any, tensors: _Weights) -> list[bytes]:
    name, attributes, inputs = node['name'], node['attr'], node['input']
    kernel, each = tensors[inputs[1]], 'Depthwise' in node['op']
    stride, size = int(attributes['strides']['list']['i'][1]), len(kernel)
    # Padding 'SAME' for images of even sides; an odd padding has one pixel more at the end.
    around = max(size - stride, 0) if _text(attributes['padding']['s']) == 'SAME' else 0
    pads = [around // 2, around // 2, around - around // 2, around - around // 2]
    kernel = kernel.transpose((2, 3, 0, 1) if each else (3, 2, 0, 1))
    fused = [_text(x) for x in attributes.get('fused_ops', {'list': {'s': []}})['list']['s']]
    biased, active = 'BiasAdd' in fused, fused[1:]
    given = inputs[: 3 if biased else 2]
    convolved = f'{name}/convolved' if active else name
    parts = [_constant(given[1], kernel), *(_constant(x, tensors[x]) for x in given[2:])]
    how = {'kernel_shape': [size, size], 'strides': [stride, stride], 'pads': pads}
    parts.append(_node('Conv', given, convolved, **how, group=len(kernel) if each else 1))
    if active == ['Relu6']:
        parts.append(_node('Clip', [convolved], name, min=0.0, max=6.0))
    elif active:
        parts.append(_node('Relu', [convolved], name))
    return parts


def _text(encoded: str) -> str:
    return base64.b64decode(encoded).decode()


# ---- Messages of ONNX ----


def _node(operation: str, inputs: Sequence[str], output: str, **attributes: Any) -> bytes:
    """A node, as a field of a graph."""
    parts = [_message(1, x) for x in inputs] + [_message(2, output), _message(4, operation)]
    parts += [_message(5, _attribute(name, value)) for name, value in attributes.items()]
    return _message(1, b''.join(parts))


def _attribute(name: str, value: Any) -> bytes:
    if isinstance(value, float):
        return _message(1, name) + _number(2 << 3 | 5) + struct.pack('<f', value) + _message(20, 1)
    if isinstance(value, int):
        return _message(1, name) + _message(3, value) + _message(20, 2)
    if isinstance(value, str):
        return _message(1, name) + _message(4, value) + _message(20, 3)
    return _message(1, name) + b''.join(_message(8, x) for x in value) + _message(20, 7)


def _constant(name: str, values: _Tensor) -> bytes:
    """A constant, as a field of a graph."""
    shape = b''.join(_message(1, side) for side in values.shape)
    content = _message(2, _FLOATS) + _message(8, name) + _message(9, values.tobytes())
    return _message(5, shape + content)


def _described(name: str, channels: int, side: int) -> bytes:
    """Encoded name, type and shape of an input or output image."""
    sides = b''.join(_message(1, _message(1, x)) for x in (1, channels, side, side))
    kind = _message(1, _message(1, _FLOATS) + _message(2, sides))
    return _message(1, name) + _message(2, kind)


def _message(field: int, value: int | str | bytes) -> bytes:
    """An encoded field of a message."""
    if isinstance(value, int):
        return _number(field << 3) + _number(value)
    content = value.encode() if isinstance(value, str) else value
    return _number(field << 3 | 2) + _number(len(content)) + content


def _number(value: int) -> bytes:
    """A varint: seven bits per byte, lowest first; all but the last byte have bit eight set."""
    result = bytearray()
    while value > 127:
        result.append(value & 127 | 128)
        value >>= 7
    result.append(value)
    return bytes(result)
