"""Cases of well-formed files that are wrong: ONNX graphs, meshes and siblings, batch records, SQLite schemas."""

import json
import shutil
import sqlite3
from functools import cache
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest
import trimesh
from damage import HUGE, damage, edited
from mutations import TEXT, changed_tree
from PIL import Image
from small_model import small_inputs, small_model, step_of_file

from bevcli.config import as_table
from bevcli.inference.load import Model
from bevcli.inference.tracking import TrackerConfig
from bevcli.sequences.open import open_sequence
from bevcli.workshop.batch.batch import BatchSummary
from bevcli.workshop.batch.job import read_record
from bevcli.workshop.batch.report import to_csv, to_parquet, write_report
from bevcli.workshop.engines.export_onnx import export_onnx
from bevcli.workshop.engines.exported import load_exported
from bevcli.workshop.meshes import load_vehicle

onnx = pytest.importorskip("onnx")
for package in ("onnxruntime", "openvino"):
    pytest.importorskip(package)

CAMERAS = ("CAM_FRONT", "CAM_BACK")
TRACKER = TrackerConfig(birth_score=0.0, keep_score=0.0)


def onnx_file(seeds: Path, case: Path, random: Random) -> None:
    """A wrong file is refused, or every output has the shape of the model's."""
    proto = onnx.load_model_from_string(_exported(seeds))
    for _ in range(random.choice((1, 1, 2))):
        random.choice(ONNX_CHANGES)(proto, random)
    for name in ("weights.bin", "pipe"):
        damage(case / name, random, [seeds / "drive/frames.csv"])
    file = case / "model.onnx"
    file.write_bytes(proto.SerializeToString())
    exported = load_exported(file, random.choice(("onnxruntime", "onnxruntime", "onnxruntime", "openvino")), 1)
    found = step_of_file(exported, small_inputs())
    assert found.bev.dtype.is_floating_point
    assert found.box_codes.shape[-1] == 10


def _any_value(graph: Any, random: Random) -> Any:
    return random.choice([*graph.input, *graph.output])


def _renamed(proto: Any, random: Random) -> None:
    _any_value(proto.graph, random).name = random.choice(("images", "bev", "", "x", "\u202e"))


def _other_shape(proto: Any, random: Random) -> None:
    shape = _any_value(proto.graph, random).type.tensor_type.shape
    kind = random.randrange(3)
    if kind == 0 and shape.dim:
        del shape.dim[random.randrange(len(shape.dim))]
    elif kind == 1:
        shape.dim.add().dim_value = random.choice((0, 1, 7))
    elif shape.dim:
        random.choice(shape.dim).dim_value = random.choice((-1, 0, 1, 2**31, 2**62))


def _dynamic(proto: Any, random: Random) -> None:
    for dimension in _any_value(proto.graph, random).type.tensor_type.shape.dim:
        dimension.dim_param = random.choice(("n", ""))


def _other_type(proto: Any, random: Random) -> None:
    _any_value(proto.graph, random).type.tensor_type.elem_type = random.choice((0, 1, 2, 6, 7, 8, 9, 10, 11, 16, 99))


def _without_value(proto: Any, random: Random) -> None:
    values = random.choice((proto.graph.input, proto.graph.output, proto.graph.initializer, proto.graph.node))
    if values:
        del values[random.randrange(len(values))]


def _external(proto: Any, random: Random) -> None:
    tensor = random.choice(proto.graph.initializer)
    tensor.ClearField("raw_data")
    tensor.data_location = onnx.TensorProto.EXTERNAL
    where = (
        "weights.bin",
        "pipe",
        "missing",
        "../../../../../etc/passwd",
        "/dev/zero",
        "",
        "/etc/passwd",
        "model.onnx",
    )
    for key, value in (("location", random.choice(where)), ("offset", random.choice(("0", "-1", "x", str(2**62))))):
        entry = tensor.external_data.add()
        entry.key, entry.value = key, value


