"""Every reader of bevcli with the seed file that the fuzz tests break: what a user's command would do with it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Reader:
    """A reader.

    Attributes:
        file: the seed file that is broken.
        kind: how it is broken, see `mutations.edits`.
        read: reads the folder of seed files.
    """

    file: str
    kind: str
    read: Callable[[Path], object]


def _drive(name: str = "drive", **options: object) -> Callable[[Path], None]:
    def read(folder: Path) -> None:
        from bevcli.sequences.open import open_sequence

        sequence = open_sequence(folder / name, **options)
        for place in range(min(3, len(sequence.stamps))):
            sequence.load(place)

    return read


def _unlisted(folder: Path) -> None:
    from bevcli.workshop.formats.unlisted import find_frames

    find_frames(folder / "drive", ("CAM_FRONT", "CAM_BACK"))


def _check(folder: Path) -> None:
    from bevcli.rig.check_calibration import check_calibration

    check = check_calibration(folder / "drive")
    check.text()
    check.to_json()


def _maps(folder: Path) -> None:
    from bevcli.sequences.files.map_folder import open_maps

    maps = open_maps(folder / "drive/ground_truth_map")
    maps.load(0)
    maps.load(1)


def _model(folder: Path) -> None:
    from bevcli.checkpoints import expected_state
    from bevcli.config import TRACKING, TRAINING, load_config, load_table
    from bevcli.inference.tracking import TrackerConfig
    from bevcli.workshop.training.job import TrainingConfig

    load_table(folder / "model.toml", TRACKING, TrackerConfig)
    load_table(folder / "model.toml", TRAINING, TrainingConfig)
    expected_state(load_config(folder / "model.toml"))


def _rig(name: str, **more: str) -> Callable[[Path], None]:
    """more: other files of the rig, by the option that names them; without any, `name` is a calibration."""

    def read(folder: Path) -> None:
        from bevcli.sequences.files.calibration_file import draft_of
        from bevcli.sequences.options import RigOptions

        files = {"intrinsics" if more else "calibration": name, **more}
        draft_of(RigOptions(**{key: folder / "rig" / file for key, file in files.items()}), folder / "drive")

    return read


def _weights(name: str) -> Callable[[Path], None]:
    def read(folder: Path) -> None:
        from bevcli.checkpoints import read_checkpoint

        read_checkpoint(folder / name)

    return read


def _recording(folder: Path) -> None:
    from bevcli.viewer.recording_file import open_recording
    from bevcli.viewer.recording_reader import summarise

    with open_recording(folder / "recording.rrd") as file:
        summarise(folder / "recording.rrd", file)


def _state(folder: Path) -> None:
    from bevcli.model.bevformer import BevHistory
    from bevcli.runs.state import RunFolder, RunState, saved_state

    with RunFolder(folder / "out", resume=True) as out:
        saved_state(out, {"model": "mini"}, RunState[BevHistory])


def _older_run(folder: Path) -> None:
    from bevcli.runs.state import RunFolder

    with RunFolder(folder / "older", force=True):
        pass


def _checkpoint(folder: Path) -> None:
    import torch

    from bevcli.workshop.training.trainer import load_checkpoint
    from bevcli.workshop.training.validation import LearningCurve

    model = torch.nn.Linear(2, 1)
    load_checkpoint(folder / "checkpoint.pt", model, torch.optim.AdamW(model.parameters()))
    LearningCurve(folder / "loss.csv", done=1)


def _vehicle(folder: Path) -> None:
    from bevcli.workshop.meshes import load_vehicle

    load_vehicle(folder / "vehicle.glb")


def _classes(folder: Path) -> None:
    from bevcli.sequences.files.boxes_file import read_class_map

    read_class_map(folder / "classes.toml")


def _predictions(folder: Path) -> None:
    from bevcli.workshop.scores.evaluate import evaluate

    evaluate(folder / "predictions.json", folder / "drive/ground_truth.json")


def _submission(folder: Path) -> None:
    from bevcli.workshop.scores.inputs import open_predictions

    open_predictions(folder / "results_nusc.json")


TABLES = ("scene", "sample", "sensor", "calibrated_sensor", "sample_data", "ego_pose", "sample_annotation", "instance")
SMALL_TABLES = ("category", "attribute", "visibility")
READERS = {
    "calibration": Reader("drive/calibration.json", "json", _drive()),
    "calibration check": Reader("drive/calibration.json", "json", _check),
    "frames": Reader("drive/frames.csv", "text", _drive()),
    "ego-motion": Reader("drive/ego_motion.csv", "text", _drive()),
    "ground truth": Reader("drive/ground_truth.json", "json", _drive()),
    "map": Reader("drive/ground_truth_map/000000.png", "bytes", _maps),
    "map legend": Reader("drive/ground_truth_map/map.json", "json", _maps),
    "timing": Reader("drive/timing.toml", "text", _unlisted),
    "model": Reader("model.toml", "text", _model),
    "Kalibr": Reader("rig/camchain.yaml", "text", _rig("camchain.yaml", extrinsics="extrinsics.json")),
    "ROS": Reader("rig/camera_info.yaml", "text", _rig("camera_info.yaml", extrinsics="extrinsics.json")),
    "extrinsics": Reader("rig/extrinsics.json", "json", _rig("camchain.yaml", extrinsics="extrinsics.json")),
    **{
        name: Reader(f"rig/{file}", kind, _rig(file.partition("/")[0]))
        for name, file, kind in (
            ("K, D and T", "named.yaml", "text"),
            ("K, D and T by number", "named.json", "json"),
            ("OpenCV XML", "opencv.xml", "text"),
            ("nerfstudio", "transforms.json", "json"),
            ("COLMAP cameras", "colmap/cameras.txt", "text"),
            ("COLMAP images", "colmap/images.txt", "text"),
            ("KITTI calibration", "kitti.txt", "text"),
        )
    },
    "JPEG": Reader("drive/images/CAM_FRONT/0.jpg", "bytes", _drive()),
    "PNG": Reader("drive/images/CAM_BACK/1.png", "bytes", _drive()),
    "MP4": Reader("videos_drive/videos/CAM_FRONT.mp4", "bytes", _drive("videos_drive", ego_motion="static")),
    "AVI": Reader("videos_drive/videos/CAM_BACK.avi", "bytes", _drive("videos_drive", ego_motion="static")),
    "pth": Reader("weights.pth", "bytes", _weights("weights.pth")),
    "old pth": Reader("old.pth", "bytes", _weights("old.pth")),
    "safetensors": Reader("weights.safetensors", "bytes", _weights("weights.safetensors")),
    "recording": Reader("recording.rrd", "bytes", _recording),
    "predictions": Reader("predictions.json", "json", _predictions),
    "class map": Reader("classes.toml", "text", _classes),
    "MCAP": Reader("bag.mcap", "bytes", _drive("bag.mcap")),
    "rosbag2": Reader("rosbag2/rosbag2.db3", "bytes", _drive("rosbag2")),
    "submission": Reader("results_nusc.json", "json", _submission),
    "state": Reader("out/.bevcli/state.pt", "bytes", _state),
    "written files": Reader("out/.bevcli/written", "bytes", _state),
    "summary": Reader("older/summary.json", "json", _older_run),
    "checkpoint": Reader("checkpoint.pt", "bytes", _checkpoint),
    "learning curve": Reader("loss.csv", "text", _checkpoint),
    "vehicle mesh": Reader("vehicle.glb", "bytes", _vehicle),
    **{
        f"{name} {Path(file).stem}": Reader(f"{name}/{file}", kind, _drive(name))
        for name, file, kind in (
            ("dgp", "scene_s.json", "json"),
            ("dgp", "calibration/c.json", "json"),
            ("argoverse2", "annotations.feather", "bytes"),
            ("argoverse2", "calibration/intrinsics.feather", "bytes"),
            ("t4", "annotation/calibrated_sensor.json", "json"),
        )
    },
    "CAN bus": Reader("nuscenes/can_bus/scene-0001_pose.json", "json", _drive("nuscenes")),
    **{
        f"nuScenes {name}": Reader(f"nuscenes/v1.0-mini/{name}.json", "json", _drive("nuscenes"))
        for name in (*TABLES, *SMALL_TABLES)
    },
}
