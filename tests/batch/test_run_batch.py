"""A batch in this process: which drives arguments give, same bytes as single runs, failed drives, and `resume`."""

import contextlib
import csv
import itertools
import json
import os
import shutil
from dataclasses import replace
from types import SimpleNamespace

import cv2
import fsspec
import numpy as np
import pyarrow.parquet as pq
import pytest
from command_line import MINI_TOML
from sequences.nuscenes_tables import Size, write_tables
from small_fleet import make_job, results_of, write_drive, write_fleet

from bevcli.errors import BevcliError, InputError, OutputError
from bevcli.runs.run_into_folder import run_in_folder, run_into_folder
from bevcli.sequences.open import open_sequence
from bevcli.workshop.batch import worker as worker_module
from bevcli.workshop.batch.batch import Batch
from bevcli.workshop.batch.job import find_drives, read_list
from bevcli.workshop.batch.storage import open_storage
from bevcli.workshop.batch.worker import Worker
from bevcli.workshop.formats import BagOptions, NuScenesOptions
from bevcli.workshop.scores.evaluate import evaluate

COMPARED = ("predictions.json", "tracks.csv")


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    """Three drives with ground truth, an empty folder, and a model."""
    folder = tmp_path_factory.mktemp("fleet")
    (folder / "mini.toml").write_text(MINI_TOML)
    write_fleet(folder / "drives", 3, frames=2, truth=True)
    (folder / "drives/empty").mkdir()
    return folder


@pytest.fixture(scope="module")
def model(fleet):
    """The model of the fleet, with random weights."""
    return make_job(fleet / "out", fleet / "mini.toml").load_model()


@pytest.fixture(autouse=True)
def witness(monkeypatch):
    """A witness that sees nothing, at once."""
    monkeypatch.setattr("bevcli.workshop.trust.estimate.load_witness", lambda: SimpleNamespace(seen=lambda frame: {}))


@pytest.fixture
def batch(fleet, model, tmp_path):
    """Runs the fleet, or other drives, into tmp_path/out."""

    def run(texts=None, out=None, options=None, frames=None, ran=None, **arguments):
        job = make_job(tmp_path / "out" if out is None else out, fleet / "mini.toml", **(options or {}))
        drives, _ = find_drives(texts or [str(fleet / "drives/*")])
        started = Batch(job, model, drives, **arguments)
        with contextlib.closing(started.run()) as running:  # of which the first `frames` steps are taken
            skipped, *steps = itertools.islice(running, frames)
        assert started.summary.skipped == skipped
        if ran is not None:
            ran.extend(record for record in steps if record is not None)
        return started.summary

    return run


def run_alone(fleet, model, name, out):
    job = make_job(out, fleet / "mini.toml")
    drive = open_sequence(fleet / "drives" / name, job.source)
    run_into_folder(model, drive, out, job.run)


def times(out):
    """File -> time of its last change, of all results."""
    return {path: path.stat().st_mtime_ns for part in ("drives", "failed") for path in (out / part).rglob("*")}


def test_drives_have_bytes_of_single_runs_and_a_bad_one_is_a_row(batch, fleet, model, tmp_path):
    summary = batch(options={"retries": 1})
    assert (summary.drives, summary.failed, summary.skipped, summary.stopped) == (4, 1, 0, False)
    results = results_of(tmp_path / "out")
    assert set(results) == {"d000", "d001", "d002"}
    run_alone(fleet, model, "d001", tmp_path / "alone")
    for name in COMPARED:
        assert (results["d001"] / name).read_bytes() == (tmp_path / "alone" / name).read_bytes()
    facts = json.loads((results["d001"] / "summary.json").read_text())
    names = ("recording.rrd", *COMPARED, "calibration.json", "summary.json")
    assert facts["files"] == [str(results["d001"] / name) for name in names]
    rows = pq.read_table(tmp_path / "out/batch.parquet").to_pylist()
    assert [row["drive"] for row in rows] == ["d000", "d001", "d002", "empty"]
    assert [row["frames"] for row in rows] == [2, 2, 2, None]
    assert rows[3]["attempts"] == 2
    assert rows[3]["error"].startswith(f"{fleet}/drives/empty: is not a sequence folder")
    assert rows[0]["boxes"] == 20 == sum(count for name, count in rows[0].items() if name.startswith("boxes_"))
    with (tmp_path / "out/batch.csv").open() as file:
        assert [row["drive"] for row in csv.DictReader(file)] == ["d000", "d001", "d002", "empty"]
    assert not list((tmp_path / "out/.bevcli/attempts").iterdir())


