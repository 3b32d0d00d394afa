import json

import numpy as np
import pytest

from hmt_ros.app.import_video.frames import Frame, FrameSource
from hmt_ros.app.import_video.keypoint_files.reading import read_keypoints
from hmt_ros.image.keypoint_schemes import schemes

START = 1_000_000_000_000
IMAGE = np.zeros((4, 4, 3), np.uint8)


class Numbered(FrameSource):
    """Frames with numbers and names, but without images."""

    def frames(self, selection):
        return iter(())


def pixels(n, number):
    """Pixels (n, 2) of a person in a frame."""
    return np.stack([10.0 + np.arange(n), 20.0 + 2 * np.arange(n) + number], 1)


def flat(n, number, sure=0.5):
    return np.column_stack([pixels(n, number), np.full(n, sure)]).reshape(-1).tolist()


def found_in(path, number=2, source=None, time_ns=None):
    source = source or Numbered(path.parent / 'walk.mp4')
    frame = Frame(number, 40_000_000 * number if time_ns is None else time_ns, '', IMAGE)
    found = read_keypoints(path, source, START)
    key = found.key_of(frame)
    return [] if key is None else found.frames[key]


def write(path, content):
    path.write_text(content if isinstance(content, str) else json.dumps(content), 'utf-8')
    return path


@pytest.mark.parametrize(
    ('n', 'scheme'),
    [
        (17, 'coco17'),
        (18, 'skeleton2d'),
        (25, 'body25'),
        (26, 'halpe26'),
        (33, 'mediapipe33'),
        (70, 'mhr70'),
        # Body part of lists that also have faces and hands.
        (133, 'wholebody23'),
        (135, 'body25b'),
        (136, 'halpe26'),
    ],
)
def test_coco_results(n, scheme, tmp_path):
    entries = [
        {'image_id': i, 'category_id': 1, 'keypoints': flat(n, i), 'score': 0.7} for i in (0, 2, 3)
    ]
    path = write(tmp_path / 'walk.json', entries)
    (seen,) = found_in(path)
    names = schemes()[scheme].names
    assert seen.keypoints.names == names
    assert np.array_equal(seen.keypoints.pixels, pixels(n, 2)[: len(names)])
    assert (seen.keypoints.confidences == 0.5).all()
    assert found_in(path, 1) == []


def test_coco_annotations(tmp_path):
    """Images and keypoints have names; flags state the visibility of a keypoint."""
    content = {
        'images': [
            {'id': 70, 'file_name': 'b.jpg'},
            {'id': 71, 'file_name': 'a.jpg', 'width': 8, 'height': 4},
        ],
        'annotations': [
            {'image_id': 70, 'keypoints': [5, 6, 2, 7, 8, 1, 9, 9, 0]},
            {'image_id': 71, 'keypoints': [1, 2, 2, 3, 4, 2, 5, 6, 2]},
        ],
        'categories': [{'id': 1, 'keypoints': ['nose', 'left_hip', 'tail']}],
    }
    source = Numbered(tmp_path, ('a.jpg', 'b.jpg'))
    (seen,) = found_in(write(tmp_path / 'walk.json', content), 1, source)
    assert seen.keypoints.names == ('nose', 'left_hip', 'tail')
    assert list(seen.keypoints.confidences) == [1.0, 0.5, 0.0]
    assert np.array_equal(seen.keypoints.pixels[:2], [[5, 6], [7, 8]])
    found = read_keypoints(tmp_path / 'walk.json', source, START)
    assert found.size == (8, 4)


def test_openpose(tmp_path):
    folder = tmp_path / 'openpose'
    folder.mkdir()
    for i in range(3):
        people = [
            {'person_id': [-1], 'pose_keypoints_2d': flat(25, i)},
            {'person_id': [4], 'pose_keypoints_2d': flat(25, 100)},
            {'person_id': [-1], 'pose_keypoints_2d': [0.0] * 75},
        ]
        write(folder / f'walk_{i:012d}_keypoints.json', {'version': 1.3, 'people': people})
    first, second = found_in(folder)
    assert first.keypoints.names == schemes()['body25'].names
    assert np.array_equal(first.keypoints.pixels, pixels(25, 2))
    assert (first.track, second.track) == ('', '4')


