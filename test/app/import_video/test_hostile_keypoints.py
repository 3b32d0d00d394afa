"""Well-formed keypoint files with unexpected content: a result, or one error line."""

import copy
import json
import random
import warnings

import numpy as np
import pytest

from hmt_ros.app.import_video.frames import FrameSource
from hmt_ros.app.import_video.keypoint_files.choice import Choice, tracks_of
from hmt_ros.app.import_video.keypoint_files.persons import person
from hmt_ros.app.import_video.keypoint_files.reading import (
    ClipReading,
    keypoints_of_person,
    read_keypoints,
)

START = 1_000_000_000_000
POINTS = [x for i in range(17) for x in (10.0 + i, 20.0 + 2 * i, 0.5)]
PLACES = [[10.0 + i, 20.0 + 2 * i] for i in range(17)]
SURE = [0.5] * 17
NAMES = [f'point_{i}' for i in range(17)]
LAYOUTS = {
    'coco results': [{'image_id': 1, 'keypoints': POINTS, 'score': 0.7, 'bbox': [1, 2, 3, 4]}],
    'coco annotations': {
        'images': [{'id': 7, 'file_name': '1.jpg', 'width': 64, 'height': 48}],
        'annotations': [{'image_id': 7, 'keypoints': POINTS, 'track_id': 3}],
        'categories': [{'id': 1, 'keypoints': NAMES}],
    },
    'mmpose': {
        'meta_info': {'keypoint_id2name': dict(zip(map(str, range(17)), NAMES, strict=True))},
        'instance_info': [
            {
                'frame_id': 1,
                'instances': [{'keypoints': PLACES, 'keypoint_scores': SURE, 'bbox_score': 0.8}],
            }
        ],
    },
    'alphapose': [{'image_id': '1.jpg', 'keypoints': POINTS, 'score': 0.8, 'idx': [4.0]}],
    'alphapose cmu': {'1.jpg': {'version': 'AlphaPose', 'bodies': [{'joints': POINTS}]}},
    'alphapose tracked': {'4': {'1': {'keypoints': POINTS, 'scores': 0.8}}},
    'ultralytics': [
        [],
        [
            {
                'confidence': 0.8,
                'track_id': 4,
                'keypoints': {'x': [1.0] * 17, 'y': [2.0] * 17, 'visible': SURE},
            }
        ],
    ],
    'texts': ['[]', json.dumps([{'keypoints': POINTS}])],
}
STRANGE = (
    {},
    [],
    '',
    None,
    True,
    0,
    -1,
    1e308,
    -1e308,
    10**30,
    10**400,
    1e-320,
    [[[1]]],
    '\x1b[31m\n',
    '9' * 5000,
    [{}],
    {'keypoints': {}},
    float('nan'),
    float('inf'),
    '\ud800',
    2**61 - 1,
    [None],
)
CHOICES = tuple(
    map(Choice.parse, ('nearest', 'largest', 'track:1', 'at:5,5,0.1', 'id:4', 'index:0'))
)


def mutated(content, rng):
    """A copy with one to three strange values, equally often near the root and deep inside."""
    content = [copy.deepcopy(content)]
    for _ in range(rng.randint(1, 3)):
        entry, key = content, 0
        while isinstance(entry[key], (dict, list)) and entry[key] and rng.random() < 0.8:
            entry = entry[key]
            key = rng.choice(list(entry) if isinstance(entry, dict) else range(len(entry)))
        entry[key] = copy.deepcopy(rng.choice(STRANGE))
    return content[0]


def outcome(path, choice=CHOICES[0]):
    """The error of reading, or '' on success; warnings are errors, too."""
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        try:
            found = read_keypoints(path, FrameSource(path.parent / 'walk.mp4'), START)
            keypoints_of_person(found, ClipReading(choice), (64, 48), lambda text: None, 0, 25.0)
        except ValueError as error:
            return str(error)
    return ''


@pytest.mark.parametrize('layout', LAYOUTS)
def test_strange_values_are_read_or_refused(layout, tmp_path):
    rng, path = random.Random(layout), tmp_path / 'walk.json'
    path.write_text(json.dumps(LAYOUTS[layout]))
    assert outcome(path) == ''
    texts = set()
    for _ in range(250):
        path.write_text(json.dumps(mutated(LAYOUTS[layout], rng)))
        texts.add(outcome(path, rng.choice(CHOICES)))
    assert len(texts) > 5
    assert all(len(text.splitlines()) <= 1 for text in texts)


def test_images_have_sides_that_images_have(tmp_path):
    content = copy.deepcopy(LAYOUTS['coco annotations'])
    content['images'] += [{'id': 8, 'width': 10**400, 'height': 1}, {'id': 9, 'width': 1e9}]
    path = tmp_path / 'walk.json'
    path.write_text(json.dumps(content))
    assert read_keypoints(path, FrameSource(tmp_path), START).size == (64, 48)


