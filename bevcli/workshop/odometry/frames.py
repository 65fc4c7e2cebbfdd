"""The views of one frame: all that is kept of it until the next one."""

from dataclasses import dataclass

import numpy as np

from bevcli.frame import Frame
from bevcli.geometry.cameras import Camera, CameraRig
from bevcli.geometry.transforms import Array
from bevcli.workshop.correspondence.images import GreyImage, grey_image, reduced
from bevcli.workshop.correspondence.points import Features, features
from bevcli.workshop.odometry.above import RoadGrids, RoadPicture

PIXELS, WIDEST = 1.8e6, 1250  # of all reduced images of a frame together, and the width of one


@dataclass(frozen=True)
class FrameView:
    """The views of one frame."""

    timestamp_ns: int
    cameras: tuple[Camera, ...]  # of the reduced images
    late_s: Array  # (C,) when each image was taken, after the frame's time
    images: tuple[GreyImage | None, ...]  # None: no image, or one that shows nothing
    features: tuple[Features | None, ...]
    grids: RoadGrids

    def road(self, slopes: Array) -> RoadPicture:
        """The road seen from above, of slopes (2,) in the ego frame."""
        return self.grids.at(slopes).picture(self.images)


class Viewer:
    """Makes the views of frames. What depends on the rig alone is kept."""

    def __init__(self) -> None:
        self._rig: CameraRig | None = None

    def view(self, frame: Frame) -> FrameView:
        """The views of a frame."""
        if frame.rig is not self._rig:
            self._rig, self._cameras = frame.rig, _reduced(frame.rig)
            self._grids = RoadGrids(self._cameras)
        time, cameras = frame.stamp.timestamp_ns, self._cameras
        taken = [frame.images[each.name].timestamp_ns if each.name in frame.images else time for each in cameras]
        images = tuple(
            grey_image(frame.images[camera.name].pixels_bgr, camera) if camera.name in frame.images else None
            for camera in cameras
        )
        found = tuple(None if image is None else features(image) for image in images)
        return FrameView(time, cameras, (np.array(taken) - time) / 1e9, images, found, self._grids)


def _reduced(rig: CameraRig) -> tuple[Camera, ...]:
    """The cameras of the reduced images."""
    wide = sum(camera.height / camera.width for camera in rig.cameras)  # pixels of all for a width of one pixel
    width = min(WIDEST, int(np.sqrt(PIXELS / wide)))
    return tuple(reduced(camera, min(width, camera.width)) for camera in rig.cameras)
