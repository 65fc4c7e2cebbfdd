"""`bevcli convert --format nuscenes`: tables as the devkit's schema states them, and the same predictions."""

import json
from pathlib import Path

import numpy as np
import pytest
from test_ways_in import assert_same_frames
from typer.testing import CliRunner

import bevcli
from bevcli.cli.main import app
from bevcli.errors import InputError, OutputError
from bevcli.sequences.open import open_sequence

STREET = Path(__file__).parents[2] / "samples/street"
# The columns of each table by nuScenes' schema; a name that ends with _token or _tokens refers to another table.
SCHEMA = {
    "attribute": "token name description",
    "calibrated_sensor": "token sensor_token translation rotation camera_intrinsic",
    "category": "token name description",
    "ego_pose": "token translation rotation timestamp",
    "instance": "token category_token nbr_annotations first_annotation_token last_annotation_token",
    "log": "token logfile vehicle date_captured location",
    "map": "token log_tokens category filename",
    "sample": "token timestamp scene_token next prev",
    "sample_annotation": "token sample_token instance_token attribute_tokens visibility_token translation size "
    "rotation num_lidar_pts num_radar_pts next prev",
    "sample_data": "token sample_token ego_pose_token calibrated_sensor_token filename fileformat width height "
    "timestamp is_key_frame next prev",
    "scene": "token name description log_token nbr_samples first_sample_token last_sample_token",
    "sensor": "token channel modality",
    "visibility": "token level description",
}
TARGETS = {
    **{name: name for name in SCHEMA},
    "first_annotation": "sample_annotation", "last_annotation": "sample_annotation",
    "first_sample": "sample", "last_sample": "sample", "log_tokens": "log", "attribute_tokens": "attribute",
}  # fmt: skip


def convert(*arguments):
    return CliRunner().invoke(app, ["convert", *map(str, arguments), "--format", "nuscenes"])


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    """samples/street as a nuScenes root."""
    out = tmp_path_factory.mktemp("street") / "root"
    answer = convert(STREET, out)
    assert answer.exit_code == 0, answer.output
    return out


@pytest.fixture(scope="module")
def tables(root):
    return {name: json.loads((root / "v1.0-custom" / f"{name}.json").read_text()) for name in SCHEMA}


def test_every_table_has_the_columns_of_the_schema(tables):
    for name, columns in SCHEMA.items():
        assert tables[name], name
        assert all(row.keys() == set(columns.split()) for row in tables[name]), name


def test_every_token_leads_to_a_row(tables):
    known = {name: {row["token"] for row in rows} for name, rows in tables.items()}
    for name, rows in tables.items():
        assert len(known[name]) == len(rows)
        for row in rows:
            for column, value in row.items():
                if column in ("prev", "next"):
                    assert value == "" or value in known[name]
                elif column.endswith(("_token", "_tokens")):
                    target = TARGETS[column.removesuffix("_token")]
                    assert set(value if isinstance(value, list) else [value]) <= known[target], column


def test_rows_are_chained_in_order_of_time(tables):
    for name in ("sample", "sample_data"):
        rows = {row["token"]: row for row in tables[name]}
        for row in rows.values():
            if row["next"]:
                assert rows[row["next"]]["prev"] == row["token"]
                assert rows[row["next"]]["timestamp"] > row["timestamp"]
    [scene] = tables["scene"]
    assert scene["nbr_samples"] == len(tables["sample"]) == 20
    counts = {row["token"]: row["nbr_annotations"] for row in tables["instance"]}
    assert sum(counts.values()) == len(tables["sample_annotation"])


def test_every_file_of_the_tables_exists(root, tables):
    for row in (*tables["sample_data"], *tables["map"]):
        assert (root / row["filename"]).is_file()


