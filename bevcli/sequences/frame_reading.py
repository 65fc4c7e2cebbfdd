"""A listed frame -> a Frame: its images, and the poses at their times."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from bevcli.frame import BevMap, Frame
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.ego_motion import GRAVITY, Kinematics
from bevcli.geometry.transforms import Pose
from bevcli.sequences.images import ImageReader
from bevcli.sequences.native.frames_table import FrameEntry

AT_REST = Kinematics(np.array([0.0, 0.0, GRAVITY]), np.zeros(3), np.zeros(3))


class Motion(Protocol):
    """The vehicle's poses over time, such as `EgoMotion`."""

    def pose_at(self, timestamp_ns: int) -> Pose:
        """world_from_ego at a time."""
        ...

    def kinematics_at(self, timestamp_ns: int) -> Kinematics:
        """Acceleration, angular rate and velocity at a time."""
        ...


def read_frame(
    entry: FrameEntry,
    rig: CameraRig,
    reader: ImageReader,
    motion: Motion | None,
    ground_truth: Boxes3D | None = None,
    ground_truth_map: BevMap | None = None,
) -> Frame:
    """The frame of an entry, with decoded images. Without motion, poses are the identity, and the vehicle is at rest.

    Raises InputError as `ImageReader.read`, and for a time that the motion does not cover.
    """
    images, dropped = reader.read(entry.sources, rig, entry.dropped)
    frame_ns = entry.stamp.timestamp_ns
    times = dict.fromkeys(rig.names, frame_ns)
    times |= {name: source.timestamp_ns for name, source in entry.sources.items()}
    times |= {name: image.timestamp_ns for name, image in images.items()}

    def pose_at(time: int) -> Pose:
        return Pose.identity() if motion is None else motion.pose_at(time)

    return Frame(
        stamp=entry.stamp,
        rig=rig,
        images=images,
        world_from_ego=pose_at(frame_ns),
        world_from_ego_at={name: pose_at(time) for name, time in times.items()},
        kinematics=AT_REST if motion is None else motion.kinematics_at(frame_ns),
        dropped=dropped,
        ground_truth=ground_truth,
        ground_truth_map=ground_truth_map,
    )
