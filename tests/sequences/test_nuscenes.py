"""Reading nuScenes tables with known contents: poses, images, annotations, splits, and the cached index."""

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from nuscenes_tables import CAMERAS, SAMPLE_US, Size, ego_x, sample_time, scene_name, write_tables

from bevcli.errors import InputError
from bevcli.sequences.files.boxes_file import BoxesFile, boxes_from_json, boxes_to_json
from bevcli.sequences.open import open_sequence
from bevcli.workshop.formats import NuScenesOptions, nuscenes_tables as tables
from bevcli.workshop.formats.convert import write_boxes
from bevcli.workshop.formats.nuscenes import NuScenesDrive, read_can_bus
from bevcli.workshop.formats.nuscenes_index import MINI_VAL, NUSCENES, TEST, VAL, numbers, split_of
from bevcli.workshop.formats.nuscenes_tables import build_index
from bevcli.workshop.scores.evaluate import evaluate
from bevcli.workshop.scores.inputs import open_ground_truth

SMALL = Size(scenes=3, samples=4, objects=8)


@pytest.fixture
def root(tmp_path):
    write_tables(tmp_path / "v1.0-trainval", SMALL)
    return tmp_path


def edit_table(root, name, change):
    path = root / "v1.0-trainval" / f"{name}.json"
    rows = json.loads(path.read_text())
    path.write_text(json.dumps(change(rows)))


def test_keyframes_of_all_scenes_in_order(root):
    sequence = NuScenesDrive(root)
    assert [stamp.index for stamp in sequence.stamps] == list(range(12))
    assert [stamp.scene for stamp in sequence.stamps] == [scene_name(s) for s in range(3) for _ in range(4)]
    times = [sample_time(s, k) * 1000 for s in range(3) for k in range(4)]
    assert [stamp.timestamp_ns for stamp in sequence.stamps] == times


def test_poses_are_at_the_times_of_lidar_and_images(root):
    frame = NuScenesDrive(root).load(6)
    assert frame.world_from_ego.translation[0] == ego_x(1, sample_time(1, 2))
    assert frame.rig.names == CAMERAS
    # The images' files are not there; each camera has its own time between 10 and 40 ms before, on a 5 m/s drive.
    assert set(frame.dropped) == set(CAMERAS)
    lags = [frame.world_from_ego.translation[0] - frame.world_from_ego_at[name].translation[0] for name in CAMERAS]
    np.testing.assert_allclose(lags, [0.05, 0.08, 0.11, 0.14, 0.17, 0.2], atol=1e-9)


def test_ground_truth_has_the_ten_classes_only(root):
    """Objects 0 to 7 are car, adult, rack, animal, and again; racks and animals are in none of the ten classes."""
    sequence = NuScenesDrive(root)
    truth = sequence.load(5).ground_truth
    assert truth.classes.tolist() == ["car", "pedestrian"] * 2
    np.testing.assert_allclose(truth.centers, [[1000 + k, 1.0, 1.0] for k in (0, 1, 4, 5)])
    np.testing.assert_allclose(truth.sizes_lwh, [[4.5, 2.0, 1.6]] * 4)
    np.testing.assert_allclose(truth.yaws, np.pi / 4)
    np.testing.assert_allclose(truth.velocities, [[0, 2.0]] * 4)
    np.testing.assert_allclose(truth.visibilities, [0.2, 0.5, 0.2, 0.5])
    assert truth.num_points.tolist() == [1, 2, 5, 6]
    assert truth.attributes.tolist() == ["", "vehicle.moving"] * 2
    assert sequence.index.bicycle_racks(5).centers[:, 0].tolist() == [1002, 1006]


