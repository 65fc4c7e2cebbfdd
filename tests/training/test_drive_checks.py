"""A training looks at its drives before it writes anything; a model file for a data set follows from its drives."""

import json
import shutil
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from command_line import MINI_TOML, command
from memory_drive import MemoryDrive
from recorded_drive import with_truth
from small_fleet import write_fleet

from bevcli.config import TRAINING, as_toml, load_config, load_table
from bevcli.errors import BevcliError, ConfigError, InputError
from bevcli.geometry.object_classes import NUSCENES_CLASSES
from bevcli.inference.load import Model
from bevcli.inference.runner import StepOptions
from bevcli.model.config import BevFrameConfig
from bevcli.model.temporal_model import build_model
from bevcli.sequences.native.folder import FolderDrive
from bevcli.workshop.synth import DriveOptions
from bevcli.workshop.synth.drives import FolderDrives, read_split, scored_drives
from bevcli.workshop.training import TrainOptions
from bevcli.workshop.training.job import TrainingConfig, TrainingJob, prepare_training, with_changes
from bevcli.workshop.training.model_file import (
    NUSCENES_SIZES,
    PRESETS,
    Cost,
    class_of_size,
    fitting_batch,
    look_at,
    model_table,
    write_model_file,
)
from bevcli.workshop.training.samples import ClipConfig
from bevcli.workshop.training.trainer import Trainer
from bevcli.workshop.training.validation import check_scored_drives, check_training_drives, run_drives

