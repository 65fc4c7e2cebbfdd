"""KITTI object labels of one camera."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from bevcli.errors import InputError
from bevcli.evaluation.box_format import BoxFormat
from bevcli.evaluation.options import ExportOptions
from bevcli.geometry.boxes import BOX_EDGES, Boxes3D
from bevcli.geometry.cameras import Camera
from bevcli.geometry.object_classes import NUSCENES_CLASSES, ObjectClass
from bevcli.geometry.transforms import Array, Pose, apply, inverse, wrap_angle
from bevcli.printing import counted
from bevcli.sequences.files.boxes_file import BoxesFile
from bevcli.sequences.files.calibration_file import CALIBRATION, read_calibration
from bevcli.writing import write_whole

OCCLUSION_UNKNOWN = 3
NEAR_M = 0.1  # box edges are clipped at this depth


def _write(boxes: BoxesFile, target: Path, options: ExportOptions, source: Path) -> str:
    camera, ego_from_bev = _camera(options, source)
    labels = write_kitti(boxes, camera, ego_from_bev, target)
    return f"{counted(len(boxes.frames), 'frames')}, {counted(labels, 'labels')} of {camera.name}"


FORMAT = BoxFormat("kitti", _write)


def _camera(options: ExportOptions, source: Path) -> tuple[Camera, Array]:
    """The camera for the labels, and ego_from_bev (4, 4). source: the boxes file.

    The calibration is by default next to the boxes file, as a run and a sequence folder have it, and the camera
    CAM_FRONT, or else the one that looks most directly ahead. Raises InputError where there is no such file or camera.
    """
    path = options.calibration or source.parent / CALIBRATION
    if options.calibration is None and not path.is_file():
        raise InputError(
            f"`form=kitti` needs `calibration`: KITTI labels are in a camera frame, and there is no {path} "
            "(a run writes it for a drive of one scene)"
        )
    path = path / CALIBRATION if path.is_dir() else path
    rig, name = read_calibration(path), options.camera
    if name is None:
        name = "CAM_FRONT" if "CAM_FRONT" in rig.names else min(rig.cameras, key=lambda camera: abs(camera.yaw)).name
    if name not in rig.names:
        raise InputError(f'{path}: has no camera "{name}" (expected one of {", ".join(rig.names)})')
    return rig[name], rig.ego_from_bev


def write_kitti(boxes: BoxesFile, camera: Camera, ego_from_bev: Array, folder: Path) -> int:
    """Write label_2/NNNNNN.txt and calib/NNNNNN.txt for every frame; NNNNNN is the frame's index.

    A label is written for each box that is at least partly inside the image without lens distortion. ego_from_bev:
    (4, 4), for boxes in the bev frame, and as the lidar frame of the calibration. Returns the number of labels. Raises
    InputError where frame indices repeat, and OutputError.
    """
    numbers = [frame.stamp.index for frame in boxes.frames]
    if len(set(numbers)) < len(numbers):
        raise InputError("frame indices repeat (KITTI's files are named by them): export each scene separately")
    count, classes = 0, boxes.classes or NUSCENES_CLASSES
    boxes = replace(boxes, ego_from_bev=Pose.from_matrix(ego_from_bev))
    for frame in boxes.frames:
        lines = kitti_labels(boxes.in_ego(frame), camera, classes)
        name = f"{frame.stamp.index:06d}.txt"
        write_whole(folder / "label_2" / name, "".join(f"{line}\n" for line in lines).encode(), parents=True)
        write_whole(folder / "calib" / name, _calibration(camera, ego_from_bev).encode(), parents=True)
        count += len(lines)
    return count


def kitti_labels(
    boxes_ego: Boxes3D, camera: Camera, classes: Mapping[str, ObjectClass] = NUSCENES_CLASSES
) -> list[str]:
    """One line for each box that the camera sees, in the order of the boxes.

    The fields: type, truncated 0 to 1, occluded (3: unknown), alpha, 2D box (left, top, right, bottom) in pixels,
    height, width and length in metres, centre of the bottom face in the camera frame, rotation_y, and the score if
    there is one.
    """
    camera_from_ego = camera.camera_from_ego
    locations = apply(camera_from_ego, boxes_ego.centers - boxes_ego.sizes_lwh * (0, 0, 0.5))
    headings = np.stack([np.cos(boxes_ego.yaws), np.sin(boxes_ego.yaws), np.zeros(len(boxes_ego))], axis=-1)
    headings = headings @ camera_from_ego[:3, :3].T
    rotations_y = np.arctan2(-headings[:, 2], headings[:, 0])
    alphas = wrap_angle(rotations_y - np.arctan2(locations[:, 0], locations[:, 2]))
    lines = []
    for place, corners in enumerate(boxes_ego.corners()):
        seen = _image_box(apply(camera_from_ego, corners), camera)
        if seen is None:
            continue
        rectangle, truncated = seen
        length, width, height = boxes_ego.sizes_lwh[place]
        numbers = [alphas[place], *rectangle, height, width, length, *locations[place], rotations_y[place]]
        kind = kitti_type(str(boxes_ego.classes[place]), classes)
        label = f"{kind} {truncated:.2f} {OCCLUSION_UNKNOWN} "
        score = "" if boxes_ego.scores is None else f" {boxes_ego.scores[place]:.4f}"
        lines.append(label + " ".join(f"{number:.3f}" for number in numbers) + score)
    return lines


def kitti_type(name: str, classes: Mapping[str, ObjectClass]) -> str:
    """A class's type in KITTI's files, whose columns are parted by spaces; "Misc" for a class that is not known."""
    one = classes.get(name)
    return "Misc" if one is None else "_".join((one.kitti or one.name).split())


def _image_box(corners: Array, camera: Camera) -> tuple[Array, float] | None:
    """The rectangle around a box's projection, clipped to the image, and the share of its area that is clipped."""
    points = _in_front_of_camera(corners)
    if not len(points):
        return None
    pixels = (points @ camera.intrinsics.T)[:, :2] / points[:, 2:]
    whole = np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])
    limits = np.array([camera.width - 1, camera.height - 1] * 2)
    cut = np.clip(whole, 0, limits)
    area, whole_area = np.prod(cut[2:] - cut[:2]), np.prod(whole[2:] - whole[:2])
    return (cut, float(1 - area / whole_area)) if area > 0 else None