def test_drives_that_are_not_scored_have_their_agreement(batch, tmp_path, monkeypatch):
    found = SimpleNamespace(score=0.51234, low=0.4, high=None)
    monkeypatch.setattr(worker_module, "agreement_of_boxes", lambda folder, drive: found)
    batch()
    row = pq.read_table(tmp_path / "out/batch.parquet").to_pylist()[0]
    assert (row["agreement"], row["agreement_low"], row["agreement_high"]) == (0.5123, 0.4, None)


def test_failed_drives_run_again_on_request_or_once_mended(batch, tmp_path):
    drives = tmp_path / "drives"
    write_drive(drives / "good", 1)
    (drives / "bad").mkdir()
    assert batch([str(drives / "*")]).failed == 1
    ran = []
    batch([str(drives / "*")], resume=True, retry_failed=True, ran=ran)
    assert [row["drive"] for row in ran] == ["bad"]
    write_drive(drives / "bad", 2)
    summary = batch([str(drives / "*")], resume=True)
    assert (summary.skipped, summary.failed) == (1, 0)


@pytest.mark.slow
def test_drives_run_again_if_input_or_option_differs_not_order(batch, tmp_path):
    paths = [str(path) for path in write_fleet(tmp_path / "drives", 3)]
    batch(paths)
    assert batch(paths[::-1], resume=True).skipped == 3
    table = tmp_path / "drives/d001/ego_motion.csv"
    os.utime(table, ns=(0, 0))
    assert batch(paths, resume=True).skipped == 2
    moved = tmp_path / "moved"
    shutil.move(tmp_path / "drives/d002", moved / "d002")
    assert batch([*paths[:2], str(moved / "d002")], resume=True).skipped == 3
    assert batch(paths[:2], resume=True, options={"evaluate": True}).skipped == 0


def test_a_folder_with_a_batch_or_other_files_is_not_overwritten(batch, fleet, tmp_path):
    batch([str(fleet / "drives/d000")])
    with pytest.raises(OutputError, match="has a batch already: pass `resume=True`"):
        batch([str(fleet / "drives/d000")])
    (tmp_path / "other").mkdir()
    (tmp_path / "other/file").touch()
    with pytest.raises(OutputError, match="is not a batch and not empty"):
        batch([str(fleet / "drives/d000")], out=tmp_path / "other")


def test_an_option_that_no_drive_has_is_refused_by_name(fleet, tmp_path):
    job = make_job(tmp_path / "out", fleet / "mini.toml")
    drives, _ = find_drives([str(fleet / "drives/*")])
    with pytest.raises(InputError, match=r"drives of the batch: `topics` \(`--topic`\) is for a ROS bag: remove it"):
        Batch(replace(job, own=(BagOptions(topics={"CAM": "/image"}),)), job.load_model(), drives)
    (tmp_path / "one.mcap").touch()
    mixed, _ = find_drives([str(fleet / "drives/d000"), str(tmp_path / "one.mcap")])
    replace(job, own=(BagOptions(topics={"CAM": "/image"}), NuScenesOptions())).check_options(mixed)


def test_a_wrong_mesh_of_a_class_ends_a_batch_before_it_starts(fleet, tmp_path):
    (tmp_path / "meshed.toml").write_text(f'{MINI_TOML}\n[class_settings.car]\nmesh = "car.glb"\n')
    job = make_job(tmp_path / "out", tmp_path / "meshed.toml")
    drives, _ = find_drives([str(fleet / "drives/*")])
    with pytest.raises(InputError, match=f'^mesh of class "car": {tmp_path}/car.glb: the file is missing$'):
        Batch(job, job.load_model(), drives)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_stopped_batch_goes_on_with_the_drives_that_are_left(batch, fleet, tmp_path):
    stopped = batch(frames=1 + 3 + 1)  # the second drive is stopped after its first frame
    assert stopped.stopped
    done = len(results_of(tmp_path / "out"))
    assert done == 1
    assert not [path for path in (tmp_path / "out/.bevcli/attempts").iterdir() if path.suffix == ".run"]
    summary = batch(resume=True)
    assert (summary.skipped, summary.failed, len(summary.records)) == (done, 1, 4)


def test_a_drive_that_kills_its_worker_each_time_becomes_a_row(fleet, tmp_path, monkeypatch):
    class Killed(BaseException):
        """What a worker does not survive."""

    def die(*arguments, **options):
        raise Killed

    job = make_job(tmp_path / "out", fleet / "mini.toml", retries=2)
    (drive,), _ = find_drives([str(fleet / "drives/d000")])
    monkeypatch.setattr(worker_module, "run_in_folder", die)
    for _ in range(3):
        with pytest.raises(Killed):
            next(Worker(job, "hash").run(drive))
    (record,) = Worker(job, "hash").run(drive)
    assert record["attempts"] == 3
    assert record["error"] == "the worker died in attempt 3 of 3 (out of memory, or a crash)"


