"""nuScenes tables with known contents, of any size: poses, images, annotations, splits, the cached index."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from nuscenes_tables import CAMERAS, SAMPLE_US, Size, ego_x, sample_time, scene_name, write_tables

from bevcli.errors import InputError
from bevcli.sequences.nuscenes import cache as nuscenes_cache
from bevcli.sequences.nuscenes import json_tables as nuscenes_json
from bevcli.sequences.nuscenes.build import build_index
from bevcli.sequences.nuscenes.can_bus import read_can_bus
from bevcli.sequences.nuscenes.scenes import NuScenesChoice, NuScenesSequence
from bevcli.sequences.nuscenes.splits import MINI_TRAIN, MINI_VAL, TEST, VAL, numbers, split_of

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
    sequence = NuScenesSequence(root)
    assert [stamp.index for stamp in sequence.stamps] == list(range(12))
    assert [stamp.scene for stamp in sequence.stamps] == [scene_name(s) for s in range(3) for _ in range(4)]
    assert [stamp.timestamp_ns for stamp in sequence.stamps] == [
        sample_time(s, k) * 1000 for s in range(3) for k in range(4)
    ]


def test_poses_are_those_of_the_lidar_and_of_each_image(root):
    frame = NuScenesSequence(root).load(6)
    assert frame.world_from_ego.translation[0] == ego_x(1, sample_time(1, 2))
    assert frame.rig.names == CAMERAS
    # The images' files are not there; each camera has its own time between 10 and 40 ms before, on a 5 m/s drive.
    assert set(frame.dropped) == set(CAMERAS)
    lags = [frame.world_from_ego.translation[0] - frame.world_from_ego_at[name].translation[0] for name in CAMERAS]
    np.testing.assert_allclose(lags, [0.05, 0.08, 0.11, 0.14, 0.17, 0.2], atol=1e-9)


def test_ground_truth_is_of_the_ten_classes(root):
    """Objects 0 to 7 are in turn car, adult, rack, animal; the last two are none of the ten."""
    sequence = NuScenesSequence(root)
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


def test_velocities_are_unknown_over_long_gaps(root):
    """Between keyframes 2 s apart nothing is known; across two gaps of 1 s it is."""

    def stretch(rows):
        return [{**row, "timestamp": row["timestamp"] * 4 - 3 * sample_time(0, 0)} for row in rows]

    edit_table(root, "sample", stretch)
    index = build_index(root / "v1.0-trainval")
    assert np.isnan(index.ground_truth(1).velocities).all()


def test_a_single_annotation_has_no_velocity(root):
    edit_table(root, "sample_annotation", lambda rows: [{**rows[0], "prev": "", "next": ""}])
    assert np.isnan(build_index(root / "v1.0-trainval").ground_truth(0).velocities).all()


@pytest.mark.parametrize("remove", [False, True])
def test_without_annotations_there_is_no_ground_truth(tmp_path, remove):
    write_tables(tmp_path / "v1.0-test", SMALL, annotated=False)
    if remove:
        for name in ("sample_annotation", "instance", "visibility", "attribute", "category"):
            (tmp_path / "v1.0-test" / f"{name}.json").unlink()
    sequence = NuScenesSequence(tmp_path)
    assert sequence.load(0).ground_truth is None
    assert len(sequence.stamps) == 12


def test_the_order_of_rows_does_not_matter(root, tmp_path):
    plain = build_index(root / "v1.0-trainval")
    for name in ("sample", "sample_data", "ego_pose", "calibrated_sensor", "sample_annotation"):
        edit_table(root, name, lambda rows: rows[::-1])
    turned = build_index(root / "v1.0-trainval")
    assert plain.samples.tokens.tolist() == turned.samples.tokens.tolist()
    assert plain.images.files.tolist() == turned.images.files.tolist()
    np.testing.assert_array_equal(plain.images.translations, turned.images.translations)


def test_tables_read_in_batches_are_the_tables(root, monkeypatch):
    path = root / "v1.0-trainval" / "sample_data.json"
    monkeypatch.setattr(nuscenes_json, "BATCH_BYTES", 10_000)
    batches = list(nuscenes_json.read_batches(path))
    assert len(batches) > 10
    assert [row for batch in batches for row in batch] == json.loads(path.read_text())


def test_can_bus_is_the_first_message_after_the_time(tmp_path):
    (tmp_path / "can_bus").mkdir()
    rows = [{"utime": t, "accel": [t, 0, 9.8], "rotation_rate": [0, 0, t], "vel": [t, 0, 0]} for t in (10, 20, 30)]
    (tmp_path / "can_bus" / "scene-0001_pose.json").write_text(json.dumps(rows))
    can_bus = read_can_bus(tmp_path, "scene-0001")
    told = {time: can_bus.kinematics_at(time).velocity[0] for time in (5, 10, 15, 20, 30, 40)}
    assert told == {5: 10, 10: 20, 15: 20, 20: 30, 30: 30, 40: 30}
    assert read_can_bus(tmp_path, "scene-0002") is None


def test_sweeps_are_the_front_images_between(root):
    """Six front images a keyframe, so twelve frames a second; keyframes keep their samples and times."""
    keyframes, sweeps = NuScenesSequence(root), NuScenesSequence(root, NuScenesChoice(sweeps=True))
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


def test_splits_are_disjoint_and_whole():
    assert (len(numbers(VAL)), len(numbers(TEST)), len(numbers(MINI_TRAIN)), len(numbers(MINI_VAL))) == (150, 150, 8, 2)
    assert not numbers(VAL) & numbers(TEST)
    assert split_of("scene-0103", mini=True) == "mini_val"
    assert split_of("scene-0103", mini=False) == "val"
    assert split_of("scene-0061", mini=False) == "train"
    assert split_of("scene-0077", mini=False) == "test"


def test_a_split_picks_its_scenes(root):
    """Of scenes 1 to 3, the third is in val."""
    assert {stamp.scene for stamp in NuScenesSequence(root, NuScenesChoice(split="val")).stamps} == {"scene-0003"}
    assert {stamp.scene for stamp in NuScenesSequence(root, NuScenesChoice(split="train")).stamps} == {
        "scene-0001",
        "scene-0002",
    }


@pytest.mark.parametrize(
    ("choice", "expected"),
    [
        (NuScenesChoice(version="v1.0-mini"), "v1.0-trainval"),
        (NuScenesChoice(scene="scene-0009"), "scene-0001"),
        (NuScenesChoice(split="validation"), "mini_val"),
        (NuScenesChoice(split="test"), "test"),
        (NuScenesChoice(scene="scene-0001", split="val"), "scene-0001"),
    ],
)
def test_wrong_choices(root, choice, expected):
    with pytest.raises(InputError, match=expected):
        NuScenesSequence(root, choice)


def test_several_versions_ask_for_a_choice(root):
    write_tables(root / "v1.0-mini", SMALL)
    with pytest.raises(InputError, match="--version"):
        NuScenesSequence(root)
    assert NuScenesSequence(root, NuScenesChoice(version="v1.0-mini")).stamps


@pytest.mark.parametrize(
    ("table", "change", "expected"),
    [
        ("ego_pose", lambda rows: rows[1:], "ego_pose.json: token"),
        ("sample", lambda rows: rows[1:], "sample.json: token"),
        ("sample_data", lambda rows: [{**row, "timestamp": "now"} for row in rows], 'sample_data.json: "timestamp"'),
        ("sample_data", lambda rows: [{"token": row["token"]} for row in rows], "sample_data.json: a row has no"),
        ("sample_data", lambda rows: [r for r in rows if "LIDAR" not in r["filename"]], "no keyframe of LIDAR_TOP"),
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
def test_tables_that_do_not_fit(root, table, change, expected):
    edit_table(root, table, change)
    with pytest.raises(InputError, match=expected):
        NuScenesSequence(root)


def test_a_missing_or_broken_table_is_named(root):
    path = root / "v1.0-trainval" / "ego_pose.json"
    path.write_text(path.read_text()[:1000])
    with pytest.raises(InputError, match=r"ego_pose.json: cannot be read as JSON"):
        NuScenesSequence(root)
    path.unlink()
    with pytest.raises(InputError, match=r"ego_pose.json: the table is missing"):
        NuScenesSequence(root)


@pytest.fixture
def cached(root, monkeypatch, tmp_path):
    """The small tables, treated like large ones."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(nuscenes_cache, "SMALLEST_BYTES", 0)
    return root


