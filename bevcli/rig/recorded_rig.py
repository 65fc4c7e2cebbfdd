"""A rig in a recording that shows one moment: poses, images, lines in the images, and the views of these."""

import contextlib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import cv2
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from bevcli.errors import OutputError
from bevcli.geometry.cameras import Camera, CameraRig
from bevcli.geometry.transforms import Array
from bevcli.recording import entities, log_static
from bevcli.recording.blueprint import Layout, camera_rows, flat_view
from bevcli.recording.colors import BACKGROUND
from bevcli.rig.overlay import Pixels, visible_runs
from bevcli.writing import whole_file

JPEG_QUALITY = 90
Lines = tuple[list[Array], tuple[int, ...], float]  # strips (P, 2) in pixels, colour, width in points of the screen


@contextlib.contextmanager
def rig_recording(path: Path, application: str, rig: CameraRig, layout: Layout) -> Iterator[rr.RecordingStream]:
    """A recording with the vehicle and the rig's pinholes; the layout is freed. Raises OutputError."""
    with whole_file(path) as unfinished, rr.RecordingStream(application) as stream:
        try:
            stream.save(unfinished, default_blueprint=layout)
        except RuntimeError as error:
            raise OutputError(f"{path}: the recording cannot be written ({error})") from error
        finally:
            layout.free()
        log_static.log_scene(stream, rig, {})
        yield stream


def log_pose(stream: rr.RecordingStream, camera: Camera, *, static: bool) -> None:
    """Writes where a camera is on the vehicle."""
    pose = rr.Transform3D(translation=camera.ego_from_camera[:3, 3], mat3x3=camera.ego_from_camera[:3, :3])
    stream.log(entities.camera(camera.name), pose, static=static)


def log_image(stream: rr.RecordingStream, name: str, pixels: Pixels) -> None:
    """Writes the image of a camera. pixels: (H, W, 3) BGR."""
    encoded = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()
    stream.log(entities.image(name), rr.EncodedImage(contents=encoded, media_type="image/jpeg"), static=True)


def log_lines(stream: rr.RecordingStream, camera: Camera, lines: Mapping[str, Lines], *, static: bool) -> None:
    """Writes lines of several kinds into the image of a camera."""
    for kind, (strips, color, width) in lines.items():
        inside = [strip for line in strips for strip in _clipped(line, camera)]
        archetype = rr.LineStrips2D(inside, colors=color, radii=rr.Radius.ui_points(width), draw_order=20)
        stream.log(entities.overlay(camera.name, kind), archetype, static=static)


def _clipped(line: Array, camera: Camera) -> list[Array]:
    """The parts of a line (P, 2) inside the image. The viewer does not clip lines."""
    size = np.array([camera.width, camera.height])
    inside = ((line >= 0) & (line <= size)).all(axis=-1, keepdims=True)
    return visible_runs(np.where(inside, line, np.nan))


def rig_view(rig: CameraRig, overlays: Iterable[str]) -> rrb.Spatial3DView:
    """The rig from behind. overlays: kinds of drawings in the images, which it leaves out."""
    return rrb.Spatial3DView(
        origin=entities.EGO,
        contents=[
            f"/{entities.WORLD}/**",
            *(f"- /{entities.overlay(name, kind)}/**" for name in rig.names for kind in overlays),
        ],
        name="The rig",
        background=list(BACKGROUND),
        line_grid=False,
        eye_controls=rrb.EyeControls3D(position=(-5.5, 0.0, 4.5), look_target=(0.9, 0.0, 0.8), eye_up=(0, 0, 1)),
    )


def camera_views(rig: CameraRig) -> list[rrb.Horizontal]:
    """The images of the cameras, in rows."""
    return [rrb.Horizontal(*(_camera_view(rig[name]) for name in row)) for row in camera_rows(rig)]


def _camera_view(camera: Camera) -> rrb.Spatial2DView:
    return flat_view(entities.camera(camera.name), camera.name, (0, camera.width), (0, camera.height))
