"""The same bag gives the same bytes on every processor.

Between image and message, functions with processor-specific code are not allowed: BLAS and LAPACK,
elementary functions of numpy and of the C library, and some functions of OpenCV. The core replaces
them.
"""

import ast
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]

# Modules and folders not used between image and message, with reasons.
EXEMPT = {
    'hmt_ros/app': 'commands: what they compute is read by people',
    'hmt_ros/evaluation': 'scores and figures',
    'hmt_ros/detectors': 'the network runs in a library that chooses by processor',
    'hmt_ros/body/moving_skeleton.py': 'files of recorded motion',
    'hmt_ros/experts/expectation_maximisation.py': 'learning',
    'hmt_ros/experts/sparse_bayes.py': 'learning',
    'hmt_ros/experts/training_pairs.py': 'learning',
}
# Exempt classes and functions in other modules: those that learn, and a check of covariances whose
# factors are not used.
BESIDE = {
    'hmt_ros/experts/gates.py': {'_Softmax', 'first', 'learned'},
    'hmt_ros/experts/neighbour_models.py': {'fit'},
    'hmt_ros/inference/random_numbers.py': {'standard_normals'},
    'msg_tools/messages/message_error.py': {'check_covariances'},
}
ELEMENTARY = {
    *('exp', 'exp2', 'expm1', 'log', 'log2', 'log10', 'log1p', 'logaddexp', 'logaddexp2', 'power'),
    *('sin', 'cos', 'tan', 'arcsin', 'arccos', 'arctan', 'arctan2', 'sinh', 'cosh', 'tanh', 'cbrt'),
    *('asin', 'acos', 'atan', 'atan2', 'pow', 'erf', 'erfc', 'gamma', 'lgamma', 'float_power'),
    *('arcsinh', 'arccosh', 'arctanh', 'asinh', 'acosh', 'atanh', 'sinc'),
}
OF_NUMPY = ELEMENTARY | {
    *('matmul', 'dot', 'vdot', 'inner', 'tensordot', 'vecdot', 'convolve', 'correlate', 'cov'),
    *('corrcoef', 'polyfit', 'hypot', 'argpartition'),
}
# numpy's norm along an axis does not use BLAS.
OF_LINALG = {'LinAlgError', 'norm'}
OF_SCIPY = {'scipy.optimize'}  # the assignment of detections only adds and compares
OF_OPENCV = {'warpAffine', 'warpPerspective', 'warpPolar', 'exp', 'log', 'pow', 'gemm', 'solve'}
INTEGERS = {'BINS'}
POWERS = {'2', '2.0', '0.5', '-1', '-1.0'}


def is_in(module, names):
    return any(module == name or module.startswith(f'{name}/') for name in names)


def modules():
    for package in ('hmt_ros', 'msg_tools'):
        for path in sorted((ROOT / package).rglob('*.py')):
            name = path.relative_to(ROOT).as_posix()
            if not is_in(name, EXEMPT):
                yield name


def is_named_by_processor(name):
    """Whether a dotted name is that of a function with processor-specific code."""
    package, _, rest = name.partition('.')
    if not re.fullmatch(r'[\w.]+', rest):
        return False
    known = {'np': OF_NUMPY, 'math': ELEMENTARY, 'cv2': OF_OPENCV}.get(package, set())
    if rest.startswith('linalg.'):
        return package == 'np' and rest.removeprefix('linalg.') not in OF_LINALG
    return rest in known


def is_called_by_processor(call):
    """Whether a call's arguments select processor-specific code, or an unstable order of ties."""
    name, given = ast.unparse(call.func), {keyword.arg for keyword in call.keywords}
    method = name.rpartition('.')[2]
    return (
        (name == 'np.einsum' and 'optimize' in given)
        or (name == 'np.linalg.norm' and 'axis' not in given and len(call.args) < 3)
        or (method == 'argsort' and 'kind' not in given)
        or (method in {'dot', 'standard_normal', 'normal', 'chisquare'} and '.' in name)
        or (method == 'multivariate_normal')
    )


