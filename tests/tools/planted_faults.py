"""Drives with one planted fault each, and the table of which ones `find_faults` finds without labels.

python tests/tools/planted_faults.py 2 15 DRIVE...    # faults on 2 rigs; all drives are sound ones, too; 15 minutes
"""

import argparse
import copy
import hashlib
from collections.abc import Callable
from dataclasses import fields, replace

import numpy as np

from bevcli.config import load_config
from bevcli.frame import CameraImage, DerivedDrive, Drive, Frame
from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.transforms import Pose, rigid
from bevcli.inference import TORCH
from bevcli.inference.load import Model
from bevcli.workshop.odometry import compare, step_views
from bevcli.workshop.odometry.measure import measure_steps
from bevcli.workshop.robustness.conditions import choose_conditions


class Planted(DerivedDrive):
    """A drive whose frames are changed when they are loaded."""

    def __init__(self, drive: Drive, change: Callable[[Drive, int, Frame], Frame], rig: CameraRig | None = None):
        super().__init__(drive)
        self.change, self.rig = change, rig or drive.rig

    def load(self, index: int) -> Frame:
        return replace(self.change(self.drive, index, self.drive.load(index)), rig=self.rig)


def with_pixels(image: CameraImage, pixels) -> CameraImage:
    return replace(image, pixels_bgr=np.ascontiguousarray(pixels), encoded=None, media_type=None)


def _image(change):
    """Changes the image of one camera. change: (drive, place, camera, image) -> image."""

    def plant(drive: Drive, camera: str) -> Drive:
        def changed(sequence, place, frame):
            return replace(
                frame, images={**frame.images, camera: change(sequence, place, camera, frame.images[camera])}
            )

        return Planted(drive, changed)

    return plant


def _turned(axis_deg):
    """One camera states another rotation. axis_deg: about its right, down and forward axes."""

    def plant(drive: Drive, camera: str) -> Drive:
        from scipy.spatial.transform import Rotation

        turn = rigid(rotation=Rotation.from_rotvec(axis_deg, degrees=True).as_matrix())
        return with_camera(drive, camera, lambda one: replace(one, ego_from_camera=one.ego_from_camera @ turn))

    return plant


def with_camera(drive: Drive, camera: str, change) -> Drive:
    cameras = tuple(change(one) if one.name == camera else one for one in drive.rig.cameras)
    return Planted(drive, lambda sequence, place, frame: frame, replace(drive.rig, cameras=cameras))


def longer_focal(drive: Drive, camera: str, factor: float = 1.15) -> Drive:
    """One camera states a focal length that is too long."""
    scale = np.array([[factor, 1, 1], [1, factor, 1], [1, 1, 1]])
    return with_camera(drive, camera, lambda one: replace(one, intrinsics=one.intrinsics * scale))


def exchanged(drive: Drive, camera: str, other: str) -> Drive:
    """The images of two cameras are exchanged."""

    def change(sequence, place, frame):
        images = dict(frame.images)
        images[camera], images[other] = images[other], images[camera]
        return replace(frame, images=images)

    return Planted(drive, change)


def late(drive: Drive, camera: str) -> Drive:
    """The images of one camera are those of the frame before."""

    def change(sequence, place, frame):
        before = sequence.load(max(place - 1, 0)).images[camera]
        image = replace(before, timestamp_ns=frame.images[camera].timestamp_ns)
        return replace(frame, images={**frame.images, camera: image})

    return Planted(drive, change)


def other_colors(drive: Drive) -> Drive:
    """Red and blue are exchanged in all images."""

    def change(sequence, place, frame):
        images = {name: with_pixels(image, image.pixels_bgr[..., ::-1]) for name, image in frame.images.items()}
        return replace(frame, images=images)

    return Planted(drive, change)


black = _image(lambda drive, place, camera, image: with_pixels(image, np.zeros_like(image.pixels_bgr)))
frozen = _image(lambda drive, place, camera, image: with_pixels(image, drive.load(0).images[camera].pixels_bgr))
mirrored = _image(lambda drive, place, camera, image: with_pixels(image, image.pixels_bgr[:, ::-1]))
yawed, pitched = _turned((0, 2.0, 0)), _turned((2.0, 0, 0))


class OtherPoses(DerivedDrive):
    """A drive whose poses are changed. change: positions (T, 3) and rotations (T, 3, 3) -> the same of other poses."""

    def __init__(self, drive: Drive, change) -> None:
        super().__init__(drive)
        motion = drive.ego_motion
        assert motion is not None
        self._change, self._start = change, motion.translations[0]
        matrices = [Pose(t, q).matrix for t, q in zip(motion.translations, motion.quaternions, strict=True)]
        poses = [self._changed(matrix) for matrix in matrices]
        self.ego_motion = replace(
            motion,
            translations=np.stack([pose.translation for pose in poses]),
            quaternions=np.stack([pose.quaternion for pose in poses]),
        )

    def _changed(self, matrix) -> Pose:
        return Pose.from_matrix(self._change(self._start, matrix))

    def load(self, index: int) -> Frame:
        frame = self.drive.load(index)
        at = {name: self._changed(pose.matrix) for name, pose in frame.world_from_ego_at.items()}
        return replace(frame, world_from_ego=self._changed(frame.world_from_ego.matrix), world_from_ego_at=at)


