"""A .db3 file of a rosbag2: its topics, the times of their messages, and single messages on demand."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.parsing.files import MIB
from bevcli.sequences.ros.decoding import Encoding, Topic

TABLES = ("topics", "messages", "message_definitions", "sqlite_master")
BUSY_TIMEOUT_S = 5.0
LARGEST_VALUE = 512 * MIB  # bytes of a message


class SqliteFile:
    """A .db3 file. Opening it reads the list of topics; a damaged file is read up to the damage.

    Raises InputError if it is not a rosbag2 database.

    Attributes:
        topics: the topics, by name.
        notes: what the user should be told about the file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.notes: tuple[str, ...] = ()
        try:
            # A recording that was cut off leaves a -wal file beside the database, which SQLite must be able to apply.
            options = "mode=ro" if path.with_name(path.name + "-wal").exists() else "mode=ro&immutable=1"
            uri = f"{path.resolve().as_uri()}?{options}"
            self._database = sqlite3.connect(uri, uri=True, check_same_thread=False, timeout=BUSY_TIMEOUT_S)
            self._database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, LARGEST_VALUE)
            self._check_tables()
            rows = self._database.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
            definitions = self._definitions()
        except sqlite3.Error as error:
            raise InputError(f"{path}: cannot be read as a rosbag2 database ({error})") from None
        self._ids: dict[str, list[int]] = {}
        self.topics: dict[str, Topic] = {}
        for number, name, kind, serialization in rows:
            self._ids.setdefault(name, []).append(number)
            self.topics[name] = Topic(name, kind, Encoding(serialization, *definitions.get(kind, ("", b""))))
        self._references: dict[str, NDArray[np.int64]] = {}

    def times(self, topic: str) -> NDArray[np.int64]:
        """(N,) log times of a topic's messages in order, ns. The messages themselves are not read."""
        return self._references_of(topic)[:, 0]

    def read(self, topic: str, index: int) -> bytes:
        """The bytes of message `index` of a topic. Raises InputError if they are broken."""
        row = int(self._references_of(topic)[index, 1])
        try:
            return self._database.execute("SELECT data FROM messages WHERE id = ?", (row,)).fetchone()[0]
        except (sqlite3.Error, TypeError) as error:
            raise InputError(f"{self.path}: {topic}: message {index} is broken ({error})") from None

    def _references_of(self, topic: str) -> NDArray[np.int64]:
        """(N, 2) log time and row of a topic's messages, in order of time."""
        if not self._references:
            self._read_index()
        return self._references.get(topic, np.zeros((0, 2), dtype=np.int64))

    def _read_index(self) -> None:
        """Read time, topic and row of every message in one pass, because the table has no index by topic."""
        rows: list[tuple[int, int, int]] = []
        try:
            for row in self._database.execute("SELECT timestamp, id, topic_id FROM messages"):
                rows.append(row)
        except sqlite3.Error as error:
            self.notes = (f"{self.path.name} is damaged ({error}): its first {len(rows)} messages are read",)
        table = np.array(rows, dtype=np.int64).reshape(-1, 3)
        for name, numbers in self._ids.items():
            part = table[np.isin(table[:, 2], numbers), :2]
            self._references[name] = part[np.argsort(part[:, 0], kind="stable")]

    def _check_tables(self) -> None:
        """Raises sqlite3.Error if a table of the bag is a view: a query in the file can compute for ever."""
        self._database.execute("PRAGMA trusted_schema = OFF")
        kinds = self._database.execute("SELECT name, type FROM sqlite_master").fetchall()
        views = [name for name, kind in kinds if name in TABLES and kind not in ("table", "index")]
        if views:
            raise sqlite3.DatabaseError(f"{views[0]} is a view (expected a table)")

    def _definitions(self) -> dict[str, tuple[str, bytes]]:
        """Encoding and text of each type's definition; files of older ROS releases have none."""
        try:
            rows = self._database.execute(
                "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            ).fetchall()
        except sqlite3.OperationalError:
            return {}
        return {kind: (encoding, text.encode()) for kind, encoding, text in rows if text}
