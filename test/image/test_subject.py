"""Subject files: content of valid ones, and one error line for invalid ones."""

from __future__ import annotations

import numpy as np
import pytest
import yaml

from hmt_ros.body import load_body
from hmt_ros.image.subject import MAX_FILE_BYTES, parse_subject
from hmt_ros.tracking import Subject, SubjectError, read_subject

JOINTS = {'head': [150, 20.5], 'neck': [151, 40], 'left_hip': [160, 110], 'right_hip': [140, 111]}


@pytest.fixture(scope='module')
def body():
    return load_body('human32')


def content(**entries):
    """Content of a subject file; entries with None are omitted."""
    values = {'stamp_ns': 1_500_000_000, 'keypoints': JOINTS} | entries
    return {key: value for key, value in values.items() if value is not None}


def test_a_whole_file(body, tmp_path):
    path = tmp_path / 'subject.yaml'
    path.write_text(
        'stamp_ns: 1700000000123456789\n'
        'sigma_px: 2.5\n'
        'keypoints:\n'
        '  head: [150, 20.5]\n'
        '  neck: [151.0, 40]\n'
        '  left_hip: [160, 110]\n'
        '  right_hip: [-3, 111]\n'
        'segment_lengths_m: {thigh: 0.4, shin: 0.39}\n'
        'stature_m: 1.82\n'
    )
    subject = read_subject(path, body)
    assert isinstance(subject, Subject)
    assert subject.stamp_ns == 1700000000123456789
    assert subject.keypoints.names == ('head', 'neck', 'left_hip', 'right_hip')
    assert np.array_equal(subject.keypoints.pixels, [[150, 20.5], [151, 40], [160, 110], [-3, 111]])
    assert np.allclose(subject.keypoints.covariances, 6.25 * np.eye(2), rtol=1e-15)
    assert np.array_equal(subject.keypoints.confidences, np.ones(4))
    assert subject.segment_lengths == {'thigh': 0.4, 'shin': 0.39}
    assert subject.stature == 1.82
    assert read_subject(str(path), body).stamp_ns == subject.stamp_ns


def test_writing_and_reading_gives_the_same(body, tmp_path):
    path = tmp_path / 'subject.yaml'
    values = content(sigma_px=1.25, segment_lengths_m={'hand': 0.1}, stature_m=1.7)
    path.write_text(yaml.safe_dump(values))
    read, parsed = read_subject(path, body), parse_subject(values, body)
    assert read.keypoints.names == tuple(sorted(JOINTS))
    order = [parsed.keypoints.names.index(name) for name in read.keypoints.names]
    assert np.array_equal(read.keypoints.pixels, parsed.keypoints.pixels[order])
    assert (read.segment_lengths, read.stature) == (parsed.segment_lengths, parsed.stature)


@pytest.mark.parametrize('rise', [-0.03, 0, 0.02])
def test_shoulders_may_lie_below_the_neck(rise):
    measured = {'shoulder_rise': rise, 'trunk': 0.4}
    found = parse_subject(content(segment_lengths_m=measured), load_body('human37'))
    assert found.segment_lengths == measured


def one_line(caught) -> str:
    text = str(caught.value)
    assert '\n' not in text
    assert len(text) < 1000
    return text


