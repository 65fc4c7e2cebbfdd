"""A single video as a sequence: one camera, a frame for each image, and no poses but those of `ego_motion_file`."""

from dataclasses import replace
from pathlib import Path

from bevcli.errors import InputError
from bevcli.frame import FrameStamp
from bevcli.printing import counted
from bevcli.sequences.files.ego_motion_file import read_ego_motion
from bevcli.sequences.images import FrameEntry, ListedSequence, bev_frame_notes
from bevcli.sequences.native.unlisted import CameraVideo
from bevcli.sequences.options import RigOptions, SequenceOptions
from bevcli.sequences.videos import count_and_rate, rotation_notes
from bevcli.workshop.formats.calibrations import SEVERAL


def open_video(path: Path, common: SequenceOptions, own: RigOptions) -> ListedSequence:
    """A video as a `Sequence`. Its first image is at time 0. Raises InputError."""
    count, rate_hz = count_and_rate(path)
    given = own.draft(path)
    if given is None:
        raise InputError(
            f"{path}: a video does not state its camera: pass `fov_deg=70` and `height=1.5`, or `calibration=FILE`"
        )
    rig = given.rig
    if len(rig.cameras) != 1:  # of a calibration.json
        if path.stem not in rig.names:
            raise InputError(f"{path}: {SEVERAL.format(counted(len(rig.cameras), 'cameras'), ', '.join(rig.names))}")
        rig = replace(rig, cameras=(rig[path.stem],))
    poses = own.ego_motion_file
    if poses is None and common.ego_motion == "required":
        raise InputError(
            f"{path}: a video has no poses of the vehicle: pass `ego_motion_file=FILE`, `temporal=False` to run "
            'without history, or `ego_motion="static"` if the vehicle stands'
        )
    motion = None if poses is None or common.ego_motion == "static" else read_ego_motion(poses)
    video, [name] = CameraVideo(path, count, 0, rate_hz), rig.names
    images = [video.image(place) for place in range(count)]
    entries = tuple(
        FrameEntry(FrameStamp(place, "", image.timestamp_ns), {name: image}, {}, f"{path}#{place}")
        for place, image in enumerate(images)
    )
    notes = (*given.notes, *bev_frame_notes(rig, "the calibration"), *rotation_notes([path]))
    notes += (f"{count} images at {rate_hz:g} per second, starting at time 0",)
    if motion is None:
        notes += ("a video has no poses: no history is used, and boxes are in the ego frame",)
    sequence = ListedSequence(path.parent, common, rig, entries, motion, notes=notes, input_files=(path,))
    sequence.name = path.resolve().stem
    return sequence