def test_velocity_is_unknown_over_a_long_gap(root):
    """Keyframes are 0.5 s apart. At twice the time between them velocities are known, at four times they are not."""

    def stretch(rows):
        return [{**row, "timestamp": 2 * row["timestamp"] - sample_time(0, 0)} for row in rows]

    edit_table(root, "sample", stretch)
    velocities = build_index(root / "v1.0-trainval", NUSCENES).ground_truth(1).velocities
    np.testing.assert_allclose(velocities, [[0, 1.0]] * len(velocities))
    edit_table(root, "sample", stretch)
    assert np.isnan(build_index(root / "v1.0-trainval", NUSCENES).ground_truth(1).velocities).all()
    edit_table(root, "sample_annotation", lambda rows: [{**rows[0], "prev": "", "next": ""}])
    assert np.isnan(build_index(root / "v1.0-trainval", NUSCENES).ground_truth(0).velocities).all()


@pytest.mark.parametrize("remove", [False, True])
def test_without_annotations_there_is_no_ground_truth(tmp_path, remove):
    write_tables(tmp_path / "v1.0-test", SMALL, annotated=False)
    if remove:
        for name in ("sample_annotation", "instance", "visibility", "attribute", "category"):
            (tmp_path / "v1.0-test" / f"{name}.json").unlink()
    sequence = NuScenesDrive(tmp_path)
    assert sequence.load(0).ground_truth is None
    assert len(sequence.stamps) == 12


def test_order_of_rows_does_not_matter(root, tmp_path):
    plain = build_index(root / "v1.0-trainval", NUSCENES)
    for name in ("sample", "sample_data", "ego_pose", "calibrated_sensor", "sample_annotation"):
        edit_table(root, name, lambda rows: rows[::-1])
    reversed_rows = build_index(root / "v1.0-trainval", NUSCENES)
    assert plain.samples.tokens.tolist() == reversed_rows.samples.tokens.tolist()
    assert plain.images.files.tolist() == reversed_rows.images.files.tolist()
    np.testing.assert_array_equal(plain.images.translations, reversed_rows.images.translations)


def test_batches_contain_all_rows_of_a_table(root, monkeypatch):
    path = root / "v1.0-trainval" / "sample_data.json"
    monkeypatch.setattr(tables, "BATCH_BYTES", 10_000)
    batches = list(tables.read_batches(path))
    assert len(batches) > 10
    assert [row for batch in batches for row in batch.rows] == json.loads(path.read_text())


def test_can_bus_is_the_first_message_after_the_time(tmp_path):
    (tmp_path / "can_bus").mkdir()
    rows = [{"utime": t, "accel": [t, 0, 9.8], "rotation_rate": [0, 0, t], "vel": [t, 0, 0]} for t in (10, 20, 30)]
    (tmp_path / "can_bus" / "scene-0001_pose.json").write_text(json.dumps(rows))
    can_bus = read_can_bus(tmp_path, "scene-0001")
    found = {time: can_bus.kinematics_at(time * 1000).velocity[0] for time in (5, 10, 15, 20, 30, 40)}
    assert found == {5: 10, 10: 20, 15: 20, 20: 30, 30: 30, 40: 30}
    assert read_can_bus(tmp_path, "scene-0002") is None


