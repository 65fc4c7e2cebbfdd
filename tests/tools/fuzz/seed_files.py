"""A valid, small file of every format that bevcli reads, from which the fuzz tests make broken ones."""

import collections
import datetime
import json
from dataclasses import replace
from importlib import resources
from pathlib import Path

import cv2
import numpy as np
import safetensors.torch
import torch
import trimesh
import yaml
from bags import drive_messages, write_mcap, write_rosbag2
from memory_drive import MemoryDrive, make_rig
from nuscenes_tables import Size, scene_name, write_tables
from recorded_drive import record
from written_formats import WRITTEN

from bevcli.frame import FrameStamp
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Pose
from bevcli.inference.runner import RunnerState
from bevcli.model.bevformer import BevHistory
from bevcli.runs.state import RunState, save_state
from bevcli.runs.summary import Counts
from bevcli.sequences.files.ego_motion_file import read_ego_motion
from bevcli.sequences.open import open_sequence
from bevcli.workshop.training.trainer import save_checkpoint

CAMERAS = ("CAM_FRONT", "CAM_BACK")
SIZE = (64, 36)
QUATERNIONS = {"CAM_FRONT": [0.5, -0.5, 0.5, -0.5], "CAM_BACK": [0.5, -0.5, -0.5, 0.5]}
BOX = Boxes3D(np.ones((1, 3)), np.ones((1, 3)), np.zeros(1), np.full((1, 2), np.nan), np.array(["car"]))
START_NS, STEP_NS, FRAMES = 1_000_000_000, 500_000_000, 2


def write_seeds(folder: Path) -> None:
    """Writes all seed files into an empty folder."""
    _drive(folder / "drive")
    _videos(folder / "videos_drive")
    _rig(folder / "rig")
    _weights(folder)
    record(folder / "recording.rrd", MemoryDrive(1, make_rig({"CAM_FRONT": 0.0})))
    _nuscenes(folder / "nuscenes")
    _other_formats(folder)
    _boxes(folder)
    _bags(folder)
    _runs(folder)
    (folder / "classes.toml").write_text('"Lorry" = "truck"\nVan = "car"\n')
    (folder / "model.toml").write_bytes(resources.files("bevcli").joinpath("configs", "demo.toml").read_bytes())


def _calibration() -> dict:
    cameras = {
        name: {
            "width": SIZE[0],
            "height": SIZE[1],
            "intrinsics": [[50.0, 0, 31.5], [0, 50.0, 17.5], [0, 0, 1]],
            "distortion": {"model": "brown_conrady", "coefficients": [0.1, 0.01, 0.001, 0.001, 0.0]},
            "ego_from_camera": {"translation": [1.0, 0.0, 1.5], "rotation_wxyz": QUATERNIONS[name]},
        }
        for name in CAMERAS
    }
    bev = {"translation": [1, 0, 1.8], "rotation_wxyz": [0.5**0.5, 0, 0, -(0.5**0.5)]}
    return {"format": "bevcli-calibration/1", "ego_from_bev": bev, "cameras": cameras}


def _frame_boxes(number: int) -> dict:
    box = {"class": "car", "center": [12.0, 3.1, 0.8], "size_lwh": [4.5, 1.9, 1.6], "yaw": 0.02, "score": 0.8}
    box |= {"velocity": [5.1, 0.0], "attribute": "vehicle.moving", "instance": "a", "visibility": 1.0, "num_points": 3}
    pose = {"translation": [number * 5.0, 0, 0], "rotation_wxyz": [1, 0, 0, 0]}
    time = START_NS + number * STEP_NS
    return {"frame": number, "scene": "", "timestamp_ns": time, "world_from_ego": pose, "boxes": [box]}


def _boxes(folder: Path) -> None:
    frames = [_frame_boxes(number) for number in range(FRAMES)]
    file = {"format": "bevcli-boxes/1", "frame_of_reference": "world", "frames": frames}
    (folder / "predictions.json").write_text(json.dumps(file))
    box = {"translation": [1.0, 2, 0], "size": [1.9, 4.5, 1.6], "rotation": [1.0, 0, 0, 0], "velocity": [0.0, 1.0]}
    box |= {"sample_token": "a" * 32, "detection_name": "car", "detection_score": 0.5, "attribute_name": ""}
    (folder / "results_nusc.json").write_text(json.dumps({"meta": {}, "results": {"a" * 32: [box]}}))