def scaled_poses(drive: Drive, factor: float = 3.6) -> Drive:
    """Positions from speeds in km/h that were taken for m/s."""
    return OtherPoses(drive, lambda start, pose: rigid(start + factor * (pose[:3, 3] - start), pose[:3, :3]))


def mirrored_poses(drive: Drive) -> Drive:
    """Poses of a left-handed world: y is mirrored."""
    flip = np.diag([1.0, -1, 1])
    return OtherPoses(drive, lambda start, pose: rigid(flip @ pose[:3, 3], flip @ pose[:3, :3] @ flip))


def lost_poses(drive: Drive) -> Drive:
    """Poses that stand still."""
    return OtherPoses(drive, lambda start, pose: rigid(start))


def beside(drive: Drive, camera: str) -> str:
    """The next camera in the rig."""
    names = drive.rig.names
    return names[(names.index(camera) + 1) % len(names)]


# Fault -> how to plant it into a drive with the camera that has it, and the findings of which one names it.
FAULTS = {
    "camera black": (black, "camera-dead"),
    "camera frozen": (frozen, "camera-frozen"),
    "images of two cameras exchanged": (lambda d, c: exchanged(d, c, beside(d, c)), "images-exchanged"),
    "images of one camera mirrored": (mirrored, "images-mirrored"),
    "images of one camera 0.5 s late": (late, "images-late"),
    "yaw of one camera off by 2°": (yawed, "calibration-off"),
    "pitch of one camera off by 2°": (pitched, "calibration-off"),
    "focal length of one camera off by 15 %": (longer_focal, "calibration-off"),
    "poses: km/h taken for m/s": (lambda d, c: scaled_poses(d), "motion-scale"),
    "poses: y mirrored": (lambda d, c: mirrored_poses(d), "motion-axes"),
    "poses: all the same": (lambda d, c: lost_poses(d), "motion-stands"),
    "red and blue exchanged": (lambda d, c: other_colors(d), "color-order"),
}


def found_in(model: Model, drive: Drive, code: str):
    """The findings among which one with a code may be."""
    from bevcli.workshop.trust.faults import input_faults, model_faults

    return model_faults(model, drive) if code == "color-order" else input_faults(drive)


def without(part: str, model: Model) -> Model:
    """The model with zeros for the weights of a part."""
    network = copy.deepcopy(model.network)
    network.load_state_dict({key: 0 * value if part in key else value for key, value in network.state_dict().items()})
    return replace(model, network=network)


class BrokenEngine(Model):
    """A model whose engine has lost the class head; the plain network has it."""

    def in_engine(self, rig, drive=None, **asked) -> Model:
        return replace(without("class_branches", self), engine=TORCH, precision="fp32") if self.needs_export else self


def with_broken_engine(model: Model) -> Model:
    return BrokenEngine(**{each.name: getattr(model, each.name) for each in fields(model)} | ENGINE)


def of_another_model(model: Model) -> Model:
    """The model file of other weights: those of `base` expect BGR without scale."""
    network, image = copy.copy(model.network), load_config("base").image
    other = {"color_order": image.color_order, "mean": image.mean, "std": image.std}
    network.config = replace(model.config, image=replace(model.config.image, **other))
    return replace(model, network=network)


ENGINE = {"engine": "openvino", "precision": "int8"}
# Fault -> how to plant it into a model, and the findings of which one names it.
MODEL_FAULTS = {
    "INT8 engine without its class head": (with_broken_engine, "engine-broken"),
    "weights with the image settings of another model": (of_another_model, "weights-broken"),
}
MOST_KEPT = 150  # features of images, and motions
MILD = ("", "fog", "snow", "low_light", "motion_blur", "jpeg", "brightness", "impulse_noise")  # of sound drives


