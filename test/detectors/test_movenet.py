"""MoveNet: its graph as ONNX, its cells, its combination with BlazePose, and the real one."""

import base64
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from hmt_ros.body import load_body
from hmt_ros.detectors import movenet, movenet_models
from hmt_ros.detectors.movenet import BlazePoseAndMoveNet, MoveNet, chosen, together
from hmt_ros.detectors.movenet_graph import HEADS, translated
from hmt_ros.detectors.square import Square
from hmt_ros.image.keypoint_schemes import noise_of, schemes
from hmt_ros.image.terms.keypoints import Keypoints
from msg_tools import BagReader
from msg_tools.messages.images import decode_image

ROOT = Path(__file__).resolve().parents[2]
NAMES = schemes()['mediapipe33'].names


# ---- The graph ----


class Graph:
    """A small graph of TensorFlow.js with all operations, and its weights."""

    def __init__(self):
        self.rng = np.random.default_rng(5)
        self.nodes, self.manifest, self.content = [], [], b''
        self.weights = {}

    def constant(self, name, *shape, half=True):
        values = self.rng.normal(size=shape).astype('<f2' if half else '<f4')
        self.content += values.tobytes()
        entry = {'name': name, 'dtype': 'float32', 'shape': list(shape)}
        quantization = {'quantization': {'dtype': 'float16'}} if half else {}
        self.manifest.append({**entry, **quantization})
        self.nodes.append({'name': name, 'op': 'Const'})
        self.weights[name] = values.astype(np.float32)
        return name

    def node(self, name, op, *inputs, stride=1, padding='SAME', fused=()):
        encoded = [base64.b64encode(x.encode()).decode() for x in (padding, *fused)]
        attributes = {'strides': {'list': {'i': [str(x) for x in (1, stride, stride, 1)]}}}
        attributes['padding'] = {'s': encoded[0]}
        if fused:
            attributes['fused_ops'] = {'list': {'s': encoded[1:]}}
        self.nodes.append({'name': name, 'op': op, 'input': [*inputs], 'attr': attributes})
        return name

    def translated(self):
        graph = {
            'modelTopology': {'node': self.nodes},
            'weightsManifest': [{'weights': self.manifest}],
        }
        return translated(json.dumps(graph).encode(), self.content)


def small_graph():
    graph = Graph()
    start = 'StatefulPartitionedCall/sub_1'
    graph.node(start, 'Sub', 'what', 'comes_before')
    graph.constant('ConstantFolding/StatefulPartitionedCall/truediv_2_recip', 64, 64, 1)
    kernel, bias = graph.constant('k1', 3, 3, 3, 4), graph.constant('b1', 4, half=False)
    half = graph.node(
        'half', '_FusedConv2D', start, kernel, bias, stride=2, fused=('BiasAdd', 'Relu6')
    )
    kernel, bias = graph.constant('k2', 3, 3, 4, 1), graph.constant('b2', 4)
    op = 'FusedDepthwiseConv2dNative'
    quarter = graph.node('quarter', op, half, kernel, bias, stride=2, fused=('BiasAdd', 'Relu6'))
    kernel, bias = graph.constant('k3', 1, 1, 4, 4), graph.constant('b3', 4)
    eighth = graph.node(
        'eighth', '_FusedConv2D', quarter, kernel, bias, stride=2, fused=('BiasAdd', 'Relu')
    )
    twice = graph.node('twice_as_large', 'ResizeBilinear', eighth, 'b1')
    total = graph.node('total', 'AddV2', twice, quarter)
    each = graph.node('each', 'DepthwiseConv2dNative', total, graph.constant('k4', 3, 3, 4, 1))
    for name, channels in zip(HEADS, (17, 1, 34, 34)):
        kernel = graph.constant(f'{name}/k', 1, 1, 4, channels)
        bias = graph.constant(f'{name}/b', channels)
        graph.node(name, '_FusedConv2D', each, kernel, bias, padding='VALID', fused=('BiasAdd',))
    return graph