def _drive(folder: Path) -> None:
    rows = ["frame,scene,timestamp_ns,CAM_FRONT,CAM_BACK,CAM_BACK.timestamp_ns"]
    pixels = np.random.default_rng(0).integers(0, 255, (SIZE[1], SIZE[0], 3), dtype=np.uint8)
    for name, suffix in zip(CAMERAS, (".jpg", ".png"), strict=True):
        (folder / "images" / name).mkdir(parents=True)
        for number in range(FRAMES):
            cv2.imwrite(str(folder / "images" / name / f"{number}{suffix}"), pixels)
    for number in range(FRAMES):
        time = START_NS + number * STEP_NS
        rows.append(f"{number},,{time},images/CAM_FRONT/{number}.jpg,images/CAM_BACK/{number}.png,{time + 1000}")
    (folder / "frames.csv").write_text("\n".join(rows) + "\n")
    (folder / "calibration.json").write_text(json.dumps(_calibration()))
    motion = ["timestamp_ns,x,y,z,qw,qx,qy,qz,ax,ay,az,wx,wy,wz,vx,vy,vz"]
    times = range(900_000_000, 1_800_000_000, 200_000_000)
    motion += [f"{time},{time / 1e8},0,0,1,0,0,0,0,0,9.81,0,0,0,10,0,0" for time in times]
    (folder / "ego_motion.csv").write_text("\n".join(motion) + "\n")
    frames = [_frame_boxes(number) for number in range(FRAMES)]
    truth = {"format": "bevcli-boxes/1", "frame_of_reference": "world", "frames": frames}
    (folder / "ground_truth.json").write_text(json.dumps(truth))
    (folder / "ground_truth_map").mkdir()
    legend = {"format": "bevcli-map/1", "x_range_m": [-8, 8], "y_range_m": [-8, 8]}
    legend["classes"] = {"1": "drivable_road", "2": "lane_boundary", "4": "pedestrian_crossing", "8": "vehicle"}
    (folder / "ground_truth_map" / "map.json").write_text(json.dumps(legend))
    for number in range(FRAMES):
        cv2.imwrite(str(folder / f"ground_truth_map/{number:06d}.png"), pixels[:16, :16, 0] & 15)
    (folder / "timing.toml").write_text(
        "start_ns = 1000000000\nrate_hz = 2.0\n[cameras.CAM_BACK]\noffset_ns = 1000\nrate_hz = 2.0\n"
    )


def _videos(folder: Path) -> None:
    (folder / "videos").mkdir(parents=True)
    for name, suffix, codec in zip(CAMERAS, (".mp4", ".avi"), ("mp4v", "MJPG"), strict=True):
        path = str(folder / "videos" / f"{name}{suffix}")
        writer = cv2.VideoWriter(path, cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*codec), 2.0, SIZE)
        for number in range(3):
            writer.write(np.full((SIZE[1], SIZE[0], 3), number * 60, np.uint8))
        writer.release()
    (folder / "calibration.json").write_text(json.dumps(_calibration()))


def _rig(folder: Path) -> None:
    folder.mkdir()
    camera = {
        "camera_model": "pinhole",
        "intrinsics": [50.0, 50.0, 31.5, 17.5],
        "distortion_model": "radtan",
        "distortion_coeffs": [0.1, 0.01, 0.001, 0.001],
        "resolution": list(SIZE),
    }
    chain = {"cam0": camera, "cam1": {**camera, "T_cn_cnm1": np.eye(4).tolist()}}
    (folder / "camchain.yaml").write_text(yaml.safe_dump(chain))
    matrix = {"rows": 3, "cols": 3, "data": [50.0, 0, 31.5, 0, 50.0, 17.5, 0, 0, 1]}
    info = {"image_width": SIZE[0], "image_height": SIZE[1], "camera_name": "cam0", "camera_matrix": matrix}
    info |= {"distortion_model": "plumb_bob", "distortion_coefficients": {"rows": 1, "cols": 5, "data": [0.0] * 5}}
    (folder / "camera_info.yaml").write_text(yaml.safe_dump(info))
    pose = {"translation": [1.0, 0, 1.5], "rotation_wxyz": QUATERNIONS["CAM_FRONT"]}
    (folder / "extrinsics.json").write_text(json.dumps({"cameras": {"cam0": {"ego_from_camera": pose}}}))
    _other_rigs(folder)


