"""`bevcli convert --format nuscenes`: tables as the devkit's schema states them, and the same predictions.

The same real drive as a native folder and a nuScenes root gives the same frames.

Lines of the map expansion around a vehicle, and the scores that need them. The vehicle is at world (0, 2000.5) and
drives along x; its lidar is 1 m ahead, so that bev x is 2000.5 - y and bev y is x - 1.
"""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import invoked
from memory_drive import MemoryDrive
from nuscenes_tables import Size, token, write_tables

from bevcli.errors import InputError, OutputError
from bevcli.frame import Ground
from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.transforms import Pose, wrap_angle
from bevcli.sequences.files.boxes_file import BoxesWriter, FrameBoxes, count_classes
from bevcli.sequences.files.json_fields import pose_to_json
from bevcli.sequences.open import open_sequence
from bevcli.workshop.formats import WriteOptions
from bevcli.workshop.formats.convert import open_writer, truth_left_out
from bevcli.workshop.formats.map_lines import LinesWriter, MapLines
from bevcli.workshop.formats.output import NativeWriter
from bevcli.workshop.scores.evaluate import evaluate
from bevcli.workshop.vad.plan import Plan, PlanWriter

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
    return invoked("convert", *arguments, "--format", "nuscenes")


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    """samples/street as a nuScenes root."""
    out = tmp_path_factory.mktemp("street") / "root"
    convert(STREET, out)
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


def test_rows_are_chained_in_order_of_time(root, tables):
    for name in ("sample", "sample_data"):
        rows = {row["token"]: row for row in tables[name]}
        for row in rows.values():
            if row["next"]:
                assert rows[row["next"]]["prev"] == row["token"]
                assert rows[row["next"]]["timestamp"] > row["timestamp"]
    for row in (*tables["sample_data"], *tables["map"]):
        assert (root / row["filename"]).is_file()
    [scene] = tables["scene"]
    assert scene["nbr_samples"] == len(tables["sample"]) == 20
    counts = {row["token"]: row["nbr_annotations"] for row in tables["instance"]}
    assert sum(counts.values()) == len(tables["sample_annotation"])


def test_the_root_is_read_as_the_same_frames(root):
    one, other = open_sequence(STREET, frames=slice(0, 4)), open_sequence(root, frames=slice(0, 4))
    assert_same_frames(one, other, same_bytes=True)
    for place in range(4):
        a, b = (drive.load(place).ground_truth for drive in (one, other))
        np.testing.assert_array_equal(a.num_points, b.num_points)
        np.testing.assert_array_equal(a.attributes, b.attributes)
        assert len(set(a.instances)) == len(set(b.instances))
        assert np.nanmax(np.abs(a.visibilities - b.visibilities)) <= 0.4  # the middle of a level


def test_scenes_missing_images_and_undistorted_ones_are_kept(drive, tmp_path):
    calibration = json.loads((drive / "calibration.json").read_text())
    lens = {"model": "brown_conrady", "coefficients": [-0.2, 0.05, 0, 0]}
    calibration["cameras"]["CAM_BACK"]["distortion"] = lens
    (drive / "calibration.json").write_text(json.dumps(calibration))
    given = open_sequence(drive)
    lines = (drive / "frames.csv").read_text().replace("images/CAM_BACK/1.png", "").splitlines()
    scenes = ["scene", "first", "first", "second", "second"]
    (drive / "frames.csv").write_text("\n".join(f"{s},{line}" for s, line in zip(scenes, lines, strict=True)))
    assert "1 image missing" in convert(drive, tmp_path / "out").output
    out = open_sequence(tmp_path / "out")
    assert [stamp.scene for stamp in out.stamps] == scenes[1:]
    assert out.load(1).images.keys() == {"CAM_FRONT"}
    assert out.load(0).ground_truth is None
    # The tables have no lens: images are undistorted, and written without loss.
    straight = given.rig["CAM_BACK"].undistort(given.load(0).images["CAM_BACK"].pixels_bgr)
    assert out.rig["CAM_BACK"].distortion is None
    np.testing.assert_array_equal(out.load(0).images["CAM_BACK"].pixels_bgr, straight)
    assert {path.suffix for path in (tmp_path / "out/samples/CAM_BACK").iterdir()} == {".png"}


def test_an_existing_root_is_replaced_only_with_force(drive, tmp_path):
    out = tmp_path / "out"
    convert(drive, out)
    with pytest.raises(OutputError, match="--force"):
        convert(drive, out)
    convert(drive, out, "--force")
    (out / "v1.0-mini").mkdir()
    (out / "v1.0-mini/scene.json").write_text("[]")
    with pytest.raises(OutputError, match="choose another folder"):
        convert(drive, out, "--force")