CPU = torch.device("cpu")
SETTINGS = {"clips.frames": "2", "clips.batch": "1", "held_out": "1", "steps": "1"}


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four drives of three frames with a car and a bicycle each, and mini.toml."""
    folder = tmp_path_factory.mktemp("fleet")
    write_fleet(folder, 4, truth=True)
    write_fleet(folder / "without", 2)
    (folder / "mini.toml").write_text(MINI_TOML)
    return folder


@pytest.fixture
def prepare(fleet: Path, tmp_path: Path) -> Callable[..., TrainingJob]:
    """`prepare_training` of the drives d000 to d003, into tmp_path/out."""

    def prepare(
        *names: str, classes: tuple[str, ...] = (), changes: dict[str, str] = SETTINGS, **data: object
    ) -> TrainingJob:
        toml = tmp_path / "mini.toml"
        own = f'name = "mini"\nclasses = {json.dumps(classes)}\ncameras ={MINI_TOML.partition("cameras =")[2]}'
        toml.write_text(own if classes else MINI_TOML)
        folders = tuple(fleet / name for name in names)
        options = TrainOptions(out=tmp_path / "out", changes={**SETTINGS, **changes})
        return prepare_training(str(toml), CPU, DriveOptions(data=folders, **data), options)

    return prepare


def test_a_training_states_its_drives_and_notes(prepare: Callable[..., TrainingJob], fleet: Path) -> None:
    job = prepare("d000", "d001", "d002", classes=("bicycle", "deer"))
    split = read_split(job.out / "split.toml")
    assert (split.train, split.validate) == ((fleet / "d000", fleet / "d001"), (fleet / "d002",))
    dropped, absent, scored, _ = job.notes
    said = "the 2 drives to train on: 6 boxes have other classes and are not trained on: car (6) (`class_map` "
    assert dropped.startswith(said)
    assert absent == "the 2 drives to train on: no box has the class deer of the model mini"
    assert scored.startswith("the drive to score on: 3 boxes have other classes and are not scored: car (3)")
    job.lock.close()
    notes = prepare("d000", "d001", changes={"freeze_batch_norm": "true"}).notes
    assert any("starts from random weights, but its file keeps the statistics of batch norms" in note for note in notes)


def test_no_known_class_is_an_error(prepare: Callable[..., TrainingJob], tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"has no class of the model mini \(expected deer; found bicycle \(6\), car"):
        prepare("d000", "d001", "d002", classes=("deer",))
    with pytest.raises(InputError, match=r"ground truth of rendered drives has no class .*set classes in the model's"):
        prepare(classes=("deer",), rendered=(1, 2))
    assert not (tmp_path / "out").exists()
    with pytest.raises(InputError, match=r"fewer frames than a clip, 21 .*: rendered drives \(20\)"):
        prepare(rendered=(1, 2), changes={"clips.frames": "21"})
    assert prepare("d000", "d001", classes=("deer",), class_map={"car": "deer"}).out.is_dir()


@pytest.mark.parametrize(
    ("names", "changes", "message"),
    [
        (
            ("d000", "without/d000", "d001"),
            {},
            "d000: 3 of 3 frames to train on have no ground truth boxes, the first is frame 0",
        ),
        (("d000", "d001", "d002"), {"clips.frames": "4"}, r"fewer frames than a clip, 4 .*: d000 \(3\), d001 \(3\)"),
        (("d000", "d001"), {"held_out": "2"}, "2 drives are too few with 2 of them held out"),
        (("d000", "nowhere", "d001"), {}, "nowhere: is missing"),
        (("d000", "d001"), {"clips.bach": "2"}, 'unknown key "clips.bach"; did you mean "clips.batch"'),
    ],
)
def test_refused_drives_leave_no_folder(
    names: tuple[str, ...], changes: dict, message: str, prepare: Callable[..., TrainingJob], tmp_path: Path
) -> None:
    with pytest.raises(BevcliError, match=message):
        prepare(*names, changes=changes)
    assert not (tmp_path / "out").exists()


def test_a_frame_without_ground_truth_is_named(fleet: Path, tmp_path: Path) -> None:
    drive = shutil.copytree(fleet / "d000", tmp_path / "part")
    truth = json.loads((drive / "ground_truth.json").read_text())
    (drive / "ground_truth.json").write_text(json.dumps(truth | {"frames": truth["frames"][1:]}))
    drives, config = FolderDrives([drive], load_config("tiny")), load_config("tiny")
    with pytest.raises(InputError, match=r"part: 1 of 3 frames to train on have no ground truth boxes, .* frame 0"):
        check_training_drives(DriveOptions(), drives, None, ClipConfig(frames=2), config)
    assert check_training_drives(DriveOptions(), drives, None, ClipConfig(frames=2, short_share=0.0), config)


def test_wrong_weights_leave_no_folder(fleet: Path, tmp_path: Path) -> None:
    options = TrainOptions(tmp_path / "out", changes=SETTINGS, weights=fleet / "mini.toml")
    with pytest.raises(BevcliError):
        prepare_training(str(fleet / "mini.toml"), CPU, DriveOptions(data=(fleet / "d000", fleet / "d001")), options)
    assert not (tmp_path / "out").exists()


def test_scored_drives_have_notes_too(fleet: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = replace(load_config(fleet / "mini.toml"), classes=("car", "Rad"))
    data = DriveOptions(data=(fleet / "d000",))
    notes = (dropped, _) = check_scored_drives(data, scored_drives(data, config), config)
    assert dropped.startswith("the drive: 3 boxes have other classes and are not scored: bicycle (3)")
    with pytest.raises(InputError, match="has no class of the model"):
        check_scored_drives(data, scored_drives(data, config), replace(config, classes=("deer",)))
    monkeypatch.setattr(FolderDrive, "class_counts", {})  # as of a format without a table
    assert check_scored_drives(data, scored_drives(data, config), config) == notes


def test_a_split_file_states_both_sets(fleet: Path, tmp_path: Path) -> None:
    file = fleet / "good.toml"
    file.write_text('train = ["d000", "d001"]\nvalidate = ["d003"]\n')
    options = TrainOptions(tmp_path / "out", changes=SETTINGS)
    job = prepare_training(str(fleet / "mini.toml"), CPU, DriveOptions(split=file), options)
    assert [job.drives.open(index).name for index in range(len(job.drives))] == ["d000", "d001"]
    assert [job.held_out.open(index).name for index in range(len(job.held_out))] == ["d003"]
    assert read_split(job.out / "split.toml") == read_split(file)
    scored = scored_drives(DriveOptions(split=file), load_config(fleet / "mini.toml"))
    assert isinstance(scored, FolderDrives)
    assert [scored.open(index).name for index in range(len(scored))] == ["d003"]
    with pytest.raises(InputError, match=r"states the drives: remove `data` \(`--data`\), or `split` \(`--split`\)"):
        scored_drives(DriveOptions(data=(fleet,), split=file), load_config(fleet / "mini.toml"))
    with pytest.raises(InputError, match=r"remove `held_out` \(`--held-out`\), or `split` \(`--split`\)"):
        prepare_training("demo", CPU, DriveOptions(split=file), TrainOptions(tmp_path / "other", held_out=1))
    file.write_text('train = ["d00?"]\nvalidate = ["without/d*"]\n')  # a star stands for folders in order
    assert [path.name for path in read_split(file).train] == ["d000", "d001", "d002", "d003"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('train = ["d000"]\n', "expected the keys train and validate, found train"),
        ('train = ["d000"]\nvalidate = []\n', "validate: leaves no drive"),
        ('train = ["d000"]\nvalidate = ["d9*"]\n', r"validate: d9\*: there is no such folder"),
        ('train = ["d000"]\nvalidate = ["./d000"]\n', "d000 stands there twice"),
        ('train = "d000"\nvalidate = ["d001"]\n', "train: expected a list of folders"),
    ],
)
def test_a_wrong_split_is_one_clear_line(text: str, message: str, fleet: Path) -> None:
    file = fleet / "wrong.toml"
    file.write_text(text)
    with pytest.raises(InputError, match=message):
        read_split(file)


def test_changes_have_the_types_of_toml() -> None:
    changes = {"optimizer.learning_rate": "1e-4", "clips.batch": "2", "weights_dtype": "float16"}
    changes |= {"clips.learn": '"all"'}
    changed = with_changes(TrainingConfig(), changes)
    assert changed.optimizer.learning_rate == 1e-4
    assert changed.clips == ClipConfig(batch=2, learn="all")
    assert changed.weights_dtype == "float16"
    assert with_changes(TrainingConfig(), {"training.rigs.cameras": "[5, 6]"}).rigs.cameras == (5, 6)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("learning_rte", "1", 'unknown key "learning_rte"; did you mean "optimizer.learning_rate"'),
        ("clips.batch", "two", "\"training.clips.batch\" must be an integer of 1 or more, but is 'two'"),
        ("clips", "2", 'unknown key "clips"; did you mean "clips'),
        ("clips.batch", "0", '"training.clips.batch" must be an integer of 1 or more, but is 0'),
        ("optimizer.average", "1", 'average" must be a number from 0 to below 1, but is 1'),
        ("optimizer.learning_rate", "0", 'learning_rate" must be a number above 0, but is 0'),
        ("augmentation.randomisation.color", "1.5", 'color" must be a number from 0 to 1, but is 1.5'),
        ("perspective_loss.depth_weight", "-1", 'depth_weight" must be a number of 0 or more, but is -1'),
        ("zzz", "0", "the keys are in the table of docs/training.md"),
    ],
)
def test_a_wrong_change_is_one_clear_line(key: str, value: str, message: str) -> None:
    with pytest.raises(ConfigError, match=rf"`changes` \(`--set`\): .*{message}"):
        with_changes(TrainingConfig(), {key: value})


def test_the_command_says_what_a_step_is_and_counts_updates(fleet: Path, tmp_path: Path) -> None:
    changes = SETTINGS | {"clips.learn": "all"}
    settings = [text for key, value in changes.items() for text in ("--set", f"{key}={value}")]
    drives = [text for name in ("d000", "d001") for text in ("--data", str(fleet / name))]
    options = ("--out", "out", "--log", "tensorboard")
    done = command(tmp_path, "train", "--model", fleet / "mini.toml", *drives, *settings, *options)
    assert done.returncode == 0, done.stderr
    lines = done.stderr.splitlines()
    assert lines[0] == (
        "a step is 2 updates of the weights, one for each frame of a batch: 1 batch of 1 clip of 2 frames; "
        "1 step; drives: 1 to train on, 1 to evaluate on; output: out"
    )
    assert lines[1].startswith("note: the drive to train on: no box has the class truck or ")
    assert lines[3].startswith("1/2 updates, ")
    assert ", step 1, loss " in lines[3]
    modes = [path.stat().st_mode & 0o777 for path in (tmp_path / "out/weights.safetensors", fleet / "mini.toml")]
    assert modes[0] == modes[1]
    assert list((tmp_path / "out" / "tensorboard").glob("events.out.tfevents.*"))


def test_missing_images_are_told(
    fleet: Path, prepare: Callable[..., TrainingJob], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    shutil.copytree(fleet / "d000", tmp_path / "d000")
    images = sorted(path for path in (tmp_path / "d000/images").rglob("*") if path.is_file())
    for path in images[1:]:
        path.unlink()
    model = Model(build_model(load_config(fleet / "mini.toml")).eval())
    frames = run_drives(model.runner(StepOptions()), FolderDrives((tmp_path / "d000",), model.config))
    assert sum(bool(frame.images) for _, frame, _ in frames) == 1
    assert f"d000: {len(images) - 1} images cannot be read" in caplog.text
    caplog.clear()
    job = prepare(str(tmp_path / "d000"), "d001", changes={"clips.batch": "3"})
    assert [event.done for event in Trainer(job).run()] == [0, 1]
    first, last = caplog.messages[0], caplog.messages[-1]
    assert first.startswith("warning: d000, frame ")
    assert first.endswith("black in training; all of these are counted at the end")
    assert f"{len(images) - 1} images could not be read, and were black in training: d000, frame 0, " in last


FRAME = BevFrameConfig()


class TrueDrive(MemoryDrive):
    """Frames with a car 12 m ahead and a bicycle at (5, 21) m, in the bev frame."""

    def load(self, place):
        return with_truth(super().load(place))


def test_the_file_trains_as_it_is_and_states_facts_and_cost(fleet: Path) -> None:
    path = fleet / "my model.toml"
    data = DriveOptions(data=(fleet / "d000", fleet / "d001"), class_map={"bicycle": "Fahrrad"})
    lines = write_model_file(path, data, "quick", CPU, longest_s=0.0)
    config, training = load_config(path), load_table(path, TRAINING, TrainingConfig)
    assert (config.name, config.classes, config.image.size) == ("my model", ("car", "Fahrrad"), (80, 45))
    assert (config.bev_grid.y_range_m, config.rate_hz, config.heads) == ((-21, 21), 2.0, ("detection",))
    assert (training.held_out, training.clips.frames, training.freeze_batch_norm) == (1, 3, True)
    assert config.training_rigs.cameras == (6, 6)
    comments = [line.removeprefix("# ") for line in path.read_text().splitlines() if line.startswith("# ")]
    assert comments == lines
    assert lines[1] == "Boxes in 6 frames: car 6, Fahrrad 6."
    assert "Fahrrad like car" in lines[2]  # the drive's bicycles are as long as cars
    assert config.object_classes["Fahrrad"].gate_m == NUSCENES_CLASSES["car"].gate_m
    assert "s an update" in lines[-2]
    assert "memory" in lines[-2]
    with pytest.raises(BevcliError, match="exists already"):
        write_model_file(path, data, "quick", CPU)


def test_a_slow_drive_keeps_its_rate_and_a_fast_one_is_thinned() -> None:
    for step_s, rate_hz, frames in ((1.0, 1.0, 4), (0.1, 2.0, 1)):
        facts = look_at([TrueDrive(4, step_s=step_s)], FRAME)
        table = model_table("m", "quick", facts)
        assert "horizon" not in table  # of demo, which knows renderings only
        assert (table["rate_hz"], table["training"]["clips"]["frames"]) == (rate_hz, frames)
    assert table["training"]["held_out"] == 0


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_gives_a_model_with_its_own_layers(preset: str, tmp_path: Path) -> None:
    facts = look_at([TrueDrive(6)], FRAME)
    (tmp_path / "m.toml").write_text(as_toml(model_table("m", preset, facts)))
    config, base = load_config(tmp_path / "m.toml"), load_config(PRESETS[preset][0])
    assert (config.encoder, config.decoder, config.backbone) == (base.encoder, base.decoder, base.backbone)
    assert (config.bev_grid.rows, config.channels) == (base.bev_grid.rows, base.channels)


def test_toml_keeps_texts_numbers_and_names_with_dots() -> None:
    table = {"a": 'Zug "1" ü', "b": [1, 2.5], "c": True, "d.e": {"f": 1e-4, "g": {"h": ["x"]}}}
    assert tomllib.loads(as_toml(table)) == table


def test_drives_without_boxes_and_other_options_are_refused(fleet: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="memory: has no ground truth boxes"):
        look_at([MemoryDrive(2)], FRAME)
    for data, message in (
        (DriveOptions(), r"give either `data` \(`--data[^`]*`\)"),
        (DriveOptions(rendered=(1,)), "rendered drives are trained with demo"),
    ):
        with pytest.raises(InputError, match=message):
            write_model_file(tmp_path / "new.toml", data, "quick", CPU)
    drive = ("--data", fleet / "d000")
    for arguments, message in (
        (("--init", "a.toml", "--steps", "3"), "--init trains nothing"),
        (("--preset", "tiny", "--model", "demo"), "--preset is for --init"),
        (("--init", "a.json"), "expected a name that ends in .toml"),
    ):
        done = command(tmp_path, "train", *arguments, *drive)
        assert (done.returncode, message in done.stderr, len(done.stderr.splitlines())) == (1, True, 1), done.stderr
    assert list(tmp_path.iterdir()) == []


def test_the_cost_of_a_step_the_batch_and_the_class_of_a_size() -> None:
    config = TrainingConfig(steps=10, clips=ClipConfig(frames=4, learn="all", in_turn=2))
    assert Cost(config, "cpu", 0.5, 2.0, 0).step_s == 4.0  # its updates
    assert Cost(config, "cpu", 0.5, 6.0, 0).step_s == 12.0  # the reading of its batches
    assert all(class_of_size(*size) == name for name, size in NUSCENES_SIZES.items())
    assert [class_of_size(*size) for size in ((4.1, 1.8, 1.5), (0.6, 0.6, 1.6))] == ["car", "pedestrian"]
    gigabytes = 10**9  # a batch fills the card, but never shrinks
    assert fitting_batch(4, 7 * gigabytes, 20 * gigabytes, 32) == 8
    assert fitting_batch(4, 7 * gigabytes, 200 * gigabytes, 32) == 32
    assert fitting_batch(4, 7 * gigabytes, 200 * gigabytes, 3) == 4
    assert fitting_batch(1, 7 * gigabytes, 8 * gigabytes, 32) == 1