def _in_front_of_camera(corners: Array) -> Array:
    """The corners (8, 3) in front of the camera, and the points where box edges intersect the plane at NEAR_M."""
    a, b = corners[np.array(BOX_EDGES)].swapaxes(0, 1)  # (12, 3) each
    crosses = (a[:, 2] < NEAR_M) != (b[:, 2] < NEAR_M)
    a, b = a[crosses], b[crosses]
    cut = a + ((NEAR_M - a[:, 2]) / (b[:, 2] - a[:, 2]))[:, None] * (b - a)
    return np.concatenate([corners[corners[:, 2] >= NEAR_M], cut])


def _calibration(camera: Camera, ego_from_bev: Array) -> str:
    """KITTI's calibration: P0 to P3 are this camera's, R0_rect is the identity, the lidar frame is the bev frame."""
    projection = np.concatenate([camera.intrinsics, np.zeros((3, 1))], axis=1)
    rows = {f"P{number}": projection for number in range(4)}
    rows["R0_rect"] = np.eye(3)
    rows["Tr_velo_to_cam"] = (camera.camera_from_ego @ ego_from_bev)[:3]
    rows["Tr_imu_to_velo"] = inverse(ego_from_bev)[:3]
    return "".join(f"{name}: {' '.join(f'{number:.12e}' for number in row.ravel())}\n" for name, row in rows.items())