def test_unknown_formats_and_boxes_are_refused(drive, tmp_path):
    with pytest.raises(InputError, match=r"`form=kitti` \(`--format`\): unknown format \(expected "):
        invoked("convert", drive, tmp_path / "out", "--format", "kitti")
    (drive / "ego_motion.csv").rename(tmp_path / "poses.csv")
    with pytest.raises(InputError, match="has no ego-motion, which a nuScenes root must have"):
        convert(drive, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    (tmp_path / "poses.csv").rename(drive / "ego_motion.csv")
    with pytest.raises(InputError, match=r"`boxes` \(`--boxes`\): a nuScenes root takes no boxes of a run"):
        convert(drive, tmp_path / "out", "--boxes", drive)


TIMES = 0.5 * np.arange(1, 7)


class Expansion:
    """Builds the JSON of a map."""

    def __init__(self) -> None:
        self.tables = {name: [] for name in ("node", "line", "polygon", "lane_divider", "road_divider", "ped_crossing",
                                             "road_segment", "lane")}  # fmt: skip

    def _nodes(self, points: list[tuple[float, float]]) -> list[str]:
        first = len(self.tables["node"])
        self.tables["node"] += [{"token": f"n{first + k}", "x": x, "y": y} for k, (x, y) in enumerate(points)]
        return [f"n{first + k}" for k in range(len(points))]

    def line(self, kind: str, points: list[tuple[float, float]]) -> None:
        own = f"{kind}{len(self.tables['line'])}"
        self.tables["line"].append({"token": own, "node_tokens": self._nodes(points)})
        self.tables[kind].append({"line_token": own})

    def rectangle(self, kind: str, x: tuple[float, float], y: tuple[float, float], hole: tuple = ()) -> None:
        own = f"{kind}{len(self.tables['polygon'])}"
        rings = [[(a, y[0]), (b, y[0]), (b, y[1]), (a, y[1])] for (a, b), y in ((x, y), *hole)]
        outer, *holes = map(self._nodes, rings)
        row = {"token": own, "exterior_node_tokens": outer, "holes": [{"node_tokens": one} for one in holes]}
        self.tables["polygon"].append(row)
        self.tables[kind].append({"polygon_token": own})


@pytest.fixture(scope="module")
def expanded_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A road of two pieces, with an island in one, a divider, and a crossing of two halves."""
    expanded_root = tmp_path_factory.mktemp("nuscenes")
    write_tables(expanded_root / "v1.0-mini", Size(scenes=1, samples=8, objects=2))
    (expanded_root / "v1.0-mini" / "log.json").write_text(json.dumps([{"token": token(9, 0), "location": "here"}]))
    made = Expansion()
    made.rectangle("road_segment", (-100, 0), (1996, 2005))
    made.rectangle("lane", (0, 200), (1996, 2005), hole=(((20, 22), (2002, 2003)),))
    made.rectangle("ped_crossing", (10, 13), (1996, 2000))
    made.rectangle("ped_crossing", (10, 13), (2000, 2005))
    made.line("lane_divider", [(-100, 2000.5), (200, 2000.5)])
    made.line("road_divider", [(5000, 2000), (5100, 2000)])
    (expanded_root / "maps" / "expansion").mkdir(parents=True)
    (expanded_root / "maps" / "expansion" / "here.json").write_text(json.dumps(made.tables))
    return expanded_root


def extents(lines: MapLines, name: str) -> set[tuple[float, ...]]:
    """Left, right, rear and front end of each line of a class, bev frame."""
    chosen = [points for points, own in zip(lines.points, lines.classes, strict=True) if own == name]
    return {tuple(np.stack([p.min(0), p.max(0)], axis=1).ravel().round(6)) for p in chosen}


def test_lines_are_cut_and_in_the_bev_frame(expanded_root: Path) -> None:
    (lines,) = open_sequence(expanded_root).ground_truth_frame(0).ground_truth_results
    assert extents(lines, "divider") == {(0, 0, -30, 30)}
    assert extents(lines, "ped_crossing") == {(-4.5, 4.5, 9, 12)}  # its halves are one
    assert extents(lines, "boundary") == {(4.5, 4.5, -30, 30), (-4.5, -4.5, -30, 30), (-2.5, -1.5, 19, 21)}


def perfect_run(expanded_root: Path, folder: Path) -> Path:
    """What a model would predict that knows everything: objects move along y at 2 m/s, the vehicle at 5 m/s."""
    folder.mkdir()
    drive = open_sequence(expanded_root)
    lines = LinesWriter(folder / "map_lines.json", "world", {"classes": ["divider", "ped_crossing", "boundary"]})
    plans = PlanWriter(folder / "plan.csv", "world", {})
    plan = Plan(("straight",), np.stack([np.zeros(6), 5 * TIMES], axis=-1)[None], TIMES, "straight")
    with BoxesWriter(folder / "predictions.json", "world", {}) as writer:
        for place in range(len(drive.stamps)):
            frame = drive.ground_truth_frame(place)
            ground, boxes = Ground(frame.stamp, frame.rig.ego_from_bev, frame.world_from_ego), frame.ground_truth
            x, y = boxes.centers[:, :1] + 0 * TIMES, boxes.centers[:, 1:2] + 2 * TIMES
            futures = np.stack([np.broadcast_to(TIMES, x.shape), x, y], axis=-1)[:, None]
            scored = boxes.__class__(**vars(boxes) | {"scores": np.ones(len(boxes)), "futures": futures})
            stated = {"ego_from_bev": pose_to_json(Pose.from_matrix(frame.rig.ego_from_bev))}
            writer.write(FrameBoxes(frame.stamp, frame.world_from_ego, scored, stated))
            scores = [replace(true, scores=np.ones(len(true))) for true in frame.ground_truth_results]
            lines.write(ground, scores[0] if scores else None)
            plans.write(ground, plan)
    lines.close()
    plans.close()
    return folder


def test_a_root_is_ground_truth_of_lines_futures_and_plans(expanded_root: Path, tmp_path: Path) -> None:
    run = perfect_run(expanded_root, tmp_path / "run")
    scores = json.loads(invoked("eval", run, expanded_root, "--map", "--motion", "--plan", "--json").stdout)
    assert scores["map"]["mean_ap"] == 1
    assert scores["map"]["ground_truth_lines"]["divider"] == 8
    assert scores["motion"]["car"]["minADE"] == pytest.approx(0, abs=2e-3)
    assert scores["motion"]["car"]["EPA"] == 1
    assert scores["plan"]["frames"] == 2
    assert scores["plan"]["at_horizon"]["L2"]["3s"] == pytest.approx(0, abs=2e-3)


def test_missing_or_wrong_maps_are_named(expanded_root: Path, tmp_path: Path) -> None:
    run, bare = perfect_run(expanded_root, tmp_path / "run"), tmp_path / "bare"
    write_tables(bare / "v1.0-mini", Size(scenes=1, samples=8, objects=2))
    with pytest.raises(InputError, match=r"scene-0001.* has no true lines .*the map expansion in .*/expansion"):
        evaluate(run, bare, map=True)
    (bare / "v1.0-mini" / "log.json").write_text(json.dumps([{"token": token(9, 0), "location": "here"}]))
    (bare / "maps" / "expansion").mkdir(parents=True)
    (bare / "maps" / "expansion" / "here.json").write_text('{"node": [{"token": "a"}]}')
    with pytest.raises(InputError, match=r"here\.json: KeyError\('x'\) \(expected a map of nuScenes' map expansion"):
        open_sequence(bare).ground_truth_frame(0)


def assert_same_rig(one: CameraRig, other: CameraRig) -> None:
    assert set(one.names) == set(other.names)
    np.testing.assert_allclose(one.ego_from_bev, other.ego_from_bev, atol=1e-12)
    for name in one.names:
        assert (one[name].width, one[name].height) == (other[name].width, other[name].height)
        np.testing.assert_allclose(one[name].intrinsics, other[name].intrinsics, atol=1e-9)
        np.testing.assert_allclose(one[name].ego_from_camera, other[name].ego_from_camera, atol=1e-9)


def assert_same_frames(one, other, *, same_bytes: bool) -> None:
    assert [stamp.timestamp_ns for stamp in one.stamps] == [stamp.timestamp_ns for stamp in other.stamps]
    for place in range(len(one.stamps)):
        a, b = one.load(place), other.load(place)
        assert_same_rig(a.rig, b.rig)
        np.testing.assert_allclose(a.world_from_ego.matrix, b.world_from_ego.matrix, atol=1e-9)
        np.testing.assert_allclose(a.world_from_ego.quaternion, b.world_from_ego.quaternion, atol=1e-6)
        for name in a.rig.names:
            np.testing.assert_allclose(a.world_from_ego_at[name].matrix, b.world_from_ego_at[name].matrix, atol=1e-9)
            assert a.images[name].timestamp_ns == b.images[name].timestamp_ns
            np.testing.assert_array_equal(a.images[name].pixels_bgr, b.images[name].pixels_bgr)
            assert not same_bytes or a.images[name].encoded == b.images[name].encoded
        for quantity in ("acceleration", "angular_rate", "velocity"):
            np.testing.assert_allclose(getattr(a.kinematics, quantity), getattr(b.kinematics, quantity), atol=1e-12)
        np.testing.assert_allclose(a.ground_truth.centers, b.ground_truth.centers, atol=1e-9)
        np.testing.assert_allclose(a.ground_truth.sizes_lwh, b.ground_truth.sizes_lwh, atol=1e-9)
        np.testing.assert_allclose(wrap_angle(a.ground_truth.yaws - b.ground_truth.yaws), 0, atol=1e-9)
        assert a.ground_truth.classes.tolist() == b.ground_truth.classes.tolist()


@pytest.mark.slow
def test_nuscenes_root_gives_the_same_frames(real_drive, nuscenes_root):
    sequence = open_sequence(nuscenes_root)
    assert sequence.has_ego_motion
    assert [stamp.scene for stamp in sequence.stamps] == ["scene-0103"] * 4
    assert_same_frames(open_sequence(real_drive), sequence, same_bytes=True)


@pytest.mark.parametrize("kind", ["real_drive", "nuscenes_root"])
def test_boxes_are_counted_as_they_are_read_without_images(kind, request):
    drive = open_sequence(request.getfixturevalue(kind))
    frames = [drive.ground_truth_frame(place) for place in range(len(drive.stamps))]
    assert drive.class_counts == count_classes(frame.ground_truth for frame in frames)
    assert drive.class_counts
    assert not any(frame.images for frame in frames)


@pytest.mark.parametrize("which", [pytest.param("native", marks=pytest.mark.slow), "nuscenes"])
def test_converted_sequence_gives_the_same_frames(real_drive, nuscenes_root, tmp_path, which):
    source = open_sequence(real_drive if which == "native" else nuscenes_root)
    with NativeWriter(tmp_path / "out", with_ego_motion=True) as writer:
        for place in range(len(source.stamps)):
            writer.write(source.load(place))
    assert_same_frames(source, open_sequence(tmp_path / "out"), same_bytes=True)


def test_without_can_bus_kinematics_come_from_the_poses(nuscenes_root, tmp_path):
    """The car drives at 8.4 m/s forward, according to its sensors."""
    shutil.copytree(nuscenes_root, tmp_path / "root", ignore=shutil.ignore_patterns("can_bus"))
    measured, derived = open_sequence(nuscenes_root), open_sequence(tmp_path / "root")
    assert any("no CAN bus" in note for note in derived.notes)
    for place in range(4):
        a, b = measured.load(place).kinematics, derived.load(place).kinematics
        np.testing.assert_allclose(a.velocity, b.velocity, atol=0.3)
        np.testing.assert_allclose(a.angular_rate[2], b.angular_rate[2], atol=0.03)
        np.testing.assert_allclose(a.acceleration, b.acceleration, atol=0.8)


LINE = np.array([[1.0, 2.0], [3.0, 14.0]])


def with_lines(drive: MemoryDrive, index: int):
    return replace(drive.load(index), ground_truth_results=(MapLines((LINE,), np.array(["divider"])),))


def test_a_sequence_folder_keeps_the_lines_of_each_frame(tmp_path):
    drive = MemoryDrive(2)
    for source, target in ((None, "one"), ("one", "two")):
        read = None if source is None else open_sequence(tmp_path / source)
        with open_writer(tmp_path / target, drive, WriteOptions()) as writer:
            for place in range(2):
                writer.write(with_lines(drive, place) if read is None else read.load(place))
    read = open_sequence(tmp_path / "two")
    for place in range(2):
        (lines,) = read.load(place).ground_truth_results
        assert list(lines.classes) == ["divider"]
        np.testing.assert_allclose(lines.points[0], LINE, atol=0.005)


@pytest.mark.parametrize(("form", "expected"), [("native", set()), ("nuscenes", {"lines of the map"})])
def test_a_format_names_the_truth_that_it_leaves_out(form, expected):
    assert truth_left_out(with_lines(MemoryDrive(1), 0), form) == expected