def test_sweeps_follow_the_front_images_between_keyframes(root):
    """There are six front images per keyframe, so 12 frames per second. Keyframes keep their samples and times."""
    keyframes, sweeps = NuScenesDrive(root), NuScenesDrive(root, own=NuScenesOptions(sweeps=True))
    times = np.array([stamp.timestamp_ns for stamp in sweeps.stamps if stamp.scene == scene_name(1)])
    assert len(times) == 4 * 6
    np.testing.assert_allclose(np.diff(times) / 1e3, SAMPLE_US / 6, atol=5)
    assert {stamp.timestamp_ns for stamp in keyframes.stamps} < {stamp.timestamp_ns for stamp in sweeps.stamps}
    for place in (6, 7):
        frame = sweeps.load(place)
        x = ego_x(0, frame.stamp.timestamp_ns // 1000)
        np.testing.assert_allclose(frame.world_from_ego.translation[0], x, atol=1e-6)
        assert (frame.sample_token is None) == (frame.ground_truth is None) == (place == 7)
        assert all(reason.endswith("is missing") for reason in frame.dropped.values())
        lags = [x - frame.world_from_ego_at[name].translation[0] for name in CAMERAS]
        np.testing.assert_allclose(lags, [0.05, 0.08, 0.11, 0.14, 0.17, 0.2], atol=1e-4)


def test_splits_have_their_official_scenes(root):
    assert (len(numbers(VAL)), len(numbers(TEST)), len(numbers(MINI_VAL))) == (150, 150, 2)
    assert not numbers(VAL) & numbers(TEST)
    assert split_of("scene-0103", mini=True) == "mini_val"
    assert split_of("scene-0103", mini=False) == "val"
    assert split_of("scene-0061", mini=False) == "train"
    assert split_of("scene-0077", mini=False) == "test"
    for split, scenes in (("val", {"scene-0003"}), ("train", {"scene-0001", "scene-0002"})):
        assert {stamp.scene for stamp in NuScenesDrive(root, own=NuScenesOptions(split=split)).stamps} == scenes


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"version": "v1.0-mini"}, "v1.0-trainval"),
        ({"scene": "scene-0009"}, "scene-0001"),
        ({"split": "validation"}, "mini_val"),
        ({"split": "test"}, "test"),
        ({"scene": "scene-0001", "split": "val"}, "scene-0001"),
    ],
)
def test_choice_without_scenes_is_an_error(root, options, expected):
    with pytest.raises(InputError, match=expected):
        open_sequence(root, **options)


def test_several_versions_require_a_choice(root):
    write_tables(root / "v1.0-mini", SMALL)
    with pytest.raises(InputError, match="`version`"):
        NuScenesDrive(root)
    assert NuScenesDrive(root, own=NuScenesOptions(version="v1.0-mini")).stamps


@pytest.mark.parametrize(
    ("table", "change", "expected"),
    [
        ("ego_pose", lambda rows: rows[1:], "ego_pose.json: token"),
        ("sample", lambda rows: rows[1:], "sample.json: token"),
        ("sample_data", lambda rows: [{**row, "timestamp": "now"} for row in rows], 'sample_data.json: "timestamp"'),
        ("sample_data", lambda rows: [{"token": row["token"]} for row in rows], "sample_data.json: a row has no"),
        (
            "sample_data",
            lambda rows: [r for r in rows if "CAM" not in r["filename"]],
            "sample_data.json: no row belongs",
        ),
        ("sample_data", lambda rows: [{**r, "width": 0} for r in rows], "sample_data.json .*camera .*found 0"),
        ("sample", lambda rows: [{**r, "timestamp": 1.5e9} for r in rows], "found 1500000000.0: give microseconds"),
        ("sensor", lambda rows: rows[1:], "sensor.json: token"),
        ("category", lambda rows: rows[1:], "instance.json: category .* is missing in category.json"),
        ("sample_annotation", lambda rows: [{**row, "size": [1, 2]} for row in rows], 'sample_annotation.json: "size"'),
        (
            "calibrated_sensor",
            lambda rows: [{**r, "rotation": [1, 0]} for r in rows],
            'calibrated_sensor.json: "rotation"',
        ),
        ("sample", lambda rows: {}, "expected a list"),
        ("scene", lambda rows: [], "no rows"),
    ],
)
def test_invalid_or_inconsistent_table_is_named(root, table, change, expected):
    edit_table(root, table, change)
    with pytest.raises(InputError, match=expected):
        NuScenesDrive(root)


def test_boxes_of_missing_instances_are_left_out_with_a_number(root):
    edit_table(root, "instance", lambda rows: rows[1:])
    drive = open_sequence(root)
    assert [len(drive.load(place).ground_truth) for place in range(12)] == [3] * 4 + [4] * 8
    assert sum(drive.class_counts.values()) == 3 * 4 + 4 * 8
    (note,) = [note for note in drive.notes if "instance.json" in note]
    assert "4 of 96 boxes are left out" in note
    edit_table(root, "instance", lambda rows: [])
    assert any("96 of 96 boxes are left out" in note for note in open_sequence(root).notes)