def convolved(image, kernel, stride, *, each=False):
    """Convolution by definition, with odd padding after the image; (H, W, C)."""
    size = len(kernel)
    around = max(size - stride, 0)
    before = around // 2
    image = np.pad(image, ((before, around - before), (before, around - before), (0, 0)))
    windows = np.lib.stride_tricks.sliding_window_view(image, (size, size), (0, 1))
    form = 'hwcij,ijck->hwc' if each else 'hwcij,ijck->hwk'
    return np.einsum(form, windows[::stride, ::stride], kernel)


def test_a_graph_is_the_same_in_onnx():
    graph = small_graph()
    onnx, centres = graph.translated()
    weights = graph.weights
    image = np.random.default_rng(6).normal(size=(256, 256, 3)).astype(np.float32)
    half = (convolved(image, weights['k1'], 2) + weights['b1']).clip(0, 6)
    quarter = (convolved(half, weights['k2'], 2, each=True) + weights['b2']).clip(0, 6)
    eighth = (convolved(quarter, weights['k3'], 2) + weights['b3']).clip(0)
    twice = cv2.resize(eighth.astype(np.float32), (64, 64), interpolation=cv2.INTER_LINEAR)
    each = convolved(twice + quarter, weights['k4'], 1, each=True)
    network = cv2.dnn.readNetFromONNX(np.frombuffer(onnx, np.uint8))
    network.setInput(np.ascontiguousarray(image.transpose(2, 0, 1)[None]))
    for name, found in zip(HEADS, network.forward(HEADS), strict=True):
        expected = convolved(each, weights[f'{name}/k'], 1) + weights[f'{name}/b']
        np.testing.assert_allclose(found[0], expected.transpose(2, 0, 1), rtol=1e-3, atol=1e-3)
    (table,) = (x for name, x in weights.items() if name.endswith('recip'))
    np.testing.assert_array_equal(centres, table[..., 0])


def test_an_operation_that_is_not_known_is_told():
    graph = small_graph()
    next(x for x in graph.nodes if x['op'] == 'AddV2')['op'] = 'Mul'
    with pytest.raises(ValueError, match='the graph has the operation Mul, which is not known'):
        graph.translated()


# ---- Cells ----


def test_landmarks_are_sought_where_the_centre_expects_them():
    heat = np.zeros((2, 64, 64), np.float32)
    # Two persons; the wrong one has the most confident landmarks.
    heat[0, 10, 20], heat[0, 50, 20] = 0.5, 0.9
    heat[1, 12, 24], heat[1, 52, 24] = 0.5, 0.9
    centre = np.zeros((64, 64), np.float32)
    centre[14, 22], centre[54, 22] = 0.9, 0.8
    ways, offsets = np.zeros((2, 4, 64, 64), np.float32)
    ways[:, 14, 22] = -3.0, -3.0, -2.0, 2.0
    offsets[:2, 10, 20], offsets[2:, 12, 24] = (0.25, 0.5), (-0.25, 0.75)
    found = chosen(heat, centre, ways, offsets)
    expected = [[20.5 / 64, 10.25 / 64, 0.5], [24.75 / 64, 11.75 / 64, 0.5]]
    np.testing.assert_allclose(found, expected)


# ---- Combination with BlazePose, with a stub for each ----


@pytest.fixture
def pair(monkeypatch):
    """Stubs of the two detectors, with their results and the images that they got."""

    class First:
        found: Keypoints | None = None

        def __init__(self, *, with_mask):
            self.mask = np.ones((240, 320), bool) if with_mask else None

        def detect(self, image, stamp_ns):
            return self.found

    class Second:
        told = np.zeros((17, 3))
        seen: list

        def landmarks(self, seen):
            self.seen.append(seen)
            return self.told

    monkeypatch.setattr(movenet, 'BlazePose', First)
    monkeypatch.setattr(movenet, 'MoveNet', Second)
    Second.seen = []
    return First, Second


def keypoints(pixels, confidences=0.8):
    unknown = np.full((33, 2, 2), np.nan)
    return Keypoints(NAMES, pixels, unknown, np.full(33, confidences), np.zeros((33, 3)))


