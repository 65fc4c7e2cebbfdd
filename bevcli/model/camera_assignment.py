"""The order in which a rig's cameras enter the model, and the camera embedding that each of them takes."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bevcli.errors import InputError
from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.transforms import wrap_angle

# Viewing directions of nuScenes' cameras in the ego frame, degrees counter-clockwise from straight ahead.
NUSCENES_YAWS_DEG = {
    "CAM_FRONT": 0.0,
    "CAM_FRONT_RIGHT": -55.0,
    "CAM_FRONT_LEFT": 55.0,
    "CAM_BACK": 180.0,
    "CAM_BACK_LEFT": 110.0,
    "CAM_BACK_RIGHT": -110.0,
}


@dataclass(frozen=True)
class CameraAssignment:
    """The cameras of a rig, assigned to the cameras that the model was trained with.

    Attributes:
        cameras: the rig's cameras in the model's order.
        embeddings: for each of them, the model's camera whose embedding it takes.
    """

    cameras: tuple[str, ...]
    embeddings: tuple[str, ...]


def assign_cameras(
    rig: CameraRig, model_cameras: tuple[str, ...], chosen: Mapping[str, str] | None = None
) -> CameraAssignment:
    """Assigns each camera of a rig to a camera of the model: as `chosen`, else by name, else by viewing direction.

    Args:
        model_cameras: the names of the model's cameras, in the order of their embeddings.
        chosen: camera of the rig -> camera of the model.

    Raises InputError for an unknown camera in `chosen`, or where the model's cameras have no known viewing direction.
    """
    chosen = chosen or {}
    for name, embedding in chosen.items():
        if name not in rig.names:
            raise InputError(f"camera {name}: is not in the rig (it has {', '.join(rig.names)})")
        if embedding not in model_cameras:
            raise InputError(
                f"camera {name}: the model has no camera {embedding} (expected {', '.join(model_cameras)})"
            )
    yaws = np.radians([NUSCENES_YAWS_DEG.get(name, np.nan) for name in model_cameras])
    embeddings = {}
    for camera in rig.cameras:
        embedding = chosen.get(camera.name, camera.name if camera.name in model_cameras else "")
        if not embedding:
            distances = np.abs(wrap_angle(yaws - camera.yaw))
            if np.isnan(distances).all():
                raise InputError(
                    f"camera {camera.name}: the model has no camera of this name; pass "
                    f"`cameras={{'{camera.name}': 'NAME'}}`"
                )
            embedding = model_cameras[int(np.nanargmin(distances))]
        embeddings[camera.name] = embedding
    order = sorted(rig.names, key=lambda name: (model_cameras.index(embeddings[name]), name != embeddings[name], name))
    return CameraAssignment(tuple(order), tuple(embeddings[name] for name in order))
