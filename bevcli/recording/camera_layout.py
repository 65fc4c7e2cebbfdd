"""The order of the camera views on the screen: like the cameras around the vehicle."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bevcli.geometry.cameras import CameraRig

SIDEWAYS = np.pi / 2 + 1e-6  # a camera that looks exactly sideways belongs to the front row


def camera_rows(rig: CameraRig) -> tuple[tuple[str, ...], ...]:
    """The camera names of a rig in one or two rows, as `rows_by_yaw` orders them."""
    return rows_by_yaw({camera.name: camera.yaw for camera in rig.cameras})


def rows_by_yaw(yaws: Mapping[str, float]) -> tuple[tuple[str, ...], ...]:
    """Camera names in one or two rows, left to right: those that look ahead, then those that look back.

    In both rows the left side of the vehicle is on the left. yaws: by camera name, radians, in the ego frame.
    """
    ahead = sorted((name for name, yaw in yaws.items() if abs(yaw) <= SIDEWAYS), key=lambda name: -yaws[name])
    back = sorted(yaws.keys() - set(ahead), key=lambda name: yaws[name] % (2 * np.pi))
    return tuple(tuple(row) for row in (ahead, back) if row)
