"""The frames that the messages of one camera name: they are to be one.

Two publishers on one topic, or the camera_info of another camera, else go unnoticed.
"""

from __future__ import annotations

from collections.abc import Callable

# Frames that are remembered; a camera has one.
_MOST_FRAMES = 8


class NamedFrames:
    """The frames that the messages of a camera name.

    Args:
        image, info: what sessions call the sources of images and of camera_info.
    """

    def __init__(self, image: str, info: str) -> None:
        self._image, self._info = image, info
        self._seen: dict[str, list[str]] = {image: [], info: []}

    def see(self, source: str, frame_id: str, naming: Callable[[str], str]) -> list[str]:
        """Takes the frame of a message; returns what is to be warned of, once for each frame.

        Args:
            source: of the message.
            frame_id: may be empty.
            naming: names a source for the user.
        """
        seen, other = self._seen[source], self._info if source == self._image else self._image
        if not frame_id or frame_id in seen or len(seen) == _MOST_FRAMES:
            return []
        texts = []
        if seen:
            texts.append(
                f'{naming(source)} has messages of the frames {seen[-1]!r} and {frame_id!r}: '
                'wanted those of one camera; stop or remap one of the publishers'
            )
        elif self._seen[other] and frame_id not in self._seen[other]:
            frames = {source: frame_id, other: self._seen[other][-1]}
            texts.append(
                f'{naming(self._image)} has frame_id {frames[self._image]!r}, '
                f'{naming(self._info)} has {frames[self._info]!r}: results are in that of the '
                'image; if both are of one camera, set one frame_id in its driver, else remap '
                'camera_info'
            )
        seen.append(frame_id)
        return texts
