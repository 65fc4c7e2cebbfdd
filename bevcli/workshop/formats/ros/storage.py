"""The files of a bag, MCAP and SQLite: topics, the times of messages from the index, and messages on demand, decoded.

All that needs the packages of the extra `ros` to read is here.
"""

import os
import sqlite3
import struct
from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from io import BytesIO
from pathlib import Path
from typing import Any

import lz4.frame  # type: ignore[import-not-found,import-untyped,unused-ignore]
import numpy as np
import zstandard
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, ChunkIndex, Schema
from mcap.summary import Summary
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore, TypesysError

from bevcli.errors import InputError
from bevcli.parsing.documents import parse_json
from bevcli.parsing.files import MIB, open_regular

MAGIC = b"\x89MCAP0\r\n"
RECORD_HEAD = struct.Struct("<BQ")  # opcode, length of what follows
MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence number, log time, publish time
PLAIN_CHUNK_HEAD = 40  # bytes before the records of a chunk without compression: times, size, checksum, two lengths
CACHE_BYTES = 256 * MIB  # of decompressed chunks
LARGEST_CHUNK = 512 * MIB  # bytes after decompression
NO_CHUNK = -1  # the message lies outside of chunks
TABLES = ("topics", "messages", "message_definitions", "sqlite_master")
BUSY_TIMEOUT_S = 5.0
VFS_WITHOUT_LOCKS = "win32-none" if os.name == "nt" else "unix-none"
LARGEST_VALUE = 512 * MIB  # bytes of a message
# What damaged bytes raise.
DAMAGES = (McapError, ValueError, EOFError, struct.error, RuntimeError)

Decode = Callable[[bytes], Any]


@dataclass(frozen=True)
class Topic:
    """A topic of a bag."""

    name: str  # such as "/camera/front/image_raw"
    type_name: str  # as the bag writes it, such as "sensor_msgs/msg/Image"
    encoding: str  # of its messages: "cdr", "json" or "protobuf"
    schema: str = ""  # encoding of the definition: "ros2msg", "ros2idl", "jsonschema", "protobuf"; "" if there is none
    definition: bytes = b""  # the definition of the type, empty if there is none

    @property
    def short_type(self) -> str:
        """The name of the type as in `messages.KINDS`: "sensor_msgs/msg/Image" -> "sensor_msgs/Image"."""
        name = self.type_name.replace("/msg/", "/").replace("foxglove_msgs/", "foxglove/")
        return name.replace("foxglove.", "foxglove/")