def test_any_exception_of_one_drive_leaves_the_others_alone(batch, monkeypatch):
    def sometimes(model, sequence, *arguments, **options):
        if sequence.name == "d001":
            raise ZeroDivisionError("two\nlines")
        return run_in_folder(model, sequence, *arguments, **options)

    monkeypatch.setattr(worker_module, "run_in_folder", sometimes)
    summary = batch()
    errors = {record["drive"]: record["error"] for record in summary.records}
    assert errors["d000"] == errors["d002"] == ""
    assert errors["d001"] == "ZeroDivisionError: two lines"


def test_metrics_of_drives_equal_eval_and_joint_ones_are_written(batch, fleet, tmp_path):
    (fleet / "drives/d000/ground_truth.json").rename(fleet / "hidden.json")
    try:
        summary = batch(options={"evaluate": True})
    finally:
        (fleet / "hidden.json").rename(fleet / "drives/d000/ground_truth.json")
    records = {record["drive"]: record for record in summary.records}
    assert records["d000"]["scores"] is None
    alone = evaluate(results_of(tmp_path / "out")["d001"], fleet / "drives/d001").to_dict()
    assert records["d001"]["scores"]["trans_err"] == pytest.approx(alone["tp_errors"]["trans_err"], abs=1e-6)
    assert records["d001"]["scores"]["ground_truth_boxes"] == alone["ground_truth_boxes"] == 4
    joint = json.loads((tmp_path / "out/metrics.json").read_text())
    assert (joint["drives"], joint["frames"], joint["ground_truth_boxes"]) == (2, 4, 8)
    row = pq.read_table(tmp_path / "out/batch.parquet").to_pylist()[1]
    assert row["mean_ap"] == records["d001"]["scores"]["mean_ap"]


def test_urls_are_copied_and_removed_and_results_go_to_urls(batch, fleet, model, tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "scratch"))
    (tmp_path / "scratch").mkdir()
    memory = fsspec.filesystem("memory")
    memory.put(str(fleet / "drives/d000"), "/fleet/d000", recursive=True)
    memory.put(str(fleet / "drives/d001"), "/fleet/d001", recursive=True)
    try:
        summary = batch(["memory://fleet/*"], out="memory://results")
        assert [record["error"] for record in summary.records] == ["", ""]
        run_alone(fleet, model, "d001", tmp_path / "alone")
        found = memory.glob("/results/drives/d001-*/predictions.json")
        assert memory.cat_file(found[0]) == (tmp_path / "alone/predictions.json").read_bytes()
        assert memory.exists("/results/batch.parquet")
        assert memory.exists("/results/report.html")
        assert batch(["memory://fleet/*"], out="memory://results", resume=True).skipped == 2
    finally:
        memory.rm("/fleet", recursive=True)
        memory.rm("/results", recursive=True)
    assert not list((tmp_path / "scratch").iterdir())


@pytest.mark.slow
def test_a_nuscenes_root_at_a_url_gives_the_bytes_of_a_local_one(batch, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "scratch"))
    (tmp_path / "scratch").mkdir()
    root = tmp_path / "root"
    write_tables(root / "v1.0-mini", Size(scenes=2, samples=2, objects=1))
    for place, data in enumerate(json.loads((root / "v1.0-mini/sample_data.json").read_text())):
        if data["is_key_frame"] and "CAM_" in data["filename"] and place % 5:  # some images are missing
            (root / data["filename"]).parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(root / data["filename"]), np.full((900, 1600, 3), place % 200, np.uint8))
    memory = fsspec.filesystem("memory")
    memory.put(str(root), "/root", recursive=True)
    try:
        remote = batch(["memory://root"], out=tmp_path / "remote")
    finally:
        memory.rm("/root", recursive=True)
    assert [record["error"] for record in remote.records] == ["", ""]
    assert [record["scene"] for record in remote.records] == ["scene-0001", "scene-0002"]
    batch([str(root)], out=tmp_path / "local")
    local = results_of(tmp_path / "local")
    for name, folder in results_of(tmp_path / "remote").items():
        assert (folder / "predictions.json").read_bytes() == (local[name] / "predictions.json").read_bytes()
    assert not list((tmp_path / "scratch").iterdir())
    (tables,) = (tmp_path / "cache/bevcli/nuscenes-tables").iterdir()
    assert [path.name for path in tables.iterdir()] == ["v1.0-mini"]


