"""Well-formed hostile files other than bags: tables, calibrations, models, images, videos."""

from __future__ import annotations

import io
import json
import os
import pickle
import struct
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.clips import ROOT
from benchmarks.soak.hostile_bags import YAML_BOMBS, bag_folders, bags, compressed_bags, databases
from benchmarks.soak.hostile_file import CONTROL, DEEP, DIGITS, Hostile
from benchmarks.soak.scenes import CLIP

# Hostile values: words, then long ones and ones with spaces.
_WORDS = """
1e999 -1e999 .nan 1e-320 [] {} null [[1]] 0xffffffffffffffffffffff /etc/passwd
/dev/zero ../../kept/canary . 1_0_0 yes  "\\e[2J\\u202e\\n" "\\ud800"
"""
_LONG = (DIGITS, DEEP, f'"{"x" * 100_000}"', '1' + ':59' * 5000, '!!binary "/w=="')
_VALUES = (*_WORDS.split(), *_LONG, '{a: b}', '{[1]: 2}', '!!timestamp 2024-01-01', '!!set {a, b}')
_CALIBRATION = """\
%YAML:1.0
---
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix {{rows: {rows}, cols: {cols}, dt: {dt}, data: [{data}]}}
distortion_coefficients: !!opencv-matrix {{rows: 1, cols: {count}, dt: d, data: [{distortion}]}}
"""
_MATRIX = '600., 0., 320., 0., 600., 240., 0., 0., 1.'
_ENTITIES = '<?xml version="1.0"?>\n<!DOCTYPE a [<!ENTITY a0 "xxxxxxxxxx">' + ''.join(
    f'<!ENTITY a{i} "{f"&a{i - 1};" * 10}">' for i in range(1, 10)
)
_OF_OPENCV = 'type_id="opencv-matrix"'
_XML = '<?xml version="1.0"?>\n<opencv_storage>{}</opencv_storage>\n'


def hostile_files(good: Path) -> dict[str, Iterable[Hostile]]:
    """Hostile files by kind; large contents are generated when the file is written.

    Args:
        good: folder of good files.
    """
    return {
        'MCAP': bags(good),
        'SQLite': databases(),
        'zstd': compressed_bags(good),
        'folders of bags': bag_folders(good),
        'YAML': _yaml(),
        'calibrations': _calibrations(),
        'JSON': _json(),
        'tables': _tables(),
        'arrays': _arrays(),
        'models': _models(),
        'images': _images(),
        'videos': _videos(good),
        'motions': _motions(),
        'no files': _no_files(),
        'outputs': _outputs(),
    }


def _yaml() -> Iterator[Hostile]:
    """YAML documents, and input files of the commands with one strange value each."""
    documents = {
        **YAML_BOMBS,
        'list_lists': '[' + '[], ' * 200_000 + '1]',
        'block_deep': ''.join(f'{" " * i}a:\n' for i in range(1400)),
        'documents': '---\na: 1\n' * 100_000,
        'scalar': 'a: ' + 'x' * 1_000_000,
        'keys': ''.join(f'k{i}: &a{i} 1\n' for i in range(60_000)),
        'doubled': 'a: 1\n' * 100_000,
        'unhashable': '? [1]\n: 2\n? {a: 1}\n: 3\n',
        'keys_strange': f'{DIGITS[:5000]}: 1\nnull: 2\n1.5: 3\n"\\e[2J\\n": 4\n~: 5\n',
        'omap': '!!omap [a: 1]\n',
        'sexagesimal': 'a: 1' + ':59' * 200_000,
        'directive': '%YAML 9.9\n%TAG ! tag:x,2000:\n---\na: !x 1\n',
        'flow_unclosed': '[' * 500_000,
        'question': '? ' * 5000 + 'a',
        'nothing': '---\n...\n',
        'bytes': '\ufeff\x85\u2028a: 1',
    }
    for name, text in documents.items():
        yield Hostile(f'{name}.yaml', text)
    sources = {
        'subject': CLIP / 'subject.yaml',
        'config': ROOT / 'hmt_ros' / 'config' / 'filter_node.yaml',
        'body': ROOT / 'hmt_ros' / 'body' / 'models' / 'human37.yaml',
    }
    rng = np.random.default_rng(0)
    for name, path in sources.items():
        lines = path.read_text('utf-8').split('\n')
        places = [i for i, x in enumerate(lines) if ': ' in x and x.lstrip()[0] != '#']
        for number, value in enumerate(_VALUES):
            for at in rng.choice(places, 2, replace=False):
                changed = list(lines)
                changed[at] = f'{changed[at].partition(":")[0]}: {value}'
                yield Hostile(f'{name}_{number}_{at}.yaml', '\n'.join(changed))
    one = '  - {{name: s{0}, parent: s{1}, length: a, dofs: [[a{0}, x, -9, 9, 0, 9]]}}\n'
    segments = ''.join(one.format(i, i - 1) for i in range(20_000))
    head = 'name: x\nlengths: {a: [1, 1]}\nsegments:\n'
    yield Hostile('body_segments.yaml', head + segments)
    dofs = ', '.join(f'[a{i}, x, -9, 9, 0, 9]' for i in range(20_000))
    yield Hostile('body_dofs.yaml', f'name: x\nsegments:\n  - {{name: a, dofs: [{dofs}]}}\n')