def is_power_by_processor(operation):
    left = operation.left
    whole = isinstance(left, ast.Constant) or ast.unparse(left) in INTEGERS
    return not whole and ast.unparse(operation.right) not in POWERS


def depends_on_processor(node):
    if isinstance(node, ast.BinOp | ast.AugAssign) and isinstance(node.op, ast.MatMult):
        return True
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Pow):
        return is_power_by_processor(node)
    if isinstance(node, ast.Attribute):  # not of what a call returns
        return is_named_by_processor(ast.unparse(node))
    if isinstance(node, ast.ImportFrom):
        module = str(node.module)
        return module in {'math', 'numpy.linalg'} or (
            module.startswith('scipy') and module not in OF_SCIPY
        )
    return isinstance(node, ast.Call) and is_called_by_processor(node)


def calls_by_processor(source, beside=frozenset()):
    """Line and text of processor-dependent calls, outside exempt functions."""
    found = []

    def visit(node):
        if getattr(node, 'name', None) in beside:
            return
        if depends_on_processor(node):
            found.append((node.lineno, ast.unparse(node)))
        for child in ast.iter_child_nodes(node):
            visit(child)

    visit(ast.parse(source))
    return found


@pytest.mark.parametrize(
    'source',
    [
        'a @ b',
        'np.linalg.inv(a)',
        'np.linalg.norm(a)',
        'np.exp(a)',
        'partial(np.logaddexp, a)',
        'math.log(a)',
        'a ** 3',
        'a.argsort()',
        'rng.standard_normal(3)',
        'cv2.warpAffine(image, matrix, size)',
        "np.einsum('i,i', a, b, optimize=True)",
        'from scipy.linalg import cholesky',
    ],
)
def test_what_depends_on_the_processor_is_found(source):
    assert len(calls_by_processor(source)) == 1
    assert calls_by_processor(f'def fit():\n    {source}', {'fit'}) == []


def test_what_does_not_depend_on_the_processor_is_not_found():
    same = 'np.linalg.norm(a, axis=1) * np.einsum("i,i", a, b) + math.sqrt(2**n) - a**2'
    assert calls_by_processor(same) == []


def test_nothing_on_the_way_from_image_to_message_depends_on_the_processor():
    found = {
        f'{name}:{line}': text
        for name in modules()
        for line, text in calls_by_processor(
            (ROOT / name).read_text('utf-8'), BESIDE.get(name, frozenset())
        )
    }
    assert found == {}


def test_what_is_exempt_is_there_and_needs_it():
    def needs(name):
        path = ROOT / name
        files = path.rglob('*.py') if path.is_dir() else [path]
        return any(calls_by_processor(file.read_text('utf-8')) for file in files)

    assert [x for x in (*EXEMPT, *BESIDE) if not needs(x)] == []


def test_the_core_calls_no_elementary_function_of_the_c_library():
    called = re.compile(rf'(?:std|\W)::(?:{"|".join(sorted(ELEMENTARY | {"hypot"}))})[fl]?\(')
    assert called.search('x = std::exp(y)')
    assert not called.search('elementary::exp(y)')
    found = [
        f'{path.name}:{number}'
        for path in sorted((ROOT / 'hmt_ros' / 'core').rglob('*.*'))
        if path.suffix in {'.h', '.cpp'}
        for number, line in enumerate(path.read_text('utf-8').splitlines(), 1)
        if called.search(line.partition('//')[0])
    ]
    assert found == []


