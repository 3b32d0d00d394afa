"""Monocular 3D human motion tracking with mixtures, as a library and as ROS 2 nodes."""

import os

__version__ = '1.0.0'

# OpenCV reads these variables when it is loaded. They limit the number of pixels of an image, and
# disable log lines about unusable files, which the package reports itself.
for _name, _value in (
    ('OPENCV_IO_MAX_IMAGE_PIXELS', str(2**26)),
    ('OPENCV_LOG_LEVEL', 'SILENT'),
    ('OPENCV_FFMPEG_LOGLEVEL', '-8'),  # AV_LOG_QUIET
):
    os.environ.setdefault(_name, _value)