@pytest.mark.parametrize(
    ('entries', 'said'),
    [
        ({'stamp_ns': None}, "no entry 'stamp_ns'"),
        ({'keypoints': None}, "no entry 'keypoints'"),
        ({'stamp_ns': 1.5}, 'whole number of nanoseconds, saw 1.5'),
        ({'stamp_ns': -1}, 'whole number of nanoseconds, saw -1'),
        ({'stamp_ns': True}, 'whole number of nanoseconds, saw True'),
        ({'stamp_ns': 'now'}, "whole number of nanoseconds, saw 'now'"),
        ({'sigma_px': 0}, 'sigma_px must be a number above 0'),
        ({'sigma_px': float('nan')}, 'sigma_px must be a number above 0 .* saw nan'),
        ({'sigma_px': '3 px'}, "sigma_px must be a number above 0 .* saw '3 px'"),
        ({'keypoints': [[1, 2]]}, 'keypoints must name at least four joints'),
        ({'keypoints': dict(list(JOINTS.items())[:3])}, 'at least four joints'),
        ({'keypoints': {**JOINTS, 'nekc': [1, 2]}}, r"has no joint \['nekc'\]; it has .*neck"),
        ({'keypoints': {**JOINTS, 3: [1, 2]}}, r"has no joint \['3'\]"),
        ({'keypoints': {**JOINTS, 'neck': [float('nan'), 2]}}, 'keypoint neck must be .*nan'),
        ({'keypoints': {**JOINTS, 'neck': [float('inf'), 2]}}, 'keypoint neck must be .*inf'),
        ({'keypoints': {**JOINTS, 'neck': [1, 2, 3]}}, r'keypoint neck must be \[u, v\] in pixels'),
        ({'keypoints': {**JOINTS, 'neck': '1, 2'}}, "keypoint neck must be .* saw '1, 2'"),
        ({'keypoints': {**JOINTS, 'neck': None}}, 'keypoint neck must be .* saw None'),
        ({'segment_lengths_m': {'thihg': 0.4}}, r"human32 has no length \['thihg'\]; .*thigh"),
        ({'segment_lengths_m': {'thigh': float('nan')}}, 'length thigh must be .* saw nan'),
        ({'segment_lengths_m': {'thigh': -0.4}}, 'length thigh must be .* saw -0.4'),
        ({'segment_lengths_m': {'thigh': 40}}, 'length thigh must be .* at most 3, saw 40'),
        ({'segment_lengths_m': [0.4]}, 'segment_lengths_m must map names to metres'),
        ({'stature_m': 180}, 'stature_m must be .* at most 3, saw 180'),
        ({'stature_m': float('nan')}, 'stature_m must be .* saw nan'),
        ({'statur_m': 1.8}, r"unknown entries \['statur_m'\], known are .*stature_m"),
    ],
)
def test_entries_that_do_not_fit(body, tmp_path, entries, said):
    with pytest.raises(SubjectError, match=said) as caught:
        parse_subject(content(**entries), body)
    one_line(caught)
    path = tmp_path / 'subject.yaml'
    path.write_text(yaml.safe_dump(content(**entries)))
    with pytest.raises(SubjectError, match=said) as caught:
        read_subject(path, body)
    assert one_line(caught).startswith(f'{path}: ')


@pytest.mark.parametrize(
    ('text', 'said'),
    [
        (b'', 'wanted entries .* saw NoneType'),
        (b'- 1\n- 2\n', 'wanted entries .* saw list'),
        (b'just words', 'wanted entries .* saw str'),
        (b'stamp_ns: [1, 2\nkeypoints: }', 'not YAML'),
        (b'stamp_ns: 1\n\tkeypoints: 2\n', 'not YAML'),
        (b'? [1]\n: 2\n', 'not YAML'),
        (b'stamp_ns: !!python/object/apply:os.getcwd []\n', 'not YAML'),
        (b'\xff\xfe\x00\x01', 'not YAML'),
        (b'PNG\x00\x01', 'not YAML'),
    ],
)
def test_files_of_something_else(body, tmp_path, text, said):
    path = tmp_path / 'subject.yaml'
    path.write_bytes(text)
    with pytest.raises(SubjectError, match=said) as caught:
        read_subject(path, body)
    assert one_line(caught).startswith(f'{path}: ')


def test_files_that_can_not_be_read(body, tmp_path):
    for path, said in (
        (tmp_path / 'missing.yaml', 'No such file'),
        (tmp_path, 'directory'),
    ):
        with pytest.raises(SubjectError, match=f'can not be read .*{said}') as caught:
            read_subject(path, body)
        assert str(path) in one_line(caught)
    large = tmp_path / 'large.yaml'
    large.write_bytes(b'#' * (MAX_FILE_BYTES + 1))
    with pytest.raises(SubjectError, match='250001 bytes') as caught:
        read_subject(large, body)
    one_line(caught)
