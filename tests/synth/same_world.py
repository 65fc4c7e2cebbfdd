"""A rendered drive seen by other cameras, and its boxes where OpenCV projects them."""

from copy import copy

import cv2
import numpy as np

from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.transforms import Pose, inverse
from bevcli.workshop.synth.drive import RenderedDrive, RenderedFrame
from bevcli.workshop.synth.rig import lens_parts


def with_rig(drive: RenderedDrive, rig: CameraRig) -> RenderedDrive:
    """The same drive with another rig, whose images have about the same width; its world is not made again."""
    other = copy(drive)
    other.rig, other._lenses = rig, {camera.name: lens_parts(camera) for camera in rig.cameras if camera.distortion}
    return other


def projected(corners_world, camera, world_from_ego):
    """Pixels (N, 2) by cv2.projectPoints and depths (N,)."""
    camera_from_world = inverse(world_from_ego.matrix @ camera.ego_from_camera)
    rotation, _ = cv2.Rodrigues(camera_from_world[:3, :3])
    pixels, _ = cv2.projectPoints(corners_world, rotation, camera_from_world[:3, 3], camera.intrinsics, None)
    return pixels[:, 0], corners_world @ camera_from_world[2, :3] + camera_from_world[2, 3]


def outside_of_boxes(drive: RenderedDrive, index: int, frame: RenderedFrame, pose: Pose) -> list[float]:
    """How far the farthest pixel of each object lies outside (negative) of its projected box, of one pose."""
    states = [state for _, state in drive._actors(index)]
    rows, found = {instance: k for k, instance in enumerate(frame.boxes.instances)}, []
    for name, view in frame.views.items():
        for owner in np.unique(view.objects[view.objects >= 0]):
            row = rows.get(states[owner].body.instance)
            if row is None:
                continue
            pixels, depths = projected(frame.boxes.corners()[row], drive.rig[name], pose)
            if depths.min() >= 0.3:
                hull, seen = cv2.convexHull(pixels.astype(np.float32)), np.argwhere(view.objects == owner)[:, ::-1]
                found.append(min(cv2.pointPolygonTest(hull, tuple(map(float, pixel)), True) for pixel in seen))
    return found
