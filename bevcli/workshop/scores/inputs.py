"""Predictions and ground truth from files, folders or a nuScenes root, and the pairs of frames of the two."""

from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from bevcli.errors import InputError
from bevcli.frame import Drive, Frame, FrameStamp
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import default_ego_from_bev
from bevcli.geometry.object_classes import NUSCENES_CLASSES, ObjectClass
from bevcli.geometry.transforms import Array, Pose, apply, inverse, rigid, rotation_about_z
from bevcli.printing import quoted
from bevcli.sequences.files.boxes_file import BoxesFile, ClassNames, FrameBoxes, read_boxes
from bevcli.sequences.files.json_fields import array_of_numbers
from bevcli.sequences.files.map_folder import MapFolder, open_maps
from bevcli.sequences.format import formats
from bevcli.sequences.open import open_sequence
from bevcli.sequences.options import InputOptions
from bevcli.workshop.formats import NuScenesOptions, is_nuscenes_root
from bevcli.workshop.formats.nuscenes_index import chosen_scenes, tables_of
from bevcli.workshop.formats.nuscenes_output import is_submission, read_submission
from bevcli.workshop.formats.nuscenes_tables import open_index
from bevcli.workshop.scores.detection import DetectionScores


@dataclass(frozen=True)
class ScoredInput:
    """Predictions or ground truth."""

    boxes: BoxesFile  # by frame
    path: Path  # the boxes file, or the drive
    maps: MapFolder | None = None  # None where there is no folder of maps
    open_drive: Callable[[], Drive] | None = None  # opens the ground truth as a drive; None of a boxes file
    bicycle_racks: Mapping[str, Boxes3D] = field(default_factory=dict)  # of nuScenes, by sample token, world
    impossible_boxes: int = 0  # the number of boxes that were left out: a size of 0 or less, or not finite

    @property
    def range_m(self) -> float | None:
        """Distance to the end of the BEV grid of the model that made the predictions, metres; None if not stated."""
        range_m = self.boxes.extras.get("range_m")
        return None if range_m is None else float(range_m)


def open_predictions(path: Path, class_map: Mapping[str, str] | None = None) -> ScoredInput:
    """Read a boxes file with scores, the predictions.json in the folder of a run, or a nuScenes submission.

    class_map: see `open_ground_truth`. Maps are in segmentation/ next to the file. Raises InputError where it is
    missing or wrong, or boxes have no scores.
    """
    file = path / "predictions.json" if path.is_dir() else path
    boxes = read_submission(file) if is_submission(file) else read_boxes(file, class_map)
    if (range_m := boxes.extras.get("range_m")) is not None:
        metres = array_of_numbers(range_m)
        if metres is None or metres.shape or not metres > 0:
            raise InputError(f'{file}: "range_m" must be a distance above 0 in metres, but is {quoted(range_m)}')
    for frame in boxes.frames:
        if len(frame.boxes) and frame.boxes.scores is None:
            raise InputError(
                f'{file}: frame {frame.stamp.index}: boxes have no "score" (expected in predictions): '
                "is this a ground truth file?"
            )
    maps = file.parent / "segmentation"
    return ScoredInput(boxes, file, open_maps(maps) if maps.is_dir() else None)


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
    if path.is_dir() and any(form.annotated and form.recognises(path) for form in formats()):
        return _open_drive(path, InputOptions(class_map or {}, scene=scene, classes=tuple(classes)))
    file = path / "ground_truth.json" if path.is_dir() else path
    boxes = read_boxes(file, class_map, classes)
    if scene is not None:
        kept = tuple(frame for frame in boxes.frames if frame.stamp.scene == scene)
        if not kept:
            raise InputError(f'{file}: has no scene "{scene}"')
        boxes = replace(boxes, frames=kept)
    maps = file.parent / "ground_truth_map"
    return ScoredInput(boxes, file, open_maps(maps) if maps.is_dir() else None)


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
    return ScoredInput(BoxesFile("world", tuple(frames)), root, None, drive, racks, impossible)


def _open_drive(path: Path, options: InputOptions) -> ScoredInput:
    drive = open_sequence(path, options)
    frames, impossible = [], 0
    for frame in map(drive.ground_truth_frame, range(len(drive.stamps))):
        if frame.ground_truth is not None:
            frames.append(_true_boxes(frame))
            impossible += frame.impossible_boxes
    if not frames:
        raise InputError(f"{path}: has no ground truth (expected for scoring): score another drive")
    return ScoredInput(BoxesFile("world", tuple(frames)), path, None, lambda: drive, impossible_boxes=impossible)


def _true_boxes(frame: Frame) -> FrameBoxes:
    token = {"sample_token": frame.sample_token} if frame.sample_token else {}
    return FrameBoxes(frame.stamp, frame.world_from_ego, frame.ground_truth or Boxes3D.empty(), token)


