"""A single video as a sequence: one camera, a frame for each image, and no poses but those of `ego_motion_file`."""

from dataclasses import replace
from pathlib import Path

from bevcli.errors import InputError
from bevcli.frame import FrameStamp
from bevcli.printing import counted
from bevcli.sequences.files.calibration_file import draft_of
from bevcli.sequences.files.ego_motion_file import DrivePoses, ReadPoses, read_poses
from bevcli.sequences.images import FrameEntry, ListedDrive, bev_frame_notes
from bevcli.sequences.native import FolderOptions
from bevcli.sequences.native.folder import check_covered, decided
from bevcli.sequences.options import InputOptions
from bevcli.sequences.videos import rotation_notes
from bevcli.workshop.formats.calibrations import SEVERAL
from bevcli.workshop.formats.unlisted import UNEVEN_TEXT, covered, video_images


def open_video(path: Path, common: InputOptions, options: FolderOptions) -> ListedDrive:
    """A video as a `Drive`. Raises InputError."""
    video = video_images(path, options.start_ns or 0, options.image_rate_hz)
    draft = draft_of(options, path)
    if draft is None:
        raise InputError(
            f"{path}: a video does not state its camera: pass `fov_deg=70` (`--fov 70`) and `height=1.5` (`--height "
            "1.5`), or `calibration` (`--calibration FILE`)"
        )
    rig = draft.rig
    if len(rig.cameras) != 1:  # of a calibration.json
        if path.stem not in rig.names:
            raise InputError(f"{path}: {SEVERAL.format(counted(len(rig.cameras), 'cameras'), ', '.join(rig.names))}")
        rig = replace(rig, cameras=(rig[path.stem],))
    [name] = rig.names
    entries = tuple(
        FrameEntry(FrameStamp(index, "", int(time)), {name: video.image(index)}, {}, f"{path}#{index}")
        for index, time in enumerate(video.times_ns)
    )
    start = "time 0 (state `start_ns` (`--start-ns`))" if options.start_ns is None else f"{options.start_ns} ns"
    rate = f"{UNEVEN_TEXT}," if video.is_uneven else f"at {1e9 / video.period_ns:g} Hz"
    understood = f"{len(entries)} images {rate} from {start} on"
    poses = ReadPoses(None)
    if options.ego_motion_file is not None and common.ego_motion != "static":
        poses = read_poses(options.ego_motion_file, DrivePoses(rig, options, video.times_ns, bool(draft.readings)))
    elif common.ego_motion == "required":
        raise InputError(
            f"{path}: a video has no poses of the vehicle: pass `ego_motion_file` (`--ego-motion FILE`), "
            "`odometry=True` (`--odometry`) to measure them from the images, `temporal=False` (`--no-temporal`) to run "
            'without history, or `ego_motion="static"` (`--static`) if the vehicle stands'
        )
    motion = poses.motion
    if motion is not None and options.ego_motion_file is not None:
        entries, understood = covered((entries, understood), motion)
        check_covered(
            options.ego_motion_file, poses, entries, "state the time of the first image by `start_ns` (`--start-ns`)"
        )
    images = ListedDrive(path.parent, common, rig, entries, None)
    draft, poses = decided(replace(draft, rig=rig), poses, images, options)
    rig, motion = draft.rig, poses.motion
    assumed = bev_frame_notes(rig, "the calibration")
    notes = (*draft.notes, *assumed, *rotation_notes([path]), understood, *poses.notes)
    if motion is None and common.ego_motion != "measured":
        without = "no history is used, and boxes are in the ego frame"
        notes += (f"a video has no poses: {without} (`odometry=True` (`--odometry`) measures them from the images)",)
    sequence = ListedDrive(path.parent, common, rig, entries, motion, notes=notes, input_files=(path,))
    sequence.name = path.resolve().stem
    sequence.facts = replace(draft.facts, geo_origin=draft.facts.geo_origin or poses.geo_origin)
    return sequence