def _calibrations() -> Iterator[Hostile]:
    usual = {'rows': '3', 'cols': '3', 'dt': 'd', 'data': _MATRIX}
    usual |= {'count': '5', 'distortion': '0., 0., 0., 0., 0.'}
    changes: dict[str, dict[str, str]] = {
        'rows': {'rows': '1000000000', 'cols': '1000000000'},
        'negative': {'rows': '-3', 'cols': '-3'},
        'digits': {'rows': DIGITS[:10_000]},
        'dt': {'dt': '"100000000d"'},
        'dt_strange': {'dt': '"3(2i"'},
        'dt_many': {'dt': '"' + '9d' * 1000 + '"'},
        'data_short': {'data': '1.'},
        'data_text': {'data': '"x", [], {}'},
        'data_nan': {'data': '.Nan, .Inf, -.Inf, 0, 0, 0, 0, 0, 0'},
        'data_digits': {'data': f'{DIGITS[:10_000]}, {_MATRIX}'},
        'data_deep': {'data': '[' * 4000 + ']' * 4000},
        'coefficients': {'count': '100000', 'distortion': '0., ' * 99_999 + '0.'},
        'coefficients_huge': {'distortion': '1e300, 1e300, 1e300, 1e300, 1e300'},
        'focal': {'data': '1e-300, 0., 1e300, 0., -1., 0., 0., 0., 0.'},
    }
    for name, change in changes.items():
        found = usual | change
        sizes = {k: found[k] for k in ('rows', 'cols', 'dt')}
        yield Hostile(f'opencv_{name}.yaml', _CALIBRATION.format(**found))
        parts = {**sizes, 'data': found['data'].replace(',', ' ')}
        inside = ''.join(f'<{k}>{text}</{k}>' for k, text in parts.items())
        yield Hostile(f'opencv_{name}.xml', _XML.format(f'<K {_OF_OPENCV}>{inside}</K>'))
        document = {'camera_matrix': {'type_id': 'opencv-matrix', **sizes, 'data': [1.0]}}
        yield Hostile(f'opencv_{name}.json', json.dumps(document))
    head = '%YAML:1.0\n---\n'
    for depth in (30, 1000, 20_000):
        lists, dots = '[' * depth + ']' * depth, '.'.join('a' * depth)
        block = ''.join(f'{" " * i}a:\n' for i in range(min(depth, 1300)))
        for name, text in {
            'lists.xml': f'{head}a: {lists}\n',
            'maps.xml': f'{head}a: {"{a: " * depth}1{"}" * depth}\n',
            'block.xml': head + block,
            'parts.xml': _XML.format('<a>' * depth + '</a>' * depth),
            'lists.json': f'{{"K": {lists}}}',
            'maps.json': '{"a": ' * depth + '1' + '}' * depth,
            'lists.toml': f'a = {lists}\n',
            'tables.toml': f'a = {"{a = " * depth}1{"}" * depth}\n',
            'keys.toml': f'{dots} = 1\n',
            'heads.toml': f'[{dots}]\nmatrix = 1\n',
        }.items():
            yield Hostile(f'deep_{depth}_{name}', text)
    entity = '<?xml version="1.0"?><!DOCTYPE a [<!ENTITY x SYSTEM "file:///etc/passwd">]>'
    inside = '<opencv_storage><K>&{};</K></opencv_storage>'
    base64 = '$base64$' + 'A' * 900_000
    for name, text in {
        'entities.xml': f'{_ENTITIES}]>\n{inside.format("a9")}',
        'external.xml': entity + inside.format('x'),
        'types.xml': _XML.format(f'<K type_id="opencv-sparse-matrix"><data>{_MATRIX}</data></K>'),
        'graph.xml': _XML.format('<K type_id="opencv-graph"><flags>1</flags></K>'),
        'base64.xml': _XML.format(f'<K type_id="binary">{base64}</K>'),
        'base64.yaml': f'{head}K: !!binary |\n  {base64}\n',
        'keys.xml': _XML.format(''.join(f'<a{i}>1</a{i}>' for i in range(50_000))),
    }.items():
        yield Hostile(name, text)
    ros = 'image_width: 640\nimage_height: 480\ncamera_matrix: {rows: 3, cols: 3, data: [%s]}\n'
    yield Hostile('ros_digits.yaml', ros % DIGITS[:10_000])
    yield Hostile('ros_long.yaml', ros % ('0, ' * 200_000))
    plain = f'k: [{_MATRIX}]\nd: [{"0., " * 100_000}0.]\nwidth: 640\nheight: 480\n'
    yield Hostile('ros_coefficients.yaml', plain)
    for name, value in enumerate(_VALUES):
        yield Hostile(f'ros_{name}.yaml', f'k: [{_MATRIX}]\nd: {value}\nwidth: {value}\n')
        yield Hostile(f'model_{name}.yaml', f'k: [{_MATRIX}]\nd: [0.]\ndistortion_model: {value}\n')
        yield Hostile(f'toml_{name}.toml', f'[cam]\nmatrix = {value}\nname = "{CONTROL[1:4]}"\n')
    yield Hostile('digits.toml', f'[cam]\nmatrix = [[{DIGITS[:100_000]}, 0, 1]]\n')
    for i, head in enumerate(('[cam%d]\n', '["\\u001b[2J%d"]\n')):
        yield Hostile(
            f'cameras_{i}.toml', ''.join(f'{head % k}matrix = [[1]]\n' for k in range(30_000))
        )
    yield Hostile('names.yaml', ''.join(f'"{i}\\e[2J\\n":\n  K: [1]\n' for i in range(20_000)))


