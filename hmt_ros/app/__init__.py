"""The commands: `python -m hmt_ros <command>`, or one executable per command."""

from __future__ import annotations

from hmt_ros.app.command_line import run_program

# Command: (module, description). A module is imported when its command runs.
COMMANDS = {
    'track-video': ('hmt_ros.app.track_video', 'import a video, track the person, write a report'),
    'import-video': (
        'hmt_ros.app.import_video.command',
        'write a video and the keypoints of a detector into a bag',
    ),
    'lift': ('hmt_ros.app.lift', 'estimate the poses of a person from keypoints alone'),
    'replay': (
        'hmt_ros.app.replay.command',
        'track the person in a bag and write the poses into a new bag',
    ),
    'install-detector': (
        'hmt_ros.app.install_detector',
        'install a keypoint detector: MediaPipe Pose, alone or with MoveNet',
    ),
    'report': (
        'hmt_ros.app.report.command',
        'show the mixtures in a bag: pictures, and a page with a 3D view',
    ),
    'export': (
        'hmt_ros.app.export',
        'write the motion of a recorded run as BVH, a table or arrays',
    ),
    'evaluate': ('hmt_ros.app.evaluate', 'compare the mixtures in a bag with ground truth'),
}

DESCRIPTION = 'Monocular 3D human motion tracking with mixtures.'
FURTHER_HELP = """\
ROS 2 runs the same commands, ros2 run hmt_ros <command>, and the nodes filter_node, smoother_node
and bme_node. In a checkout python -m hmt_learning has the commands that render and learn.
"""


def main(argv: list[str] | None = None) -> int:
    """Runs a command; returns 0 on success, 1 for bad input (explained in one line on stderr)."""
    return run_program('hmt_ros', COMMANDS, DESCRIPTION, FURTHER_HELP, argv)
