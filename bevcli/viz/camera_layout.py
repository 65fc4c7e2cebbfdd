"""Where each camera's view stands on the screen: as the cameras stand around the vehicle."""

from __future__ import annotations

import numpy as np

from bevcli.geometry.cameras import CameraRig

SIDEWAYS = np.pi / 2 + 1e-6  # a camera that looks exactly sideways belongs to the front


def camera_rows(rig: CameraRig) -> tuple[tuple[str, ...], ...]:
    """The cameras' names in one or two rows: those that look ahead, from left to right; then those that look back.

    In the row of those that look back the left of the vehicle is on the left, too.
    """
    ahead = sorted((c for c in rig.cameras if abs(c.yaw) <= SIDEWAYS), key=lambda c: -c.yaw)
    back = sorted((c for c in rig.cameras if abs(c.yaw) > SIDEWAYS), key=lambda c: c.yaw % (2 * np.pi))
    return tuple(tuple(c.name for c in row) for row in (ahead, back) if row)