@dataclass(frozen=True)
class FramePairs:
    """F frames that are scored, in the order of the predictions."""

    frame_of_reference: str  # of all boxes, "world", "ego" or "bev"
    predictions: tuple[FrameBoxes, ...]  # F frames, without boxes where only the ground truth has the frame
    ground_truth: tuple[FrameBoxes, ...]  # F frames
    reference_from_ego: Array  # (F, 4, 4), pose of the ego vehicle in the frame of reference
    ego_pose_known: bool  # whether each frame has an ego pose on at least one side
    matched_by: str  # the key by which frames were paired
    notes: tuple[str, ...]  # messages for the user, one line each

    @property
    def boxes(self) -> tuple[list[Boxes3D], list[Boxes3D]]:
        """The boxes of the predictions and of the ground truth, by frame."""
        predicted, true = ([frame.boxes for frame in side] for side in (self.predictions, self.ground_truth))
        return predicted, true

    @property
    def ego_xy(self) -> Array:
        """(F, 2), position of the ego vehicle in the frame of reference, metres."""
        return self.reference_from_ego[:, :2, 3]


# Keys that identify a frame, the most reliable first; the first one with common values is used.
_KEYS: dict[str, Callable[[FrameBoxes], Hashable]] = {
    "sample_token": lambda frame: frame.extras.get("sample_token"),
    "scene and timestamp_ns": lambda frame: (frame.stamp.scene, frame.stamp.timestamp_ns),
    "timestamp_ns": lambda frame: frame.stamp.timestamp_ns,
    "scene and frame index": lambda frame: (frame.stamp.scene, frame.stamp.index),
    "frame index": lambda frame: frame.stamp.index,
}
RELIABLE = ("sample_token", "scene and timestamp_ns")


def pair_frames(predictions: BoxesFile, ground_truth: BoxesFile, *, count_missing: bool = False) -> FramePairs:
    """Pair the frames of two files.

    Frames of only one file are left out, which a note reports; with count_missing, those of the ground truth are kept
    as frames without predictions. Where one file is in the world frame and the other in the ego or bev frame, all boxes
    are transformed to the world frame. Raises InputError where the files have no frame in common, or a pose for the
    transformation is missing.
    """
    key, pairs = _common_frames(predictions.frames, ground_truth.frames)
    notes = _notes(key, len(pairs), len(predictions.frames), len(ground_truth.frames), count_missing)
    if count_missing:
        paired = {id(true) for _, true in pairs}
        missing = [true for true in ground_truth.frames if id(true) not in paired]
        pairs += [(replace(true, world_from_ego=None, boxes=Boxes3D.empty()), true) for true in missing]
    if predictions.extras.get("ego_motion") == "measured" and predictions.frame_of_reference == "world":
        pairs = [(_in_world_of(prediction, true), true) for prediction, true in pairs]
    references = {predictions.frame_of_reference, ground_truth.frame_of_reference}
    reference = "world" if "world" in references else "ego"
    if references == {"bev"} and not (predictions.ego_from_bev and ground_truth.ego_from_bev):
        reference = "bev"
    ego_from_bev = predictions.ego_from_bev or ground_truth.ego_from_bev
    poses = [true.world_from_ego or prediction.world_from_ego for prediction, true in pairs]
    return FramePairs(
        frame_of_reference=reference,
        predictions=tuple(
            _transformed(prediction, predictions, reference, prediction.world_from_ego or pose)
            for (prediction, _), pose in zip(pairs, poses, strict=True)
        ),
        ground_truth=tuple(
            _transformed(true, ground_truth, reference, pose) for (_, true), pose in zip(pairs, poses, strict=True)
        ),
        reference_from_ego=np.stack([_reference_from_ego(reference, pose, ego_from_bev) for pose in poses]),
        ego_pose_known=all(pose is not None for pose in poses),
        matched_by=key,
        notes=notes,
    )


def _in_world_of(prediction: FrameBoxes, true: FrameBoxes) -> FrameBoxes:
    """A frame whose pose is measured from the images, in the world frame of the ground truth."""
    pose, measured = true.world_from_ego, prediction.world_from_ego
    if pose is None or measured is None:
        return prediction
    boxes = prediction.boxes.transformed(pose.matrix @ inverse(measured.matrix))
    return replace(prediction, world_from_ego=pose, boxes=boxes)


def boxes_of_drive(predictions: BoxesFile, drive: Drive) -> tuple[list[Boxes3D | None], FramePairs]:
    """The predictions for each frame of a drive in its world frame, and the pairs of frames.

    Frames are matched as for scoring, and need no ground truth. None where the predictions lack a frame. Raises
    InputError as `pair_frames`, and for boxes in the world frame where the drive has no poses.
    """
    if predictions.frame_of_reference == "world" and not drive.has_ego_motion:
        raise InputError("the boxes are in the world frame, and the drive has no ego-motion (expected boxes in ego)")
    frames = tuple(_true_boxes(drive.ground_truth_frame(index)) for index in range(len(drive.stamps)))
    pairs = pair_frames(predictions, BoxesFile("world", frames))
    boxes_at = {true.stamp: frame.boxes for frame, true in zip(pairs.predictions, pairs.ground_truth, strict=True)}
    return [boxes_at.get(stamp) for stamp in drive.stamps], pairs


