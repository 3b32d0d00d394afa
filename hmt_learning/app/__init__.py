"""The commands: `python -m hmt_learning <command>`."""

from __future__ import annotations

from hmt_ros.app.command_line import run_program

# Command: (module, description).
COMMANDS = {
    'make-bag': ('hmt_learning.app.make_bag', 'render a motion into a bag with ground truth'),
    'train': ('hmt_learning.app.train', 'learn a predictor of poses from silhouettes'),
    'learn': (
        'hmt_learning.app.learn',
        'learn lengths, angles or motion of people, or depth from keypoints',
    ),
}
ABOUT = 'Rendering and learning for hmt_ros, from motion files.'


def main(argv: list[str] | None = None) -> int:
    """Runs a command; returns 0, or 1 after bad input, which one line on stderr explains."""
    return run_program('hmt_learning', COMMANDS, ABOUT, argv=argv)
