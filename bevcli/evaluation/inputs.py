"""Reads predictions and ground truth from files, folders or a nuScenes root."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from bevcli.errors import InputError
from bevcli.evaluation.formats.nuscenes import is_submission, read_submission
from bevcli.evaluation.pairing import FramePairs
from bevcli.frame import FrameStamp, Ground, Sequence, result_of
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.object_classes import NUSCENES_CLASSES
from bevcli.geometry.transforms import Pose, apply, rigid, rotation_about_z
from bevcli.sequences.files.boxes_file import BoxesFile, FrameBoxes, read_boxes
from bevcli.sequences.files.class_names import ClassNames
from bevcli.sequences.files.map_folder import MapFolder, open_maps
from bevcli.sequences.format import formats
from bevcli.sequences.nuscenes.cache import open_index
from bevcli.sequences.nuscenes.choice import chosen_scenes, tables_of
from bevcli.sequences.nuscenes.format import NuScenesOptions, is_nuscenes_root
from bevcli.sequences.open import open_sequence
from bevcli.sequences.options import SequenceOptions
from bevcli.workshop.vad.map_lines import LINE_CLASSES, TRUE_LINES, FrameLines, LinesFile, MapLines, read_lines


@dataclass(frozen=True)
class ScoredInput:
    """Predictions or ground truth.

    Attributes:
        boxes: by frame.
        maps: None where there is no folder of maps.
        bicycle_racks: by sample token, in the world frame; only of a nuScenes root.
        lines: reads the true lines of the map, and raises InputError without them; None of predictions.
        impossible_boxes: the number of boxes that were left out: a size of 0 or less, or not finite.
    """

    boxes: BoxesFile
    maps: MapFolder | None = None
    bicycle_racks: Mapping[str, Boxes3D] = field(default_factory=dict)
    lines: Callable[[], LinesFile] | None = None
    impossible_boxes: int = 0


def open_predictions(path: Path, class_map: Mapping[str, str] | None = None) -> ScoredInput:
    """Read a boxes file with scores, the predictions.json in the folder of a run, or a nuScenes submission.

    class_map: see `open_ground_truth`. Maps are in segmentation/ next to the file. Raises InputError where it is
    missing or wrong, or boxes have no scores.
    """
    file = path / "predictions.json" if path.is_dir() else path
    boxes = read_submission(file) if is_submission(file) else read_boxes(file, class_map)
    for frame in boxes.frames:
        if len(frame.boxes) and frame.boxes.scores is None:
            raise InputError(
                f'{file}: frame {frame.stamp.index}: boxes have no "score" (expected in predictions): '
                "is this a ground truth file?"
            )
    return ScoredInput(boxes, _maps_next_to(file, "segmentation"))


def open_ground_truth(
    path: Path,
    options: NuScenesOptions = NuScenesOptions(),
    scene: str | None = None,
    class_map: Mapping[str, str] | None = None,
    classes: Iterable[str] = NUSCENES_CLASSES,
) -> ScoredInput:
    """Read a boxes file, the ground_truth.json in a sequence folder, or a drive of another format.

    Maps are in ground_truth_map/ next to the file. options: the part of a nuScenes root. scene: selects frames of a
    drive or a boxes file. class_map: names of the ground truth -> classes. classes: those that are scored. Raises
    InputError where the ground truth is missing or wrong.
    """
    if path.is_dir() and is_nuscenes_root(path):
        return _open_nuscenes(path, options, scene, ClassNames(class_map, classes))
    if path.is_dir() and any(one.annotated and one.recognises(path) for one in formats()):
        return _open_drive(path, SequenceOptions(class_map or {}, scene=scene, classes=tuple(classes)))
    file = path / "ground_truth.json" if path.is_dir() else path
    boxes = read_boxes(file, class_map, classes)
    if scene is not None:
        kept = tuple(frame for frame in boxes.frames if frame.stamp.scene == scene)
        if not kept:
            raise InputError(f'{file}: has no scene "{scene}"')
        boxes = replace(boxes, frames=kept)
    return ScoredInput(boxes, _maps_next_to(file, "ground_truth_map"), lines=partial(_lines_next_to, file))


def without_cycles_in_racks(pairs: FramePairs, bicycle_racks: Mapping[str, Boxes3D]) -> FramePairs:
    """Leave out bicycles and motorcycles, of both sides, whose centre is in a bicycle rack, as the devkit does.

    bicycle_racks: by sample token, in the world frame, as the pairs.
    """
    if not bicycle_racks:
        return pairs
    assert pairs.frame_of_reference == "world"
    tokens = [frame.extras.get("sample_token", "") for frame in pairs.ground_truth]
    racks = [bicycle_racks.get(token, Boxes3D.empty()) for token in tokens]
    found, true = (tuple(map(_outside, side, racks)) for side in (pairs.predictions, pairs.ground_truth))
    return replace(pairs, predictions=found, ground_truth=true)


def _outside(frame: FrameBoxes, racks: Boxes3D) -> FrameBoxes:
    boxes = frame.boxes
    cycles = np.isin(boxes.classes, ("bicycle", "motorcycle"))
    if not len(racks) or not cycles.any():
        return frame
    inside = np.zeros(len(boxes), dtype=bool)
    for center, size, yaw in zip(racks.centers, racks.sizes_lwh, racks.yaws, strict=True):
        rack_from_world = np.linalg.inv(rigid(center, rotation_about_z(float(yaw))))
        inside |= (np.abs(apply(rack_from_world, boxes.centers)) <= size / 2).all(axis=1)
    return replace(frame, boxes=boxes[~(cycles & inside)])


def _maps_next_to(file: Path, name: str) -> MapFolder | None:
    folder = file.parent / name
    return open_maps(folder) if folder.is_dir() else None


def _lines_next_to(file: Path) -> LinesFile:
    lines = file.with_name(TRUE_LINES)
    if not lines.exists():
        raise InputError(f"{lines}: `map`: the file is missing (expected true lines, as `bevcli render` writes them)")
    return read_lines(lines)


def _lines_of(open_drive: Callable[[], Sequence], expected: str) -> LinesFile:
    """The true lines of a drive in the world frame. expected: what would have them."""
    drive, frames = open_drive(), []
    for frame in map(drive.ground_truth_frame, range(len(drive.stamps))):
        if (lines := result_of(MapLines, frame.ground_truth_results)) is None:
            where = f'scene "{frame.stamp.scene}"' if frame.stamp.scene else f"frame {frame.stamp.index}"
            raise InputError(f"{drive.name}: `map`: {where} has no true lines of the map (expected {expected})")
        ground = Ground(frame.stamp, frame.rig.ego_from_bev, frame.world_from_ego)
        frames.append(FrameLines(frame.stamp, replace(lines, points=tuple(map(ground.points, lines.points)))))
    return LinesFile("world", LINE_CLASSES, tuple(frames))


def _open_nuscenes(root: Path, options: NuScenesOptions, only: str | None, names: ClassNames) -> ScoredInput:
    tables = tables_of(root, options.version)
    index, _ = open_index(tables)
    frames, racks, samples, impossible = list[FrameBoxes](), {}, index.samples, 0
    for scene in chosen_scenes(index, tables, options.split, only):
        for sample in range(*index.scenes.first_sample[scene : scene + 2]):
            boxes, token = index.ground_truth(sample), samples.tokens[sample].decode()
            if boxes is None:
                raise InputError(f"{tables}: has no annotations (expected for scoring): choose another split than test")
            stamp = FrameStamp(len(frames), str(index.scenes.names[scene]), int(samples.times_us[sample]) * 1000)
            pose = Pose(np.array(samples.translations[sample]), np.array(samples.quaternions[sample]))
            impossible += len(boxes) - len(boxes.possible())
            frames.append(FrameBoxes(stamp, pose, names.renamed(boxes.possible()), {"sample_token": token}))
            racks[token] = index.bicycle_racks(sample)
    drive = partial(open_sequence, root, scene=only, version=options.version, split=options.split)
    lines = partial(_lines_of, drive, f"the map expansion in {root / 'maps' / 'expansion'}")
    return ScoredInput(BoxesFile("world", tuple(frames)), None, racks, lines, impossible)


def _open_drive(path: Path, options: SequenceOptions) -> ScoredInput:
    drive = open_sequence(path, options)
    found, impossible = [], 0
    for frame in map(drive.ground_truth_frame, range(len(drive.stamps))):
        if frame.ground_truth is not None:
            token = {"sample_token": frame.sample_token} if frame.sample_token else {}
            found.append(FrameBoxes(frame.stamp, frame.world_from_ego, frame.ground_truth, token))
            impossible += frame.impossible_boxes
    if not found:
        raise InputError(f"{path}: has no ground truth (expected for scoring): score another drive")
    lines = partial(_lines_of, lambda: drive, "a drive that has them")
    return ScoredInput(BoxesFile("world", tuple(found)), lines=lines, impossible_boxes=impossible)
