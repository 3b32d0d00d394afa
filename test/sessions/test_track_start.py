from dataclasses import replace

import numpy as np
import pytest

from hmt_ros.sessions import track_start
from hmt_ros.sessions.declared_parameters import with_values
from hmt_ros.sessions.track_start import prepare_start
from hmt_ros.sessions.tracking_parameters import FilterParameters
from msg_tools import RosbagsMessages


def parameters(**values):
    return with_values(FilterParameters(), {name: str(value) for name, value in values.items()})


def test_reads_what_the_parameters_name(subject_file, background_file):
    start = prepare_start(parameters(subject_file=subject_file, background_file=background_file))
    assert start.body.name == 'human37'
    assert start.background.shape == (48, 64, 3)
    assert start.initial.keypoints.names[-1] == 'head'
    nothing = prepare_start(parameters(body_model='human34'))
    assert (nothing.body.name, nothing.background, nothing.initial) == ('human34', None, None)


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        (None, 'can not be read (No such file'),
        ('a: [', 'not YAML'),
        ('keypoints: {}\n', "no entry 'stamp_ns'"),
        ('stamp_ns: 1\n', "no entry 'keypoints'"),
        ('stamp_ns: 1\nkeypoints: {head: [1, 2]}\n', 'at least four joints'),
        (
            'stamp_ns: 1\nkeypoints: {haed: [1, 2], neck: [1, 2], pelvis: [1, 2], left_hip: '
            '[1, 2]}',
            "human37 has no joint ['haed']",
        ),
        (
            'stamp_ns: 1\nkeypoints: {head: [1, .nan], neck: [1, 2], pelvis: [1, 2], left_hip: '
            '[1, 2]}',
            'keypoint head must be [u, v] in pixels',
        ),
    ],
)
def test_subject_files_that_are_none(tmp_path, text, message):
    path = tmp_path / 'subject.yaml'
    if text is not None:
        path.write_text(text)
    with pytest.raises(ValueError, match=r'subject\.yaml') as caught:
        prepare_start(parameters(subject_file=path))
    assert message in str(caught.value)
    assert '\n' not in str(caught.value)


def test_backgrounds_that_are_none(tmp_path):
    path = tmp_path / 'background.png'
    with pytest.raises(ValueError, match=r'background.png: can not be read \(No such file'):
        prepare_start(parameters(background_file=path))
    for data in (b'', b'\x89PNG\r\n\x1a\nno'):
        path.write_bytes(data)
        with pytest.raises(ValueError, match=r'background.png: not a picture'):
            prepare_start(parameters(background_file=path))
    # A sparse file.
    with path.open('wb') as file:
        file.truncate(2**28 + 1)
    with pytest.raises(ValueError, match=r'268435457 bytes, wanted at most 268435456'):
        prepare_start(parameters(background_file=path))


def test_bodies_that_are_none(tmp_path, monkeypatch, body):
    with pytest.raises(ValueError, match="no body 'nobody'"):
        prepare_start(parameters(body_model='nobody'))
    broken = tmp_path / 'broken.yaml'
    broken.write_text('a: [')
    with pytest.raises(ValueError, match=r'broken.yaml: not a body model'):
        prepare_start(parameters(body_model=broken))
    monkeypatch.setattr(track_start, 'load_body', lambda model: replace(body, shapes=(), growth=()))
    with pytest.raises(ValueError, match=r'bones has no flesh: wanted one such as human37'):
        prepare_start(parameters(body_model='bones'))


def mixture(body, **changes):
    messages = RosbagsMessages()
    component = messages.create(
        'hmt_msgs/msg/PoseComponent',
        weight=1.0,
        mean=body.prior_mean,
        covariance=np.eye(body.dimension).reshape(-1),
    )
    fields = {
        'body_model': body.name,
        'dof_names': list(body.dof_names),
        'components': [component],
        **changes,
    }
    return messages.create('hmt_msgs/msg/PoseMixture', **fields)


def test_mixtures_go_before_the_subject(subject_file, body):
    given = parameters(subject_file=subject_file)
    start = prepare_start(given, mixture(body))
    assert np.array_equal(start.initial.means, [body.prior_mean])
    empty = prepare_start(given, mixture(body, components=[]))
    assert empty.initial.stamp_ns == prepare_start(given).initial.stamp_ns
    taller = body.with_stature(1.9)
    assert prepare_start(given, mixture(body), taller).body is taller
    # The present body is of another model and gives no information about this one.
    other = prepare_start(parameters(body_model='human34')).body
    assert prepare_start(given, mixture(body), other).body.name == 'human37'
