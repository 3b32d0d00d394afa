"""strangers: commands with files of other programs, compared with plain files.

The development data has small inputs modelled on public bug reports of other projects (`cases`),
cut from a clip with truth. A case is met if the error of the heaviest mode is at most a tenth above
that with a plain file of the same points, or if one line says what to do. The error is that of 13
joints relative to the pelvis, over images whose timestamps are in the truth.
"""

from __future__ import annotations

import contextlib
import io
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.clips import development_folder, table
from benchmarks.command import benchmark_parser, run_benchmark, told
from benchmarks.machine import description
from hmt_ros.app import lift, track_video
from hmt_ros.app.evaluate import score_bag
from hmt_ros.app.replay import command as replay
from hmt_ros.app.truth import read_truth

CLIP, MORE = 'wander', 1.1
_SIZE = ('--fov', '63.7', '--size', '640x480', '--quiet')
_AT_30 = (*_SIZE, '--fps', '30')
_VIDEO = ('--fov', '63.7', '--quiet')


class Case(NamedTuple):
    """A command on a file of a case; `{}` is the folder of the case.

    Attributes:
        name: name of the case.
        program: module of the command.
        arguments: arguments of the command, without -o.
        images: number of images of the plain command for comparison; 0 if success is enough.
        turned: whether the camera hangs upside down.
    """

    name: str
    program: Any
    arguments: tuple[str, ...]
    images: int
    turned: bool = False


_DOWN = ('--gravity', '0', '-0.9895', '0.1447')
CASES = (
    Case('alphapose_cmu', lift, ('{}/results.json', *_AT_30), 45),
    Case('bag_yuv420', replay, ('{}', '--quiet'), 0),
    Case('desk', lift, ('{}/keypoints.npz', '--camera', '{}/camera.yaml', *_SIZE[2:]), 0),
    Case('fisheye_skew', lift,
         ('{}/kp10.json', '--camera', '{}/fisheye_skew.yaml', *_AT_30[2:]), 10),
    Case('gap_in_3d', track_video,
         ('{}/absent.mp4', '--detector', 'mediapipe', '--stature', '1.75', '--level', *_VIDEO), 0),
    Case('idx_list', lift, ('{}/alphapose-results.json', '--person', 'id:0', *_AT_30), 45),
    Case('low_scores', lift, ('{}/predictions.json', *_AT_30), 45),
    Case('mirrored_by_metadata', track_video,
         ('{}/walk.mp4', '--detector', 'mediapipe', *_VIDEO), 0),
    Case('mmpose', lift, ('{}/results_v.json', *_AT_30), 45),
    Case('mmpose, inferencer', lift, ('{}/inferencer.json', *_AT_30), 45),
    Case('unix_times', lift, ('{}/keypoints.csv', *_SIZE), 30),
    Case('upside_down', lift, ('{}/keypoints.npz', *_SIZE, *_DOWN), 45, turned=True),
    Case('upside_down, video', track_video,
         ('{}/walk.mp4', '--keypoints', '{}/keypoints.npz', *_DOWN, *_VIDEO), 60, turned=True),
    Case('whole_body', lift, ('{}/wholebody133.json', *_AT_30), 20),
    Case('whole_body, Halpe', lift, ('{}/halpe136.json', *_AT_30), 20),
)  # fmt: skip


def run_case(case: Case, cases: Path, folder: Path) -> dict[str, Any]:
    """The exit code of a command, its last line on stderr, and the error, mm."""
    here = str(cases / case.name.split(',')[0])
    arguments = [x.replace('{}', here) for x in case.arguments]
    spoken = io.StringIO()
    with contextlib.redirect_stderr(spoken), contextlib.redirect_stdout(io.StringIO()):
        code = case.program.main([*arguments, '-o', str(folder)])
    lines = [line for line in spoken.getvalue().splitlines() if line.strip()]
    said = lines[-1] if lines else ''
    said = said.replace(f'{cases}/', '').replace(f'{folder}/', '')
    result = {'case': case.name, 'code': code, 'said': said, 'mm': np.nan, 'images': case.images}
    if code == 0 and case.images:
        bag = folder / ('lifted' if case.program is lift else 'tracked')
        result['mm'] = heaviest_of(bag, cases.parent / 'video' / CLIP, turned=case.turned)
    return result


def heaviest_of(bag: Path, clip: Path, *, turned: bool = False) -> float:
    """Mean error of the heaviest mode in a bag against the truth of a clip, mm."""
    truth = read_truth(clip / 'truth.npz')
    if turned:
        for joints in truth.joints.values():
            joints *= (-1.0, -1.0, 1.0)
    found = score_bag(bag, truth)
    wanted = ('pose_mixture', 'pose_prediction')
    (scores,) = (x.scores for name, x in found.items() if name.rpartition('/')[2] in wanted)
    return float(scores.summary()['heaviest_mm'])


def plain_of(chosen: Sequence[Case], cases: Path, folder: Path) -> dict[int, float]:
    """Errors of the plain commands on the clip, mm, by number of images."""
    clip, found = cases.parent / 'video' / CLIP, {}
    keypoints = dict(np.load(clip / 'keypoints_mediapipe.npz'))
    for images in sorted({case.images for case in chosen if case.images and case.program is lift}):
        made = folder / f'plain_{images}'
        made.mkdir()
        rows = {
            k: v[:images] if len(v) == len(keypoints['stamps']) else v for k, v in keypoints.items()
        }
        np.savez(made / 'points.npz', **rows)
        with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
            lift.main([str(made / 'points.npz'), '-o', str(made / 'out'), *_AT_30])
        found[images] = heaviest_of(made / 'out' / 'lifted', clip)
    return found


def measure(*, quick: bool = False) -> dict[str, Any]:
    """Results of the commands for all cases.

    Raises:
        FileNotFoundError: the development data are missing.
    """
    cases = development_folder().parent / 'cases'
    if not cases.is_dir():
        raise FileNotFoundError(f'{cases} is absent (set HMT_SHARED)')
    rows = []
    with tempfile.TemporaryDirectory() as made:
        chosen = CASES[:1] if quick else CASES
        for i, case in enumerate(told('strangers', chosen, lambda x: x.name)):
            rows.append(run_case(case, cases, Path(made) / str(i)))
        plain = plain_of(chosen, cases, Path(made))
    return {'machine': description(), 'rows': rows, 'plain_mm': plain}


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """Human-readable table."""
    rows = [['case', 'exit code', 'error, mm', 'plain, mm', 'last line']]
    for one in result['rows']:
        plain = result['plain_mm'].get(one['images'], np.nan)
        numbers = [f'{x:.0f}' if np.isfinite(x) else '-' for x in (one['mm'], plain)]
        rows.append([one['case'], str(one['code']), *numbers, one['said'][:120]])
    return table(rows, markdown=markdown)


def main(argv: list[str]) -> int:
    """Runs the benchmark."""
    parser = benchmark_parser('strangers', __doc__, quick='the first case')
    options = parser.parse_args(argv)
    return run_benchmark(
        'strangers', lambda: measure(quick=options.quick), as_text, as_json=options.json
    )