def _other_rigs(folder: Path) -> None:
    """One camera that looks ahead, as other programs write it."""
    k, d, t = [[50.0, 0, 31.5], [0, 50.0, 17.5], [0, 0, 1]], [0.1, 0.01, 0.001, 0.001], [1.0, 0, 1.5]
    r = [[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    matrix = [[*row, place] for row, place in zip(r, t, strict=True)]
    named = {"K": k, "D": d, "T": matrix, "resolution": list(SIZE)}
    (folder / "named.yaml").write_text(yaml.safe_dump({"cam0": named}))
    by_name = {"intrinsics": {"fx": 50, "fy": 50, "cx": 31.5, "cy": 17.5}, "distortion": {"k1": 0.1, "model": "radtan"}}
    by_name |= {"pose": {"position": {"x": 1, "y": 0, "z": 1.5}, "quaternion": [0.5, -0.5, 0.5, -0.5]}, "width": 64}
    (folder / "named.json").write_text(json.dumps({"cameras": [{"name": "cam0", "height": 36, **by_name}]}))
    data = " ".join(str(number) for row in k for number in row)
    matrices = f"<K type_id='opencv-matrix'><rows>3</rows><cols>3</cols><dt>d</dt><data>{data}</data></K>"
    xml = f"<opencv_storage>{matrices}<T>{' '.join(str(n) for row in matrix for n in row)}</T></opencv_storage>"
    (folder / "opencv.xml").write_text(xml.replace("</K>", "</K><width>64</width><height>36</height>"))
    opengl = [[0.0, 0, -1, 1], [-1, 0, 0, 0], [0, 1, 0, 1.5], [0, 0, 0, 1]]
    frame = {"file_path": "images/cam0/0.jpg", "transform_matrix": opengl}
    nerf = {"fl_x": 50.0, "cx": 32, "cy": 18, "w": 64, "h": 36, "k1": 0.1, "frames": [frame]}
    (folder / "transforms.json").write_text(json.dumps(nerf))
    (folder / "colmap").mkdir()
    (folder / "colmap/cameras.txt").write_text("# CAMERA_ID\n1 OPENCV 64 36 50 50 32 18 0.1 0.01 0 0\n")
    (folder / "colmap/images.txt").write_text("1 0.5 0.5 -0.5 0.5 0 1.5 -1 1 cam0/0.jpg\n1 2 -1\n")
    velodyne = "0 -1 0 0 0 0 -1 -0.08 1 0 0 -0.27"
    (folder / "kitti.txt").write_text(f"P2: 50 0 32 0 0 50 18 0 0 0 1 0\nS_rect_02: 64 36\nTr: {velodyne}\n")


def _weights(folder: Path) -> None:
    state = collections.OrderedDict(
        (name, torch.arange(6.0).reshape(2, 3)) for name in ("a.weight", "b.weight", "c.num_batches_tracked")
    )
    state["b.weight"] = state["a.weight"].t()
    meta = {"epoch": 3, "date": datetime.datetime(2022, 8, 16), "score": np.float64(0.5)}
    contents = {"state_dict": state, "meta": meta, "optimizer": {"state": {0: {"step": torch.tensor(1)}}}}
    torch.save(contents, folder / "weights.pth")
    torch.save(contents, folder / "old.pth", _use_new_zipfile_serialization=False)
    tensors = {name: tensor.contiguous().clone() for name, tensor in state.items()}
    safetensors.torch.save_file(tensors, folder / "weights.safetensors", {"epoch": "3"})


def _runs(folder: Path) -> None:
    """The state of a run, the summary of an older one, a checkpoint of a training, and a mesh of the vehicle."""
    (folder / "out/.bevcli").mkdir(parents=True)
    (folder / "out/.bevcli/written").write_text("recording.rrd\npredictions.json\n")
    memory, stamp = BevHistory(torch.zeros(1, 4, 2), Pose.identity()), FrameStamp(0, "", 5)
    runner = RunnerState(memory, stamp)
    save_state(folder / "out/.bevcli/state.pt", RunState({"model": "mini"}, None, Counts(), runner))
    (folder / "older").mkdir()
    (folder / "older/summary.json").write_text(json.dumps({"bevcli_version": "0.1", "files": ["older/recording.rrd"]}))
    model = torch.nn.Linear(2, 1)
    optimizer = torch.optim.AdamW(model.parameters())
    model(torch.ones(1, 2)).sum().backward()
    optimizer.step()
    save_checkpoint(folder / "checkpoint.pt", 1, model, optimizer)
    (folder / "loss.csv").write_text("step,loss\n1,0.5\n")
    (folder / "vehicle.glb").write_bytes(trimesh.creation.box((4.0, 2.0, 1.5)).export(file_type="glb"))


def _bags(folder: Path) -> None:
    motion = read_ego_motion(folder / "drive/ego_motion.csv")
    messages = list(drive_messages(open_sequence(folder / "drive"), motion))
    write_mcap(folder / "bag.mcap", messages)
    write_rosbag2(folder / "rosbag2", messages, "sqlite3")


def _other_formats(folder: Path) -> None:
    drive = open_sequence(folder / "drive", ground_truth=False)
    box = replace(BOX, instances=np.array(["1"]))
    frames = [replace(drive.load(place), ground_truth=box) for place in range(FRAMES)]
    for name, written in WRITTEN.items():
        written.write(frames, folder / name)


def _nuscenes(root: Path) -> None:
    write_tables(root / "v1.0-mini", Size(scenes=1, samples=2, objects=2))
    message = {"utime": 1_500_000_000_000_000, "accel": [0.0, 0, 9.8], "rotation_rate": [0.0] * 3, "vel": [1.0, 0, 0]}
    (root / "can_bus").mkdir()
    (root / "can_bus" / f"{scene_name(0)}_pose.json").write_text(json.dumps([message, message]))