def arrays(rows=4, n=33, **changed):
    content = {
        'landmark_names': np.array(schemes()['mediapipe33'].names),
        'pixels': np.stack([pixels(n, i) for i in range(rows)]).astype(np.float32),
        'visibility': np.full((rows, n), 0.25, np.float32),
        'world': np.arange(rows * n * 3.0).reshape(rows, n, 3),
        'detected': np.arange(rows) != 1,
    }
    return content | changed


def test_arrays(tmp_path):
    path = tmp_path / 'walk.npz'
    content = arrays()
    np.savez(path, **content)
    (seen,) = found_in(path)
    assert seen.keypoints.names == schemes()['mediapipe33'].names
    assert np.array_equal(seen.keypoints.pixels, pixels(33, 2))
    assert np.array_equal(seen.keypoints.positions, content['world'][2])
    assert (seen.keypoints.confidences == 0.25).all()
    assert found_in(path, 1) == []
    found = read_keypoints(path, Numbered(tmp_path), START)
    assert (found.rows, found.lifts, found.last) == (4, True, 3)


WIDE = """\
frame,left_hip_u,left_hip_v,left_hip_confidence,nose_u,nose_v,nose_confidence
1,11,12,0.5,13,14,0.25
2,21,22,0.75,,,
"""
LONG = """\
stamp_ns, name, u, v, confidence
1000080000000,left_hip,21,22,0.75
1000080000000,nose,0,0,0.9
1000040000000,nose,3,4,0.9
"""


@pytest.mark.parametrize(
    'text', [WIDE, LONG, WIDE.replace('frame', 'time_s').replace('\n2', '\n0.0801')]
)
def test_tables(text, tmp_path):
    (seen,) = found_in(write(tmp_path / 'walk.csv', text))
    assert {*seen.keypoints.names} == {'left_hip', 'nose'}
    which = seen.keypoints.names.index('left_hip')
    assert list(seen.keypoints.seen) == [x == 'left_hip' for x in seen.keypoints.names]
    assert list(seen.keypoints.pixels[which]) == [21, 22]
    assert seen.keypoints.confidences[which] == 0.75


def test_rows_far_from_a_frame_in_time_are_not_its(tmp_path):
    path = write(tmp_path / 'walk.csv', 'time_s,a_u,a_v\n0.5,5,6\n')
    assert len(found_in(path, time_ns=491_000_000)) == 1
    assert found_in(path, time_ns=489_000_000) == []


@pytest.mark.parametrize(
    ('name', 'content', 'message'),
    [
        ('a.json', '{', 'not JSON'),
        (
            'a.json',
            {'people': []},
            'entry 0 has no image_id or no keypoints: put files of single fr',
        ),
        ('a.json', {'annotations': []}, 'no list images'),
        ('a.json', [1], 'entry 0 is not an object'),
        ('a.json', {'a': 1}, 'no known layout of JSON; wanted a list of'),
        ('a.json', [{'keypoints': []}], 'entry 0 has no image_id or no keypoints'),
        ('a.json', [{'image_id': 0, 'keypoints': [1, 2]}], 'entry 0 has 2 numbers'),
        ('a.json', [{'image_id': 0, 'keypoints': ['x'] * 3}], 'keypoints are not numbers'),
        ('a.json', [{'image_id': 0, 'keypoints': [5.0] * 30}], '10 keypoints without names'),
        ('a.json', [{'image_id': 'walk', 'keypoints': [5.0] * 51}], 'walk is not the name of a fr'),
        ('a.json', [{'image_id': 0, 'keypoints': [1e9] * 51}], r'a keypoint lies 1e\+09 px away'),
        ('a.json', [{'image_id': 0, 'keypoints': [10**400] * 51}], 'keypoints are not numbers'),
        (
            'a.json',
            {
                'images': [],
                'annotations': [{'image_id': 0, 'keypoints': [5.0] * 6}],
                'categories': [{'keypoints': ['a', 'b', 'c']}],
            },
            'entry 0 has 2 keypoints, but 3 are named in categories',
        ),
        ('a.json', [{'image_id': 0, 'keypoints': [5.0] * 102}], 'of two persons, 17 each?'),
        ('a.json', [{'image_id': 10**9, 'keypoints': [5.0] * 51}], 'wanted at most 10000000 fr'),
        ('a.json', {'images': [{'id': {}}], 'annotations': []}, 'an image has no id'),
        ('a.json', {'a': {'b': 1}, 'c': [{}]}, 'entry 0 has no number|c is not the name'),
        ('a.csv', 'u,v\n1,2\n', 'wanted a column frame, time_s or stamp_ns'),
        ('a.csv', 'frame,nose\n1,2\n', 'wanted columns NAME_u and NAME_v, or name, u and v'),
        ('a.csv', 'frame,nose_u\n1,2\n', 'no column nose_v'),
        ('a.csv', 'frame,a_u,a_v\n1,x,3\n', "line 2: 'x', wanted a number"),
        ('a.csv', 'time_s,a_u,a_v\nx,1,3\n', 'time_s has could not convert'),
        ('a.csv', 'frame,name,u,v\n1,a,1,3\n1,a,1,3\n', 'line 3: a twice in frame 1'),
        ('a.csv', 'frame,name,u,v\n1,,1,3\n', 'line 2: no name'),
        ('a.csv', 'name,u,v,frame\na,1,3\n', 'line 2: no frame'),
        ('a.npz', 'no archive', 'not a zip file'),
        ('a.txt', 'words', '.txt is not known; wanted a detector'),
    ],
)
def test_bad_files(name, content, message, tmp_path):
    path = write(tmp_path / name, content)
    with pytest.raises(ValueError, match=message) as caught:
        found_in(path)
    assert str(caught.value).startswith(f'{path}: ')
    assert '\n' not in str(caught.value)


