"""MediaPipe Pose, a detector of 33 landmarks of one person, in pixels and in metres.

MediaPipe needs numpy below 2 and libGL. It therefore runs in a process of its own, with the
interpreter of an environment of its own, which `make mediapipe` makes; nothing is downloaded while
it runs. Its landmarks are smoothed from image to image as in a video of 30 images a second.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import weakref
from pathlib import Path
from typing import IO

import numpy as np

from hmt_ros.detectors import mediapipe_worker
from hmt_ros.detectors.mediapipe_worker import LANDMARKS, READY, REPLY, REQUEST
from hmt_ros.image.keypoint_schemes import schemes
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference.arrays import Image, Mask

# Environment variable that names the interpreter.
PYTHON = 'HMT_ROS_DETECTOR_PYTHON'
SCHEME = 'mediapipe33'
# After such an interval without an image the person is sought anew, ns.
_LONGEST_INTERVAL = 1_000_000_000
# Variables of a ROS workspace that would lead the interpreter to packages of another one.
_OF_THIS_INTERPRETER = ('PYTHONPATH', 'PYTHONHOME')


class DetectorError(ValueError):
    """The detector can not run, or has ended; one line."""


class MediaPipePose:
    """MediaPipe Pose, full model, which follows one person from image to image.

    Args:
        python: interpreter that imports MediaPipe; if empty, the one that the environment variable
            HMT_ROS_DETECTOR_PYTHON names, else the one that runs this program.
        with_mask: whether `mask` is wanted as well.

    Attributes:
        mask: (H, W) where the person was seen in the last image; None without `with_mask`.

    Raises:
        DetectorError: the interpreter does not exist, or does not import MediaPipe.
    """

    def __init__(self, python: str = '', *, with_mask: bool = False) -> None:
        self.mask: Mask | None = None
        self._python = python or os.environ.get(PYTHON, '') or sys.executable
        self._with_mask = with_mask
        self._names = schemes()[SCHEME].names
        self._newest: int | None = None
        self._worker: _Worker | None = _Worker(self._python, with_mask)

    def detect(self, image: Image, stamp_ns: int) -> Keypoints | None:
        """The landmarks of the person in an image, named as in the scheme 'mediapipe33'.

        An image that is older than the one before, or younger by more than 1 s, begins a new
        sequence.

        Args:
            image: (H, W, 3) BGR.
            stamp_ns: of the image.

        Returns:
            The keypoints, with unknown covariances, the visibilities as confidences, and positions
            in m from the middle of the hips along the axes of the camera. None: nobody was seen.

        Raises:
            DetectorError: the detector has ended; the next call starts it again.
        """
        height, width = image.shape[:2]
        anew = self._newest is not None and not 0 <= stamp_ns - self._newest <= _LONGEST_INTERVAL
        self._newest = stamp_ns
        if self._worker is None:
            self._worker = _Worker(self._python, self._with_mask)
        try:
            found, mask = self._worker.answer(np.ascontiguousarray(image), anew)
        except DetectorError:
            self.close()
            raise
        if self._with_mask:
            self.mask = np.zeros((height, width), dtype=np.bool_) if mask is None else mask
        if found is None:
            return None
        return Keypoints(
            self._names,
            found[:, :2].copy(),
            np.full((LANDMARKS, 2, 2), np.nan),
            found[:, 2].clip(0.0, 1.0),
            found[:, 3:].copy(),
        )

    def close(self) -> None:
        """Ends the process of the detector; the next image would start it again."""
        if self._worker is not None:
            self._worker.end()
        self._worker = None

    def __enter__(self) -> MediaPipePose:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _Worker:
    """The process of `mediapipe_worker`; it ends with this object at the latest."""

    def __init__(self, python: str, with_mask: bool) -> None:
        self._python, self._with_mask = python, with_mask
        environment = {'GLOG_minloglevel': '2', 'TF_CPP_MIN_LOG_LEVEL': '3', **os.environ}
        if Path(python) != Path(sys.executable):
            for name in _OF_THIS_INTERPRETER:
                environment.pop(name, None)
        # Open as long as the process runs.
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115
        command = [python, str(Path(mediapipe_worker.__file__).resolve())]
        try:
            process = subprocess.Popen(
                [*command, '--mask'] if with_mask else command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._errors,
                env=environment,
                # Who interrupts the program ends this process by closing its input.
                start_new_session=True,
            )
        except OSError as error:
            self._errors.close()
            raise DetectorError(f'{_missing(python)} ({error.strerror})') from error
        assert process.stdin is not None
        assert process.stdout is not None
        self._requests, self._replies = process.stdin, process.stdout
        self.end = weakref.finalize(self, _end, process, self._errors)
        if self._replies.readline() != READY:
            reason = self._last_line()
            self.end()
            raise DetectorError(f'{_missing(python)} ({reason})')

    def answer(self, image: Image, anew: bool) -> tuple[np.ndarray | None, Mask | None]:
        """Rows (33, 6) and mask (H, W) for an image; None where nobody was seen."""
        height, width = image.shape[:2]
        try:
            self._requests.write(REQUEST.pack(height, width, anew))
            self._requests.write(image.data)
            self._requests.flush()
        except OSError:
            raise self._ended() from None
        if not REPLY.unpack(self._read(REPLY.size))[0]:
            return None, None
        rows = np.frombuffer(self._read(8 * 6 * LANDMARKS), '<f8').reshape(LANDMARKS, 6)
        if not self._with_mask:
            return rows, None
        mask = np.frombuffer(self._read(height * width), np.uint8).reshape(height, width)
        return rows, mask.astype(np.bool_)

    def _read(self, size: int) -> bytes:
        data = self._replies.read(size)
        if len(data) < size:
            raise self._ended()
        return data

    def _ended(self) -> DetectorError:
        return DetectorError(
            f'MediaPipe, run by {self._python}, has ended: {self._last_line() or "it says nothing"}'
        )

    def _last_line(self) -> str:
        self._errors.seek(0)
        lines = self._errors.read().decode('utf-8', 'replace').split('\n')
        return next((line.strip() for line in reversed(lines) if line.strip()), '')


def _missing(python: str) -> str:
    return (
        f'{python} can not run MediaPipe: run "make mediapipe", or name by {PYTHON} the Python of '
        'an environment with "pip install mediapipe==0.10.21"'
    )


def _end(process: subprocess.Popen[bytes], errors: IO[bytes]) -> None:
    process.kill()
    process.communicate()
    errors.close()
