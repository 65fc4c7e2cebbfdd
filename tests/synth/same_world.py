"""A rendered drive seen by other cameras."""

from copy import copy

from bevcli.geometry.cameras import CameraRig
from bevcli.workshop.synth.drive import RenderedDrive
from bevcli.workshop.synth.rig import lens_parts


def with_rig(drive: RenderedDrive, rig: CameraRig) -> RenderedDrive:
    """The same drive with another rig, whose images have about the same width; its world is not made again."""
    other = copy(drive)
    other.rig, other._lenses = rig, {camera.name: lens_parts(camera) for camera in rig.cameras if camera.distortion}
    return other
