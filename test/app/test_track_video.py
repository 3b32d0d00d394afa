"""track-video: from a video to bags and a report."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from hmt_ros.app import main, track_video
from hmt_ros.app.evaluate import score_bag
from hmt_ros.app.truth import read_truth
from hmt_ros.body import load_body
from hmt_ros.detectors.registry import DETECTORS
from hmt_ros.tracking import read_subject
from test.app.conftest import data_of
from test.test_docs import ROOT, commands


@pytest.fixture(autouse=True)
def installed(monkeypatch):
    """Names of installed detectors; empty in all tests that do not fill it."""
    names: list[str] = []
    for name, kind in DETECTORS.items():
        answer = partial(names.__contains__, name)
        monkeypatch.setitem(DETECTORS, name, replace(kind, is_installed=answer))
    return names


@pytest.fixture
def begun(monkeypatch):
    """Recorded options of imports, settings of replays and notes of reports, which do not run."""
    seen = SimpleNamespace(imports=[], settings=[], notes=[])
    monkeypatch.setattr(
        track_video, 'import_video', lambda options, notify: seen.imports.append(options)
    )
    monkeypatch.setattr(
        track_video, 'replay_bag',
        lambda source, target, options, notify: seen.settings.append(options.settings),
    )  # fmt: skip

    def write_report(options):
        seen.notes.append(options.notes)
        return None, ''

    monkeypatch.setattr(track_video, 'write_report', write_report)
    return seen


def run(folder, *options):
    command = [str(folder / 'walk.mp4'), '--fov', '60', '--quiet']
    return track_video.main([*command, *options])


def keypoints(folder):
    return ['--keypoints', str(folder / 'walk.json')]


def test_from_video_to_report(walk_video, tmp_path, monkeypatch, capsys):
    """Runs the command line of the README."""
    out = tmp_path / 'walk'
    for name in ('walk.mp4', 'walk.json'):
        (tmp_path / name).symlink_to(walk_video / name)
    monkeypatch.chdir(tmp_path)
    (words,) = (
        words
        for words, _ in commands(ROOT / 'README.md')
        if 'track-video' in words and '--keypoints' in words
    )
    assert main(words[3:]) == 0, capsys.readouterr().err
    told = capsys.readouterr().out.splitlines()
    assert told[0] == 'walk/video: 8 images, 8 with keypoints'
    assert 'walk/tracked: 7 of 8 images tracked' in told
    assert sorted(x.name for x in out.iterdir()) == ['report', 'tracked', 'video']
    assert (out / 'report' / 'report.html').stat().st_size > 100_000
    truth = read_truth(walk_video / 'rendered' / 'truth.npz')
    scored = score_bag(out / 'tracked', truth, topics=['pose_mixture'])['/pose_mixture']
    assert len(scored.scores) == 7
    # The first images determine limb depths poorly; a correct facing is below 0.2 m.
    assert np.median(scored.scores.best) < 0.1
    assert run(walk_video, '-o', str(out), *keypoints(walk_video)) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line == f'track-video: {out}/video exists; give another name, or --overwrite'


def test_a_stature_and_a_subject_file(walk_video, tmp_path, monkeypatch):
    """A stature makes a subject file from keypoints; one that is given is used as it is."""
    used = []

    def replay_bag(source, target, options, notify):
        used.append(options.subject)
        raise ValueError('enough')

    monkeypatch.setattr(track_video, 'replay_bag', replay_bag)
    out = tmp_path / 'walk'
    assert run(walk_video, '-o', str(out), *keypoints(walk_video), '--stature', '1.75') == 1
    written = out / 'subject.yaml'
    assert read_subject(written, load_body('human37')).stature == 1.75
    assert run(walk_video, '-o', str(tmp_path / 'given'), '--subject', str(written)) == 1
    assert used == [written, written]
    assert [x.name for x in (tmp_path / 'given').iterdir()] == ['video']


def video(path, pictures, fps=10.0):
    kind = cv2.VideoWriter_fourcc(*'mp4v')
    writer = cv2.VideoWriter(str(path), kind, fps, pictures[0].shape[1::-1])
    for picture in pictures:
        writer.write(picture)
    writer.release()
    return path


def test_nobody_in_the_whole_video(tmp_path, capsys):
    rng = np.random.default_rng(0)
    pictures = list(rng.integers(0, 256, (3, 48, 64, 3), dtype=np.uint8))
    source, out = video(tmp_path / 'empty.mp4', pictures), tmp_path / 'out'
    (tmp_path / 'nobody.json').write_text('[]', 'utf-8')
    arguments = [str(source), '-o', str(out), '--fov', '60', '--stature', '1.7']
    assert track_video.main([*arguments, '--keypoints', str(tmp_path / 'nobody.json')]) == 0
    told = capsys.readouterr()
    assert 'tracked: 0 of 3 images tracked' in told.out
    assert 'nobody is found at 3 of 3 times' in told.out
    assert 'wanted 4 at least: --stature is not used' in told.err
    assert 'nobody is found in its 3 images' in told.err
    data = data_of((out / 'report' / 'report.html').read_text('utf-8'))
    assert np.allclose(data['times'], [0.0, 0.1, 0.2])
    assert (data['layers'], len(data['images']['jpegs'])) == ([], 3)
    assert not (out / 'subject.yaml').exists()


def test_without_options_the_detector_and_the_usual_lens_are_used(
    walk_video, begun, installed, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    installed.append('mediapipe')
    assert track_video.main([str(walk_video / 'walk.mp4'), '--quiet']) == 0
    (options,) = begun.imports
    assert options.output == Path('walk_tracked/video')
    assert (options.detector, options.fov, options.vertical_fov) == ('mediapipe', 60.0, None)
    # Its error is in the results, its explanation on stderr and on the page.
    assert begun.settings == [['focal_length_sigma=0.2']]
    (note,) = begun.notes[0]
    assert note.startswith('the field of view is assumed to be 60 degrees along the longer side')
    assert capsys.readouterr().err == f'track-video: {note}\n'


def test_the_surest_detector_is_used(walk_video, begun, installed, tmp_path):
    out = ['-o', str(tmp_path / 'out'), '--overwrite']
    for name in ('mediapipe', 'mediapipe+movenet'):
        installed.append(name)
        assert run(walk_video, *out) == 0
    assert run(walk_video, *out, '--detector', 'mediapipe') == 0
    used = [options.detector for options in begun.imports]
    assert used == ['mediapipe', 'mediapipe+movenet', 'mediapipe']


def test_what_is_given_is_not_assumed(walk_video, begun, installed, tmp_path, capsys):
    installed.append('mediapipe')
    out = ['-o', str(tmp_path / 'out'), '--overwrite']
    assert run(walk_video, *out, *keypoints(walk_video)) == 0
    assert run(walk_video, *out, '--no-detector', '--background', str(ROOT / 'README.md')) == 0
    assert [options.detector for options in begun.imports] == [None, None]
    assert begun.settings == [[], []]
    assert capsys.readouterr().err == ''
    # Settings of the user come last.
    given = ['--set', 'focal_length_sigma=0.05']
    assert track_video.main([str(walk_video / 'walk.mp4'), '--quiet', *out, *given]) == 0
    assert begun.settings[-1] == ['focal_length_sigma=0.2', 'focal_length_sigma=0.05']


def test_several_people(walk_video, begun, tmp_path, monkeypatch):
    replayed = []
    monkeypatch.setattr(track_video, 'replay_bag', lambda *given: replayed.append(given[2]))
    assert run(walk_video, '-o', str(tmp_path / 'out'), '--people', '3') == 0
    (options,) = begun.imports
    assert (options.people, options.detector) == (3, None)
    assert replayed[0].people is True


def test_metadata_tell_the_lens(walk_video, begun, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(track_video, 'metadata_fov', lambda path: 69.4)
    out = ['-o', str(tmp_path / 'out'), '--no-detector']
    assert track_video.main([str(walk_video / 'walk.mp4'), '--quiet', *out]) == 0
    assert begun.imports[0].fov == 69.4
    assert begun.settings == [['focal_length_sigma=0.1']]
    assert 'by the metadata 69 degrees' in capsys.readouterr().err


@pytest.mark.parametrize(
    ('options', 'message'),
    [
        (['--stature', '1.7'], '--stature goes with --keypoints, or with a detector'),
        (['--subject', 'nothing.yaml'], 'nothing.yaml: no such file'),
        (['--subject', 'a.yaml', '--stature', '1.7'], '--stature: not allowed with argument'),
        (['--keypoints', 'nothing.json'], 'nothing.json: no such file'),
        (['--people', '2', '--stature', '1.7'], '--stature is for one person'),
        (['--people', '2', '--subject', 'a.yaml'], '--subject is for one person'),
        (['--camera', 'camera.yaml'], '--camera: not allowed with argument --fov'),
    ],
)
def test_bad_input_is_one_line(walk_video, options, message, tmp_path, capsys):
    assert run(walk_video, '-o', str(tmp_path / 'out'), *options) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith('track-video: ')
    assert message in line
    assert not (tmp_path / 'out').exists()
