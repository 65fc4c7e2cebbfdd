"""The same drive through every way in gives the same boxes."""

import shutil

import cv2
import pytest
import torch

from bevcli.pipeline.preprocess import Preprocessor
from bevcli.pipeline.runner import Runner
from bevcli.sequences.open import open_sequence


def world_boxes(model, path):
    runner = Runner(model, torch.device("cpu"))
    sequence = open_sequence(path)
    steps = runner.run(sequence, range(len(sequence.stamps)), Preprocessor(model.config))
    return [prediction.boxes_world for _, prediction, _ in steps]


def assert_same_boxes(model, one, other):
    for a, b in zip(world_boxes(model, one), world_boxes(model, other), strict=True):
        assert a.centers == pytest.approx(b.centers, abs=0.05)
        assert a.scores == pytest.approx(b.scores, abs=1e-4)
        assert a.classes.tolist() == b.classes.tolist()


def test_a_native_folder_and_a_nuscenes_root(mini_model, shared):
    assert_same_boxes(mini_model, shared / "data/nuscenes-scene-0103", shared / "data/nuscenes-mini-4")


def test_a_native_folder_and_six_lossless_videos(mini_model, shared, tmp_path):
    drive = shared / "data/nuscenes-scene-0103"
    (tmp_path / "videos").mkdir()
    for name in ("calibration.json", "ego_motion.csv"):
        shutil.copyfile(drive / name, tmp_path / name)
    table = (drive / "frames.csv").read_text()
    for folder in (drive / "images").iterdir():
        video = f"videos/{folder.name}.mkv"
        writer = cv2.VideoWriter(str(tmp_path / video), cv2.VideoWriter_fourcc(*"FFV1"), 2, (1600, 900))
        for number, image in enumerate(sorted(folder.iterdir())):
            writer.write(cv2.imread(str(image)))
            table = table.replace(f"images/{folder.name}/{image.name}", f"{video}#{number}")
        writer.release()
    (tmp_path / "frames.csv").write_text(table)
    assert_same_boxes(mini_model, drive, tmp_path)