def test_crowds_whose_tracks_would_take_hours_are_refused():
    places = np.stack([np.arange(17.0), np.arange(17.0) ** 1.5], 1) + 1.0
    crowd = {t: [person(None, places + 500.0 * i) for i in range(400)] for t in range(3)}
    with pytest.raises(ValueError, match='too many persons at once to follow each'):
        tracks_of(crowd)
    assert len(tracks_of({t: those[:20] for t, those in crowd.items()})) == 20


def write_table(path, rows):
    path.write_text('\n'.join(','.join(row) for row in rows), 'utf-8')
    return path


TABLE = (
    'frame,left_hip_u,left_hip_v,left_hip_confidence,nose_u,nose_v',
    '1,11,12,0.5,13,14',
    '2,2',
)
LONG = ('time_s,name,u,v', '0.04,nose,1,2', '0.04,left_hip,3,4', '0.08,left_hip,3,4')
LAB = ('scorer,net,net', 'bodyparts,LHip,LHip', 'coords,x,y', '1,1,2', '2,3,4')
CELLS = (
    '',
    'nan',
    'inf',
    '1e308',
    '9' * 400,
    '9' * 5000,
    '-1',
    '\0',
    '"',
    '\u0663',
    '\x1b[31m',
    'x',
)


@pytest.mark.parametrize('table', [TABLE, LONG, LAB])
def test_strange_cells_are_read_or_refused(table, tmp_path):
    rng, texts = random.Random(table[0]), set()
    for _ in range(400):
        rows = [row.split(',') for row in table]
        for _ in range(rng.randint(0, 3)):
            row = rng.choice(rows)
            row[rng.randrange(len(row))] = rng.choice((*CELLS, *row))
        rows += [rng.choice(rows)] * rng.randint(0, 1)
        texts.add(outcome(write_table(tmp_path / 'walk.csv', rows), rng.choice(CHOICES)))
    assert '' in texts
    assert len(texts) > 5
    assert all(len(text.splitlines()) <= 1 for text in texts)


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        (','.join(f'a{i}_u,a{i}_v' for i in range(9000)) + ',frame\n' + ',\n' * 9000, 'records'),
        (f'bodyparts{",LHip" * 9000}\ncoords{",x,y" * 4500}\n' + '1\n' * 9000, 'records'),
        (',' * 20_000_000, 'cells take 1320000000 bytes'),
        ('\n' * 10_000_000, 'cells take 1300000000 bytes'),
        (f'frame,a_u,a_v\n{"1" * 200_000},1,2\n', 'field larger than field limit'),
        (f'frame,a_u,a_v\n{10**18},1,2\n', 'wanted at most 10000000 frames'),
        (f'stamp_ns,a_u,a_v\n{10**18},1,2\n{10**19},1,2\n', 'years apart'),
    ],
)
def test_tables_that_claim_much_are_refused(text, message, tmp_path):
    path = tmp_path / 'walk.csv'
    path.write_text(text)
    assert message in outcome(path)


def test_keypoints_that_differ_from_row_to_row_are_compared_by_name(tmp_path):
    rows = [('frame', 'name', 'u', 'v'), ('0', 'nose', '1', '2'), ('0', 'left_hip', '3', '4')]
    rows += [('1', 'left_hip', '6', '8'), ('2', 'left_hip', '6', '8'), ('2', 'nose', '1', '2')]
    path = write_table(tmp_path / 'walk.csv', rows)
    found = read_keypoints(path, FrameSource(tmp_path), START)
    (first,), (second,), (third,) = found.frames.values()
    assert first.distance(second) == second.distance(first) == 5.0
    assert third.distance(first) == 2.5
    assert outcome(path) == ''


def test_arrays_whose_rows_cost_more_than_their_bytes(tmp_path):
    """Arrays of one value compress a thousandfold."""
    path = tmp_path / 'walk.npz'
    np.savez_compressed(path, pixels=np.ones((20_000, 17, 2), np.int8))
    assert 'more than' in outcome(path)
    np.savez_compressed(path, pixels=np.ones((1000, 17, 2)))
    assert 'records' not in outcome(path)
    np.savez_compressed(
        path, pixels=np.ones((1, 2, 2)), landmark_names=np.array([['a'], 1], object)
    )
    assert 'holds object, wanted numbers or texts' in outcome(path)
    np.savez_compressed(path, pixels=np.ones((1, 2, 2)), landmark_names=np.ones(2))
    assert 'entries that are not texts' in outcome(path)
    np.savez_compressed(path, pixels=np.ones((1_000_000, 0, 2)))
    assert 'records' in outcome(path)
