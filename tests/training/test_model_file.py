"""A model file for a data set follows from its drives, can be trained as it is, and states the cost."""

import tomllib
from pathlib import Path

import pytest
import torch
from command_line import command
from memory_drive import MemoryDrive
from recorded_drive import with_truth
from small_fleet import write_fleet

from bevcli.config import TRAINING, as_toml, load_config, load_table
from bevcli.errors import BevcliError, InputError
from bevcli.geometry.object_classes import NUSCENES_CLASSES
from bevcli.model.config import BevFrameConfig
from bevcli.workshop.synth import DriveOptions
from bevcli.workshop.training.job import TrainingConfig
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

CPU = torch.device("cpu")
FRAME = BevFrameConfig()


class TrueDrive(MemoryDrive):
    """Frames with a car 12 m ahead and a bicycle at (5, 21) m, in the bev frame."""

    def load(self, place):
        return with_truth(super().load(place))


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fleet")
    write_fleet(folder, 2, truth=True)
    return folder


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
