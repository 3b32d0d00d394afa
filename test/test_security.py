"""External input is data: never executed, never unpickled, always bounded."""

import ast
import re
from pathlib import Path

import pytest

from hmt_learning.motion import rig
from hmt_ros.body import model_file
from hmt_ros.image import subject
from hmt_ros.sessions import camera_session, parameter_file
from msg_tools.bags import bag_metadata, storage
from msg_tools.files import array_file
from msg_tools.messages import detections, images, keypoints, pose_mixtures

ROOT = Path(__file__).resolve().parents[1]
FILES = sorted(
    path
    for folder in ('hmt_ros', 'hmt_learning', 'msg_tools', 'launch')
    for path in (ROOT / folder).rglob('*.py')
)
# Modules that execute what they read, or open connections.
FORBIDDEN_MODULES = {
    'pickle', 'cPickle', 'dill', 'cloudpickle', 'joblib', 'shelve', 'marshal', 'code', 'codeop',
    'http', 'urllib.request', 'requests', 'ftplib', 'smtplib', 'telnetlib', 'xmlrpc',
    'socket', 'socketserver', 'ssl', 'torch',
}  # fmt: skip
# Allowed uses of forbidden modules, which open no connection.
ALLOWED = {
    # Reserves the number of a ROS domain for a replay, without listening.
    ('hmt_ros/app/replay/player.py', 'socket'),
}
FORBIDDEN_CALLS = {
    'eval', 'exec', 'compile', '__import__', 'os.system', 'os.popen', 'yaml.load_all',
    'yaml.unsafe_load', 'yaml.full_load', 'np.loadtxt', 'np.genfromtxt', 'np.fromfile',
}  # fmt: skip


def faults(text, name):
    """Forbidden actions of a source file."""
    found = []
    for node in ast.walk(ast.parse(text)):
        modules = []
        if isinstance(node, ast.Import):
            modules = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and not node.level:
            modules = [str(node.module), *(f'{node.module}.{alias.name}' for alias in node.names)]
        for module in modules:
            known = {module, module.partition('.')[0]}
            if known & FORBIDDEN_MODULES and (name, module) not in ALLOWED:
                found.append(f'imports {module}')
        if isinstance(node, ast.Call):
            found += faults_of_call(node)
    return found


def faults_of_call(call):
    function = ast.unparse(call.func)
    words = {word.arg: ast.unparse(word.value) for word in call.keywords}
    found = [function] if function in FORBIDDEN_CALLS else []
    if words.get('shell', 'False') != 'False':
        found.append(f'{function} through a shell')
    if function in ('np.load', 'numpy.load') and words.get('allow_pickle') != 'False':
        found.append(f'{function} without allow_pickle=False')
    if function == 'yaml.load' and words.get('Loader') != '_PlainLoader':
        found.append(f'{function} with another loader')
    return found


def test_nothing_that_is_read_is_executed():
    found = {str(x.relative_to(ROOT)): x.read_text('utf-8') for x in FILES}
    assert {name: wrong for name, text in found.items() if (wrong := faults(text, name))} == {}


def test_limits_are_those_of_the_page():
    page = (ROOT / 'docs' / 'security.md').read_text('utf-8')
    table = page.partition('## Limits')[2].partition('\n## ')[0]
    stated = {int(text.replace(' ', '')) for text in re.findall(r'\*\*([\d ]+)\*\*', table)}
    limits = {
        images.MAX_PIXELS,
        images.MAX_JPEG_SCANS,
        images.FREE_PIXELS,
        camera_session._MAX_PICTURE_BYTES,
        pose_mixtures.MAX_COMPONENTS,
        keypoints.MAX_KEYPOINTS,
        detections.MAX_PEOPLE,
        model_file.MAX_FILE_BYTES,
        subject.MAX_FILE_BYTES,
        parameter_file.MAX_FILE_BYTES,
        rig.MAX_FILE_BYTES,
        rig.MAX_MOTION,
        array_file.MAX_ARCHIVE_BYTES,
    }
    assert limits <= stated


def test_limits_of_bags_are_those_of_the_page():
    page = (ROOT / 'docs' / 'security.md').read_text('utf-8')
    (row,) = (line for line in page.splitlines() if line.startswith('| bag |'))
    stated = [int(text.replace(' ', '')) for text in re.findall(r'\*\*([\d ]+)\*\*', row)]
    assert stated == [storage.MAX_CHUNK_BYTES, bag_metadata.MAX_BYTES]


def test_each_promise_of_the_page_names_a_test_that_exists():
    page = (ROOT / 'docs' / 'security.md').read_text('utf-8')
    promises = page.partition('## Files')[2].partition('\n## Limits')[0]
    rows = [line for line in promises.splitlines() if line.startswith('| ') and line[2] != 'p']
    named = [re.fullmatch(r'\| .+\. \| `(test/[\w/]+\.py)::(test_\w+)` \|', row) for row in rows]
    assert len(named) > 20
    assert [row for row, match in zip(rows, named, strict=True) if match is None] == []
    wrong = [
        match[0]
        for match in named
        if f'def {match[2]}(' not in (ROOT / match[1]).read_text('utf-8')
    ]
    assert wrong == []


@pytest.mark.ros
def test_limits_of_messages_are_those_of_the_page():
    from hmt_ros.nodes import subscribed_topic
    from hmt_ros.sessions import image_inputs

    page = (ROOT / 'docs' / 'security.md').read_text('utf-8')
    stated = {int(text.replace(' ', '')) for text in re.findall(r'\*\*([\d ]+)\*\*', page)}
    assert {
        image_inputs.MAX_MESSAGE_BYTES,
        image_inputs.MAX_MASK_BYTES,
        image_inputs.MAX_DEPTH_BYTES,
    } <= stated
    assert subscribed_topic.MAX_IMAGE_BYTES in stated