@pytest.mark.parametrize("size", [[0.0, 0.0, 0.0], [2.0, -4.0, 1.5]])
def test_boxes_of_an_impossible_size_are_left_out(size, root):
    edit_table(root, "sample_annotation", lambda rows: [{**rows[0], "size": size}, *rows[1:]])
    frames = [open_sequence(root).load(place) for place in range(2)]
    assert [len(frame.ground_truth) for frame in frames] == [3, 4]
    assert [frame.impossible_boxes for frame in frames] == [1, 0]
    truth = open_ground_truth(root)
    assert (truth.impossible_boxes, [len(frame.boxes) for frame in truth.boxes.frames[:2]]) == (1, [3, 4])
    predictions = root / "predictions.json"
    scored = [replace(one, boxes=replace(one.boxes, scores=np.ones(len(one.boxes)))) for one in truth.boxes.frames]
    write_boxes(BoxesFile("world", tuple(scored)), predictions)
    assert "1 box of the ground truth left out: a size of 0 or less, or not finite" in evaluate(predictions, root).notes


def test_scenes_without_frames_are_skipped(root):
    edit_table(root, "scene", lambda rows: [{**rows[0], "token": "e" * 32, "name": "empty"}, *rows])
    assert {stamp.scene for stamp in open_sequence(root).stamps} == {scene_name(number) for number in range(3)}
    with pytest.raises(InputError, match=r"sample_data\.json: scene empty has no image of a camera"):
        open_sequence(root, scene="empty")


def test_without_lidar_the_pose_is_the_nearest_and_bev_is_stated(root):
    with_lidar = open_sequence(root)
    rows = json.loads((root / "v1.0-trainval/sample_data.json").read_text())
    first = next(row for row in rows if "LIDAR" in row["filename"])
    edit_table(root, "sample_data", lambda rows: [row for row in rows if row["token"] != first["token"]])
    drive = open_sequence(root)  # of which one sample has none
    np.testing.assert_array_equal(drive.rig.ego_from_bev, with_lidar.rig.ego_from_bev)
    assert any("1 of 12 samples" in note for note in drive.notes)
    edit_table(root, "sample_data", lambda rows: [row for row in rows if "LIDAR" not in row["filename"]])
    drive = open_sequence(root)
    assert drive.stamps == with_lidar.stamps
    x = [drive.load(place).world_from_ego.translation[0] for place in range(4)]
    np.testing.assert_allclose(x, [ego_x(0, sample_time(0, sample) - 10_000) for sample in range(4)])
    assert drive.rig.ego_from_bev_assumed
    assert any("12 of 12 samples have no keyframe of LIDAR_TOP" in note for note in drive.notes)
    assert any("(0.94, 0, 1.84)" in note for note in drive.notes)