def _json() -> Iterator[Hostile]:
    person = [float(x) for i in range(17) for x in (100 + i, 100 + 2 * i, 0.9)]
    annotation = {'image_id': 0, 'keypoints': person, 'score': 1.0, 'category_id': 1}
    strange: list[Any] = [None, True, [1], {'a': 1}, 'x', '\x1b[2J\n', '\ud800', 'x' * 100_000]
    strange += [1e308, -1, 10**12, 2**63, 10**4000, float('nan'), float('inf')]
    strange += [[[[]]], [10**400] * 51]
    usual = {
        'images': [{'id': 0, 'file_name': 'x_0.png'}],
        'annotations': [annotation],
        'categories': [{'id': 1, 'keypoints': []}],
    }
    for number, value in enumerate(strange):
        instance = {'keypoints': [[1, 2]] * 17, 'keypoint_scores': value, 'bbox': value}
        frames = [{'frame_id': value, 'instances': [instance]}]
        people = [{'pose_keypoints_2d': value, 'person_id': value}]
        for name, document in {
            **{f'results_{key}': [annotation, {**annotation, key: value}] for key in annotation},
            **{f'coco_{key}': {**usual, key: value} for key in usual},
            'coco_image': {**usual, 'images': [{'id': value, 'file_name': value}]},
            'coco_category': {**usual, 'categories': [{'id': 1, 'keypoints': value}]},
            'openpose': {'people': people, 'version': value},
            'mmpose': {'meta_info': value, 'instance_info': frames},
            'ultralytics': [[{'name': value, 'box': value, 'keypoints': {'x': value, 'y': value}}]],
        }.items():
            yield Hostile(f'{name}_{number}.json', partial(_dumped, document))
    far = [{**annotation, 'image_id': i * 10**9} for i in range(3)]
    names = [{**annotation, 'image_id': f'{"x" * 9000}{i}'} for i in range(2000)]
    for name, content in {
        'frames_far': partial(_dumped, far),
        'frames_names': partial(_dumped, names),
        'persons': partial(_dumped, [annotation] * 20_000),
        'deep': DEEP,
        'deep_maps': '{"a":' * 100_000 + '1' + '}' * 100_000,
        'empty_lists': '[' + '[],' * 1_000_000 + '[]]',
        'empty_maps': '[' + '{},' * 1_000_000 + '{}]',
        'numbers': '[' + '1,' * 3_000_000 + '1]',
        'digits': f'[{DIGITS}]',
        'exponent': '[1e999999999, 1' + '0' * 100_000 + '.0]',
        'keys': lambda: '{' + ','.join(f'"{i}":1' for i in range(300_000)) + '}',
        'doubled': '{' + '"a":1,' * 300_000 + '"a":1}',
        'text': '"' + '\\u001b' * 300_000 + '"',
    }.items():
        yield Hostile(f'{name}.json', content)


def _dumped(document: Any) -> str:
    """JSON; an integer with too many digits for Python is replaced by text."""
    try:
        return json.dumps(document)
    except ValueError:
        return json.dumps(str(document)[:100])


