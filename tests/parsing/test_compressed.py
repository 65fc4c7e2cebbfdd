"""Compressed data is read up to a limit, whatever size it states."""

import gc
import shutil
import sqlite3
from types import SimpleNamespace

import pytest

pytest.importorskip("mcap")
import lz4.frame
import zstandard

from bevcli.errors import InputError
from bevcli.workshop.formats import is_ros_bag
from bevcli.workshop.formats.ros.storage import SqliteFile, Topic, decoder, decompressed

COMPRESS = {"zstd": zstandard.compress, "lz4": lz4.frame.compress, "": bytes}


@pytest.mark.parametrize("kind", COMPRESS)
def test_data_comes_back_up_to_its_limit(kind):
    data = bytes(range(256)) * 5000
    packed = COMPRESS[kind](data)
    assert decompressed(kind, packed, len(data)) == data
    with pytest.raises(ValueError, match="more than"):
        decompressed(kind, packed, len(data) - 1)


@pytest.mark.parametrize("kind", ["zstd", "lz4"])
def test_damaged_data_is_a_value_error(kind):
    packed = bytearray(COMPRESS[kind](bytes(5000)))
    packed[:4] = b"none"
    with pytest.raises(ValueError, match=r"."):
        decompressed(kind, bytes(packed), 5000)
    with pytest.raises(ValueError, match="unknown compression"):
        decompressed("bzip3", b"", 5000)


def test_messages_of_a_json_topic_are_objects_with_attributes():
    decode = decoder(Topic("/t", "T", "json"))
    assert decode(b'{"a": [1, {"b": "\\u00e9"}]}') == SimpleNamespace(a=[1, SimpleNamespace(b="\u00e9")])
    for text in (b"[" * 100_000, b'{"a": ' + b"9" * 5000 + b"}", b"{"):
        with pytest.raises(InputError):
            decode(text)


ENDLESS = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT i AS timestamp, i AS id, 1 FROM n"


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (f"CREATE VIEW messages AS {ENDLESS}", "a view"),
        ("CREATE VIRTUAL TABLE messages USING fts5(timestamp, id, topic_id, content='endless')", "a virtual table"),
    ],
)
def test_what_is_no_plain_table_is_refused(tmp_path, made, said):
    with sqlite3.connect(tmp_path / "a.db3", timeout=5) as database:
        database.execute("CREATE TABLE topics (id, name, type, serialization_format)")
        database.execute(made)
    database.close()
    with pytest.raises(InputError, match=f"messages is {said}"):
        SqliteFile(tmp_path / "a.db3")


@pytest.mark.parametrize("table", ["topics", "messages", "Messages", "message_definitions"])
def test_a_computed_column_is_refused(tmp_path, table):
    """Each value may take minutes, inside a call that no signal interrupts."""
    with sqlite3.connect(tmp_path / "a.db3", timeout=5) as database:
        if table != "topics":
            database.execute("CREATE TABLE topics (id, name, type, serialization_format)")
        slow = "length(replace(printf('%.*c', 1000000, 'a'), 'a', 'aa'))"
        database.execute(f"CREATE TABLE {table} (id INTEGER PRIMARY KEY, topic_id, data, timestamp AS ({slow}))")
        database.execute(f"INSERT INTO {table} (topic_id) VALUES (1)")
    database.close()
    with pytest.raises(InputError, match="column timestamp is computed"):
        SqliteFile(tmp_path / "a.db3")


def test_names_and_messages_of_other_types_are_refused(tmp_path):
    with sqlite3.connect(tmp_path / "a.db3", timeout=5) as database:
        database.execute("CREATE TABLE topics (id, name, type, serialization_format)")
        database.execute("CREATE TABLE messages (id, topic_id, timestamp, data)")
        database.execute("INSERT INTO topics VALUES (1, '/a', 'std_msgs/msg/String', 'cdr')")
        database.execute("INSERT INTO messages VALUES (1, 1, 5, 'text')")
    with pytest.raises(InputError, match=r"/a: message 0 is broken \('text' is not bytes\)"):
        SqliteFile(tmp_path / "a.db3").read("/a", 0)
    with database:
        database.execute("UPDATE topics SET name = x'2f61'")
    database.close()
    with pytest.raises(InputError, match="table topics: b'/a' is no text"):
        SqliteFile(tmp_path / "a.db3")


def test_a_bag_that_was_cut_off_is_read_without_writing(tmp_path):
    """Its last messages are in the -wal file. SQLite would put a -shm file beside it, and delete both at the end."""
    live, folder = tmp_path / "live.db3", tmp_path / "bag"
    folder.mkdir()
    with sqlite3.connect(live, timeout=5) as database:
        database.execute("PRAGMA journal_mode = WAL")
        database.execute("CREATE TABLE topics (id, name, type, serialization_format)")
        database.execute("CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id, timestamp, data)")
        database.execute("INSERT INTO topics VALUES (1, '/a', 'T', 'cdr')")
        database.execute("INSERT INTO messages VALUES (1, 1, 7, x'05')")
        database.commit()
        for end in ("", "-wal"):
            shutil.copy(f"{live}{end}", folder / f"a.db3{end}")
    database.close()
    before = {file.name: file.read_bytes() for file in folder.iterdir()}
    assert len(before) == 2
    bag = SqliteFile(folder / "a.db3")
    assert bag.times("/a").tolist() == [7]
    assert bag.read("/a", 0) == b"\x05"
    assert {file.name for file in folder.iterdir()} == set(before)
    del bag
    gc.collect()
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == before


def test_only_the_start_of_a_metadata_file_is_read(tmp_path):
    with (tmp_path / "metadata.yaml").open("wb") as file:
        file.write(b"rosbag2_bagfile_information:\n")
        file.truncate(1 << 40)
    assert is_ros_bag(tmp_path)