def _other_operator(proto: Any, random: Random) -> None:
    node = random.choice(proto.graph.node)
    node.op_type = random.choice(
        ("Identity", "Relu", "Add", "Reshape", "Gather", "NoSuchOperator", "", "Loop", "Squeeze")
    )


def _other_input(proto: Any, random: Random) -> None:
    node = random.choice([node for node in proto.graph.node if node.input])
    names = [name for other in proto.graph.node for name in other.output]
    node.input[random.randrange(len(node.input))] = random.choice([*names, "", "nowhere"])


def _other_attribute(proto: Any, random: Random) -> None:
    node = random.choice([node for node in proto.graph.node if node.attribute])
    attribute = random.choice(node.attribute)
    attribute.i, attribute.f = random.choice((-1, 0, 3, 2**31, -(2**62))), random.choice((0.0, float("nan"), 1e38))
    if attribute.ints:
        attribute.ints[random.randrange(len(attribute.ints))] = random.choice((-1, 0, 5, 2**31))


def _other_constant(proto: Any, random: Random) -> None:
    """Shapes and indices become wrong, so that nodes fail when they run."""
    kinds = onnx.TensorProto.INT64, onnx.TensorProto.FLOAT
    tensor = random.choice([each for each in proto.graph.initializer if each.data_type in kinds and each.raw_data])
    array = onnx.numpy_helper.to_array(tensor).copy()
    if array.size:
        array.reshape(-1)[random.randrange(array.size)] = random.choice((-1, 0, 1, 3, 10**6))
    tensor.CopyFrom(onnx.numpy_helper.from_array(array, tensor.name))


def _other_metadata(proto: Any, random: Random) -> None:
    entry = random.choice(proto.metadata_props)
    kind = random.randrange(4)
    if kind == 0:
        proto.metadata_props.remove(entry)
    elif kind == 1:
        entry.value = random.choice(("", "x", "int8", "[]", "null", "-1", "1e999", "9" * 5000, "[" * 5000))
    else:
        entry = next((each for each in proto.metadata_props if each.key == "config"), entry)
        changed = changed_tree(entry.value.encode(), random.choice(("value", "drop", "copy")), *_places(random))
        entry.value = changed.decode(errors="replace")


def _other_version(proto: Any, random: Random) -> None:
    if random.random() < 0.5:
        proto.ir_version = random.choice((0, 1, 3, 99))
    else:
        random.choice(proto.opset_import).version = random.choice((0, 1, 9, 13, 99))


ONNX_CHANGES = (
    _renamed, _other_shape, _dynamic, _other_type, _without_value, _external, _other_operator, _other_input,
    _other_attribute, _other_constant, _other_metadata, _other_metadata, _other_version,
)  # fmt: skip


@cache
def _exported(seeds: Path) -> bytes:
    file = seeds / "small.onnx"
    if not file.exists():
        model = small_model()
        export_onnx(model, file, contents=as_table(model.config, TRACKER), untrained=True)
    return file.read_bytes()


def mesh(seeds: Path, case: Path, random: Random) -> None:
    """A mesh whose siblings are wrong is refused, or has finite vertices and faces between them."""
    (case / "mesh").mkdir()
    (case / "outside.png").write_bytes(b"secret")
    name = random.choice(("car.obj", "car.gltf"))
    for file, content in _meshes(name).items():
        (case / "mesh" / file).write_bytes(content)
    files = sorted((case / "mesh").iterdir())
    for _ in range(random.choice((1, 1, 2))):
        path = random.choice(files)
        kind = random.randrange(3)
        if kind == 0:
            damage(path, random, [case / "outside.png", *(each for each in files if each.is_file())])
        elif path.is_file():
            content = path.read_bytes()
            if path.suffix == ".gltf" and kind == 1:
                path.write_bytes(
                    changed_tree(content, random.choice(("value", "value", "drop", "copy")), *_places(random))
                )
            else:
                names = (
                    b"../outside.png",
                    b"/dev/zero",
                    b"..",
                    b".",
                    b"car.obj",
                    b"\x00",
                    b"a" * 300,
                    b"~/x",
                    b"car.mtl",
                )
                old = random.choice([each.name.encode() for each in files])
                path.write_bytes(
                    content.replace(old, random.choice(names)) if kind == 1 else edited(content, random, TEXT)
                )
    found = load_vehicle(case / "mesh" / name).mesh
    assert np.isfinite(found.vertices).all()
    assert np.isfinite(found.normals).all()
    assert found.faces.min() >= 0
    assert found.faces.max() < len(found.vertices)
    assert len(found.vertices) == len(found.normals) == len(found.colors)


