"""Reads a .db3 file of a bag, the default storage before ROS 2 Iron.

The database is opened read-only, and only its tables are read, because queries of views, virtual
tables and generated columns could run endlessly. The number of SQLite steps for queries is limited.
"""

from __future__ import annotations

import sqlite3
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from msg_tools.bags.storage import (
    MAX_CHUNK_BYTES,
    MAX_TOPICS,
    NEVER_NS,
    Channel,
    StoredMessage,
    as_bag_errors,
)
from msg_tools.files.budget import Budget, BudgetError
from msg_tools.messages.definitions import MAX_BYTES

MAGIC = b'SQLite format 3\x00'

# Limits of SQLite: steps of its virtual machine for every file, and additional steps per byte of
# the file (a row has more than ten bytes and takes approximately thirty steps); steps between two
# checks; memory in the whole process, bytes.
_STEPS, _STEPS_PER_BYTE, _STEPS_AT_ONCE, _MEMORY = 10**7, 4, 10**5, 2**29


class SqliteFile:
    """An SQLite file, with the same attributes and methods as `McapFile`.

    Args:
        budget: budget for opening the bag.
    """

    cut_off = False

    def __init__(self, path: Path, name: str, budget: Budget) -> None:
        self._path, self.name = path, name
        self._channels: dict[int, Channel] = {}
        self.counts: Counter[Channel] = Counter()
        self.start = NEVER_NS
        with as_bag_errors(name), _connected(path) as database:
            # To describe one table, SQLite resolves all views, in time exponential in the number of
            # views.
            if _mentions(database, 'view') or _mentions(database, 'virtual'):
                raise sqlite3.DataError('it has views or virtual tables, wanted tables')
            definitions = {}
            if _is_table(database, 'message_definitions'):
                text = f'substr(encoded_message_definition, 1, {MAX_BYTES + 1})'
                query = f'SELECT topic_type, encoding, {text} FROM message_definitions'
                for msgtype, encoding, text in _rows(database, query, (str, str, str), budget):
                    definitions[msgtype] = encoding, text
            if not _is_table(database, 'topics') or not _is_table(database, 'messages'):
                raise sqlite3.DataError('it has no tables topics and messages')
            query = 'SELECT id, name, type, serialization_format FROM topics ORDER BY id'
            for key, topic, msgtype, encoding in _rows(
                database, query, (int, str, str, str), budget
            ):
                definition = definitions.get(msgtype, ('', ''))
                self._channels[key] = Channel(topic, msgtype, encoding, *definition)
                self.counts[self._channels[key]] += 0
                if len(self._channels) > MAX_TOPICS:
                    raise BudgetError(f'it has more than {MAX_TOPICS} topics')
            query = 'SELECT topic_id, count(*), min(timestamp) FROM messages GROUP BY topic_id'
            for key, count, start in _rows(database, query, (int, int, int), budget):
                if key in self._channels:
                    self.counts[self._channels[key]] += count
                    self.start = min(self.start, start)

    def messages(self, topics: Collection[str], budget: Budget) -> Iterator[StoredMessage]:
        """See `McapFile.messages`."""
        wanted = [str(key) for key, channel in self._channels.items() if channel.topic in topics]
        query = (
            'SELECT topic_id, timestamp, '
            f'CASE WHEN length(data) <= {MAX_CHUNK_BYTES} THEN data END '
            f'FROM messages WHERE topic_id IN ({", ".join(wanted)}) ORDER BY timestamp, id'
        )
        with as_bag_errors(self.name), _connected(self._path) as database:
            for key, time, data in _rows(database, query, (int, int, bytes), budget):
                budget.spend(unpacked=len(data))
                if time < 0:
                    raise sqlite3.DataError('a message before 1970')
                yield StoredMessage(time, self._channels[key], data)


@contextmanager
def _connected(path: Path) -> Iterator[sqlite3.Connection]:
    """Opens a database read-only, with limits on the time and memory of queries."""
    uri = f'{path.absolute().as_uri()}?mode=ro&immutable=1'
    with closing(sqlite3.connect(uri, uri=True, check_same_thread=False)) as database:
        steps = iter(range((_STEPS + _STEPS_PER_BYTE * path.stat().st_size) // _STEPS_AT_ONCE))
        # The handler returns True to interrupt SQLite when no steps are left.
        database.set_progress_handler(lambda: next(steps, None) is None, _STEPS_AT_ONCE)
        database.execute('PRAGMA trusted_schema = OFF')
        database.execute(f'PRAGMA hard_heap_limit = {_MEMORY}')
        yield database


def _mentions(database: sqlite3.Connection, word: str) -> bool:
    """Searches SQL statements in the schema for a word, because its column `type` can be forged."""
    query = 'SELECT 1 FROM sqlite_master WHERE CAST(sql AS TEXT) LIKE ?'
    return database.execute(query, (f'%{word}%',)).fetchone() is not None


def _is_table(database: sqlite3.Connection, name: str) -> bool:
    """Whether a table has this name and only stored columns; the schema must have no views."""
    columns = database.execute('SELECT hidden FROM pragma_table_xinfo(?)', (name,)).fetchall()
    return bool(columns) and not any(hidden for (hidden,) in columns)


def _rows(
    database: sqlite3.Connection, query: str, kinds: tuple[type, ...], budget: Budget
) -> Iterator[Any]:
    """Yields rows of a query after a check of their types, which SQLite does not enforce."""
    for row in database.execute(query):
        budget.spend(records=1)
        if tuple(map(type, row)) != kinds:
            raise sqlite3.DataError(f'a row has {[type(x).__name__ for x in row]}')
        yield row
