"""A drive's rig next to the rigs that a model's weights were trained on."""

import json
from collections.abc import Iterator, Mapping

import numpy as np

from bevcli.geometry.cameras import Camera, CameraRig
from bevcli.model.config import ModelConfig
from bevcli.printing import counted

# How far outside the range of the training a camera may be without a note.
_FOV_DEG, _HEIGHT_M, _TILT_DEG = 8.0, 0.3, 1.5
_BEV_TILT_DEG = 4.0  # published weights were trained with nuScenes' LIDAR_TOP, which is tilted by up to 3 degrees


def training_rig_notes(rig: CameraRig, config: ModelConfig) -> tuple[str, ...]:
    """Warnings where a rig lies outside the training distribution, at most two: the cameras, and the bev frame."""
    notes, trained = [], config.training_rigs
    if trained.known and rig.cameras:
        count, heights = len(rig.cameras), [float(camera.ego_from_camera[2, 3]) for camera in rig.cameras]
        fovs = [fov_deg(camera) for camera in rig.cameras]
        tilt = max(tilt_deg(camera) for camera in rig.cameras)
        far = []
        if not trained.cameras[0] <= count <= trained.cameras[1]:
            far.append(f"{counted(count, 'cameras')} ({_range(trained.cameras, '')})")
        if min(heights) < trained.height_m[0] - _HEIGHT_M or max(heights) > trained.height_m[1] + _HEIGHT_M:
            trained_range = _range(trained.height_m, " m")
            far.append(f"camera heights {_range((min(heights), max(heights)), ' m')} ({trained_range})")
        if min(fovs) < trained.fov_deg[0] - _FOV_DEG or max(fovs) > trained.fov_deg[1] + _FOV_DEG:
            far.append(f"fields of view {_range((min(fovs), max(fovs)), '°', 0)} ({_range(trained.fov_deg, '°', 0)})")
        if tilt > trained.tilt_deg + _TILT_DEG:
            far.append(f"pitch or roll up to {tilt:.1f}° ({trained.tilt_deg:g}°)")
        if far:
            cost = f"; measured: {trained.cost}" if trained.cost else ""
            theirs = "the rig is unlike those that the weights were trained on (theirs in brackets)"
            notes.append(f"{theirs}: {', '.join(far)}{cost}")
    tilt = float(np.degrees(np.arccos(np.clip(rig.ego_from_bev[2, 2], -1, 1))))
    height, expected = float(rig.ego_from_bev[2, 3]), config.bev_frame
    if expected.level and (tilt >= 0.1 or abs(height - expected.height_m) >= 0.05):
        notes.append(
            f"the bev frame is tilted by {tilt:.1f}° and {height:.2f} m high, but the weights expect a level one "
            f"at {expected.height_m:g} m: the model computes in such a frame, and gives boxes back in ego and world"
        )
    if not expected.level and tilt > _BEV_TILT_DEG:
        off = 30 * np.tan(np.radians(tilt))
        notes.append(
            f"the bev frame is tilted by {tilt:.1f}°, but the weights were trained with one tilted by up to 3°: "
            f'boxes 30 m away may be {off:.1f} m too high or too low (level "ego_from_bev" in the calibration)'
        )
    return tuple(notes)


def weights_facts(config: ModelConfig) -> dict[str, str]:
    """The metadata of a weights file: the model, its classes and cameras, and the frame and rigs that it expects."""
    x0, x1 = config.bev_grid.x_range_m
    frame = config.bev_frame
    facts = {
        "model": config.name,
        "classes": json.dumps(config.classes, ensure_ascii=False),
        "cameras": json.dumps(config.cameras, ensure_ascii=False),
        "bev_frame": f"level, {frame.height_m:g} m above the ground" if frame.level else "as in the drive",
        "range_m": f"{x0:g} to {x1:g}",
    }
    rigs = config.training_rigs
    if not rigs.known:
        return facts
    count = "{} to {}".format(*rigs.cameras) if rigs.cameras[0] < rigs.cameras[1] else f"{rigs.cameras[0]}"
    lenses = "field of view {:g} to {:g}°".format(*rigs.fov_deg)
    places = "height {:g} to {:g} m, pitch and roll up to {:g}°".format(*rigs.height_m, rigs.tilt_deg)
    return facts | {"training_rigs": f"{counted(count, 'cameras')}, {lenses}, {places}"}


def facts_notes(facts: Mapping[str, str], config: ModelConfig) -> Iterator[str]:
    """Warnings where the model's file contradicts the bev frame or the classes that the weights file states."""
    expected_facts = weights_facts(config)
    if facts.get("classes", expected_facts["classes"]) != expected_facts["classes"]:
        names = [listed.strip("[]").replace('"', "") for listed in (facts["classes"], expected_facts["classes"])]
        yield "the weights were trained for the classes {}, but the model's file names {}".format(*names)
    expected = expected_facts["bev_frame"]
    frame = facts.get("bev_frame", expected)
    if frame != expected:
        yield (
            f'the weights were trained with a bev frame "{frame}", but the model\'s file gives them one "{expected}": '
            "set [bev_frame] in the model's file"
        )


def fov_deg(camera: Camera) -> float:
    """Horizontal field of view without distortion, degrees."""
    focal, center = camera.intrinsics[0, 0], camera.intrinsics[0, 2]
    return float(np.degrees(np.arctan(center / focal) + np.arctan((camera.width - center) / focal)))


def tilt_deg(camera: Camera) -> float:
    """The larger of pitch and roll, degrees; a camera upside down or on its side has a roll near 0."""
    heights = np.abs(camera.ego_from_camera[2, [0, 2]])  # of the axes to the right and ahead
    return float(np.degrees(np.arcsin(np.clip(heights, 0, 1))).max())


def _range(ends: tuple[float, float], unit: str, digits: int = 1) -> str:
    low, high = (f"{end:.{digits}f}".removesuffix(".0") for end in ends)
    return f"{low}{unit}" if low == high else f"{low} to {high}{unit}"