def test_the_cached_index_is_the_index(cached, monkeypatch):
    first, note = nuscenes_cache.open_index(cached / "v1.0-trainval")
    assert str(cached / "cache" / "bevcli") in note
    monkeypatch.delattr(nuscenes_cache, "build_index")  # the second time reads no table
    second, note = nuscenes_cache.open_index(cached / "v1.0-trainval")
    assert note == ""
    for part in ("scenes", "sensors", "samples", "images", "annotations"):
        for name, values in vars(getattr(first, part)).items():
            np.testing.assert_array_equal(values, getattr(getattr(second, part), name))


def test_a_changed_table_makes_the_index_anew(cached):
    nuscenes_cache.open_index(cached / "v1.0-trainval")
    edit_table(cached, "scene", lambda rows: [{**row, "name": "scene-09" + row["name"][-2:]} for row in rows])
    index, _ = nuscenes_cache.open_index(cached / "v1.0-trainval")
    assert index.scenes.names.tolist() == ["scene-0901", "scene-0902", "scene-0903"]


def test_nothing_is_written_into_the_dataset(cached):
    before = sorted(path.name for path in (cached / "v1.0-trainval").iterdir())
    nuscenes_cache.open_index(cached / "v1.0-trainval")
    assert sorted(path.name for path in (cached / "v1.0-trainval").iterdir()) == before


@pytest.mark.slow
def test_large_tables_take_little_memory(tmp_path):
    """40 scenes by default; BEVCLI_SCENES=850 writes tables of the real size (2.3 GB) and opens them in under 6 GB."""
    scenes = int(os.environ.get("BEVCLI_SCENES", "40"))
    write_tables(tmp_path / "v1.0-trainval", Size(scenes=scenes))
    code = (
        "import sys; from pathlib import Path; from bevcli.sequences.nuscenes.scenes import NuScenesSequence\n"
        "sequence = NuScenesSequence(Path(sys.argv[1]))\n"
        # Not getrusage: a child's peak there begins with what its parent had.
        "peak = Path('/proc/self/status').read_text().split('VmHWM:')[1].split()[0]\n"
        "print(len(sequence.stamps), peak)"
    )
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path / "cache")}
    command = [sys.executable, "-c", code, str(tmp_path)]
    answer = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.split()
    assert int(answer[0]) == scenes * 41
    assert int(answer[1]) * 1024 < (6 if scenes == 850 else 1) * 2**30