class McapFile:
    """An MCAP file. topics: by name. notes: for the user about the file.

    Opening it reads the summary at its end. A file without one (its recording was cut off) is scanned up to its end.
    Raises InputError if it is not an MCAP file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.notes: tuple[str, ...] = ()
        self._file = open_regular(path)
        if self._file.read(len(MAGIC)) != MAGIC:
            raise InputError(f"{path}: is not an MCAP file (its first bytes are different)")
        self._chunks: OrderedDict[int, bytes] = OrderedDict()
        self._chunk_indexes: list[ChunkIndex] = []
        # By channel, if the file has no index: log time in ns, start of the chunk in the file or NO_CHUNK, and offset.
        self._scanned: dict[int, list[tuple[int, int, int]]] = {}
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        summary = self._summary()
        if summary is None:
            self._scan()
        else:
            self._schemas, self._channels = summary.schemas, summary.channels
            self._chunk_indexes = sorted(summary.chunk_indexes, key=lambda chunk: chunk.chunk_start_offset)
        # Where the records of chunks without compression start: of these, single messages are read.
        plain = [chunk.chunk_start_offset for chunk in self._chunk_indexes if not chunk.compression]
        self._starts = {NO_CHUNK: 0, **{start: start + RECORD_HEAD.size + PLAIN_CHUNK_HEAD for start in plain}}
        self.topics = {
            channel.topic: Topic(channel.topic, schema.name, channel.message_encoding, schema.encoding, schema.data)
            for channel in self._channels.values()
            if (schema := self._schemas.get(channel.schema_id))
        }
        self._references = cache(self._read_references)

    def times(self, topic: str) -> NDArray[np.int64]:
        """(N,) log times of a topic's messages in order, ns. Only the index is read."""
        return self._references(topic)[:, 0]

    def read(self, topic: str, index: int) -> bytes:
        """The bytes of message `index` of a topic. Raises InputError if they are broken."""
        _, chunk, offset = (int(number) for number in self._references(topic)[index])
        try:
            return self._message(chunk, offset)
        except DAMAGES as error:
            raise InputError(f"{self.path}: {topic}: message {index} is broken ({error})") from None

    def _summary(self) -> Summary | None:
        """The summary, None if the file has none, or one that does not list all messages."""
        try:
            self._file.seek(0)  # the reader takes the first bytes
            summary = SeekingReader(self._file).get_summary()
        except (McapError, ValueError, EOFError, OSError, struct.error, StopIteration, OverflowError, MemoryError):
            return None
        if summary is None or not summary.chunk_indexes or not summary.channels:
            return None
        return summary if all(chunk.message_index_length for chunk in summary.chunk_indexes) else None

    def _read_references(self, topic: str) -> NDArray[np.int64]:
        """(N, 3) log time, start of the chunk or NO_CHUNK, and offset of a topic's messages, in order of time."""
        channels = [number for number, channel in self._channels.items() if channel.topic == topic]
        references_by_chunk = [references for number in channels for references in self._references_in(number)]
        rows = np.concatenate([np.zeros((0, 3), dtype=np.int64), *references_by_chunk])
        return rows[np.argsort(rows[:, 0], kind="stable")]

    def _references_in(self, channel: int) -> Iterator[NDArray[np.int64]]:
        if channel in self._scanned:
            yield np.array(self._scanned[channel], dtype=np.int64)
        for chunk in self._chunk_indexes:
            if channel not in chunk.message_index_offsets:
                continue
            content = self._record(chunk.message_index_offsets[channel], Opcode.MESSAGE_INDEX)
            pairs = np.frombuffer(content[6:], dtype="<u8").reshape(-1, 2).astype(np.int64)
            starts = np.full(len(pairs), chunk.chunk_start_offset, dtype=np.int64)
            yield np.column_stack([pairs[:, 0], starts, pairs[:, 1]])

    def _record(self, position: int, opcode: int) -> bytes:
        self._file.seek(position)
        found_opcode, length = RECORD_HEAD.unpack(self._file.read(RECORD_HEAD.size))
        if found_opcode != opcode or length > self.path.stat().st_size:
            raise InputError(f"{self.path}: the index is broken (at byte {position})")
        return self._file.read(length)

    def _message(self, chunk: int, offset: int) -> bytes:
        if chunk in self._starts:
            return self._record(self._starts[chunk] + offset, Opcode.MESSAGE)[MESSAGE_HEAD.size :]
        content = self._chunk(chunk)
        opcode, length = RECORD_HEAD.unpack_from(content, offset)
        start = offset + RECORD_HEAD.size
        if opcode != Opcode.MESSAGE or start + length > len(content):
            raise ValueError("the index does not fit the chunk")
        return content[start + MESSAGE_HEAD.size : start + length]

    def _chunk(self, position: int) -> bytes:
        """The decompressed records of a chunk, from a cache of the chunks used last."""
        content = self._chunks.get(position)
        if content is None:
            content = _decompressed(self._record(position, Opcode.CHUNK))
            self._chunks[position] = content
            while len(self._chunks) > 1 and sum(map(len, self._chunks.values())) > CACHE_BYTES:
                self._chunks.popitem(last=False)
        self._chunks.move_to_end(position)
        return content

    def _scan(self) -> None:
        """Find schemas, channels and messages by reading the file from its start, as far as its records are whole."""
        end = self.path.stat().st_size
        position = len(MAGIC)
        while position + RECORD_HEAD.size <= end:
            self._file.seek(position)
            opcode, length = RECORD_HEAD.unpack(self._file.read(RECORD_HEAD.size))
            if opcode in (Opcode.DATA_END, Opcode.FOOTER):
                return
            if position + RECORD_HEAD.size + length > end:
                break
            if opcode == Opcode.CHUNK:
                try:
                    content = _decompressed(self._file.read(length))
                except DAMAGES:
                    break
                self._scan_chunk(content, position)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
                self._note(opcode, self._file.read(length), NO_CHUNK, position)
            position += RECORD_HEAD.size + length
        share = f"{position / MIB:.1f} of {end / MIB:.1f} MiB"
        self.notes = (f"{self.path.name} is cut off: its first {share} are read",)

    def _scan_chunk(self, content: bytes, chunk: int) -> None:
        offset = 0
        while offset + RECORD_HEAD.size <= len(content):
            opcode, length = RECORD_HEAD.unpack_from(content, offset)
            start = offset + RECORD_HEAD.size
            self._note(opcode, content[start : start + length], chunk, offset)
            offset = start + length

    def _note(self, opcode: int, content: bytes, chunk: int, offset: int) -> None:
        stream = ReadDataStream(BytesIO(content))
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            self._schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(stream)
            self._channels[channel.id] = channel
        elif opcode == Opcode.MESSAGE:
            number, _, log_time, _ = MESSAGE_HEAD.unpack(content[: MESSAGE_HEAD.size])
            self._scanned.setdefault(number, []).append((log_time, chunk, offset))