def test_bad_folders(tmp_path):
    folder = tmp_path / 'openpose'
    folder.mkdir()
    with pytest.raises(ValueError, match=r'no \.json files in this folder'):
        found_in(folder)
    write(folder / 'walk_1_keypoints.json', {'people': [{'pose_keypoints_2d': [1.0] * 4}]})
    with pytest.raises(ValueError, match=r'walk_1_keypoints\.json: a person has 4 numbers'):
        found_in(folder)
    write(folder / 'walk_1_keypoints.json', {'persons': []})
    with pytest.raises(ValueError, match=r'walk_1_keypoints\.json: an object without people'):
        found_in(folder)
    with pytest.raises(ValueError, match='no such file'):
        found_in(tmp_path / 'missing.json')


def rows(n=17, number=2):
    """Column, row and confidence (n, 3) as in JSON."""
    return np.column_stack([pixels(n, number), np.full(n, 0.5)]).tolist()


def places(number=2):
    return [list(map(float, x)) for x in pixels(17, number)]


def instance(number=2, **more):
    return {'keypoints': places(number), 'keypoint_scores': [0.5] * 17, **more}


ULTRALYTICS = {
    'name': 'person', 'class': 0, 'confidence': 0.8, 'track_id': 4,
    'keypoints': {
        'x': [x for x, _ in places()], 'y': [y for _, y in places()], 'visible': [0.5] * 17
    },
}  # fmt: skip
NAMES = {str(i): name for i, name in enumerate(schemes()['coco17'].names)}
LAYOUTS = {
    'mmpose inferencer': [
        {'frame_id': i, 'instances': [instance(i, bbox=[[1, 2, 3, 4]], bbox_score=0.8)]}
        for i in range(3)
    ],
    'mmpose demo, which counts from 1': {
        'meta_info': {'keypoint_id2name': NAMES},
        'instance_info': [
            {'frame_id': i + 1, 'instances': [instance(i, bbox_score=0.8)]} for i in range(3)
        ],
    },
    'mmpose before 1': {
        str(i): [{'bbox': [1, 2, 3, 4, 0.8], 'keypoints': rows(number=i)}] for i in range(3)
    },
    'alphapose': [
        {'image_id': '2.jpg', 'keypoints': flat(17, 2), 'score': 0.8, 'idx': [4.0]},
        {'image_id': '1.jpg', 'keypoints': flat(17, 1), 'score': 0.8, 'idx': [5.0]},
    ],
    'alphapose cmu': {
        f'{i}.jpg': {'version': 'AlphaPose v0.3', 'bodies': [{'joints': flat(17, i)}]}
        for i in range(3)
    },
    'alphapose tracked': {'4': {'2': {'keypoints': flat(17, 2), 'scores': 0.8}}},
    'ultralytics': [[], [], [ULTRALYTICS]],
    'ultralytics as texts': ['[]', '[]', json.dumps([ULTRALYTICS])],
}


