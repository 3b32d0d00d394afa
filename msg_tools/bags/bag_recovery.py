"""Writes a new bag from the intact parts of one that was cut off or damaged."""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from msg_tools.bags.bag_metadata import (
    DATABASE_SUFFIXES,
    FILE_NAME,
    MCAP_SUFFIXES,
    read_file_names,
    recorded_quality_of_service,
)
from msg_tools.bags.bag_writer import BagFolder, unfinished_folders
from msg_tools.bags.contents import BagError, Channel, absolute_name, reason
from msg_tools.bags.mcap_records import ZSTD_MAGIC, DecompressionError, decompress_file
from msg_tools.bags.mcap_salvage import (
    Loss,
    McapSalvage,
    Saved,
    SavedAttachment,
    SavedChannel,
    SavedMessage,
    SavedMetadata,
)

# Written anew.
_OWN_METADATA = 'rosbag2'
# Encoding of the messages of ROS 2.
_OF_ROS_2 = 'cdr'


@dataclass(frozen=True)
class Recovery:
    """Result of the recovery of a bag.

    Attributes:
        path: the new bag.
        messages: how many were saved.
        topics: number of their topics.
        lost_messages: how many were not; None if the bag has no count of its messages.
        losses: one line for each loss.
    """

    path: Path
    messages: int
    topics: int
    lost_messages: int | None
    losses: tuple[str, ...]


def recover_bag(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    progress: Callable[[int | None], object] = lambda total: None,
) -> Recovery:
    """Writes a new bag with all that is whole in another.

    Args:
        source: folder, also without metadata.yaml; an .mcap file, also compressed with zstd; or the
            name of a bag whose writer was killed, so that only its hidden folder is there.
        target: folder of the new bag; nothing that is there is overwritten.
        progress: called for each message that was saved, with the number of messages that the bag
            had; None where it does not tell.

    Raises:
        BagError: there is nothing to be saved, the target is there, the disk is full; then nothing
            is written.
    """
    if os.path.lexists(target):
        raise BagError(f'{target} exists, and nothing is overwritten; give another name')
    paths, losses = _files(Path(source))
    with _opened(Path(source), paths, losses) as files:
        # Opened before: a bag that can not be read at all is an error before anything is written.
        folder = BagFolder(target, profile=_profile(files))
        try:
            channels: dict[Channel, int] = {}
            topics: set[str] = set()
            messages = 0
            total = _announced(files)
            for file in files:
                for saved in file.content():
                    _write(folder, channels, saved)
                    if isinstance(saved, SavedMessage):
                        messages += 1
                        topics.add(saved.channel.channel.topic)
                        progress(total)
            for file in files:
                losses += [_line(file, loss) for loss in file.losses]
            if not messages:
                why = f': {losses[0]}' if losses else ''
                raise BagError(f'{source} has no message that could be saved{why}')
            folder.close()
        except BaseException:
            folder.abort()
            raise
        announced = _announced(files)
    lost = None
    if announced is not None and len(losses) == sum(len(file.losses) for file in files):
        lost = max(0, announced - messages)
    elif not losses:
        lost = 0
    return Recovery(folder.path, messages, len(topics), lost, tuple(losses))


def _announced(files: list[McapSalvage]) -> int | None:
    """Number of messages that the files had when they were complete; None if one does not tell."""
    counts = [file.announced for file in files if file.announced is not None]
    return sum(counts) if len(counts) == len(files) else None


def _profile(files: list[McapSalvage]) -> str:
    profiles = {file.profile for file in files}
    return profiles.pop() if len(profiles) == 1 else 'ros2'


def _write(folder: BagFolder, channels: dict[Channel, int], saved: Saved) -> None:
    if isinstance(saved, SavedMetadata):
        if saved.name != _OWN_METADATA:
            folder.add_metadata(saved.name, saved.content)
    elif isinstance(saved, SavedAttachment):
        folder.add_attachment(
            saved.name, saved.media_type, saved.log_time, saved.create_time, saved.data
        )
    elif isinstance(saved, SavedChannel):
        _key(folder, channels, saved)
    else:
        folder.add_message(
            _key(folder, channels, saved.channel),
            saved.log_time,
            bytes(saved.data),
            saved.publish_time,
            saved.sequence,
        )


