"""`open_sequence`: recognises the format of an input and opens it as a Sequence."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from bevcli.frame import Sequence
from bevcli.geometry.object_classes import NUSCENES_CLASSES
from bevcli.options import defaults, gather
from bevcli.sequences.files.class_names import ClassNames
from bevcli.sequences.format import drives_in, format_of, is_drive, own_options
from bevcli.sequences.options import SequenceOptions
from bevcli.sequences.selection import (
    WithClassNames,
    WithoutGroundTruth,
    check_time_unit,
    select_every,
    select_range,
    select_rate,
    select_scene,
)


def open_sequence(path: str | Path, options: SequenceOptions | None = None, **changes: Any) -> Sequence:
    """Open a drive.

    It is a native sequence folder (images or videos), a nuScenes dataset root, an MCAP file, a ROS 2 bag, or a drive of
    another data set (docs/other-inputs.md).

        drive = open_sequence("my_drive")
        drive = open_sequence("drive.mcap", calibration="calibration.json")
        drive = open_sequence("my_drive", rate_hz=2.0, frames=slice(0, 40))
        drive = open_sequence("nuscenes", version="v1.0-mini", scene="scene-0103")
        drive = open_sequence("ddad_train_val", scene="000150")  # a folder of drives
        for place, stamp in enumerate(drive.stamps):
            frame = drive.load(place)

    Only calibration, times and poses are read here. `load` decodes the images of a frame.

    Args:
        path: the folder or file.
        options: the options of every format; None for the defaults.
        changes: options as keywords, those of `SequenceOptions` and those of the path's format: `RigOptions`,
            `NuScenesOptions`, `BagOptions`, `Argoverse2Options` and so on, or the options of an installed format.

    Raises InputError if the path has no known format, a file is missing or invalid, the format does not have an option,
    or no frame is left; TypeError for an option that no format has.
    """
    path, common = Path(path), defaults(SequenceOptions)
    options = gather(SequenceOptions, options, {name: changes.pop(name) for name in common if name in changes})
    if options.scene is not None and (drive := _drive_of(path, options.scene)):
        path, options = drive, replace(options, scene=None)
    chosen = format_of(path)
    own = own_options(path, chosen, changes)
    sequence = chosen.open(path, options, own)
    check_time_unit(sequence, path)
    if options.ground_truth:
        sequence = WithClassNames(sequence, ClassNames(options.class_map, options.classes or NUSCENES_CLASSES))
    else:
        sequence = WithoutGroundTruth(sequence)
    if options.scene is not None:
        sequence = select_scene(sequence, options.scene)
    if options.every is not None:
        sequence = select_every(sequence, options.every)
    rate_hz = options.rate_hz
    if rate_hz is None and options.every is None and not own.wants_all_frames:
        rate_hz = options.model_rate_hz
    if rate_hz is not None and rate_hz != "all":
        sequence = select_rate(sequence, rate_hz)
    return sequence if options.frames is None else select_range(sequence, options.frames)


def _drive_of(root: Path, name: str) -> Path | None:
    """A drive of a folder of drives by its name; None where the path is a drive itself, or holds none of this name."""
    return None if not root.is_dir() or is_drive(root) else drives_in(root).get(name)