@pytest.mark.parametrize('layout', LAYOUTS)
def test_layouts_of_json(layout, tmp_path):
    (seen,) = found_in(write(tmp_path / 'walk.json', LAYOUTS[layout]))
    assert seen.keypoints.names == schemes()['coco17'].names
    assert np.array_equal(seen.keypoints.pixels, pixels(17, 2))
    assert (seen.keypoints.confidences == 0.5).all()
    assert seen.score == (1.0 if layout == 'alphapose cmu' else 0.8)
    tracked = layout in ('alphapose', 'alphapose tracked') or 'ultra' in layout
    assert seen.track == ('4' if tracked else '')


@pytest.mark.parametrize(
    ('sure', 'tail', 'track', 'score'),
    [
        (True, '', '', 1.0),
        (True, ' 0.8', '', 0.8),
        (False, ' 0.8 4', '4', 0.8),
        (True, ' 4', '4', 1),
    ],
)
def test_labels_of_ultralytics(sure, tail, track, score, tmp_path):
    """Fractions of the image; video frames count from 1; other classes are ignored."""
    folder = tmp_path / 'labels'
    folder.mkdir()
    for i in (1, 2):
        values = np.array(rows(number=i)) / (64, 48, 1)
        text = ' '.join(str(x) for x in values[:, : 3 if sure else 2].ravel())
        write(folder / f'walk_{i + 1}.txt', f'0 .5 .5 .2 .3 {text}{tail}\n7 .5 .5 .2 .3\n')
    (seen,) = found_in(folder)
    np.testing.assert_allclose(seen.keypoints.pixels * (64, 48), pixels(17, 2))
    assert (seen.keypoints.confidences == (0.5 if sure else 1.0)).all()
    assert (seen.track, seen.score) == (track, score)
    write(folder / 'walk_9.txt', '0 .5 .5 .2 .3\n')
    with pytest.raises(
        ValueError, match=r'walk_9\.txt: line 1 has 5 numbers, wanted class, box and'
    ):
        found_in(folder)


DEEPLABCUT = """\
scorer,net,net,net,net,net,net
individuals,one,one,one,two,two,two
bodyparts,LHip,LHip,LHip,tail,tail,tail
coords,x,y,likelihood,x,y,likelihood
1,1,2,0.5,,,
2,3,4,0.5,9,9,0.9
"""


@pytest.mark.parametrize('several', [True, False])
def test_deeplabcut(several, tmp_path):
    lines = DEEPLABCUT.splitlines(keepends=True)
    text = ''.join(x for x in lines if several or not x.startswith('individuals'))
    (seen,) = found_in(write(tmp_path / 'walk.csv', text))
    assert seen.keypoints.names == ('left_hip',)
    assert list(seen.keypoints.pixels[0]) == [3, 4]
    assert seen.keypoints.confidences[0] == 0.5
    assert seen.track == ('one' if several else '')
    with pytest.raises(ValueError, match='wanted names such as left_hip or LHip'):
        found_in(write(tmp_path / 'tail.csv', text.replace('LHip', 'paw')))


MARKERS = """\
PathFileType\t4\t(X/Y/Z)\twalk.trc
DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits
25\t25\t2\t2\tm
Frame#\tTime\tRBigToe\t\t\tNeck\t\t
\t\tX1\tY1\tZ1\tX2\tY2\tZ2
0\t3.0\t31\t32\t0\t41\t42\t0
2\t3.08\t51\t52\t0\t\t\t
"""


def test_markers(tmp_path):
    """Times are relative to the first row; a Y axis that points up is inverted."""
    for text in (MARKERS, MARKERS.replace('\t32', '\t-32').replace('\t52', '\t-52')):
        text = text if '-32' not in text else text.replace('\t42', '\t-42')
        (seen,) = found_in(write(tmp_path / 'walk.trc', text), time_ns=3_080_000_000)
        assert seen.keypoints.names == ('right_big_toe', 'neck')
        assert list(seen.keypoints.pixels[0]) == [51, 52]
        assert list(seen.keypoints.seen) == [True, False]
    for bad in (MARKERS.replace('32\t0', '32\t7'), MARKERS.replace('\t5', '\t0.5')):
        bad = bad.replace('\t31\t32', '\t.31\t.32').replace('\t41\t42', '\t.41\t.42')
        with pytest.raises(ValueError, match=r'three coordinates or metres; wanted .* _px_'):
            found_in(write(tmp_path / 'walk.trc', bad))
    with pytest.raises(ValueError, match='no line Frame#'):
        found_in(write(tmp_path / 'walk.trc', 'x\ty\n'))
