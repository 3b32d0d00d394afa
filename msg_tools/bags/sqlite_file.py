"""Reads one SQLite file (.db3) of a bag, the default storage before ROS 2 Iron."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from urllib.parse import quote

from msg_tools.bags.contents import BagError, Channel, StoredMessage, reason

MAGIC = b'SQLite format 3\x00'


class SqliteFile:
    """A .db3 file; the counterpart of `McapFile`, with the same attributes."""

    def __init__(self, path: Path, name: str) -> None:
        self._path = path
        self._name = name
        self.damage: str | None = None
        self.counts: dict[Channel, int] = {}
        self._channels: dict[int, Channel] = {}
        try:
            with closing(self._connect()) as database:
                counts = dict(
                    database.execute('SELECT topic_id, COUNT(*) FROM messages GROUP BY topic_id')
                )
                definitions = self._definitions(database)
                for key, topic, msgtype, encoding in database.execute(
                    'SELECT id, name, type, serialization_format FROM topics ORDER BY id'
                ):
                    definition = definitions.get(msgtype, ('', b''))
                    channel = Channel(str(topic), str(msgtype), str(encoding), *definition)
                    self._channels[key] = channel
                    self.counts[channel] = self.counts.get(channel, 0) + counts.get(key, 0)
                self.start, self.end = database.execute(
                    'SELECT MIN(timestamp), MAX(timestamp) FROM messages'
                ).fetchone()
        except sqlite3.Error as error:
            raise BagError(f'{name} is not a bag of rosbag2: {reason(error)}') from error
        if not all(isinstance(time, int | None) for time in (self.start, self.end)):
            raise BagError(f'{name} is damaged: a time is not a whole number')

    def _connect(self) -> sqlite3.Connection:
        return sqlite3.connect(f'file:{quote(str(self._path.resolve()))}?mode=ro', uri=True)

    @staticmethod
    def _definitions(database: sqlite3.Connection) -> dict[str, tuple[str, bytes]]:
        # Bags of ROS 2 Humble and before do not carry them.
        table = "SELECT 1 FROM sqlite_master WHERE name = 'message_definitions'"
        if database.execute(table).fetchone() is None:
            return {}
        rows = database.execute(
            'SELECT topic_type, encoding, encoded_message_definition FROM message_definitions'
        )
        return {name: (str(encoding), str(text).encode()) for name, encoding, text in rows}

    def messages(
        self, wanted: Callable[[Channel], bool] = lambda channel: True
    ) -> Iterator[tuple[int, StoredMessage]]:
        """Log time in ns and message, by log time, then in the order in which they were written.

        Raises:
            BagError: where the file is damaged, after the messages before the damage.
        """
        keys = [key for key, channel in self._channels.items() if wanted(channel)]
        query = (
            'SELECT topic_id, timestamp, data FROM messages '
            f'WHERE topic_id IN ({", ".join("?" * len(keys))}) ORDER BY timestamp, id'
        )
        try:
            with closing(self._connect()) as database:
                for key, time, data in database.execute(query, keys):
                    if not isinstance(time, int) or not isinstance(data, bytes):
                        raise BagError(
                            f'{self._name} is damaged: a message at {time!r} has no data'
                        )
                    yield time, StoredMessage(self._channels[key], memoryview(data))
        except sqlite3.Error as error:
            raise BagError(f'{self._name} is damaged: {reason(error)}') from error
