"""The tutorials in examples/tutorials: what they print is so, and their pictures show something."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]
TUTORIALS = ROOT / 'examples' / 'tutorials'
NAMES = ('one_image', 'several_people', 'train_experts', 'two_answers', 'video')


def started(name, picture, *words):
    """A script in a process of its own, outside the repository and without ROS."""
    return subprocess.run(
        [sys.executable, TUTORIALS / f'{name}.py', '-o', picture, *words],
        cwd=picture.parent,
        env=os.environ | {'PYTHONPATH': str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )


def printed(name, folder):
    """What a script prints, once its picture is checked."""
    path = folder / 'picture.png'
    done = started(name, path)
    assert (done.returncode, done.stderr) == (0, '')
    picture = cv2.imread(str(path))
    height, width = picture.shape[:2]
    assert width == 1000
    assert 500 < height < 900
    # Neither blank nor a few lines: all columns of tenths but margins have something to see.
    dark = (picture.min(2) < 200).mean(0).reshape(10, -1).mean(1)
    assert (dark > 0.01).sum() >= 7, dark
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 100
    return done.stdout


def numbers(pattern, text):
    """The numbers of all matches, a row each."""
    return [tuple(map(float, x)) for x in re.findall(pattern, text)]


def test_the_page_names_every_tutorial():
    found = sorted(x.stem for x in TUTORIALS.glob('*.py') if x.stem != 'tutorial')
    assert tuple(found) == NAMES
    text = (ROOT / 'examples' / 'README.md').read_text('utf-8')
    assert [name for name in NAMES if f'{name}.py`' not in text] == []


def test_one_image_has_two_answers(tmp_path):
    text = printed('one_image', tmp_path)
    (front,) = numbers(r'(\d+) %: the arm is in front, its wrist ([\d.]+) m', text)
    (behind,) = numbers(r'(\d+) %: the arm is behind, its wrist ([\d.]+) m', text)
    assert front[0] + behind[0] == pytest.approx(100.0, abs=1.0)
    assert min(front[0], behind[0]) > 20.0
    # The arm is in front.
    assert front[1] < 0.2 < 0.6 < behind[1]
    (apart,) = re.findall(r'answers are ([\d.]+) m apart', text)
    assert float(apart) > 0.5


def test_a_video_has_a_band_that_holds_the_truth(tmp_path):
    text = printed('video', tmp_path)
    assert '40 of 40 images have a pose' in text
    ((low, high),) = numbers(r'wrist is ([-\d.]+) to ([-\d.]+) m in front', text)
    # It hangs, then points at the camera, 0.15 and 0.58 m in front of the true pelvis.
    assert low < 0.2
    assert 0.4 < high < 0.7
    (inside,) = re.findall(r'(\d+) % of the true places', text)
    assert int(inside) >= 80
    assert (tmp_path / 'picture_files' / 'report' / 'report.html').is_file()


def test_the_filter_keeps_two_answers_until_images_decide(tmp_path):
    text = printed('two_answers', tmp_path)
    found = dict(line.split(': ', 1) for line in text.splitlines() if ': the arm' in line)
    answers = {
        key: {what: int(share) for share, what in re.findall(r'(\d+) %: the arm is (\w+)', line)}
        for key, line in found.items()
    }
    assert min(answers['1.4 s, filter'].values()) > 20
    assert len(answers['1.4 s, filter']) == 2
    assert answers['1.9 s, filter']['in'] > 95
    assert answers['1.4 s, smoother']['in'] > 90


def test_experts_learn(tmp_path):
    text = printed('train_experts', tmp_path)
    heaviest, best, mean = (float(x) for x in re.findall(r'^([\d.]+) m in the', text, re.MULTILINE))
    assert best < 0.75 * heaviest
    assert heaviest < 0.6 * mean


def test_two_people_keep_their_identities(tmp_path):
    text = printed('several_people', tmp_path)
    seen = re.findall(r'(p\d): in (\d+) of 30 images', text)
    owners = re.findall(r'(p\d): it is person (\d) in (\d+) images, ([\d.]+) m', text)
    assert [name for name, *_ in owners] == [name for name, _ in seen] == ['p1', 'p2']
    assert sorted(person for _, person, *_ in owners) == ['1', '2']
    for (_, count), (_, _, own, away) in zip(seen, owners, strict=True):
        assert int(own) == int(count) >= 25
        assert float(away) < 0.5


@pytest.mark.parametrize(
    ('name', 'words', 'text'),
    [
        ('one_image', ['nosuch'], 'nosuch can not be read'),
        ('one_image', [str(ROOT / 'bags' / 'reach')], 'bags/reach has no keypoints'),
        ('video', ['nosuch.mp4'], 'nosuch.mp4: no such file'),
        ('two_answers', ['nosuch'], 'nosuch can not be read'),
        ('several_people', [str(ROOT / 'bags' / 'reach')], '--people needs the topic detections'),
        ('train_experts', ['--samples', '5'], 'a whole number from 100'),
    ],
)
def test_bad_input_is_one_line(tmp_path, name, words, text):
    picture = tmp_path / 'picture.png'
    done = started(name, picture, *words)
    (line,) = done.stderr.splitlines()
    assert text in line
    assert (done.returncode, done.stdout, picture.exists()) == (1, '', False)