@pytest.mark.parametrize(("divisor", "said"), [(1000, "milliseconds"), (10**6, "milliseconds or seconds")])
def test_tables_in_another_unit_of_time_are_refused(divisor, said, root):
    for table in ("sample", "sample_data"):
        edit_table(root, table, lambda rows: [{**row, "timestamp": row["timestamp"] // divisor} for row in rows])
    with pytest.raises(InputError, match=f"the timestamps are {divisor} times too small .*{said}"):
        open_sequence(root)


def test_unknown_visibilities_and_points_are_unknown(root):
    edit_table(root, "visibility", lambda rows: [{**row, "level": "Not available"} for row in rows])
    edit_table(root, "sample_annotation", lambda rows: [{**row, "num_lidar_pts": None} for row in rows])
    truth = open_sequence(root).load(0).ground_truth
    assert np.isnan(truth.visibilities).all()
    assert (truth.num_points == -1).all()
    both = [{"num_lidar_pts": -1, "num_radar_pts": -1}, {"num_lidar_pts": 5, "num_radar_pts": 2}]
    edit_table(root, "sample_annotation", lambda rows: [{**row, **both[k // 4 % 2]} for k, row in enumerate(rows)])
    counts = open_sequence(root).load(0).ground_truth.num_points
    written = boxes_from_json(boxes_to_json(open_sequence(root).load(0).ground_truth), "written").num_points
    assert written.tolist() == [-1 if count < 0 else count for count in counts]


def test_missing_or_broken_table_is_named(root):
    path = root / "v1.0-trainval" / "ego_pose.json"
    path.write_text(path.read_text()[:1000])
    with pytest.raises(InputError, match=r"ego_pose.json: line 94, .*broken JSON"):
        NuScenesDrive(root)
    path.unlink()
    with pytest.raises(InputError, match=r"ego_pose.json: the table is missing"):
        NuScenesDrive(root)


@pytest.fixture
def cached(root, monkeypatch, tmp_path):
    """The small tables, cached like large ones."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(tables, "SMALLEST_BYTES", 0)
    return root


def test_cached_index_equals_the_built_index(cached, monkeypatch):
    before = sorted(path.name for path in (cached / "v1.0-trainval").iterdir())
    first, note = tables.open_index(cached / "v1.0-trainval")
    assert sorted(path.name for path in (cached / "v1.0-trainval").iterdir()) == before
    assert str(cached / "cache" / "bevcli") in note
    build = tables.build_index
    monkeypatch.delattr(tables, "build_index")  # the second time reads no table
    second, note = tables.open_index(cached / "v1.0-trainval")
    assert note == ""
    for part in ("scenes", "sensors", "samples", "images", "annotations"):
        for name, values in vars(getattr(first, part)).items():
            np.testing.assert_array_equal(values, getattr(getattr(second, part), name))
    monkeypatch.setattr(tables, "build_index", build, raising=False)
    edit_table(cached, "scene", lambda rows: [{**row, "name": "scene-09" + row["name"][-2:]} for row in rows])
    index, _ = tables.open_index(cached / "v1.0-trainval")  # of tables that changed
    assert index.scenes.names.tolist() == ["scene-0901", "scene-0902", "scene-0903"]


@pytest.mark.parametrize("content", [None, b"", b"\x93NUMPY broken", b"no folder", b"zeros"])
def test_a_damaged_cache_is_built_anew(cached, content):
    index, _ = tables.open_index(cached / "v1.0-trainval")
    (file,) = (cached / "cache").rglob("samples.times_us.npy")
    if content == b"no folder":
        file = file.parent
        shutil.rmtree(file)
    elif content == b"zeros":  # as after a loss of power: the size is right
        content = file.read_bytes()[:128].ljust(file.stat().st_size, b"\0")
    file.unlink() if content is None else file.write_bytes(content)
    again, note = tables.open_index(cached / "v1.0-trainval")
    assert "is cached in" in note
    np.testing.assert_array_equal(again.samples.times_us, index.samples.times_us)


def test_a_cache_that_cannot_be_written_leaves_nothing(cached, monkeypatch):
    def full(*arguments: object, **options: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "save", full)
    _, note = tables.open_index(cached / "v1.0-trainval")
    assert "cannot be cached (No space left on device)" in note
    assert not list((cached / "cache/bevcli/nuscenes").iterdir())


@pytest.mark.slow
def test_large_tables_take_little_memory(tmp_path):
    """40 scenes by default; BEVCLI_SCENES=850 writes tables of the real size (2.3 GB) and opens them in under 6 GB."""
    scenes = int(os.environ.get("BEVCLI_SCENES", "40"))
    write_tables(tmp_path / "v1.0-trainval", Size(scenes=scenes))
    code = (
        "import sys; from pathlib import Path; from bevcli.workshop.formats.nuscenes import NuScenesDrive\n"
        "sequence = NuScenesDrive(Path(sys.argv[1]))\n"
        # Not getrusage: a child's peak there begins with what its parent had.
        "peak = Path('/proc/self/status').read_text().split('VmHWM:')[1].split()[0]\n"
        "print(len(sequence.stamps), peak)"
    )
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path / "cache")}
    command = [sys.executable, "-c", code, str(tmp_path)]
    answer = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.split()
    assert int(answer[0]) == scenes * 41
    assert int(answer[1]) * 1024 < (6 if scenes == 850 else 1) * 2**30
