"""Interrupted runs: resumed they equal uninterrupted ones, and the output folder keeps what is not theirs."""

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from memory_drive import MemoryDrive

from bevcli.errors import OutputError
from bevcli.frame import FrameStamp
from bevcli.inference.load import Model
from bevcli.inference.tracking import TrackerConfig
from bevcli.model.bevformer import BEVFormer
from bevcli.recording import RecordingOptions
from bevcli.recording.writer import Recording
from bevcli.runs import RunOptions
from bevcli.runs.run_into_folder import run_in_folder, run_into_folder
from bevcli.runs.state import load_state, save_state
from bevcli.runs.summary import Counts
from bevcli.sequences.files.boxes_file import read_boxes
from bevcli.viewer.recording_file import open_recording
from bevcli.viewer.recording_reader import RecordingReader

FRAMES = 4
pytestmark = pytest.mark.usefixtures("unchecked_recordings")


class MadeDrive(MemoryDrive):
    """A drive with the tokens of nuScenes keyframes; loading the frame `broken` fails."""

    def __init__(self, count=FRAMES, broken=FRAMES):
        super().__init__(count)
        self.broken = broken

    def load(self, place):
        if place == self.broken:
            raise KeyboardInterrupt
        return replace(super().load(place), sample_token=f"token-{place}")


@pytest.fixture(scope="module")
def model(mini_config):
    torch.manual_seed(1)
    encoder, decoder = (replace(part, layers=1) for part in (mini_config.encoder, mini_config.decoder))
    config = replace(mini_config, heads=("detection", "segmentation"), encoder=encoder, decoder=decoder)
    return Model(BEVFormer(config).eval(), tracker=TrackerConfig(birth_score=0.0, keep_score=0.0))


def options_for(out, score=0.0):
    return RunOptions(recording=RecordingOptions(score=score), save_bev=out.parent / f"{out.name}-bev")


def run_all(model, out, drive=None, score=0.0, **arguments):
    return run_into_folder(model, drive or MadeDrive(), out, options_for(out, score), **arguments)


def stepped(model, out, drive=None, **arguments):
    return run_in_folder(model, drive or MadeDrive(), out, options_for(out), **arguments)


def interrupt(model, out, frames, drive=None):
    with pytest.raises(KeyboardInterrupt):
        run_all(model, out, drive or MadeDrive(broken=frames))


def contents(out: Path) -> dict[str, bytes]:
    """The files whose bytes do not depend on the time that a run took."""
    folders = (out, out.parent / f"{out.name}-bev")
    files = [path for folder in folders for path in folder.rglob("*") if path.is_file() and ".bevcli" not in path.parts]
    return {path.name: path.read_bytes() for path in files if path.name not in ("recording.rrd", "summary.json")}


