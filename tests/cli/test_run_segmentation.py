"""A run of a model with a segmentation head leaves its maps as files."""

from dataclasses import replace

import torch
from memory_drive import MemoryDrive

from bevcli.frame import MAP_CLASSES
from bevcli.inference.load import Model
from bevcli.model.bevformer.bevformer import BEVFormer
from bevcli.recording.options import RecordingOptions
from bevcli.runs.run_into_folder import RunOptions, run_into_folder
from bevcli.sequences.files.map_folder import open_maps


def run(config, out, frames, *, force=False):
    torch.manual_seed(0)
    options = RunOptions(recording=RecordingOptions("minimal"))
    run_into_folder(Model(BEVFormer(config).eval()), MemoryDrive(frames), out, options, force=force)


def test_maps_are_written_and_an_earlier_runs_maps_are_gone(mini_config, tmp_path):
    config = replace(mini_config, heads=("detection", "segmentation"))
    run(config, tmp_path, frames=3)
    run(config, tmp_path, frames=2, force=True)
    maps = open_maps(tmp_path / "segmentation")
    assert [maps.has(frame) for frame in range(3)] == [True, True, False]
    assert maps.load(1).cells.shape == (48, 40)
    assert (maps.x_range_m, maps.y_range_m, set(maps.classes)) == ((-25, 25), (-30, 30), set(MAP_CLASSES))


def test_a_model_without_the_head_writes_no_maps(mini_config, tmp_path):
    run(mini_config, tmp_path, frames=1)
    assert not (tmp_path / "segmentation").exists()