@cache
def _meshes(name: str) -> dict[str, bytes]:
    box = trimesh.creation.box((4.0, 2.0, 1.5))
    places = np.random.default_rng(0).random((len(box.vertices), 2))
    texture = Image.fromarray(np.full((8, 8, 3), 128, np.uint8))
    box.visual = trimesh.visual.TextureVisuals(places, image=texture)
    if name.endswith(".gltf"):
        files = dict(box.export(file_type="gltf"))
        return {name: files.pop("model.gltf"), **files}
    text, files = trimesh.exchange.obj.export_obj(box, return_texture=True, mtl_name="car.mtl")
    return {name: text.encode(), **files}


def batch_record(seeds: Path, case: Path, random: Random) -> None:
    """A wrong record is not taken, or can be tabled, reported and summarised."""
    content = json.dumps(RECORD if random.random() < 0.8 else FAILED).encode()
    for _ in range(random.choice((1, 1, 2))):
        content = changed_tree(content, random.choice(("value", "value", "drop", "copy", "nest")), *_places(random))
    record = read_record(content, "d-1")
    if record is not None:
        records = [record, RECORD]
        assert to_parquet(records, _model().config.classes)
        assert to_csv(records, _model().config.classes)
        assert write_report(records, None, _model())
        assert BatchSummary(tuple(records), 2, 0, False, ()).table()


RECORD = {
    "drive": "d", "source": "/drives/d", "scene": None, "result": "d-1", "attempts": 1, "error": "", "frames": 3,
    "boxes": 5, "boxes_by_class": {"car": 4, "pedestrian": 1}, "tracks": 2, "dropped_images": 0, "skipped_frames": 0,
    "not_finite_frames": 0, "seconds": 1.5, "frames_per_second": 2.0, "fetch_seconds": 0.1, "output_bytes": 1000,
    "score_histogram": [0] * 19 + [5], "scores": {"mean_ap": 0.5, "nd_score": None, "ground_truth_boxes": 3},
    "not_scored": "", "input_errors": "",
}  # fmt: skip
FAILED = {name: RECORD[name] for name in ("drive", "source", "scene", "result", "attempts")} | {"error": "no images"}


@cache
def _model() -> Model:
    return Model(small_model(cameras=CAMERAS))


def sqlite_schema(seeds: Path, case: Path, random: Random) -> None:
    """A bag with another schema, or values of other types, is read or refused."""
    shutil.copytree(seeds / "rosbag2", case / "bag")
    database = sqlite3.connect(case / "bag/rosbag2.db3", isolation_level=None)
    for _ in range(random.choice((1, 1, 2, 3))):
        try:
            database.executescript(_statements(random))
        except (sqlite3.Error, UnicodeEncodeError):  # changes that exclude each other
            continue
    database.close()
    sequence = open_sequence(case / "bag")
    for place in range(min(3, len(sequence.stamps))):
        sequence.load(place)