def _key(folder: BagFolder, channels: dict[Channel, int], saved: SavedChannel) -> int:
    channel = saved.channel
    if channel.encoding == _OF_ROS_2:
        # As rosbag2 records it; topics of other systems may have names of another kind.
        channel = channel._replace(topic=absolute_name(channel.topic))
    key = channels.get(channel)
    if key is None:
        offered = recorded_quality_of_service(saved.offered_qos)
        key = channels[channel] = folder.add_channel(channel, offered, saved.type_hash)
    return key


def _line(file: McapSalvage, loss: Loss) -> str:
    text = f'{file.name} {loss.why}'
    if loss.end > loss.start:
        text += f' (bytes {loss.start} to {loss.end})'
    return text


# Files of a damaged bag


def _files(source: Path) -> tuple[list[Path], list[str]]:
    """Files to look into, in their order; and a line for each missing one."""
    try:
        if not os.path.lexists(source):
            source = _unfinished(source)
        if not source.is_dir():
            if not source.is_file():
                raise BagError(f'{source} is neither a file nor a folder')
            _check_database([source])
            return [source], []
        inside = sorted(source.iterdir(), key=_by_number)
    except (OSError, ValueError) as error:
        if isinstance(error, BagError):
            raise
        raise BagError(f'{source} can not be read: {reason(error)}') from error
    paths = [path for path in inside if path.name.endswith(MCAP_SUFFIXES) and path.is_file()]
    if not paths:
        _check_database(inside)
        raise BagError(f'{source} has no .mcap file')
    try:
        named = read_file_names(source)
    except BagError:
        # Recorders write it at the end, so that a recording that was cut off lacks it.
        named = []
    there = {path.name for path in paths}
    missing = [
        f'{name}, which {FILE_NAME} names, is missing' for name in named if name not in there
    ]
    return paths, missing


def _unfinished(source: Path) -> Path:
    """The hidden folder of a bag that was not completed."""
    found = unfinished_folders(source)
    if not found:
        raise BagError(f'{source} is not there')
    if len(found) > 1:
        names = ', '.join(str(path) for path in found)
        raise BagError(f'{source} was begun several times: name one of {names}')
    return found[0]


def _by_number(path: Path) -> list[tuple[int, str]]:
    """Orders name_2 before name_10."""
    parts = re.split(r'(\d+)', path.name)
    return [(int(part), '') if part.isdigit() else (-1, part) for part in parts]


def _check_database(paths: list[Path]) -> None:
    for path in paths:
        if path.name.endswith(DATABASE_SUFFIXES):
            raise BagError(
                f'{path} is a database, which keeps by itself what was written: it can be read as '
                'it is, and `ros2 bag reindex` writes its metadata anew'
            )


@contextmanager
def _opened(source: Path, paths: list[Path], losses: list[str]) -> Iterator[list[McapSalvage]]:
    """The files that are MCAP files; those compressed as a whole are read through copies."""
    with tempfile.TemporaryDirectory(prefix='bag_recovery.') as scratch:
        files = []
        for number, path in enumerate(paths):
            try:
                with path.open('rb') as file:
                    packed = file.read(len(ZSTD_MAGIC)) == ZSTD_MAGIC
                plain = Path(scratch) / str(number) if packed else path
                if packed:
                    losses += _decompressed(path, plain)
            except OSError as error:
                raise BagError(f'{path} can not be read: {reason(error)}') from error
            try:
                files.append(McapSalvage(plain, path.name))
            except BagError as error:
                losses.append(str(error))
        if not files:
            raise BagError(f'{source} has no message that could be saved: {losses[0]}')
        yield files


def _decompressed(path: Path, plain: Path) -> list[str]:
    """Decompresses as much of a file as can be; returns the faults."""
    with path.open('rb') as compressed, plain.open('wb') as target:
        try:
            for piece in decompress_file(compressed):
                target.write(piece)
        except DecompressionError as error:
            return [f'{path.name} is damaged: {error}']
    return []
