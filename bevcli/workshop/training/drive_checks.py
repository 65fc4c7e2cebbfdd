"""Checks of drives before they are trained on or scored: classes, ground truth, and frames enough for a clip."""

from collections import Counter
from collections.abc import Iterator, Mapping

from bevcli.errors import InputError
from bevcli.frame import Sequence, result_of
from bevcli.geometry.object_classes import NUSCENES_CLASSES
from bevcli.model.config import ModelConfig
from bevcli.sequences.files.class_names import ClassNames, count_classes
from bevcli.sequences.native.folder import BOXES_FILE
from bevcli.sequences.selection import scenes_of
from bevcli.workshop.synth.drives import FRAMES_PER_DRIVE, Drives
from bevcli.workshop.synth.options import DriveOptions
from bevcli.workshop.training.samples import ClipConfig
from bevcli.workshop.vad.map_lines import TRUE_LINES, MapLines


def check_training_drives(
    data: DriveOptions, drives: Drives, held_out: Drives | None, clips: ClipConfig, config: ModelConfig
) -> tuple[str, ...]:
    """Notes about the drives of a training, each set once. Renders no drive.

    drives: to train on. held_out: to score on; None for the same drives.
    Raises InputError where a frame to train on has no ground truth or a drive is shorter than a clip, and as
    `check_classes`.
    """
    if data.rendered is not None:
        if clips.frames > FRAMES_PER_DRIVE:
            raise _too_short(f"rendered drives ({FRAMES_PER_DRIVE})", clips.frames, FRAMES_PER_DRIVE)
        _check_rendered_classes(data.class_map, config)
        return ()
    _check_lengths(drives, clips.frames)
    _check_ground_truth(drives, clips, config)
    notes = [*check_classes(drives, f"{_count(drives)} to train on", "trained on", config)]
    if held_out is not None:
        notes += check_classes(held_out, f"{_count(held_out)} to score on", "scored", config)
    return tuple(notes)


def check_scored_drives(data: DriveOptions, drives: Drives, config: ModelConfig) -> tuple[str, ...]:
    """Notes about drives that are scored. Renders no drive. Raises InputError as `check_classes`."""
    if data.rendered is not None:
        _check_rendered_classes(data.class_map, config)
        return ()
    return tuple(check_classes(drives, _count(drives), "scored", config))


def check_classes(drives: Drives, where: str, use: str, config: ModelConfig) -> Iterator[str]:
    """Notes about the classes in the ground truth of drives: boxes that are left out, and classes without a box.

    Args:
        drives: folders; opens each of them, and reads the frames of a format that has no table of its boxes.
        where: the set of drives, for messages, such as "the 4 held-out drives".
        use: what happens to boxes of known classes: "trained on" or "scored".

    Raises InputError where no box has a class of the model.
    """
    counts: Counter[str] = Counter()
    for drive in map(drives.open, range(len(drives))):
        counts.update(drive.class_counts or _count_in_frames(drive))
    absent = [name for name in config.classes if not counts[name]]
    if counts and len(absent) == len(config.classes):
        named = ", ".join(f"{name} ({count})" for name, count in sorted(counts.items()))
        raise _no_known_class(f"the ground truth of {where}", named, counts.most_common(1)[0][0], config)
    yield from ClassNames(classes=config.classes).note(counts, where, use)
    if counts and absent:
        yield f"{where}: no box has the class {' or '.join(absent)} of the model {config.name}"


def _count_in_frames(drive: Sequence) -> Counter[str]:
    """Number of boxes by class in the frames of a drive."""
    truths = (drive.ground_truth_frame(place).ground_truth for place in range(len(drive.stamps)))
    return count_classes(boxes for boxes in truths if boxes is not None)


def _check_rendered_classes(class_map: Mapping[str, str], config: ModelConfig) -> None:
    """Raise InputError where the model has none of the classes of rendered drives."""
    names = ClassNames(class_map, config.classes)
    if not {names[name] for name in NUSCENES_CLASSES} & set(config.classes):
        raise _no_known_class("the ground truth of rendered drives", ", ".join(NUSCENES_CLASSES), "car", config)


def _check_ground_truth(drives: Drives, clips: ClipConfig, config: ModelConfig) -> None:
    """Raise InputError for a drive with a frame that may be trained on and has no ground truth boxes, or no lines."""
    first = clips.frames - 1 if clips.learn == "last" and clips.short_share == 0 else 0
    for drive in map(drives.open, range(len(drives))):
        places = [place for scene in scenes_of(drive.stamps) for place in scene[first:]]
        without: dict[tuple[str, str], list[int]] = {("boxes", BOXES_FILE): [], ("lines", TRUE_LINES): []}
        for frame in map(drive.ground_truth_frame, places):
            if frame.ground_truth is None:
                without["boxes", BOXES_FILE].append(frame.stamp.index)
            if MapLines in config.results and result_of(MapLines, frame.ground_truth_results) is None:
                without["lines", TRUE_LINES].append(frame.stamp.index)
        for (truth, file), missing in without.items():
            if missing:
                raise InputError(
                    f"{drive.name}: {len(missing)} of {len(places)} frames to train on have no ground truth {truth}, "
                    f"the first is frame {missing[0]}: add them to {file}, or remove the frames"
                )


def _check_lengths(drives: Drives, clip_frames: int) -> None:
    """Raise InputError that names the drives without a scene as long as a clip. Opens each of them."""
    lengths = {drive.name: longest_scene(drive) for drive in map(drives.open, range(len(drives)))}
    short = {name: frames for name, frames in lengths.items() if frames < clip_frames}
    if short:
        named = ", ".join(f"{name} ({frames})" for name, frames in short.items())
        raise _too_short(named, clip_frames, min(short.values()))


def longest_scene(drive: Sequence) -> int:
    """The number of frames of the longest scene of a drive."""
    return max(map(len, scenes_of(drive.stamps)), default=0)


def _count(drives: Drives) -> str:
    return "the drive" if len(drives) == 1 else f"the {len(drives)} drives"


def _too_short(drives: str, clip_frames: int, frames: int) -> InputError:
    return InputError(
        f"drives with fewer frames than a clip, {clip_frames} at the model's frame rate: {drives}: leave them out, or "
        f'pass `changes={{"clips.frames": {frames}}}`'
    )


def _no_known_class(where: str, found: str, example: str, config: ModelConfig) -> InputError:
    return InputError(
        f"{where} has no class of the model {config.name} (expected {', '.join(config.classes)}; found {found}): "
        f"pass `class_map={{{example!r}: {config.classes[0]!r}}}`, or set classes in the model's file"
    )
