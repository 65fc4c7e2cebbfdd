"""`open_sequence`: opens an input of any format as a drive, and selects a scene, a range of frames, a frame rate."""

from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from bevcli.errors import InputError
from bevcli.frame import Drive
from bevcli.geometry.object_classes import NUSCENES_CLASSES
from bevcli.options import defaults, gather
from bevcli.sequences.files.boxes_file import ClassNames
from bevcli.sequences.format import check_options, drives_in, format_of, is_drive
from bevcli.sequences.options import InputOptions
from bevcli.sequences.view import DriveView, select_every, select_range, select_rate, select_scene

SHORTEST_PERIODS_NS = 3_000_000, 5_000_000  # between frames: a shorter one has a wrong unit; the right unit gives more


def open_sequence(path: str | Path, options: InputOptions | None = None, **changes: Any) -> Drive:
    """Open a drive.

    It is a native sequence folder (images or videos), a nuScenes dataset root, an MCAP file, a ROS 2 bag, or a drive of
    another data set (docs/other-inputs.md).

        drive = open_sequence("my_drive")
        drive = open_sequence("drive.mcap", calibration="calibration.json")
        drive = open_sequence("my_drive", rate_hz=2.0, frames=slice(0, 40))
        drive = open_sequence("nuscenes", version="v1.0-mini", scene="scene-0103")
        drive = open_sequence("ddad_train_val", scene="000150")  # a folder of drives
        drive = open_sequence("dash.mp4", fov_deg=70, height=1.4, odometry=True)  # poses measured from the images
        for index in range(len(drive.stamps)):
            frame = drive.load(index)

    Only calibration, times and poses are read here, and with `odometry` all images. `load` decodes those of a frame.

    Args:
        path: the folder or file.
        options: the options of every format; None for the defaults.
        changes: options as keywords, those of `InputOptions` and those of the path's format: `RigOptions`,
            `NuScenesOptions`, `BagOptions`, `Argoverse2Options` and so on, or the options of an installed format.

    Raises InputError if the path has no known format, a file is missing or invalid, the format does not have an option,
    or no frame is left; TypeError for an option that no format has.
    """
    drive: Drive = deque[Any](open_steps(path, options, **changes), maxlen=1).pop()
    return drive


def open_steps(
    path: str | Path, options: InputOptions | None = None, **changes: Any
) -> Iterator[tuple[int, int] | Drive]:
    """Open a drive as `open_sequence`: the drive at the end.

    Before it, with `odometry`, the number of steps that are measured and of all, scene by scene.
    """
    path, common = Path(path), defaults(InputOptions)
    options = gather(InputOptions, options, {name: changes.pop(name) for name in common if name in changes})
    if options.scene is not None and (named := _drive_of(path, options.scene)):
        path, options = named, replace(options, scene=None)
    if options.odometry:
        options = replace(options, ego_motion="measured")
    opened = format_of(path)
    check_options(changes, [opened], f"{path}: is {opened.name}")
    made = gather(opened, None, {name: value for name, value in changes.items() if name in defaults(opened)})
    drive = made.open(path, options)
    if not drive.rig.cameras:
        raise InputError(f"{path}: {drive.name}: the rig has no camera (expected one or more)")
    check_time_unit(drive, path)
    if options.ground_truth:
        names = ClassNames(options.class_map, options.classes or NUSCENES_CLASSES)
        note = names.note(drive.class_counts, f"{drive.name}: the ground truth")
        drive = DriveView(drive, names=names, notes=note)
    else:
        drive = DriveView(drive, has_truth=False)
    if options.scene is not None:
        drive = select_scene(drive, options.scene)
    whole = drive
    if options.every is not None:
        drive = select_every(drive, options.every)
    rate_hz = options.rate_hz
    if rate_hz is None and options.every is None and not made.wants_all_frames:
        rate_hz = options.model_rate_hz
    if rate_hz is not None and rate_hz != "all":
        drive = select_rate(drive, rate_hz)
    if options.frames is not None:
        drive = select_range(drive, options.frames)
    if options.odometry:
        from bevcli.workshop.odometry.report import with_measured_motion

        yield from with_measured_motion(drive, whole)
    else:
        yield drive


def _drive_of(root: Path, name: str) -> Path | None:
    """A drive of a folder of drives by its name; None where the path is a drive itself, or holds none of this name."""
    return None if not root.is_dir() or is_drive(root) else drives_in(root).get(name)


def check_time_unit(drive: Drive, source: object) -> None:
    """Raise InputError where frames follow each other so fast that their times are no nanoseconds."""
    pairs = pairwise(drive.stamps)
    periods = [after.timestamp_ns - before.timestamp_ns for before, after in pairs if before.scene == after.scene]
    period = (np.median(periods) or np.mean(periods)) if periods else np.inf
    if period < SHORTEST_PERIODS_NS[0]:
        # In place of nanoseconds, or of microseconds as in nuScenes' tables.
        units = {10**3: "microseconds or milliseconds", 10**6: "milliseconds or seconds", 10**9: "seconds"}
        factor = next((multiple for multiple in units if period * multiple >= SHORTEST_PERIODS_NS[1]), 10**9)
        raise InputError(
            f"{source}: the timestamps are {factor} times too small (in {units[factor]}?): the frames are {period:.0f} "
            f"ns apart (expected {SHORTEST_PERIODS_NS[0]} or more): multiply all times"
        )