def test_the_report_needs_no_other_file_nor_a_drives_markup(batch, fleet, tmp_path):
    name = "<b>bold<b>"
    shutil.copytree(fleet / "drives/d000", tmp_path / "drives" / name)
    batch([str(tmp_path / "drives" / name), str(fleet / "drives/empty")])
    page = (tmp_path / "out/report.html").read_text()
    assert "src=" not in page
    assert "http" not in page
    assert "<b>bold" not in page
    assert "is not a sequence folder" in page
    (result,) = results_of(tmp_path / "out").values()
    assert f'href="drives/{result.name}/recording.rrd"' in page


def test_the_hash_of_a_job_follows_model_weights_and_options(fleet, tmp_path):
    job = make_job(tmp_path, fleet / "mini.toml")
    model = job.load_model()
    other = tmp_path / "other.toml"
    other.write_text(MINI_TOML.replace("queries = 20", "queries = 21"))
    jobs = [
        job,
        replace(job, source=replace(job.source, every=2)),
        replace(job, run=replace(job.run, track=False)),
        replace(job, model=replace(job.model, precision="bf16")),
    ]
    hashes = [each.hash(model) for each in jobs] + [
        replace(job, model=replace(job.model, model=str(other))).hash(
            replace(job, model=replace(job.model, model=str(other))).load_model()
        )
    ]
    assert len(set(hashes)) == 5
    assert replace(job, out="elsewhere", retries=0).hash(model) == job.hash(model)


WRONG = {
    "attempts": "日本",
    "error": None,
    "frames": -1,
    "boxes": 1 << 80,
    "boxes_by_class": {"car": 0.5},
    "score_histogram": [1, 2],
    "scores": {"mean_ap": "high"},
    "result": "../elsewhere",
    "seconds": [],
    "input_errors": 3,
}


@pytest.mark.slow
def test_damaged_records_are_run_again(batch, tmp_path):
    names = [str(tmp_path / "drives" / f"d{number:03d}") for number in range(len(WRONG) + 1)]
    write_fleet(tmp_path / "drives", len(names), 1)
    batch(names)
    results = results_of(tmp_path / "out")
    before = {name: (folder / "drive.json").read_text() for name, folder in results.items()}
    for (name, folder), (key, value) in zip(sorted(results.items()), WRONG.items(), strict=False):
        (folder / "drive.json").write_text(json.dumps(json.loads(before[name]) | {key: value}))
    summary = batch(names, resume=True)
    assert (summary.failed, summary.skipped) == (0, 1)
    for name, folder in results_of(tmp_path / "out").items():
        old, new = json.loads(before[name]), json.loads((folder / "drive.json").read_text())
        assert old.keys() == new.keys()
        assert all(old[key] == new[key] for key in ("drive", "result", "attempts", "error", "boxes_by_class"))


@pytest.mark.slow
def test_odd_names_of_drives_are_cells_and_no_formulas(batch, tmp_path):
    names = ["+1+1", "-1", "=1+1", "@x", "\udcffx"]
    for seed, name in enumerate(names):
        write_drive(tmp_path / name, seed, 1)
    batch([str(tmp_path / name) for name in names])
    rows = list(csv.DictReader((tmp_path / "out/batch.csv").open()))
    assert [row["drive"] for row in rows] == ["'+1+1", "'-1", "_1+1", "_x", "_x"]
    assert rows[-1]["source"].endswith(r"/\udcffx")
    assert all(cell[:1] not in ("+", "=", "-", "@") for row in rows for cell in row.values())
    table = pq.read_table(tmp_path / "out/batch.parquet").to_pylist()
    assert [row["drive"] for row in table] == ["+1+1", "-1", "_1+1", "_x", "_x"]


def test_the_row_of_a_drive_in_millimetres_says_so(batch, tmp_path):
    calibration = write_drive(tmp_path / "wrong", 0) / "calibration.json"
    content = json.loads(calibration.read_text())
    pose = content["cameras"]["CAM_FRONT"]["ego_from_camera"]
    pose["translation"] = [1000 * metres for metres in pose["translation"]]
    calibration.write_text(json.dumps(content))
    batch([str(tmp_path / "wrong")])
    (row,) = pq.read_table(tmp_path / "out/batch.parquet").to_pylist()
    assert row["error"] == ""
    assert "CAM_FRONT" in row["input_errors"]
    assert "bevcli project-debug" in row["input_errors"]


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
    with pytest.raises(InputError, match=r"000150/scene_12\.json: object missing required field `data`"):
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