def _tables() -> Iterator[Hostile]:
    head = 'frame,left_hip_u,left_hip_v,left_hip_confidence,nose_u,nose_v,nose_confidence\n'
    rows = '0,1,2,1,3,4,1\n1,1,2,1,3,4,1\n'
    values = ['1000000000', str(2**63), DIGITS, '-1', 'nan', '1e308', '1e999']
    values += ['\x1b[2J', '"a\nb"', '0x1', '\u0663', '1_0', 'x' * 200_000]
    for number, value in enumerate(values):
        for name, text in {
            'frame': f'{head}{rows}{value},1,2,1,3,4,1\n',
            'value': f'{head}{rows}2,{value},2,1,3,4,{value}\n',
            'name': f'frame,{value}_u,{value}_v\n0,1,2\n',
            'time': f'time_s,a_u,a_v\n{value},1,2\n',
            'stamp': f'stamp_ns,person,a_u,a_v\n{value},{value},1,2\n',
            'long': f'frame,name,u,v,confidence\n{value},{value},1,2,1\n',
            'people': f'file,subject\n{value},{value}\nx,y\n',
        }.items():
            yield Hostile(f'{name}_{number}.csv', text)
        yield Hostile(f'{number}.trc', _TRC.replace('?', value))
    columns = ','.join(f'k{i}_u,k{i}_v' for i in range(50_000))
    every = range(99_999)
    for name, text in {
        'columns.csv': f'frame,{columns}\n0{",1" * 100_000}\n',
        'rows.csv': head + '1,1,2,1,3,4,1\n' * 300_000,
        'frames.csv': head + ''.join(f'{i}000,1,2,1,3,4,1\n' for i in every),
        'persons.csv': 'frame,person,a_u,a_v\n' + ''.join(f'0,p{i},1,2\n' for i in every),
        'names.csv': 'frame,name,u,v\n' + ''.join(f'0,n{i},1,2\n' for i in every),
        'quote.csv': head + '"' + 'x' * 1_000_000,
        'quotes.csv': head + '""' * 500_000,
        'nul.csv': head + '\0' * 1000,
        'lines.csv': '\n' * 1_000_000,
        'commas.csv': ',' * 1_000_000,
        'tabs.trc': '\t' * 1_000_000 + '\n' * 9,
        'deeplabcut.csv': 'scorer,a,a,a\nbodyparts,nose,nose,nose\ncoords,x,y,likelihood\n'
        f'{DIGITS[:20]},1,2,1\n',
    }.items():
        yield Hostile(name, text)


_TRC = (
    'PathFileType\t4\t(X/Y/Z)\tx.trc\nDataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\t'
    'OrigDataRate\tOrigDataStartFrame\tOrigNumFrames\n?\t?\t?\t?\tm\t?\t1\t?\n'
    'Frame#\tTime\tLHip\t\t\n\t\tX1\tY1\tZ1\n\n1\t?\t1\t2\t0\n'
)


def _npy(head: str | Mapping[str, Any], content: bytes = b'abc', version: int = 1) -> bytes:
    text = (head if isinstance(head, str) else repr(dict(head))).encode() + b'\n'
    length = struct.pack(
        '<H' if version == 1 else '<I', len(text) % (2**16 if version == 1 else 2**32)
    )
    return b'\x93NUMPY' + bytes([version, 0]) + length + text + content


class _Call:
    """Object whose pickle runs a shell command when it is loaded."""

    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, ('touch ../kept/pwned',)


def _pickles() -> dict[str, bytes]:
    nested: Any = ()
    for _ in range(30):
        nested = (nested, nested)
    doubled = b'\x80\x04)' + b'q\x00h\x00\x86' * 60 + b'.'
    return {
        'call': pickle.dumps(_Call()),
        'doubled': pickle.dumps(nested),
        'memo': doubled,
        'deep': b'\x80\x04' + b']' * 100_000 + b'a' * 99_999 + b'.',
        'bytes': b'\x80\x04\x8e' + struct.pack('<Q', 2**40) + b'x.',
        'long': b'\x80\x04\x8b' + struct.pack('<i', 2**31 - 1) + b'\x01.',
        'put': b'\x80\x04Nr\xff\xff\xff\x7f.',
        'import': b"\x80\x04cos\nsystem\n(S'touch ../kept/pwned'\ntR.",
        'numpy': b'\x80\x04cnumpy\nzeros\n(I1000000000000\ntR.',
        'bytearray': b'\x80\x05\x96' + struct.pack('<Q', 2**40) + b'x.',
        'marks': b'\x80\x04' + b'(' * 500_000 + b'.',
        'repeat': b'\x80\x04cnumpy\nndarray\n(I1000000000000\ntR.',
    }


