"""Compressed data is read up to a limit, whatever size it states."""

import sqlite3
from types import SimpleNamespace

import pytest

pytest.importorskip("mcap")
import lz4.frame
import zstandard

from bevcli.errors import InputError
from bevcli.parsing.files import decompressed
from bevcli.sequences.ros.format import is_ros_bag
from bevcli.sequences.ros.messages import Topic, decoder
from bevcli.sequences.ros.storage import SqliteFile

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


def test_a_view_in_place_of_a_table_is_refused(tmp_path):
    with sqlite3.connect(tmp_path / "a.db3", timeout=5) as database:
        database.execute("CREATE TABLE topics (id, name, type, serialization_format)")
        endless = (
            "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT i AS timestamp, i AS id, 1 FROM n"
        )
        database.execute(f"CREATE VIEW messages AS {endless}")
    database.close()
    with pytest.raises(InputError, match="messages is a view"):
        SqliteFile(tmp_path / "a.db3")


def test_only_the_start_of_a_metadata_file_is_read(tmp_path):
    with (tmp_path / "metadata.yaml").open("wb") as file:
        file.write(b"rosbag2_bagfile_information:\n")
        file.truncate(1 << 40)
    assert is_ros_bag(tmp_path)