def sound_drive(drive: Drive, number: int) -> Drive:
    """Every second sound drive has images in mild fog, snow, bad light and so on."""
    name = MILD[number // 2 % len(MILD)] if number % 2 else ""
    if not name:
        return drive
    (condition,) = (each for each in choose_conditions("easy", [name]) if each.name == name)
    return condition.sequences(drive, number, "black")[0]


class Standing(DerivedDrive):
    """A drive whose vehicle stands: every frame shows the first one, at later times, with the noise of a camera."""

    def __init__(self, drive: Drive) -> None:
        super().__init__(drive)
        motion, first = drive.ego_motion, drive.load(0).world_from_ego
        count = len(motion.timestamps_ns)
        still = {name: np.zeros((count, 3)) for name in ("accelerations", "angular_rates", "velocities")}
        still = {name: value for name, value in still.items() if hasattr(motion, name)}
        poses = {
            "translations": np.tile(first.translation, (count, 1)),
            "quaternions": np.tile(first.quaternion, (count, 1)),
        }
        self.ego_motion = replace(motion, **poses, **still)

    def load(self, index: int) -> Frame:
        frame, first = self.drive.load(index), self.drive.load(0)
        random = np.random.default_rng(index)
        images = {}
        for name, image in first.images.items():
            noise = random.normal(0, 2, image.pixels_bgr.shape)
            noisy = with_pixels(image, np.clip(image.pixels_bgr + noise, 0, 255).astype(np.uint8))
            images[name] = replace(noisy, timestamp_ns=frame.images[name].timestamp_ns)
        at = dict.fromkeys(frame.world_from_ego_at, first.world_from_ego)
        return replace(frame, images=images, world_from_ego=first.world_from_ego, world_from_ego_at=at)


def without_repetition() -> None:
    """Features of an image, and the motion that images show, are computed once for all drives that share the images."""

    def once(function, key):
        known = {}

        def kept(*arguments):
            name = key(*arguments)
            if name not in known:
                if len(known) >= MOST_KEPT:
                    known.clear()
                known[name] = function(*arguments)
            return known[name]

        return kept

    def images_of(drive: Drive, *_) -> bytes:
        frames = [drive.load(place) for place in range(len(drive.stamps))]
        pixels = b"".join(image.pixels_bgr.tobytes() for frame in frames for image in frame.images.values())
        rig = [(one.intrinsics.tolist(), one.ego_from_camera.tolist()) for one in drive.rig.cameras]
        return hashlib.sha256(pixels + repr(rig).encode()).digest()

    step_views.features = once(step_views.features, lambda image: hashlib.sha256(image.pixels.tobytes()).digest())
    compare.measure_steps = once(lambda drive: list(measure_steps(drive)), images_of)


def table(folders: list[str], rigs: int, minutes: float, model_name: str) -> None:
    """Prints a line for each planted fault on some rigs, and one for each sound drive, until the time is over.

    folders: of rendered drives. The faults are planted into the first `rigs` of them.
    """
    import time

    import bevcli
    from bevcli.workshop.trust.faults import find_faults, model_faults

    without_repetition()
    model, end = bevcli.load_model(model_name), time.monotonic() + 60 * minutes
    drives = {folder: bevcli.open_sequence(folder) for folder in folders}
    tests = [("sound", folder, number) for number, folder in enumerate(folders)]
    tests += [("standing", folder, number) for number, folder in enumerate(folders[:4])]
    planted = [(name, folder, number) for number, folder in enumerate(folders[:rigs]) for name in FAULTS]
    planted += [(name, folder, number) for number, folder in enumerate(folders[:rigs]) for name in MODEL_FAULTS]
    alike = {folder: [each for each in planted if each[1] == folder] for folder in folders}
    for name, folder, number in (each for test in tests for each in (test, *(alike.pop(test[1], ())))):
        if time.monotonic() > end:
            break
        start, drive = time.process_time(), drives[folder]
        if name in FAULTS:
            camera = drive.rig.names[(number + list(FAULTS).index(name)) % len(drive.rig.cameras)]
            plant, code = FAULTS[name]
            findings = found_in(model, plant(drive, camera), code)
            verdict = "FOUND" if any(each.code == code for each in findings) else "MISSED"
        elif name in MODEL_FAULTS:
            change, code = MODEL_FAULTS[name]
            camera, findings = "", model_faults(change(model), drive)
            verdict = "FOUND" if any(each.code == code for each in findings) else "MISSED"
        else:
            camera, verdict = "", "SOUND"
            sound = Standing(drive) if name == "standing" else sound_drive(drive, number)
            findings = find_faults(model, sound)
            if any(each.severity != "info" for each in findings):
                verdict = "FALSE ALARM"
            name = f"{name} {'' if name == 'standing' or not number % 2 else MILD[number // 2 % len(MILD)]}".strip()
        seconds = time.process_time() - start
        print(f"{verdict:12}{folder[-7:]} {len(drive.rig.cameras)} cameras {name} {camera} {seconds:.1f} s", flush=True)
        for finding in findings:
            print(f"    {finding.severity} {finding.code} {finding.line}", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Show which planted faults are found without labels.")
    parser.add_argument("rigs", type=int, help="number of drives that get all faults")
    parser.add_argument("minutes", type=float, help="time after which no fault is begun")
    parser.add_argument("drives", nargs="+", help="rendered drives")
    parser.add_argument("--model", default="photographs", help="its boxes are looked at (default: photographs)")
    asked = parser.parse_args()
    table(asked.drives, asked.rigs, asked.minutes, asked.model)