@pytest.fixture(scope="module")
def whole(model, tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "out"
    run_all(model, out)
    return out


def assert_equals(out: Path, whole: Path) -> None:
    assert contents(out) == contents(whole)
    with open_recording(out / "recording.rrd") as file:
        assert file == out / "recording.rrd"
        assert [frame.index for frame in RecordingReader(file).frames()] == list(range(FRAMES))
    one, other = (json.loads((folder / "summary.json").read_text()) for folder in (out, whole))
    for key in ("frames", "boxes", "boxes_by_class", "tracks", "started_anew", "dropped_images"):
        assert one[key] == other[key]


@pytest.mark.parametrize("finished", [pytest.param(n, marks=[pytest.mark.slow] * (n != 2)) for n in range(FRAMES + 1)])
def test_a_resumed_run_equals_an_uninterrupted_one(model, whole, tmp_path, finished):
    drive = MadeDrive()
    drive.broken = finished
    out = tmp_path / "out"
    if finished < FRAMES:
        with pytest.raises(KeyboardInterrupt):
            run_all(model, out, drive)
    else:
        run_all(model, out, drive)
    assert len(read_boxes(out / "predictions.json").frames) == finished
    run_all(model, out, resume=True)
    assert_equals(out, whole)


def test_boxes_of_a_resumed_run_that_is_killed_are_all_in_its_recording(model, tmp_path, monkeypatch):
    out = tmp_path / "out"
    state = out / ".bevcli/state.pt"
    interrupt(model, out, 2)
    after_two = state.read_bytes()
    with pytest.raises(KeyboardInterrupt):
        run_all(model, out, MadeDrive(broken=3), resume=True)
    state.write_bytes(after_two)  # as if the third frame's had not been saved yet

    def kill(*_arguments, **_options):
        raise KeyboardInterrupt

    monkeypatch.setattr(Recording, "_send_layout", kill)  # its file is open
    with pytest.raises(KeyboardInterrupt):
        run_all(model, out, resume=True)
    with open_recording(out / "recording.rrd") as file:
        recorded = [frame.index for frame in RecordingReader(file).frames()]
    assert [frame.stamp.index for frame in read_boxes(out / "predictions.json").frames] == recorded == [0, 1]


def test_a_resumed_run_keeps_the_frames_that_failed(model, tmp_path):
    calls = []

    def spoil(module, arguments, output):
        calls.append(module)
        if len(calls) in (2, 3):  # the second frame, and the search in it
            output[0][0] = float("nan")

    with model.prepared.get_submodule("neck").register_forward_hook(spoil):
        interrupt(model, tmp_path / "out", 3)
    failed = json.loads((tmp_path / "out/summary.json").read_text())["not_finite_frames"]
    assert [each["frame"] for each in failed] == [1]
    assert run_all(model, tmp_path / "out", resume=True).to_dict()["not_finite_frames"] == failed


@pytest.fixture(scope="module")
def interrupted_once(model, tmp_path_factory):
    """The folder of a run after three frames, and a copy of it, with all that is beside them."""
    folder, kept = (tmp_path_factory.mktemp(name) for name in ("interrupted", "kept"))
    interrupt(model, folder / "out", 3)
    shutil.copytree(folder, kept, dirs_exist_ok=True)
    return folder, kept


@pytest.fixture
def interrupted(interrupted_once):
    folder, kept = interrupted_once
    yield folder / "out"
    shutil.rmtree(folder)
    shutil.copytree(kept, folder)


def test_another_run_is_not_resumed_and_the_difference_is_named(model, mini_model, interrupted):
    before = contents(interrupted)
    shifted = MadeDrive()
    shifted.stamps = (FrameStamp(0, "b", 5), *shifted.stamps[1:])
    with pytest.raises(OutputError, match=r"frames of the input: was 4, \w+, is 4, \w+"):
        run_all(model, interrupted, shifted, resume=True)
    with pytest.raises(OutputError, match=r"option recording: was .*0.0.*is .*0.5"):
        run_all(model, interrupted, score=0.5, resume=True)
    with pytest.raises(OutputError, match=r"model: was .* weights: was"):
        run_all(Model(mini_model), interrupted, resume=True)
    with pytest.raises(OutputError, match="exclude each other"):
        run_all(model, interrupted, resume=True, force=True)
    with pytest.raises(OutputError, match="`resume=True`"):
        run_all(model, interrupted)
    assert contents(interrupted) == before


def test_a_broken_state_is_an_error_of_one_line(model, interrupted):
    (interrupted / ".bevcli/state.pt").write_bytes(b"no state")
    with pytest.raises(OutputError, match=r"`force=True` .* to start anew"):
        run_all(model, interrupted, resume=True)


def test_resume_without_an_earlier_run_starts_at_the_first_frame(model, whole, tmp_path):
    run_all(model, tmp_path / "out", resume=True)
    assert_equals(tmp_path / "out", whole)


def test_force_removes_only_what_a_run_wrote(model, tmp_path):
    out = tmp_path / "out"
    run_all(model, out)
    kept = [out / "segmentation/0001.png", out / "segmentation/000099.png", out / "notes.txt", tmp_path / "a.json"]
    for path in kept:
        path.write_text("mine")
    (out / ".bevcli/written").open("a").write("../a.json\n")
    run_all(model, out, MadeDrive(2), force=True)
    assert all(path.read_text() == "mine" for path in kept)
    assert {path.name for path in out.glob("segmentation/00000*.png")} == {"000000.png", "000001.png"}
    mine = tmp_path / "other/segmentation/000000.png"
    mine.parent.mkdir(parents=True)
    mine.write_text("mine")
    with pytest.raises(OutputError, match=r"000000\.png: exists already, and no run wrote it"):
        run_all(model, tmp_path / "other", force=True)
    assert mine.read_text() == "mine"


def test_a_second_run_in_a_folder_is_refused_and_names_the_first(model, whole, tmp_path):
    with stepped(model, tmp_path / "out") as running:
        for _ in running.frames:
            for how in ({"force": True}, {"resume": True}):
                with pytest.raises(OutputError, match=f"in use by another run .process {os.getpid()}: "):
                    run_all(model, tmp_path / "out", **how)
    assert_equals(tmp_path / "out", whole)
    assert not (tmp_path / "out/.bevcli/lock").exists()


DAMAGE = {
    "tracks.csv": lambda path: path.write_bytes(bytes(100)),
    "results_nusc.json": lambda path: os.truncate(path, 400),
    "recording.rrd": lambda path: os.truncate(path, path.stat().st_size // 4),
    "segmentation/000001.png": lambda path: path.unlink(),
    "../out-bev/000000.npy": lambda path: path.unlink(),
}


def test_cut_files_are_named_and_left_alone(model, interrupted):
    kept = contents(interrupted)
    for name, damage in DAMAGE.items():
        folder = interrupted.with_name("damaged")
        shutil.copytree(interrupted.parent, folder, ignore=lambda *_: ["damaged"])
        damage(interrupted / name)
        before = contents(interrupted)
        named = (interrupted / name).resolve().name
        with pytest.raises(OutputError, match=rf"{named}: `resume` .*: was cut or removed.*`force=True`"):
            run_all(model, interrupted, resume=True)
        assert contents(interrupted) == before
        shutil.copytree(folder, interrupted.parent, dirs_exist_ok=True)
        shutil.rmtree(folder)
        assert contents(interrupted) == kept


def test_pipes_and_devices_in_place_of_files_are_not_waited_for(model, interrupted):
    path, calibration = interrupted / "segmentation/000001.png", interrupted / "calibration.json"
    content = path.read_bytes()
    for replaced in (os.mkfifo, lambda path: path.symlink_to("/dev/zero")):
        path.unlink()
        replaced(path)
        with pytest.raises(OutputError, match=r"000001.png: `resume` .*: was cut or removed"):
            run_all(model, interrupted, resume=True)
    path.unlink()
    path.write_bytes(content)
    calibration.unlink(missing_ok=True)
    os.mkfifo(calibration)
    run_all(model, interrupted, resume=True)
    assert calibration.is_file()


def test_a_pipe_that_appears_under_way_is_replaced(model, tmp_path):
    summary, state = tmp_path / "out/summary.json", tmp_path / "state.pt"
    with stepped(model, tmp_path / "out", MadeDrive(1)) as running:
        next(running.frames)
        os.mkfifo(summary)
    assert summary.is_file()
    os.mkfifo(state)
    save_state(state, Counts())
    assert load_state(state, Counts) == Counts()


def test_changed_images_are_seen(model, tmp_path):
    class WithImages(MadeDrive):
        def image_files(self, place):
            return (tmp_path / f"{place}.jpg",)

    for place in range(FRAMES):
        (tmp_path / f"{place}.jpg").write_bytes(bytes(place))
    out = tmp_path / "out"
    interrupt(model, out, 2, WithImages(broken=2))
    shutil.copy(tmp_path / "1.jpg", tmp_path / "3.jpg")
    with pytest.raises(OutputError, match=r"images of the input: was 4, \w+, is 4, \w+"):
        run_all(model, out, WithImages(), resume=True)


@pytest.mark.slow
def test_nothing_is_deleted_or_written_through_links(model, interrupted):
    elsewhere = interrupted.parent / "elsewhere"
    (elsewhere / "maps").mkdir(parents=True)
    precious = elsewhere / "maps" / "000000.png"
    precious.write_bytes(b"precious")
    shutil.rmtree(interrupted / "segmentation")
    (interrupted / "segmentation").symlink_to(elsewhere / "maps")
    with (interrupted / ".bevcli" / "written").open("a") as file:
        file.write(f"segmentation/000000.png\n{precious}\n../elsewhere/maps/000000.png\n")
    with pytest.raises(OutputError, match=r"segmentation/000000\.png: is a link, or leads out of"):
        run_all(model, interrupted, force=True)
    (interrupted / "segmentation").unlink()
    (interrupted / "segmentation").symlink_to("segmentation")
    with pytest.raises(OutputError, match=r"segmentation"):
        run_all(model, interrupted, force=True)
    (interrupted / "segmentation").unlink()
    (interrupted / "predictions.json").unlink(missing_ok=True)
    (interrupted / "predictions.json").symlink_to(elsewhere / "new")
    run_all(model, interrupted, force=True)
    assert precious.read_bytes() == b"precious"
    assert [path.name for path in elsewhere.rglob("*")] == ["maps", "000000.png"]


def test_a_deleted_lock_admits_no_second_run_which_leaves_no_lock(model, tmp_path):
    out = tmp_path / "out"
    with stepped(model, out) as running:
        for _ in running.frames:
            (out / ".bevcli/lock").unlink(missing_ok=True)
            with pytest.raises(OutputError, match="in use by another run"):
                run_all(model, out, resume=True)
            assert not (out / ".bevcli/lock").exists()