def _arrays() -> Iterator[Hostile]:
    """Archives of arrays under the names that commands look for."""
    usual = {'descr': '<f8', 'fortran_order': False, 'shape': (3, 6, 2)}
    shapes = [(2**40, 2), (2**62, 0, 2), (2**33, 2**33, 2), (-3, 6, -2), (1,) * 200]
    types: list[Any] = ['<U1000000000', '|V2147483647', '|O', '<M8[as]']
    types += [[('x', '<f8', (2**30, 2**30))], [(f'f{i}', '<f8') for i in range(3000)]]
    heads: dict[str, str | dict[str, Any]] = {
        **{f'shape_{i}': {**usual, 'shape': shape} for i, shape in enumerate(shapes)},
        **{f'type_{i}': {**usual, 'descr': kind} for i, kind in enumerate(types)},
        'void': {**usual, 'descr': '|V0', 'shape': (2**40,)},
        'text': {**usual, 'descr': '<U0', 'shape': (2**40,)},
        'digits': str(usual).replace('3, 6', DIGITS[:9000]),
        'code': '__import__("os").system("touch ../kept/pwned")',
        'deep': '(' * 5000 + ')' * 5000,
        'deep_minus': str(usual).replace('3, 6', '-' * 9000 + '1'),
        'long': {**usual, 'x' * 60_000: 1},
    }
    for name, head in heads.items():
        for version in (1, 2):
            content = _npy(head, bytes(288), version)
            yield Hostile(f'{name}_{version}.npz', partial(_zip, dict.fromkeys(_WANTED, content)))
    for name, data in _pickles().items():
        content = _npy({**usual, 'descr': '|O', 'shape': ()}, data)
        yield Hostile(f'pickle_{name}.npz', partial(_zip, dict.fromkeys(_WANTED, content)))
    yield Hostile('bomb.npz', partial(zeros_archive, 960_000_000))
    yield Hostile('bombs.npz', partial(zeros_archive, 200_000_000, 9))
    yield Hostile('members.npz', lambda: _zip({f'a{i}': b'' for i in range(60_000)}))
    small = _npy({**usual, 'shape': (1,)}, bytes(8))
    yield Hostile('arrays.npz', lambda: _zip({f'a{i}': small for i in range(9_999)}))
    yield Hostile('dots.npz', _zip(dict.fromkeys(('../../kept/canary', '/tmp/pwned'), small)))
    yield Hostile('control.npz', _zip({CONTROL: small, **dict.fromkeys(_WANTED, small)}))
    yield Hostile('lies.npz', _lying(_zip(dict.fromkeys(_WANTED, small))))
    yield Hostile('doubled.npz', lambda: _zip(dict.fromkeys(_WANTED, small)) * 2)
    keypoints: dict[str, Any] = {
        'pixels': np.full((3, 6, 2), 1e300),
        'landmark_names': np.array([CONTROL] * 6),
        'visibility': np.full((3, 6), np.nan),
        'detected': np.array([2**62] * 3),
        'world': np.full((3, 6, 3), np.inf),
    }
    good = {'pixels': np.ones((3, 6, 2)), 'landmark_names': np.array(list('abcdef'))}
    for name, value in keypoints.items():
        yield Hostile(f'value_{name}.npz', _saved({**good, name: value}))
        yield Hostile(f'scalar_{name}.npz', _saved({**good, name: np.array(7)}))
        yield Hostile(f'text_{name}.npz', _saved({**good, name: np.array(['x' * 10_000])}))
    wide = {'pixels': np.ones((2, 50_000, 2)), 'landmark_names': np.arange(50_000).astype('U')}
    yield Hostile('landmarks.npz', lambda: _saved(wide))
    yield Hostile('frames.npz', lambda: _saved({**good, 'pixels': np.zeros((500_000, 6, 2), 'f2')}))
    truth = {'stamps': np.array([-(2**63), 0, 2**63 - 1]), 'joint_names': np.array(['pelvis'] * 3)}
    yield Hostile('truth.npz', _saved({**truth, 'joints': np.full((3, 3, 3), 1e300)}))


_WANTED = ('pixels', 'stamps', 'joints', 'joint_names', 'positions_2d', 'format', 'parameters')