# Replays short clips and prints a digest of each topic of filter, predictor and smoother.
RUN = r"""
import hashlib, json, sys
from pathlib import Path
from hmt_ros.app.replay.one_bag import replay_bag
from hmt_ros.app.replay.options import ReplayOptions
from msg_tools import BagReader, BagWriter

bags, folder = Path(sys.argv[1]), Path(sys.argv[2])

def digests_of(clip, name, count, **options):
    source, short = bags / name, folder / clip
    with BagReader(source) as old, BagWriter(short) as new:
        images = 0
        for stored in old.messages():
            images += stored.topic == '/image/compressed'
            if images > count:
                break
            new.write(stored.topic, stored.log_time_ns, stored.message)
    result = folder / f'{clip}_result'
    replay_bag(short, result, ReplayOptions(quiet=True, **options), notify=lambda *_: None)
    digests = {}
    with BagReader(result) as bag:
        for stored in bag.messages():
            digests.setdefault(stored.topic, hashlib.sha256()).update(stored.data)
    return {f'{clip}{topic}': found.hexdigest()[:16] for topic, found in digests.items()}

def known(name, **options):
    source = bags / name
    return {'subject': source / 'subject.yaml', 'background': source / 'background.png', **options}

print(json.dumps({
    **digests_of('keypoints', 'living_room', 12, **known('living_room')),
    **digests_of('anybody', 'living_room', 24, bme='', with_smoother=False),
    **digests_of('images', 'reach', 12, **known('reach'), with_smoother=False),
}))
"""

# Switches that disable processor features; together they emulate a processor of 2008. The core
# detects the processor itself: `test/core` compares the versions of its functions.
SWITCHES = {
    'C library': {
        'GLIBC_TUNABLES': 'glibc.cpu.hwcaps=-AVX2,-AVX2_Usable,-FMA,-FMA_Usable,-FMA4,-AVX,-AVX512F'
        ',-AVX512VL,-AVX512DQ,-ERMS'
    },
    'BLAS': {'OPENBLAS_CORETYPE': 'Nehalem'},
    'numpy': {'NPY_DISABLE_CPU_FEATURES': 'X86_V3 X86_V4 AVX512_ICL'},
    'OpenCV': {
        'OPENCV_CPU_DISABLE': 'AVX512-SKX,AVX2,FP16,AVX,SSE4.2,SSE4.1',
        'OPENCV_IPP': 'sse42',
    },
}
# Digests of some topics, and the versions for which they are valid. After an intended change of
# results, copy the digests from the failed test.
VERSIONS = {'numpy': '2.4.6', 'cv2': '5.0.0'}
DIGESTS = {
    'keypoints/pose_mixture': 'eb6dc3232bcfc94d',
    'keypoints/smoothed_pose_mixture': '77d6b27effac32e9',
    'anybody/pose_mixture': '5c6dc1eb0c760ea4',
    'images/pose_mixture': '97da8f3ee1af5da4',
}


def digests_of_run(folder, **switches):
    """Digests of the topics published by the nodes for the clips, by clip and topic."""
    folder.mkdir()
    done = subprocess.run(
        [sys.executable, '-c', RUN, str(ROOT / 'bags'), str(folder)],
        env=os.environ | {'PYTHONPATH': str(ROOT)} | switches,
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.fixture(scope='module')
def usual_digests(tmp_path_factory):
    return digests_of_run(tmp_path_factory.mktemp('usual') / 'run')


@pytest.mark.skipif(sys.platform != 'linux', reason='other libraries, with other switches')
@pytest.mark.parametrize('names', [*([x] for x in SWITCHES), [*SWITCHES]], ids=' and '.join)
def test_a_run_gives_the_same_bytes_with_the_code_of_another_processor(
    tmp_path, usual_digests, names
):
    switches = {name: value for x in names for name, value in SWITCHES[x].items()}
    found = digests_of_run(tmp_path / 'run', **switches)
    assert found.keys() == usual_digests.keys()
    assert [x for x in usual_digests if found[x] != usual_digests[x]] == []


@pytest.mark.skipif(
    {'numpy': np.__version__, 'cv2': cv2.__version__} != VERSIONS,
    reason=f'the digests are those of {VERSIONS}',
)
def test_a_run_gives_the_bytes_that_are_known(usual_digests):
    assert {name: usual_digests[name] for name in DIGESTS} == DIGESTS
