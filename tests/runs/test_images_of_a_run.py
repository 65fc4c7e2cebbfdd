"""A run tells what is wrong with all images of a drive, or of a camera."""

import json
from dataclasses import replace

import numpy as np
import pytest
from memory_drive import MemoryDrive, WithoutImages

from bevcli.errors import InputError
from bevcli.frame import CameraImage
from bevcli.inference.load import Model
from bevcli.recording.options import RecordingOptions
from bevcli.runs.options import RunOptions
from bevcli.runs.run_into_folder import run_into_folder

MINIMAL = RunOptions(recording=RecordingOptions(level="minimal"))


def test_a_run_without_any_image_is_an_error(mini_model, tmp_path):
    drive = WithoutImages({0: "all", 1: "all"}, count=2)
    with pytest.raises(InputError, match=r"memory: not one image could be read \(camera CAM_FRONT: missing\)"):
        run_into_folder(Model(mini_model), drive, tmp_path / "none", MINIMAL)
    assert list(tmp_path.iterdir()) == []  # what would stand in the way of the corrected command
    with_one = run_into_folder(Model(mini_model), WithoutImages({0: "all"}, count=2), tmp_path / "none", MINIMAL)
    assert with_one.counts.skipped == [0]


class BreaksOff(MemoryDrive):
    """The second frame cannot be read."""

    broken = 1

    def load(self, place):
        if place == self.broken:
            raise InputError("an image has another size")
        return super().load(place)


@pytest.mark.parametrize("broken", [0, 1])
def test_a_run_that_fails_at_once_leaves_nothing(mini_model, tmp_path, broken):
    """Beside what was in the folder before. With a frame, there is something to resume."""
    (tmp_path / "before").mkdir()
    drive = BreaksOff(3)
    drive.broken = broken
    for name in ("new", "before"):
        with pytest.raises(InputError, match="another size"):
            run_into_folder(Model(mini_model), drive, tmp_path / name, MINIMAL)
        assert (tmp_path / name / "summary.json").exists() == (broken == 1)
    assert broken == 1 or list(tmp_path.iterdir()) == [tmp_path / "before"]
    run_into_folder(Model(mini_model), MemoryDrive(3), tmp_path / "before", MINIMAL, resume=broken == 1)


class TwelveBitsInSixteen(MemoryDrive):
    """The images of one camera have 12 bits that are stored in 16, of which a reader keeps the upper 8."""

    def load(self, place):
        frame = super().load(place)
        image = frame.images["CAM_BACK"]
        dark = CameraImage(image.timestamp_ns, (image.pixels_bgr.astype(np.uint16) * 16 // 256).astype(np.uint8))
        return replace(frame, images={**frame.images, "CAM_BACK": dark})


def test_images_that_are_black_throughout_are_said(mini_model, tmp_path):
    summary = run_into_folder(Model(mini_model), TwelveBitsInSixteen(2), tmp_path, MINIMAL)
    said = "all images of CAM_BACK are nearly black or white"
    assert said in summary.table()
    assert any(said in note for note in json.loads((tmp_path / "summary.json").read_text())["notes"])
