"""A new detector, background, term or command is a new file and a line in a table."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import types
from pathlib import Path

import numpy as np
import pytest

from hmt_ros import app
from hmt_ros.app.import_video import command as import_video
from hmt_ros.detectors.detector import DetectorKind
from hmt_ros.detectors.registry import DETECTORS
from hmt_ros.image import background
from hmt_ros.image.background import BackgroundModel, BackgroundSettings
from hmt_ros.image.pixel_backgrounds import FOREGROUND_LABEL
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.sessions.camera_session import IMAGE
from hmt_ros.sessions.declared_parameters import with_values
from hmt_ros.sessions.keypoints_session import KeypointsParameters, KeypointsSession
from msg_tools import BagReader
from test.sessions.conftest import Somebody

ROOT = Path(__file__).resolve().parents[1]


class Corner:
    """A detector that sees a nose in the corner of every image."""

    def __init__(self, *, with_mask):
        self.mask = None

    def detect(self, image, stamp_ns):
        return Keypoints(('nose',), np.zeros((1, 2)), np.full((1, 2, 2), np.nan), np.ones(1))


@pytest.fixture
def corner(monkeypatch):
    installed = []
    kind = DetectorKind('Corner', Corner, lambda: True, lambda: installed.append('corner'))
    monkeypatch.setitem(DETECTORS, 'corner', kind)
    return installed


def test_a_detector_is_a_file_and_a_line(corner, tmp_path, capsys):
    # The node.
    outputs = []
    parameters = with_values(KeypointsParameters(), {'detector': 'corner'})
    session = KeypointsSession(parameters, outputs.append)
    assert session.take(IMAGE, Somebody().image(0)).faults == ()
    assert [output.topic for output in outputs] == ['keypoints', 'keypoints_3d']
    assert session.state.landmarks == 1
    with pytest.raises(ValueError, match=r"detector must be one of .*, saw 'edge'"):
        with_values(KeypointsParameters(), {'detector': 'edge'})
    # The video import, here of two images.
    for name in ('1.png', '2.png'):
        import_video.cv2.imwrite(str(tmp_path / name), np.zeros((48, 64, 3), np.uint8))
    given = [str(tmp_path), '-o', str(tmp_path / 'bag'), '--fov', '60', '--fps', '10']
    assert import_video.main([*given, '--detector', 'corner', '--quiet']) == 0
    with BagReader(tmp_path / 'bag') as bag:
        names = [stored.message.names for stored in bag.messages(['keypoints'])]
    assert names == [['nose'], ['nose']]
    # The installation of the detector.
    assert app.main(['install-detector', 'corner']) == 0
    assert (corner, capsys.readouterr().out) == (['corner'], 'Corner is installed\n')


class Bright:
    """A background model that takes everything brighter than 200 as foreground."""

    repeats = 1

    def __init__(self, threshold, shadow_threshold):
        self.empty = np.zeros((0, 0, 3), np.uint8)

    def learn(self, image, share):
        self.empty = image.copy()

    def labels(self, image):
        return np.where(image.max(2) > 200, np.uint8(FOREGROUND_LABEL), np.uint8(0))


def test_a_background_is_a_file_and_a_line(monkeypatch):
    monkeypatch.setitem(background.BACKGROUNDS, 'bright', Bright)
    model = BackgroundModel(BackgroundSettings(method='bright'))
    image = np.full((48, 64, 3), 90, np.uint8)
    model.learn(image)
    image[10:30, 20:40] = 250
    found = model.silhouette(image)
    assert found[10:30, 20:40].all()
    assert found.sum() == 400
    model.forget()
    assert model.unknown.all()


TERM = """
from typing import NamedTuple
from hmt_ros.image.terms.image_term import ImageTerm, TermSettings, Weighting

class Inputs(NamedTuple):
    term: Weighting
    brightness: float

BRIGHTNESS = ImageTerm(
    'brightness', 'Brightness of the image', TermSettings(2.0, 1.0, 1.0),
    lambda window: float(window.image.mean()),
    lambda term, evidence: Inputs(term, float(evidence or 0.0)),
)
"""
HEADER = """
#pragma once
#include "../pose_view.h"

namespace hmt {

struct BrightnessInputs {
  Weighting term;
  double brightness;
};

inline double add_term(const PoseView&, const BrightnessInputs& inputs, const Sums&) {
  return inputs.term.weight * inputs.brightness;
}

}  // namespace hmt
"""
TRY_TERM = """
import numpy as np
from hmt_ros.body import Camera, load_body
from hmt_ros.image.likelihood import ImageLikelihood, LikelihoodSettings
from hmt_ros.image.observation import observe
from hmt_ros.image.pose_energy import PoseEnergy
from hmt_ros.image.terms.image_term import TermSettings

body, camera = load_body('human32'), Camera(100.0, 100.0, 31.5, 23.5, 64, 48)
settings = LikelihoodSettings.of_terms(brightness=TermSettings(3.0, 1.0, 1.0))
poses = np.zeros((2, body.dimension))
poses[:, 2] = 3.0
observation = observe(np.full((48, 64, 3), 60, np.uint8))
likelihood = ImageLikelihood(body, camera, settings)
energy = PoseEnergy(likelihood, likelihood.seen(observation))
print(energy.by_cue(poses, derivatives=False).values[:, 0].tolist())
"""


def put(path, changes):
    """Replaces texts that each occur once in a file."""
    text = path.read_text('utf-8')
    for old, new in changes.items():
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    path.write_text(text, 'utf-8')


def test_a_likelihood_term_is_two_files_and_two_lines(tmp_path):
    """In a copy of the package, with the core compiled without optimisation to save time."""
    for name in ('hmt_ros', 'msg_tools'):
        ignored = shutil.ignore_patterns('__pycache__', '*.so')
        shutil.copytree(ROOT / name, tmp_path / name, ignore=ignored)
    shutil.copy(ROOT / 'setup.py', tmp_path)
    package = tmp_path / 'hmt_ros'
    terms = package / 'image' / 'terms'
    (terms / 'brightness.py').write_text(TERM, 'utf-8')
    first = 'from hmt_ros.image.terms.depth import DEPTH\n'
    more = 'from hmt_ros.image.terms.brightness import BRIGHTNESS\n'
    put(terms / 'registry.py', {first: more + first, 'DEPTH)': 'DEPTH, BRIGHTNESS)'})
    (package / 'core' / 'terms' / 'brightness.h').write_text(HEADER, 'utf-8')
    include = '#include "terms/coverage.h"\n'
    more = '#include "terms/brightness.h"\n'
    put(
        package / 'core' / 'terms.h',
        {include: more + include, 'DepthInputs>': 'DepthInputs, BrightnessInputs>'},
    )
    put(tmp_path / 'setup.py', {"'-O3'": "'-O0', '-g0'"})
    environment = {**os.environ, 'PYTHONPATH': str(tmp_path)}
    for command in (['setup.py', '-q', 'build_ext', '--inplace'], ['-c', TRY_TERM]):
        done = subprocess.run(
            [sys.executable, *command],
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
    assert done.stdout == '[180.0, 180.0]\n'


def test_a_command_is_a_file_and_a_line(monkeypatch, capsys):
    module = types.ModuleType('hmt_ros.app.greet')
    module.main = lambda argv: print('hello', *argv) or 0
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setitem(app.COMMANDS, 'greet', (module.__name__, 'say hello'))
    assert app.main(['greet', 'you']) == 0
    assert app.main(['--help']) == 0
    found = capsys.readouterr().out
    assert found.startswith('hello you\n')
    assert '  greet' in found