def test_movenet_sees_what_lies_in_the_image(pair):
    first, second = pair
    pixels = np.tile([100.0, 120.0], (33, 1))
    pixels[0], pixels[NAMES.index('left_ankle')] = (100.0, 40.0), (100.0, 400.0)
    first.found = keypoints(pixels)
    # All landmarks are in the middle of the square, with higher confidence.
    second.told = np.tile([0.5, 0.5, 0.9], (17, 1))
    second.told[11:, 2] = 0.29
    image = np.zeros((240, 320, 3), np.uint8)
    image[:, 100] = 255
    detector = BlazePoseAndMoveNet(with_mask=True)
    found = detector.detect(image, 1)
    # From row 40 to the last, 239, and a margin of a quarter.
    square = Square((100.0, 139.5), 1.25 * 199, 0.0)
    (seen,) = second.seen
    np.testing.assert_array_equal(seen, square.seen(image, 256, cv2.BORDER_REPLICATE))
    middle = square.corner + square.side * (0.5 - 0.5 / 256)
    for name, own, other in zip(NAMES, pixels, found.pixels, strict=True):
        counted = name.partition('_')[2] in ('shoulder', 'elbow', 'wrist')
        np.testing.assert_allclose(other, (own + 2 * middle) / 3 if counted else own)
    assert found.positions is first.found.positions
    assert detector.mask.all()
    # Landmarks outside are ignored; without a person there is no result.
    second.told[:, 2] = 0.9
    row = NAMES.index('left_ankle')
    assert (detector.detect(image, 2).pixels[row] == pixels[row]).all()
    first.found = None
    assert BlazePoseAndMoveNet().detect(image, 3) is None
    assert len(second.seen) == 2


def test_a_person_without_extent_is_not_looked_at(pair):
    first, second = pair
    first.found = keypoints(np.full((33, 2), 50.0))
    found = BlazePoseAndMoveNet().detect(np.zeros((240, 320, 3), np.uint8), 1)
    assert found is first.found
    assert second.seen == []


def test_what_differs_is_unsure():
    rng = np.random.default_rng(7)
    found = keypoints(rng.uniform(50, 300, (33, 2)), 0.6)
    rows, apart = np.array([13, 11]), np.array([[3.0, -6.0], [0.0, 0.0]])
    mean = together(found, rows, found.pixels[rows] + apart)
    np.testing.assert_allclose(mean.pixels[rows], found.pixels[rows] + apart * 2 / 3)
    others = np.setdiff1d(np.arange(33), rows)
    np.testing.assert_array_equal(mean.pixels[others], found.pixels[others])
    assert np.isnan(mean.covariances[others]).all()
    sigma = found.magnification() * noise_of(np.array([0.6]))[0]
    np.testing.assert_allclose(mean.covariances[11], sigma**2 * np.eye(2))
    expected = sigma**2 * np.eye(2) + [[2.25, -4.5], [-4.5, 9.0]]
    np.testing.assert_allclose(mean.covariances[13], expected)
    np.testing.assert_array_equal(mean.confidences, found.confidences)
    # Only landmarks of the tracker's joints have this noise, others that of their confidence.
    known, _ = mean.named_for(load_body('human37'))
    row = known.names.index('left_elbow')
    np.testing.assert_allclose(known.covariances[row], expected)
    assert known.noise is not None
    assert known.noise[row] < 0.02 < known.noise[known.names.index('left_wrist')]


# ---- MoveNet itself ----


def test_it_finds_what_tensorflow_finds():
    """TensorFlow.js 4.22 saw the squares about the first images of bags/reach."""
    if not movenet_models.FILES.exist():
        pytest.skip('MoveNet is not installed: run "install-detector mediapipe+movenet"')
    with np.load(Path(__file__).parent / 'reach_movenet.npz') as file:
        known = file['rows']
    network, square = MoveNet(), Square((239.5, 179.5), 479.0, 0.0)
    with BagReader(ROOT / 'bags' / 'reach') as bag:
        stored = zip(range(len(known)), bag.messages(['image/compressed']))
        images = [decode_image(each.message) for _, each in stored]
    seen = [square.seen(image, 256, cv2.BORDER_REPLICATE) for image in images]
    found = np.array([network.landmarks(image) for image in seen])
    np.testing.assert_allclose(256 * found[..., :2], 256 * known[..., :2], atol=0.01)
    np.testing.assert_allclose(found[..., 2], known[..., 2], atol=1e-3)
