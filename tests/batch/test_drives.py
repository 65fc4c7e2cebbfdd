"""Which drives arguments, lists and patterns give, and how the input of a drive is known again."""

import shutil

import pytest
from sequences.nuscenes_tables import Size, write_tables
from small_fleet import write_drive

from bevcli.errors import BevcliError, InputError
from bevcli.sequences.open import open_sequence
from bevcli.workshop.batch.job import find_drives, read_list
from bevcli.workshop.batch.storage import open_storage
from bevcli.workshop.formats import NuScenesOptions


def test_patterns_lists_and_paths_give_each_drive_once(tmp_path):
    for name in ("a", "b", "c"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "calibration.json").write_text(name)
    listed = tmp_path / "list.txt"
    listed.write_text(f"# the fleet\n{tmp_path}/b\n\n{tmp_path}/[bc]\n")
    drives, notes = find_drives([str(tmp_path / "a"), *read_list(listed), str(tmp_path / "a") + "/"])
    assert [drive.name for drive in drives] == ["a", "b", "c"]
    assert notes == ()


def test_copies_of_a_drive_run_once(tmp_path):
    write_drive(tmp_path / "one/d", 1, frames=1)
    shutil.copytree(tmp_path / "one", tmp_path / "two")  # keeps the times
    drives, notes = find_drives([str(tmp_path / "*/d")])
    assert len(drives) == 1
    assert notes == (f"{tmp_path}/two/d: is a copy of {tmp_path}/one/d: run once",)


def test_a_nuscenes_root_gives_a_drive_per_scene(tmp_path):
    write_tables(tmp_path / "v1.0-mini", Size(scenes=3, samples=2, objects=1))
    drives, _ = find_drives([str(tmp_path)])
    assert [(drive.name, drive.scene) for drive in drives] == [(f"scene-000{i}",) * 2 for i in (1, 2, 3)]
    assert len({drive.input_hash for drive in drives}) == 3
    (other,), _ = find_drives([str(tmp_path)], NuScenesOptions(version="v1.0-test"))
    assert 'has no version "v1.0-test"' in other.problem


def test_a_folder_of_drives_gives_all_of_them(tmp_path):
    """As ROOT/SPLIT/LOG of Argoverse 2, and ROOT/NUMBER/scene_*.json of DDAD, whose root has a file with splits."""
    for log in ("train/a", "val/a", "val/b"):
        (tmp_path / log / "calibration").mkdir(parents=True)
        (tmp_path / log / "city_SE3_egovehicle.feather").write_text(log)
    (tmp_path / "000150").mkdir()
    (tmp_path / "000150/scene_12.json").write_text("{}")
    (tmp_path / "ddad.json").write_text("{}")
    (tmp_path / "locked").mkdir(mode=0)
    drives, _ = find_drives([str(tmp_path)])
    assert [drive.name for drive in drives] == ["000150", "train-a", "val-a", "b"]
    assert [drive.source for drive in drives][1:] == [f"{tmp_path}/{log}" for log in ("train/a", "val/a", "val/b")]
    with pytest.raises(InputError, match=r"is a folder of 4 drives \(000150, train/a, val/a, b\): choose one with `sc"):
        open_sequence(tmp_path)
    with pytest.raises(InputError, match=f'{tmp_path}/000150/scene_12.json: "data" is missing'):
        open_sequence(tmp_path, scene="000150")


def test_names_are_safe_as_folders(tmp_path):
    for source, name in (("a b/../x y.mcap", "x_y"), ("..hidden", "hidden"), ("s3://bucket/fleet/7.db3", "7")):
        drive = find_drives([source if "://" not in source else str(tmp_path / "7.db3")])[0][0]
        assert drive.name == name


def test_what_cannot_be_found_is_named(tmp_path):
    with pytest.raises(InputError, match="nothing matches this pattern"):
        find_drives([str(tmp_path / "x*")])
    with pytest.raises(InputError, match="there are no drives"):
        find_drives([])
    (tmp_path / "list.txt").write_text("# nothing\n")
    with pytest.raises(InputError, match="contains no drive"):
        read_list(tmp_path / "list.txt")


def test_a_missing_package_for_a_url_is_named():
    with pytest.raises(BevcliError, match=r"gs:// needs a package that is not installed: run pip install gcsfs"):
        open_storage("gs://bucket/fleet")
    with pytest.raises(BevcliError, match=r"Protocol not known"):
        open_storage("nosuch://bucket/fleet")
    (drive,), _ = find_drives(["gs://bucket/fleet"])
    assert "pip install gcsfs" in drive.problem
