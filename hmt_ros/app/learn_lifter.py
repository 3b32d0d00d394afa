"""learn-lifter: learns experts that know depth, from recorded motions.

    learn-lifter FILES_OR_FOLDERS ... -o keypoints.npz --test PEOPLE_LEFT_OUT

The tracker takes the file that lies in `hmt_ros/experts/models` as keypoints.npz; any other one by
its path.
"""

from __future__ import annotations

import argparse
from dataclasses import asdict, replace

import numpy as np

from hmt_ros.app.command_line import (
    CommandParser,
    add_people,
    add_seed,
    add_sources,
    model_file,
    run_command,
    whole_number,
)
from hmt_ros.app.learn_motion import chosen_motions, data_card, read_motions, shares_of
from hmt_ros.app.progress import show_progress
from hmt_ros.body import Body, load_body
from hmt_ros.experts.keypoint_training import WindowSettings, keypoint_tracks, training_windows
from hmt_ros.experts.lifter import Lifter
from hmt_ros.experts.lifter_learning import LearningSettings, learn_lifter, lifter_scores
from hmt_ros.experts.network_learning import check_tools
from hmt_ros.experts.training_set import PoseSequence, recorded_sequence

# Windows that a lifter is scored on.
SCORED_WINDOWS = 2000


def main(argv: list[str] | None = None) -> int:
    """Runs the command; returns 0, or 1 after bad input, which one line on stderr explains."""
    return run_command(_parser(), _learn, argv)


def _parser() -> CommandParser:
    usual = LearningSettings()
    parser = CommandParser(
        prog='learn-lifter',
        description='Learns to tell the depths of joints from windows of keypoints.',
    )
    parser.add_motions()
    parser.add_model()
    add_sources(parser)
    add_people(parser)
    parser.add_argument(
        '--steps',
        type=whole_number(1),
        default=usual.steps,
        help=f'number of steps ({usual.steps})',
    )
    parser.add_argument(
        '--batch', type=whole_number(2), default=usual.batch, help=f'windows a step ({usual.batch})'
    )
    parser.add_argument(
        '--experts', type=whole_number(1, 32), default=usual.experts,
        help=f'number of experts ({usual.experts})',
    )  # fmt: skip
    add_seed(parser)
    parser.add_argument(
        '--resume', action='store_true',
        help='go on with a training that was broken off, marked beside FILE as FILE.resume',
    )  # fmt: skip
    return parser


def _learn(options: argparse.Namespace) -> int:
    output, quiet = model_file(options.output, overwrite=options.overwrite), options.quiet
    mark = output.with_suffix('.resume')
    if mark.exists() and not options.resume:
        raise ValueError(f'{mark} marks a training that was broken off: --resume, or remove it')
    check_tools()
    body = load_body(options.body)
    learned, tested = (
        read_motions('learn-lifter', paths, options.body, recorded_sequence, quiet=quiet)
        for paths in (
            chosen_motions(options.motions, options.without),
            [] if options.test is None else chosen_motions([options.test], []),
        )
    )
    shares = shares_of(learned, options.alike, options.alike_share)
    settings = LearningSettings(
        experts=options.experts, steps=options.steps, batch=options.batch, seed=options.seed
    )
    windows = WindowSettings()
    with show_progress('placing', quiet=quiet):
        tracks = keypoint_tracks(body, learned, shares, seed=options.seed)
    notes = {
        'card': data_card(learned, options.acknowledgement),
        'scored on': sorted(one.name for one in tested), 'learning': asdict(settings),
        'windows': asdict(windows),
    }  # fmt: skip
    with show_progress('learning', 'steps', options.steps, quiet=quiet) as bar:
        done = 0

        def told(step: int, _loss: float) -> None:
            nonlocal done
            bar.update(step - done)
            done = step

        lifter = learn_lifter(body, tracks, settings, windows, notes, told, mark)
    if tested:
        lifter.notes['scores'] = _scores(body, tested, lifter, windows)
    lifter.save(output)
    mark.unlink(missing_ok=True)
    if not quiet:
        size = output.stat().st_size / 1e6
        print(f'{output}: {len(learned)} motions, {size:.1f} MB', flush=True)
        for name, value in lifter.notes.get('scores', {}).items():
            print(f'  {name}: {value}', flush=True)
    return 0


def _scores(
    body: Body, tested: list[PoseSequence], lifter: Lifter, windows: WindowSettings
) -> dict[str, str]:
    """Scores on motions of other people, as text by what the keypoints are."""
    tracks = keypoint_tracks(body, tested, [1.0] * len(tested), variants=1)
    known = replace(
        windows, cut=0.0, causal=0.0, gravity_spread=0.0, lengths_spread=0.0, lengths=1.0
    )
    kinds = {
        'clean keypoints': replace(known, noise=0.0),
        'a detector that errs': known,
        'the same, causal': replace(known, causal=1.0),
        'the same, lengths unknown': replace(known, causal=1.0, lengths=0.0),
    }
    result = {}
    for name, kind in kinds.items():
        drawn = training_windows(tracks, SCORED_WINDOWS, np.random.default_rng(0), kind, 0)
        s = lifter_scores(lifter, *drawn)
        result[name] = (
            f'{1e3 * s.heaviest:.0f} mm heaviest, {1e3 * s.best:.0f} best, '
            f'{s.log_density:.2f} nats, {100 * s.within:.0f} % within 90'
        )
    return result