def _zip(members: Mapping[str, bytes], zeros: int = 0) -> bytes:
    target = io.BytesIO()
    with zipfile.ZipFile(target, 'w', zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, content in members.items():
            with archive.open(f'{name}.npy', 'w', force_zip64=True) as member:
                member.write(content)
                for _ in range(zeros // 2**20):
                    member.write(bytes(2**20))
    return target.getvalue()


def zeros_archive(size: int, count: int = 1) -> bytes:
    """An archive of `count` arrays of zeros, each about `size` bytes when unpacked."""
    head = _npy({'descr': '<f8', 'fortran_order': False, 'shape': (size // 96, 6, 2)}, b'')
    return _zip({f'pixels{i or ""}': head for i in range(count)}, size)


def _lying(data: bytes) -> bytes:
    """The archive with a wrong size in its directory."""
    at = data.rindex(b'PK\x01\x02')
    return data[: at + 24] + struct.pack('<I', 100) + data[at + 28 :]


def _saved(arrays: Mapping[str, Any]) -> bytes:
    target = io.BytesIO()
    np.savez_compressed(target, **arrays)
    return target.getvalue()


def _models() -> Iterator[Hostile]:
    """Bundled models with one array replaced by hostile values of the right type."""
    for name in ('silhouettes', 'keypoints'):
        with np.load(ROOT / 'hmt_ros' / 'experts' / 'models' / f'{name}.npz') as archive:
            arrays = dict(archive)
        for key, values in arrays.items():
            changed: dict[str, Any] = {}
            if values.dtype.kind in 'fiu':
                most = {'f': 6e4}.get(values.dtype.kind, 2**62)
                changed = {
                    'zero': np.zeros_like(values),
                    'large': np.full_like(values, most),
                    'negative': -np.abs(values) - 1,
                }
            elif key.endswith('parameters'):
                changed = dict(_changed_parameters(str(values)))
            if values.dtype.kind == 'f':
                changed['nan'] = np.full_like(values, np.nan)
                changed['tiny'] = np.full_like(values, 1e-7)
            for how, value in changed.items():
                file = f'{name}_{key.replace("/", ".")}_{how}.npz'
                content = partial(_saved, {**arrays, key: value})
                yield Hostile(file, content, routes=('model', 'lifter'))


def _changed_parameters(text: str) -> Iterator[tuple[str, Any]]:
    found = json.loads(text)
    yield 'deep', np.array(DEEP[:4000] + ']' * 4000)
    yield 'deep_inside', np.array(text[:-1] + ', "x": ' + '[' * 9000 + ']' * 9000 + '}')
    yield 'digits', np.array(text[:-1] + f', "x": {DIGITS[:100_000]}}}')
    yield 'list', np.array('[' + '[],' * 100_000 + '1]')
    for key in found:
        for number, value in enumerate((None, -1, 10**9, [], {}, '\x1b[2J', '../../x', 1e308)):
            yield f'{key}_{number}', np.array(json.dumps({**found, key: value}))


def _png(width: int, height: int, content: bytes, more: bytes = b'', colour: int = 0) -> bytes:
    head = struct.pack('>IIBBBBB', width, height, 8, colour, 0, 0, 0)
    parts = _part(b'IHDR', head) + more + _part(b'IDAT', content) + _part(b'IEND', b'')
    return b'\x89PNG\r\n\x1a\n' + parts


def _part(kind: bytes, data: bytes) -> bytes:
    check = zlib.crc32(kind + data)
    return struct.pack('>I', len(data)) + kind + data + struct.pack('>I', check)


def _zeros(size: int) -> bytes:
    press = zlib.compressobj(9)
    return b''.join(press.compress(bytes(2**20)) for _ in range(size // 2**20)) + press.flush()


def _claimed_images() -> Iterator[tuple[str, bytes]]:
    """Names and contents of images of many formats whose headers claim a large size."""
    for side in (20_000, 60_000, 2**31 - 1):
        square, short = struct.pack('<II', side, side), struct.pack('>HH', side % 65536, 65000)
        content = _zeros(2**20 if side > 20_000 else side * (side + 1))
        jpeg = b'\xff\xd8\xff\xc0\x00\x11\x08' + short + b'\3\1\x22\0\2\x11\1\3\x11\1'
        jpeg += b'\xff\xda\x00\x0c\x03\x01\x00\x02\x11\x03\x11\x00\x3f\x00'
        bmp = b'BM' + struct.pack('<IIII', 10**6, 0, 54, 40) + square
        j2k = struct.pack('>HHIIIIIIII', 47, 0, side, side, 0, 0, side, side, 0, 0)
        for kind in ('P5', 'P3'):
            yield f'{kind}_{side}.pgm', f'{kind} {side} {side} 255\n'.encode() + bytes(100)
        yield f'{side}.png', _png(side, side, content)
        yield f'colour_{side}.png', _png(side, side, content[: 2**20], colour=2)
        yield f'{side}.jpg', jpeg + bytes(2000) + b'\xff\xd9'
        yield f'{side}.bmp', bmp + struct.pack('<HHI', 1, 24, 0) + bytes(1000)
        yield f'rle_{side}.bmp', bmp + struct.pack('<HHI', 1, 8, 1) + bytes(1000)
        head = f'#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {side} +X {side}\n'
        yield f'{side}.hdr', head.encode() + bytes(99)
        strips = {273: 200, 278: side, 279: 99}
        yield f'{side}.tif', _tiff({256: side, 257: side, **strips})
        tiles = {322: side, 323: side, 324: 200, 325: 99}
        yield f'tiles_{side}.tif', _tiff({256: side, 257: side, **tiles})
        yield f'{side}.jp2', b'\xff\x4f\xff\x51' + j2k + b'\0\3' + b'\7\1\1' * 3 + bytes(99)
    gif = b'GIF89a\xff\xff\xff\xff\xf0\0\0' + bytes(6)
    yield 'frames.gif', gif + (b',' + bytes(4) + b'\xff\xff\xff\xff\0\2\2D\1\0') * 999 + b';'
    webp = b'WEBPVP8X\x0a\0\0\0' + bytes(4) + b'\xfe\xff\xff\xfe\xff\0'
    yield 'side.webp', b'RIFF' + struct.pack('<I', len(webp)) + webp


def _tiff(tags: Mapping[int, int]) -> bytes:
    tags = dict(sorted({**tags, 258: 8, 259: 8, 262: 1, 277: 1}.items()))
    rows = (struct.pack('<HHII', tag, 4, 1, value) for tag, value in tags.items())
    directory = struct.pack('<H', len(tags)) + b''.join(rows) + bytes(4)
    return (b'II*\0\x08\0\0\0' + directory).ljust(200, b'\0') + zlib.compress(bytes(9999))


def _images() -> Iterator[Hostile]:
    """Images, alone and in folders of frames or masks."""
    text = _part(b'zTXt', b'a\0\0' + zlib.compress(bytes(2**26)))
    profile = _part(b'iCCP', b'a\0\0' + zlib.compress(bytes(2**26)))
    pixel = zlib.compress(bytes(64 * 65))
    found = {
        **dict(_claimed_images()),
        'texts.png': _png(64, 64, pixel, text * 100),
        'profile.png': _png(64, 64, pixel, profile),
        'parts.png': _png(64, 64, pixel, _part(b'tEXt', b'a\0b') * 200_000),
        'longer.png': _png(64, 64, _zeros(2**30)),
        'strange_name\x1b[2J.png': _png(2**20, 64, pixel),
    }
    for name, content in found.items():
        yield Hostile(name, content)
        if name.endswith(('.png', '.jpg', '.tif')):
            yield Hostile(f'folder_{name}', write=partial(_write_frames, name, content))


def _write_frames(name: str, content: bytes, folder: Path) -> None:
    folder.mkdir()
    for number in range(2):
        (folder / f'{number}_{name}').write_bytes(content)


def _box(kind: bytes, content: bytes, size: int | None = None) -> bytes:
    return struct.pack('>I', len(content) + 8 if size is None else size) + kind + content


def _videos(good: Path) -> Iterator[Hostile]:
    video = (good / 'video.avi').read_bytes()
    for side in (20_000, 60_000, 2**31 - 1):
        size = struct.pack('<II', side, side)
        at = video.index(b'strf')
        changed = video[: at + 12] + size + video[at + 20 :]
        yield Hostile(f'format_{side}.avi', changed)
        yield Hostile(f'head_{side}.avi', changed[:64] + size + changed[72:])
        yield Hostile(f'{side}.y4m', f'YUV4MPEG2 W{side} H{side} F25:1 C420\nFRAME\n' + 'x' * 1000)
    at = video.index(b'avih')
    yield Hostile('frames.avi', video[: at + 24] + b'\xff\xff\xff\x7f' + video[at + 28 :])
    yield Hostile('rate.avi', video[: at + 8] + b'\0\0\0\0' + video[at + 12 :])
    file = _box(b'ftyp', b'isom\0\0\0\0isom')
    nested = b''
    for _ in range(3000):
        nested = _box(b'moov', nested)
    itself = '#EXTM3U\n#EXT-X-TARGETDURATION:1\n' + '#EXTINF:1,\nlist.m3u8\n' * 20_000
    for name, content in {
        'nested': file + nested,
        'boxes': file + _box(b'free', b'') * 500_000,
        'tracks': file + _box(b'moov', _box(b'trak', _box(b'tkhd', bytes(84))) * 20_000),
        'zero': file + _box(b'moov', b'', 0) * 100,
        'one': file + _box(b'moov', struct.pack('>Q', 2**63), 1),
        'small': file + _box(b'moov', b'', 4),
        'long': file + _box(b'moov', bytes(100), 2**31),
        'list': itself.encode(),
        'playlist': b'#EXTM3U\n#EXTINF:1,\nfile:///etc/passwd\n#EXTINF:1,\nhttp://127.0.0.1:9/x\n',
        'concat': b'ffconcat version 1.0\nfile /etc/passwd\nfile ../kept/canary\n' * 100,
        'sdp': b'v=0\no=- 0 0 IN IP4 127.0.0.1\nc=IN IP4 127.0.0.1\nt=0 0\nm=video 9 RTP/AVP 96\n',
        'subtitles': b'1\n00:00:00,000 --> 99:00:00,000\n\x1b[2Jx\n' * 10_000,
    }.items():
        for suffix in ('.mp4', '.mkv', '.m3u8')[: 3 if 'list' in name else 2]:
            yield Hostile(f'{name}{suffix}', content)


def _motions() -> Iterator[Hostile]:
    joint = 'JOINT a%d\n{\nOFFSET 0 1 0\nCHANNELS 3 Zrotation Xrotation Yrotation\n'
    channels = 'Xposition Yposition Zposition Zrotation Xrotation Yrotation'
    root = f'HIERARCHY\nROOT Hips\n{{\nOFFSET 0 0 0\nCHANNELS 6 {channels}\n'
    motion = 'MOTION\nFrames: %s\nFrame Time: %s\n'
    row = '0 0 0 0 0 0\n'
    for depth in (500, 20_000):
        deep = ''.join(joint % i for i in range(depth)) + '}\n' * depth
        numbers = '0 ' * (6 + 3 * depth)
        yield Hostile(f'deep_{depth}.bvh', f'{root}{deep}}}\n{motion % (1, 0.03)}{numbers}')
    flat = ''.join(joint % i + '}\n' for i in range(20_000))
    yield Hostile('joints.bvh', f'{root}{flat}}}\n{motion % (1, 0.03)}' + '0 ' * 60_006)
    for number, value in enumerate(('1000000000000', '-1', DIGITS, 'nan', '1e-320', '\x1b[2J', '')):
        for name, text in {
            'frames': f'{root}}}\n{motion % (value, 0.03)}{row}',
            'time': f'{root}}}\n{motion % (2, value)}{row * 2}',
            'value': f'{root}}}\n{motion % (1, 0.03)}0 0 0 0 0 {value}\n',
            'name': f'{root.replace("Hips", value)}}}\n{motion % (1, 0.03)}{row}',
            'channels': f'{root.replace("S 6", f"S {value}")}}}\n{motion % (1, 1)}{row}',
        }.items():
            yield Hostile(f'{name}_{number}.bvh', text)
        amc = f':FULLY-SPECIFIED\n:DEGREES\n{value}\nroot {value} 0 0 0 0 0\n'
        yield Hostile(f'{number}.amc', amc)
    yield Hostile('numbers.bvh', f'{root}}}\n{motion % (1, 0.03)}' + '0 ' * 2_000_000)
    yield Hostile('rows.bvh', f'{root}}}\n{motion % (300_000, 0.03)}' + row * 300_000)


_SUFFIXES = '.mcap .db3 .zstd .yaml .xml .json .toml .npz .csv .trc .png .jpg .mp4 .avi .bvh .amc'


def _no_files() -> Iterator[Hostile]:
    """Links, pipes, folders and other odd things in the place of a file."""
    links = {'zeros': '/dev/zero', 'random': '/dev/urandom', 'memory': '/proc/self/mem'}
    for suffix in _SUFFIXES.split():
        for name, target in links.items():
            yield Hostile(f'{name}{suffix}', write=partial(_link, target))
        yield Hostile(f'circle{suffix}', write=partial(_link, f'circle{suffix}'))
        yield Hostile(f'pipe{suffix}', write=os.mkfifo)
        yield Hostile(f'directory{suffix}', write=Path.mkdir)
        yield Hostile(f'sparse{suffix}', write=_write_sparse)
        yield Hostile(f'empty{suffix}', b'')
        yield Hostile(f'control\x1b[2J\n{suffix}', b'x')
        yield Hostile(f'{"x" * 240}{suffix}', b'x')
    yield Hostile('folder_pipes', write=_write_pipes)
    yield Hostile('folder_links', write=partial(_link, '/proc/self/root'))
    yield Hostile('folder_many', write=_write_many)


def _link(target: str, path: Path) -> None:
    path.symlink_to(target)


def _write_sparse(path: Path) -> None:
    with path.open('wb') as file:
        file.truncate(2**33)


def _write_pipes(path: Path) -> None:
    path.mkdir()
    for suffix in _SUFFIXES.split():
        os.mkfifo(path / f'x_0{suffix}')
    os.mkfifo(path / 'metadata.yaml')


def _write_many(path: Path) -> None:
    path.mkdir()
    for number in range(20_000):
        (path / f'x_{number:06}.json').write_bytes(b'')


def _outputs() -> Iterator[Hostile]:
    """Output paths that lead elsewhere, such as links to folders and files of other users."""
    # A folder in the path of an output is allowed to be a link.
    over = ('written over',)
    yield Hostile('link.out', write=partial(_link, '../kept'), routes=over)
    yield Hostile('linked_file.out', write=partial(_link, '../kept/canary'))
    yield Hostile('nowhere.out', write=partial(_link, '../kept/new'))
    yield Hostile('folder.out', write=_write_linked)
    yield Hostile('file.out', b'alive')
    yield Hostile('pipe.out', write=os.mkfifo)


def _write_linked(path: Path) -> None:
    path.mkdir()
    for name in ('x.npz', 'report.html', '.x.npz.partial'):
        (path / name).symlink_to('../../kept/canary')