def _decompressed(content: bytes) -> bytes:
    chunk = Chunk.read(ReadDataStream(BytesIO(content)))
    if chunk.uncompressed_size > LARGEST_CHUNK:
        raise ValueError(f"a chunk of {chunk.uncompressed_size} bytes (expected at most {LARGEST_CHUNK})")
    data = decompressed(chunk.compression, chunk.data, chunk.uncompressed_size)
    if len(data) < chunk.uncompressed_size:
        raise ValueError(f"a chunk of {len(data)} bytes (expected {chunk.uncompressed_size})")
    return data


class SqliteFile:
    """A .db3 file, with the attributes of `McapFile`.

    Opening it reads the list of topics; a damaged file is read up to the damage.
    Raises InputError if it is not a rosbag2 database.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.notes: tuple[str, ...] = ()
        try:
            # A recording that was cut off leaves a -wal file beside the database, which SQLite must be able to apply.
            # Without locks and with exclusive access it keeps the index of that file in memory, not in a -shm file.
            has_wal = path.with_name(path.name + "-wal").exists()
            options = f"mode=ro&vfs={VFS_WITHOUT_LOCKS}" if has_wal else "mode=ro&immutable=1"
            uri = f"{path.resolve().as_uri()}?{options}"
            self._database = sqlite3.connect(uri, uri=True, check_same_thread=False, timeout=BUSY_TIMEOUT_S)
            self._database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, LARGEST_VALUE)
            self._database.execute("PRAGMA locking_mode = EXCLUSIVE")
            self._check_tables()
            rows = self._database.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
            if wrong := [cell for row in rows for cell in row[1:] if not isinstance(cell, str)]:
                raise sqlite3.DatabaseError(f"table topics: {wrong[0]!r:.50} is no text (expected names and types)")
            definitions = self._definitions()
        except sqlite3.Error as error:
            raise InputError(f"{path}: cannot be read as a rosbag2 database ({error})") from None
        self._ids: dict[str, list[int]] = {}
        self.topics: dict[str, Topic] = {}
        for number, name, type_name, serialization in rows:
            self._ids.setdefault(name, []).append(number)
            self.topics[name] = Topic(name, type_name, serialization, *definitions.get(type_name, ("", b"")))

    def times(self, topic: str) -> NDArray[np.int64]:
        """(N,) log times of a topic's messages in order, ns. The messages themselves are not read."""
        return self._references[topic][:, 0]

    def read(self, topic: str, index: int) -> bytes:
        """The bytes of message `index` of a topic. Raises InputError if they are broken."""
        row = int(self._references[topic][index, 1])
        try:
            data = self._database.execute("SELECT data FROM messages WHERE id = ?", (row,)).fetchone()[0]
            if not isinstance(data, bytes):
                raise TypeError(f"{data!r:.50} is not bytes")
            return data
        except (sqlite3.Error, TypeError) as error:
            raise InputError(f"{self.path}: {topic}: message {index} is broken ({error})") from None

    @cached_property
    def _references(self) -> dict[str, NDArray[np.int64]]:
        """(N, 2) log time and row of each topic's messages, in order of time.

        They are read in one pass, because the table has no index by topic.
        """
        rows: list[tuple[int, int, int]] = []
        try:
            for row in self._database.execute("SELECT timestamp, id, topic_id FROM messages"):
                rows.append(row)
        except sqlite3.Error as error:
            self.notes = (f"{self.path.name} is damaged ({error}): its first {len(rows)} messages are read",)
        table = np.array(rows, dtype=np.int64).reshape(-1, 3)
        table = table[np.argsort(table[:, 0], kind="stable")]
        return {name: table[np.isin(table[:, 2], numbers), :2] for name, numbers in self._ids.items()}

    def _check_tables(self) -> None:
        """Raises sqlite3.Error unless the tables of the bag hold plain values: code in a file can compute for ever."""
        self._database.execute("PRAGMA trusted_schema = OFF")
        entries = self._database.execute("SELECT name, type, rootpage FROM sqlite_master").fetchall()
        for name, entry_type, page in entries:
            if name.lower() not in TABLES or entry_type == "index":
                continue
            if entry_type != "table" or not page:
                description = "virtual table" if entry_type == "table" else entry_type
                raise sqlite3.DatabaseError(f"{name} is a {description} (expected a table)")
            for _, column, _, _, _, _, hidden in self._database.execute(f"PRAGMA table_xinfo({name})"):
                if hidden:
                    raise sqlite3.DatabaseError(f"{name}: column {column:.50} is computed (expected stored values)")

    def _definitions(self) -> dict[str, tuple[str, bytes]]:
        """Encoding and text of each type's definition; files of older ROS releases have none."""
        try:
            rows = self._database.execute(
                "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            ).fetchall()
        except sqlite3.OperationalError:
            return {}
        return {type_name: (encoding, text.encode()) for type_name, encoding, text in rows if text}


def decoder(topic: Topic) -> Decode:
    """The function that decodes a topic's messages. Nested messages are objects with attributes, too.

    Raises InputError if the encoding is not supported, or the definition is broken.
    """
    makers = {"cdr": _cdr, "json": _json, "protobuf": _protobuf}
    make = makers.get(topic.encoding)
    if make is None:
        hint = ": convert the .bag of ROS 1 with rosbags-convert" if topic.encoding == "ros1" else ""
        raise InputError(f"{topic.name}: messages are encoded as {topic.encoding} (expected {', '.join(makers)}){hint}")
    return make(topic)


def _cdr(topic: Topic) -> Decode:
    name = topic.type_name if "/msg/" in topic.type_name else topic.type_name.replace("/", "/msg/")
    text = topic.definition.decode(errors="replace")
    try:
        store = _types(name, text, topic.schema == "ros2idl")
    except (TypesysError, KeyError, ValueError) as error:
        cause = "its definition cannot be read" if text else "the bag has no definition of it, and it is not a ROS type"
        raise InputError(f"{topic.name}: type {name}: {cause} ({error})") from None
    return lambda data: store.deserialize_cdr(data, name)


@lru_cache(maxsize=64)
def _types(name: str, text: str, is_idl: bool) -> Typestore:
    """The type with this name and definition, which most topics of images share. It is compiled on first use."""
    store = get_typestore(Stores.EMPTY if text else Stores.LATEST)
    if text:
        store.register(get_types_from_idl(text) if is_idl else get_types_from_msg(text, name))
    store.get_msgdef(name)
    return store


def _json(topic: Topic) -> Decode:
    # Objects with attributes in place of dicts.
    return lambda data: parse_json(data, Path(topic.name), namespaces=True)


def _protobuf(topic: Topic) -> Decode:
    pool = descriptor_pool.DescriptorPool()
    try:
        files = descriptor_pb2.FileDescriptorSet.FromString(topic.definition)
        message_factory.GetMessages(files.file, pool)  # adds each file after those that it imports
        message = message_factory.GetMessageClass(pool.FindMessageTypeByName(topic.type_name))
    except (DecodeError, KeyError, TypeError) as error:
        raise InputError(f"{topic.name}: the definition of {topic.type_name} cannot be read ({error})") from None
    return message.FromString


def decompressed(compression: str, data: bytes, largest: int) -> bytes:
    """The bytes of compressed data.

    compression: "zstd", "lz4", or "" for data that is not compressed.
    Raises ValueError for another kind, damaged data, or more than `largest` bytes. Data that is cut off may give less.
    """
    try:
        if compression == "zstd":
            content = zstandard.ZstdDecompressor().stream_reader(data).read(largest + 1)
        elif compression == "lz4":
            content = bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, largest + 1))
        else:
            content = data
    except (zstandard.ZstdError, RuntimeError, EOFError) as error:
        raise ValueError(str(error)) from None
    if compression not in ("zstd", "lz4", ""):
        raise ValueError(f'unknown compression "{compression:.20}" (expected zstd, lz4 or none)')
    if len(content) > largest:
        raise ValueError(f"has more than {largest} bytes when it is decompressed")
    return content
