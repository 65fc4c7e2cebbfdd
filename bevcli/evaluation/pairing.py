"""Pairs the frames of predictions and ground truth, and moves their boxes into one frame of reference."""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bevcli.errors import InputError
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import default_ego_from_bev
from bevcli.geometry.transforms import Array, Pose, inverse
from bevcli.sequences.files.boxes_file import BoxesFile, FrameBoxes


@dataclass(frozen=True)
class FramePairs:
    """F frames that are scored, in the order of the predictions.

    Attributes:
        frame_of_reference: of all boxes, "world", "ego" or "bev".
        predictions: F frames, without boxes where only the ground truth has the frame.
        ground_truth: F frames.
        reference_from_ego: (F, 4, 4), pose of the ego vehicle in the frame of reference.
        ego_pose_known: whether each frame has an ego pose on at least one side.
        matched_by: the key by which frames were paired.
        notes: messages for the user, one line each.
    """

    frame_of_reference: str
    predictions: tuple[FrameBoxes, ...]
    ground_truth: tuple[FrameBoxes, ...]
    reference_from_ego: Array
    ego_pose_known: bool
    matched_by: str
    notes: tuple[str, ...]

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
_RELIABLE = ("sample_token", "scene and timestamp_ns")


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
    reference = _common_frame_of_reference(predictions, ground_truth)
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


def _common_frames(
    predictions: Sequence[FrameBoxes], ground_truth: Sequence[FrameBoxes]
) -> tuple[str, list[tuple[FrameBoxes, FrameBoxes]]]:
    """The name of the key, and the pairs."""
    for name, side in (("predictions", predictions), ("ground truth", ground_truth)):
        if not side:
            raise InputError(f"the {name} contain no frame (expected at least one)")
    for name, key in _KEYS.items():
        of_truth, of_predictions = (list(map(key, side)) for side in (ground_truth, predictions))
        if _ambiguous(of_truth) or _ambiguous(of_predictions):
            continue
        truth = dict(zip(of_truth, ground_truth, strict=True))
        pairs = [(one, truth[k]) for one, k in zip(predictions, of_predictions, strict=True) if k in truth]
        if pairs:
            return name, pairs
    raise InputError(
        f"predictions and ground truth have no frame in common: predictions start with {_described(predictions[0])}, "
        f"ground truth with {_described(ground_truth[0])}: check that both belong to the same drive"
    )


def _ambiguous(keys: Sequence[Hashable]) -> bool:
    return None in keys or len(set(keys)) < len(keys)


def _described(frame: FrameBoxes) -> str:
    return f'scene "{frame.stamp.scene}" frame {frame.stamp.index} at {frame.stamp.timestamp_ns} ns'


def _common_frame_of_reference(one: BoxesFile, other: BoxesFile) -> str:
    references = {one.frame_of_reference, other.frame_of_reference}
    if "world" in references:
        return "world"
    return "bev" if references == {"bev"} and not (one.ego_from_bev and other.ego_from_bev) else "ego"


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
    if key not in _RELIABLE:
        notes.append(f"timestamps or scenes differ between the files: frames are matched by {key}")
    if pairs < ground_truth:
        left_out = "left out (`count_missing=True` counts them)"
        treatment = "all their boxes count as missed" if count_missing else left_out
        notes.append(f"{ground_truth - pairs} of {ground_truth} ground-truth frames have no prediction: {treatment}")
    if pairs < predictions:
        notes.append(f"{predictions - pairs} of {predictions} predicted frames have no ground truth: left out")
    return tuple(notes)