def _statements(random: Random) -> str:
    table = random.choice(("messages", "topics", "message_definitions"))
    column = random.choice(COLUMNS[table])
    columns = ", ".join(COLUMNS[table])
    others = ", ".join(name for name in COLUMNS[table] if name != column)
    value, kind = random.choice(SQL_VALUES), random.choice(("TEXT", "BLOB", "REAL", "INTEGER"))
    broken = random.choice(("sql = 'x'", "rootpage = 99999", "rootpage = 1", "type = 'view'", "sql = NULL"))
    copied = f"INSERT INTO {table} SELECT {columns} FROM old"
    texts = ", ".join(f"{name} TEXT COLLATE NOCASE" for name in COLUMNS[table])
    endless = f"WITH RECURSIVE n(i) AS (VALUES(1) UNION ALL SELECT i + 1 FROM n) SELECT i {column} FROM n"
    definition = random.choice(
        (
            f"CREATE VIEW {table} AS SELECT * FROM old",
            f"CREATE VIEW {table} AS {endless}",
            f"CREATE TABLE {table}({columns}, PRIMARY KEY({column})) WITHOUT ROWID; {copied}",
            f"CREATE TABLE {table}({others}, {column} AS ({value})); INSERT INTO {table} SELECT {others} FROM old",
            f"CREATE TABLE {table}({others}, {column} AS (randomblob(1 << 30)) STORED)",
            f"CREATE TABLE {table} AS SELECT {others} FROM old",
            f"CREATE TABLE {table}({texts}); {copied}",
            f"CREATE TABLE {table}({columns.replace(',', ' ANY,')} ANY) STRICT; {copied}",
            f"CREATE VIRTUAL TABLE {table} USING fts5({columns})",
            f"CREATE TABLE {table}({columns}, CHECK({column} > 0))",
            f"CREATE TABLE {table}({columns}); {copied}; {copied}",
            f'CREATE TABLE "{table} "({columns})',
        )
    )
    return random.choice(
        (
            f"ALTER TABLE {table} RENAME TO old; {definition}",
            f"ALTER TABLE {table} RENAME TO old; {definition}; DROP TABLE old",
            f"UPDATE {table} SET {column} = {value}",
            f"UPDATE {table} SET {column} = {value} WHERE rowid = {random.randrange(1, 9)}",
            f"UPDATE {table} SET {column} = CAST({column} AS {kind})",
            f"ALTER TABLE {table} ADD COLUMN more DEFAULT {value}",
            f"ALTER TABLE {table} RENAME COLUMN {column} TO {random.choice(('other', 'rowid', 'oid'))}",
            f"DELETE FROM {table}",
            f"CREATE TRIGGER t AFTER INSERT ON {table} BEGIN SELECT load_extension('x'); END",
            f"CREATE INDEX i ON {table}({column}) WHERE {column} IS NOT NULL",
            f"CREATE INDEX i ON {table}(abs({column}))",
            f"PRAGMA writable_schema = ON; UPDATE sqlite_master SET {broken} WHERE name = '{table}'",
            "PRAGMA journal_mode = WAL; VACUUM",
            "PRAGMA user_version = -1",
            "PRAGMA encoding = 'UTF-16'; VACUUM",
            f"DROP TABLE {table}",
        )
    )  # fmt: skip


COLUMNS = {
    "messages": ("id", "topic_id", "timestamp", "data"),
    "topics": ("id", "name", "type", "serialization_format"),
    "message_definitions": ("id", "topic_type", "encoding", "encoded_message_definition"),
}
SQL_VALUES = (
    "NULL", "''", "'x'", "-1", "0", "9223372036854775807", "-9223372036854775808", "1e308", "9e999", "1.5", "x'00ff'",
    "zeroblob(100000)", "'日本'", "CAST(x'c328' AS TEXT)", "'/tf_static'", "'sensor_msgs/msg/Image'", "'cdr'", "'json'",
    "hex(randomblob(5000))",
)  # fmt: skip


def _places(random: Random) -> tuple[int, int]:
    return random.randrange(HUGE), random.randrange(HUGE)
