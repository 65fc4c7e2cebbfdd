"""The same drive through every way in gives the same boxes."""

import json
import shutil

import cv2
import numpy as np
import pytest
import torch
from bags import drive_messages, write_mcap

from bevcli.inference.runner import Runner
from bevcli.sequences.files.ego_motion_file import read_ego_motion
from bevcli.sequences.open import open_sequence


def world_boxes(model, path, count):
    runner = Runner(model, torch.device("cpu"))
    sequence = open_sequence(path, frames=slice(0, count))
    steps = runner.run(sequence)
    return [prediction.boxes_world for _, prediction, _ in steps]


def assert_same_boxes(model, one, other, count=4):
    for a, b in zip(world_boxes(model, one, count), world_boxes(model, other, count), strict=True):
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
    table = "\n".join((drive / "frames.csv").read_text().splitlines()[:3])  # two frames
    for folder in (drive / "images").iterdir():
        video = f"videos/{folder.name}.mkv"
        writer = cv2.VideoWriter(str(tmp_path / video), cv2.VideoWriter_fourcc(*"FFV1"), 2, (1600, 900))
        for number, image in enumerate(sorted(folder.iterdir())[:2]):
            writer.write(cv2.imread(str(image)))
            table = table.replace(f"images/{folder.name}/{image.name}", f"{video}#{number}")
        writer.release()
    (tmp_path / "frames.csv").write_text(table)
    assert_same_boxes(mini_model, drive, tmp_path, count=2)


def test_a_native_folder_and_an_mcap_file(mini_model, shared, tmp_path):
    native = as_a_bag_holds_it(shared / "data/nuscenes-scene-0103", tmp_path / "native")
    motion = read_ego_motion(native / "ego_motion.csv")
    bag = write_mcap(tmp_path / "drive.mcap", drive_messages(open_sequence(native), motion))
    assert_same_boxes(mini_model, native, bag)


def as_a_bag_holds_it(source, folder):
    """A copy with what a bag holds: no bev frame, poses without kinematics, and frames at the time of CAM_BACK."""
    shutil.copytree(source, folder)
    calibration = json.loads((folder / "calibration.json").read_text())
    del calibration["ego_from_bev"]
    (folder / "calibration.json").write_text(json.dumps(calibration))
    motion = read_ego_motion(source / "ego_motion.csv")
    lines = ["timestamp_ns,x,y,z,qw,qx,qy,qz"]
    for time in np.linspace(motion.first_ns, motion.last_ns, 17).astype(np.int64).tolist():
        pose = motion.pose_at(time)
        lines.append(",".join(map(repr, [time, *pose.translation.tolist(), *pose.quaternion.tolist()])))
    (folder / "ego_motion.csv").write_text("\n".join(lines) + "\n")
    rows = [line.split(",") for line in (folder / "frames.csv").read_text().splitlines()]
    column = rows[0].index("CAM_BACK.timestamp_ns")
    for row in rows[1:]:
        row[1], row[2] = "", row[column]
    (folder / "frames.csv").write_text("\n".join(map(",".join, rows)) + "\n")
    return folder