def _common_frames(
    predictions: Sequence[FrameBoxes], ground_truth: Sequence[FrameBoxes]
) -> tuple[str, list[tuple[FrameBoxes, FrameBoxes]]]:
    """The name of the key, and the pairs."""
    for name, side in (("predictions", predictions), ("ground truth", ground_truth)):
        if not side:
            raise InputError(f"the {name} contain no frame (expected at least one)")
    for name, key in _KEYS.items():
        of_truth, of_predictions = (list(map(key, side)) for side in (ground_truth, predictions))
        if any(None in keys or len(set(keys)) < len(keys) for keys in (of_truth, of_predictions)):  # ambiguous
            continue
        truth = dict(zip(of_truth, ground_truth, strict=True))
        pairs = [
            (prediction, truth[k]) for prediction, k in zip(predictions, of_predictions, strict=True) if k in truth
        ]
        if pairs:
            return name, pairs
    raise InputError(
        f"predictions and ground truth have no frame in common: predictions start with {_described(predictions[0])}, "
        f"ground truth with {_described(ground_truth[0])}: check that both belong to the same drive"
    )


def _described(frame: FrameBoxes) -> str:
    return f'scene "{frame.stamp.scene}" frame {frame.stamp.index} at {frame.stamp.timestamp_ns} ns'


def _transformed(frame: FrameBoxes, file: BoxesFile, reference: str, world_from_ego: Pose | None) -> FrameBoxes:
    if file.frame_of_reference == reference:
        return frame
    ego_from_boxes = np.eye(4)
    if file.frame_of_reference == "bev":
        if file.ego_from_bev is None:
            raise InputError(
                f"frame {frame.stamp.index}: boxes in the bev frame cannot be transformed to the {reference} frame: "
                'add "ego_from_bev" to the boxes file'
            )
        ego_from_boxes = file.ego_from_bev.matrix
    if reference == "ego":
        return replace(frame, boxes=frame.boxes.transformed(ego_from_boxes))
    if world_from_ego is None:
        raise InputError(
            f"frame {frame.stamp.index}: boxes in the {file.frame_of_reference} frame cannot be transformed to the "
            'world frame: "world_from_ego" is missing in predictions and ground truth'
        )
    return replace(frame, boxes=frame.boxes.transformed(world_from_ego.matrix @ ego_from_boxes))


def _reference_from_ego(reference: str, world_from_ego: Pose | None, ego_from_bev: Pose | None) -> Array:
    if reference == "world":
        assert world_from_ego is not None  # otherwise the boxes could not have been transformed
        return world_from_ego.matrix
    if reference == "bev":
        return inverse(ego_from_bev.matrix if ego_from_bev else default_ego_from_bev())
    return np.eye(4)


def _notes(key: str, pairs: int, predictions: int, ground_truth: int, count_missing: bool) -> tuple[str, ...]:
    notes = []
    if key not in RELIABLE:
        notes.append(f"timestamps or scenes differ between the files: frames are matched by {key}")
    if pairs < ground_truth:
        left_out = "left out (`count_missing=True` (`--count-missing`) counts them)"
        treatment = "all their boxes count as missed" if count_missing else left_out
        notes.append(f"{ground_truth - pairs} of {ground_truth} ground-truth frames have no prediction: {treatment}")
    if pairs < predictions:
        notes.append(f"{predictions - pairs} of {predictions} predicted frames have no ground truth: left out")
    return tuple(notes)


def without_cycles_in_racks(pairs: FramePairs, bicycle_racks: Mapping[str, Boxes3D]) -> FramePairs:
    """Leave out bicycles and motorcycles, of both sides, whose centre is in a bicycle rack, as the devkit does.

    bicycle_racks: by sample token, in the world frame, as the pairs.
    """
    if not bicycle_racks:
        return pairs
    assert pairs.frame_of_reference == "world"
    tokens = [frame.extras.get("sample_token", "") for frame in pairs.ground_truth]
    racks = [bicycle_racks.get(token, Boxes3D.empty()) for token in tokens]
    predicted, true = (tuple(map(_outside, side, racks)) for side in (pairs.predictions, pairs.ground_truth))
    return replace(pairs, predictions=predicted, ground_truth=true)


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


@dataclass(frozen=True)
class Compared:
    """Predictions and ground truth of the same frames."""

    pairs: FramePairs  # the frames that are scored
    classes: Mapping[str, ObjectClass]  # of the predictions, by name
    max_range_m: float | None  # from the ego vehicle; nothing beyond is scored. None for the range of each class
    predictions: ScoredInput | None = None  # with all frames; None of frames in memory
    truth: ScoredInput | None = None  # with all frames; None of frames in memory
    detection: DetectionScores | None = None  # the scores of the boxes; None where they are not computed
    selection: Mapping[str, str] = field(default_factory=dict)  # of the ground truth: "scene", "version" and "split"
