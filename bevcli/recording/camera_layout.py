"""Where each camera's view stands on the screen: as the cameras stand around the vehicle."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bevcli.geometry.cameras import CameraRig

SIDEWAYS = np.pi / 2 + 1e-6  # a camera that looks exactly sideways belongs to the front


def camera_rows(rig: CameraRig) -> tuple[tuple[str, ...], ...]:
    """The names of a rig's cameras in one or two rows (`rows_by_yaw`)."""
    return rows_by_yaw({camera.name: camera.yaw for camera in rig.cameras})


def rows_by_yaw(yaws: Mapping[str, float]) -> tuple[tuple[str, ...], ...]:
    """Cameras, by name with yaw in radians in ego: those that look ahead from left to right; then those that look back.

    In the row of those that look back the left of the vehicle is on the left, too.
    """
    ahead = sorted((name for name, yaw in yaws.items() if abs(yaw) <= SIDEWAYS), key=lambda name: -yaws[name])
    back = sorted(yaws.keys() - set(ahead), key=lambda name: yaws[name] % (2 * np.pi))
    return tuple(tuple(row) for row in (ahead, back) if row)
