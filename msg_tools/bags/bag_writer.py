"""Writes a bag that rosbag2 can play, either completely or not at all.

Topics have absolute names, because rosbag2 compares names literally. Relative names are resolved
in the namespace of the bag, as nodes resolve names. Log time and publish time are both the stamp
given by the caller.

The bag is written into a hidden folder `.<name>.<random>.partial` next to its final path, and moved
there once it is complete and on the disk; after an error it is removed. If the process is killed,
the hidden folder remains, and its file can be read except for the last chunk, because chunks are
flushed at once. Chunks, data and summary have checksums. The same calls write the same bytes.

    with BagWriter('out') as bag:
        bag.add_topic('body', 'hmt_msgs/msg/Body', latched=True)
        bag.write('body', stamp_ns, message)
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from mcap.writer import CompressionType, Writer

from msg_tools.bags.bag_metadata import (
    FILE_NAME,
    SUFFIXES,
    VERSION,
    BagError,
    absolute_name,
    as_yaml,
    quality_of_service,
    reason,
)
from msg_tools.files.new_folder import FolderKind
from msg_tools.messages.cdr import serialise
from msg_tools.messages.message_types import typestore

LIBRARY = 'hmt_ros'
CHUNK_BYTES = 2**20
_FOLDER = FolderKind('a bag', FILE_NAME, tuple(f'*{suffix}' for suffix in SUFFIXES))


class _Dropped(Exception):
    """Raised to remove a new folder instead of moving it to its final path."""


@dataclass
class _Topic:
    """A topic of the bag: the number of its channel, and its entries in metadata.yaml."""

    msgtype: str
    channel: int
    offered_qos: list[dict[str, Any]]
    type_hash: str
    message_count: int = 0


class BagWriter(AbstractContextManager['BagWriter']):
    """A bag that is open for writing; the context manager closes it, or removes it on an error.

    Args:
        path: folder to write, `<name>`; the file in it is `<name>.mcap`.
        overwrite: whether to replace an existing bag; other files and folders are never replaced.
        namespace: namespace of topics with relative names, '/humans/bodies/p1' for example.

    Raises:
        BagError: the folder exists, or can not be created or written.
    """

    def __init__(
        self, path: str | os.PathLike[str], *, overwrite: bool = False, namespace: str = ''
    ) -> None:
        self.path = Path(path).absolute()
        if self.path.name in ('', '..'):
            raise BagError(f'{self.path} is not the name of a folder')
        self._namespace = namespace
        self._topics: dict[str, _Topic] = {}
        self._schemas: dict[str, int] = {}
        self._start: int | None = None
        self._end = 0
        self._file: BinaryIO | None = None
        self._place = ExitStack()
        with self._dropping_on_error():
            new = _FOLDER.new(self.path, overwrite=overwrite)
            self._folder = self._place.enter_context(new)
            self._folder.mkdir()
            self._file = (self._folder / self._file_name).open('xb')
            self._writer = Writer(
                self._file,
                chunk_size=CHUNK_BYTES,
                compression=CompressionType.ZSTD,
                enable_crcs=True,
                enable_data_crcs=True,
            )
            self._writer.start(profile='ros2', library=LIBRARY)

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.close()
        else:
            self.abort()

    def add_topic(self, name: str, msgtype: str, *, latched: bool = False) -> None:
        """Adds a topic; `write` also adds missing topics, which are not latched.

        Args:
            name: name of the topic, absolute or relative to the namespace.
            msgtype: type, for example 'hmt_msgs/msg/PoseMixture'.
            latched: whether the QoS is transient local: late subscribers get the last message.

        Raises:
            BagError: the type is unknown, or the topic was already added.
        """
        store, name = typestore(), absolute_name(name, self._namespace)
        if msgtype not in store.fielddefs:
            raise BagError(f'{self.path}: topic {name} can not have the unknown type {msgtype!r}')
        if name in self._topics:
            raise BagError(f'{self.path}: topic {name} is there already')
        definition, _ = store.generate_msgdef(msgtype, ros_version=2)
        offered, type_hash = quality_of_service(latched), store.hash_rihs01(msgtype)
        metadata = {'offered_qos_profiles': as_yaml(offered), 'topic_type_hash': type_hash}
        with self._dropping_on_error():
            if msgtype not in self._schemas:
                self._schemas[msgtype] = self._writer.register_schema(
                    msgtype, 'ros2msg', definition.encode()
                )
            channel = self._writer.register_channel(name, 'cdr', self._schemas[msgtype], metadata)
        self._topics[name] = _Topic(msgtype, channel, offered, type_hash)

    def write(self, topic: str, stamp_ns: int, message: Any) -> None:
        """Writes a message of `typestore()`; adds the topic if needed.

        Raises:
            BagError: the topic has another type, a field is invalid, or the disk is full.
        """
        msgtype, topic = message.__msgtype__, absolute_name(topic, self._namespace)
        if topic not in self._topics:
            self.add_topic(topic, msgtype)
        if self._topics[topic].msgtype != msgtype:
            raise BagError(
                f'{self.path}: topic {topic} has type {self._topics[topic].msgtype}, not {msgtype}'
            )
        try:
            data = serialise(message)
        except Exception as error:
            # Generated code of the library; its exceptions for invalid fields are not documented.
            raise BagError(
                f'{self.path}: message of {topic} does not fit {msgtype}: {reason(error)}'
            ) from error
        self.write_serialised(topic, stamp_ns, data)

    def write_serialised(self, topic: str, stamp_ns: int, data: bytes) -> None:
        """Writes a message given as CDR bytes; the topic must have been added before.

        Raises:
            BagError: no such topic, a stamp before 1970, or the disk is full.
        """
        topic = absolute_name(topic, self._namespace)
        known = self._topics.get(topic)
        if known is None:
            raise BagError(f'{self.path}: topic {topic} has not been added')
        if not 0 <= stamp_ns < 2**63:
            raise BagError(
                f'{self.path}: stamp {stamp_ns} ns of a message of {topic} is not a time'
            )
        assert self._file is not None
        with self._dropping_on_error():
            self._writer.add_message(known.channel, stamp_ns, data, stamp_ns)
            self._file.flush()  # so that a killed process loses no data
        known.message_count += 1
        self._start = stamp_ns if self._start is None else min(self._start, stamp_ns)
        self._end = max(self._end, stamp_ns)

    def close(self) -> None:
        """Completes the bag and moves it to its final path, unless it is already closed.

        Raises:
            BagError: the disk is full, or the folder was created meanwhile; all files are removed.
        """
        if self._file is None or self._file.closed:
            return
        with self._dropping_on_error():
            information = self._information()
            self._writer.add_metadata('rosbag2', {'serialized_metadata': as_yaml(information)})
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._file.flush()
            os.fsync(self._file.fileno())
            self._file.close()
            with (self._folder / FILE_NAME).open('x', encoding='utf-8') as file:
                file.write(as_yaml({'rosbag2_bagfile_information': information}))
                file.flush()
                os.fsync(file.fileno())
            _sync_folder(self._folder)
            self._place.close()
            _sync_folder(self.path.parent)

    def abort(self) -> None:
        """Removes everything that was written."""
        if self._file is not None:
            # Closing writes the buffer and may fail again on a full disk, which is harmless here.
            with suppress(OSError):
                self._file.close()
        with suppress(_Dropped), self._place:
            raise _Dropped

    @property
    def _file_name(self) -> str:
        return f'{self.path.name}.mcap'

    @contextmanager
    def _dropping_on_error(self) -> Iterator[None]:
        """Removes the bag on an exception; turns OSError and ValueError into BagError."""
        if self._file is not None and self._file.closed:
            raise BagError(f'{self.path} is closed')
        try:
            yield
        except OSError as error:
            self.abort()
            raise BagError(f'{self.path} can not be written: {reason(error)}') from error
        except ValueError as error:
            self.abort()
            raise BagError(str(error)) from error
        except BaseException:
            self.abort()
            raise

    def _information(self) -> dict[str, Any]:
        """Content of metadata.yaml, in the form of rosbag2 in ROS 2 Jazzy."""
        start = 2**63 - 1 if self._start is None else self._start
        span = {
            'duration': {'nanoseconds': max(0, self._end - start)},
            'starting_time': {'nanoseconds_since_epoch': start},
            'message_count': sum(topic.message_count for topic in self._topics.values()),
        }
        return {
            'version': VERSION,
            'storage_identifier': 'mcap',
            **span,
            'topics_with_message_count': [
                {
                    'topic_metadata': {
                        'name': name,
                        'type': topic.msgtype,
                        'serialization_format': 'cdr',
                        'offered_qos_profiles': topic.offered_qos,
                        'type_description_hash': topic.type_hash,
                    },
                    'message_count': topic.message_count,
                }
                for name, topic in self._topics.items()
            ],
            'compression_format': '',
            'compression_mode': '',
            'relative_file_paths': [self._file_name],
            'files': [{'path': self._file_name, **deepcopy(span)}],
            'custom_data': None,
            'ros_distro': 'jazzy',
        }


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
