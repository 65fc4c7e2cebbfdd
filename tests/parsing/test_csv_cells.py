"""No name from outside is a formula in a CSV file, and every name comes back."""

import csv
from dataclasses import replace

import pytest
from memory_drive import MemoryDrive, make_rig
from recorded_drive import boxes_ahead

from bevcli.frame import FrameStamp
from bevcli.geometry.transforms import Pose
from bevcli.printing import cell_of, name_of
from bevcli.sequences.files.boxes_file import BoxesFile, FrameBoxes
from bevcli.sequences.files.boxes_table import write_csv
from bevcli.sequences.open import open_sequence
from bevcli.workshop.formats.output import NativeWriter

SIGNS = ("=", "+", "-", "@", "\t", "\r")


@pytest.mark.parametrize("name", ["+1+1", "=1+1", "-1", "@x", "\t=1", "'=1", "''-1", "'", "'a", "", "a=1", "scene-1"])
def test_a_name_comes_back_and_is_no_formula(name):
    assert not cell_of(name).startswith(SIGNS)
    assert name_of(cell_of(name)) == name


def test_scene_and_camera_come_back_from_frames_csv(tmp_path):
    drive = MemoryDrive(2, make_rig({"=FRONT": 0.0}))
    with NativeWriter(tmp_path / "drive", with_ego_motion=True) as writer:
        for place in range(2):
            frame = drive.load(place)
            writer.write(replace(frame, stamp=replace(frame.stamp, scene="-1+1")))
    cells = [cell for row in csv.reader((tmp_path / "drive/frames.csv").open()) for cell in row]
    assert not any(cell.startswith(SIGNS) for cell in cells)
    again = open_sequence(tmp_path / "drive")
    assert again.rig.names == ("=FRONT",)
    assert {stamp.scene for stamp in again.stamps} == {"-1+1"}


def test_boxes_of_odd_names_are_no_formulas(tmp_path):
    boxes = boxes_ahead()
    boxes = replace(boxes, instances=boxes.classes.astype("<U20"))
    boxes.instances[:] = "@SUM(1)"
    frame = FrameBoxes(FrameStamp(0, "=1+1", 5), Pose.identity(), boxes)
    write_csv(BoxesFile("world", (frame,)), tmp_path / "boxes.csv")
    for row in csv.DictReader((tmp_path / "boxes.csv").open()):
        assert row["scene"] == "'=1+1"
        assert row["instance"] == "'@SUM(1)"