def test_the_root_is_read_as_the_same_frames(root):
    one, other = open_sequence(STREET, frames=slice(0, 4)), open_sequence(root, frames=slice(0, 4))
    assert_same_frames(one, other, same_bytes=True)
    for place in range(4):
        a, b = (drive.load(place).ground_truth for drive in (one, other))
        np.testing.assert_array_equal(a.num_points, b.num_points)
        np.testing.assert_array_equal(a.attributes, b.attributes)
        assert len(set(a.instances)) == len(set(b.instances))
        assert np.nanmax(np.abs(a.visibilities - b.visibilities)) <= 0.4  # the middle of a level


def predictions(drive, model):
    return [prediction for _, prediction in bevcli.run(model, drive)]


@pytest.mark.parametrize("lens", [None, [-0.2, 0.05, 0, 0]])
def test_predictions_are_the_same(drive, mini_model, tmp_path, lens):
    calibration = json.loads((drive / "calibration.json").read_text())
    if lens is not None:
        calibration["cameras"]["CAM_BACK"]["distortion"] = {"model": "brown_conrady", "coefficients": lens}
        (drive / "calibration.json").write_text(json.dumps(calibration))
    assert convert(drive, tmp_path / "root").exit_code == 0
    model = bevcli.Model(mini_model)
    one, other = (predictions(open_sequence(path), model) for path in (drive, tmp_path / "root"))
    for a, b in zip(one, other, strict=True):
        np.testing.assert_allclose(a.boxes_world.centers, b.boxes_world.centers, atol=1e-5)
        np.testing.assert_allclose(a.boxes.scores, b.boxes.scores, atol=1e-6)
    suffix = {path.suffix for path in (tmp_path / "root/samples/CAM_BACK").iterdir()}
    assert suffix == {".png"}


@pytest.mark.slow
def test_a_real_root_is_converted_to_the_same_frames(nuscenes_root, tmp_path):
    assert convert(nuscenes_root, tmp_path / "out").exit_code == 0
    assert_same_frames(open_sequence(nuscenes_root), open_sequence(tmp_path / "out"), same_bytes=True)


def test_scenes_and_missing_images_are_kept(drive, tmp_path):
    lines = (drive / "frames.csv").read_text().replace("images/CAM_BACK/1.png", "").splitlines()
    scenes = ["scene", "first", "first", "second", "second"]
    (drive / "frames.csv").write_text("\n".join(f"{s},{line}" for s, line in zip(scenes, lines, strict=True)))
    assert "1 image missing" in convert(drive, tmp_path / "out").output
    out = open_sequence(tmp_path / "out")
    assert [stamp.scene for stamp in out.stamps] == scenes[1:]
    assert out.load(1).images.keys() == {"CAM_FRONT"}
    assert out.load(0).ground_truth is None


def test_what_the_format_cannot_hold_is_refused(drive, tmp_path):
    (drive / "ego_motion.csv").unlink()
    answer = convert(drive, tmp_path / "out")
    assert isinstance(answer.exception, InputError)
    assert "has no ego-motion, which a nuScenes root must have" in str(answer.exception)
    assert not (tmp_path / "out").exists()


def test_an_existing_root_is_replaced_only_with_force(drive, tmp_path):
    out = tmp_path / "out"
    assert convert(drive, out).exit_code == 0
    assert "--force" in str(convert(drive, out).exception)
    assert convert(drive, out, "--force").exit_code == 0
    (out / "v1.0-mini").mkdir()
    (out / "v1.0-mini/scene.json").write_text("[]")
    answer = convert(drive, out, "--force")
    assert isinstance(answer.exception, OutputError)
    assert "choose another folder" in str(answer.exception)


def test_unknown_formats_and_boxes_are_refused(drive, tmp_path):
    answer = CliRunner().invoke(app, ["convert", str(drive), str(tmp_path / "out"), "--format", "kitti"])
    assert "`form=kitti` (`--format`): unknown format (expected " in str(answer.exception)
    answer = convert(drive, tmp_path / "out", "--boxes", drive)
    assert "`boxes` (`--boxes`): a nuScenes root takes no boxes of a run" in str(answer.exception)
