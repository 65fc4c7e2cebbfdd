"""`estimate_score`: do the boxes of a model agree with a second witness, on a drive without ground truth?

`agreement_of_run` and `agreement_of_boxes` take the boxes of a run that is done, or of any file.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bevcli.frame import Drive, Frame, Prediction
from bevcli.geometry.boxes import Boxes2D, Boxes3D
from bevcli.geometry.object_classes import NUSCENES_CLASSES, ObjectClass
from bevcli.inference import run
from bevcli.inference.load import Model
from bevcli.inference.runner import RunnerState
from bevcli.printing import cell_of
from bevcli.sequences.files.boxes_file import BoxesFile
from bevcli.workshop.scores.inputs import boxes_of_drive, open_predictions
from bevcli.workshop.trust.agreement import Agreement, FrameAgreement, agreement, compared
from bevcli.workshop.trust.faults import find_faults
from bevcli.workshop.trust.witness import load_witness, seen_in_run

Step = tuple[Frame, Prediction, RunnerState[Any]]  # of `Runner.run`
EVERY, SHORT = 3, 8  # the witness looks at every third frame, at each one of a drive with up to eight
RANGE_M = 50.0  # of boxes whose file states none
NO_BOXES = Boxes2D(np.zeros((0, 4)), np.zeros(0, str), np.zeros(0))


def estimate_score(model: Model, drive: Drive, *, temporal: bool = True) -> Agreement:
    """Agreement of a model's boxes with a detector in the images, on a drive that needs no ground truth; and faults.

        found = bevcli.estimate_score(model, bevcli.open_sequence("my_drive"))
        print(found.score, found.low, found.high, found.groups["vehicles"].found)

    Args:
        model: of `load_model`.
        drive: of `open_sequence`.
        temporal: use the frames before.

    Raises InputError where a frame cannot be read.
    """
    found = agreement(list(frames_of_model(model, drive, temporal=temporal)))
    return replace(found, findings=find_faults(model, drive))


def frames_of_model(model: Model, drive: Drive, *, temporal: bool = True) -> Iterator[FrameAgreement]:
    """The frames of a model's run over a drive, held against the witness as it goes, for `agreement`."""

    def frames() -> Iterator[tuple[Frame, Boxes3D, Mapping[str, Boxes2D] | None]]:
        for place, (frame, prediction) in enumerate(run(model, drive, temporal=temporal, track=False)):
            seen = prediction.image_boxes
            if seen is None and _is_looked_at(place, drive):
                seen = load_witness().seen(frame)
            yield frame, prediction.boxes_ego.transformed(frame.world_from_ego.matrix), seen

    classes, range_m = model.config.object_classes, model.config.bev_grid.nearest_side_m
    return compared(frames(), classes, range_m, has_poses=drive.has_ego_motion)


def witnessed(steps: Iterable[Step], drive: Drive) -> Iterator[Step]:
    """The steps of a run, with what the witness sees as the boxes in the images where the model has no detector."""
    for frame, prediction, after in steps:
        if prediction.image_boxes is None:
            is_looked_at = _is_looked_at(drive.stamps.index(frame.stamp), drive)
            prediction = replace(prediction, image_boxes=load_witness().seen(frame) if is_looked_at else {})
        yield frame, prediction, after


def agreement_of_run(folder: Path, drive: Drive) -> Agreement:
    """The agreement from the files of a run over a drive. Raises InputError where they cannot be read."""
    file, path = open_predictions(folder), folder / "image_boxes.csv"
    return agreement_of_boxes(file.boxes, drive, file.range_m, seen_in_run(path) if path.exists() else None)


def agreement_of_boxes(
    boxes: BoxesFile,
    drive: Drive,
    range_m: float | None = None,
    seen: Mapping[tuple[int, int], Mapping[str, Boxes2D]] | None = None,
    worst: int = 0,
) -> Agreement:
    """The agreement of the boxes of any model with the witness.

    Args:
        boxes: of the drive's frames.
        drive: it needs no ground truth.
        range_m: nothing beyond it is counted; default: RANGE_M.
        seen: index and time of a frame -> camera -> what the witness saw, from an earlier run. Default: it looks now.
        worst: length of the list of frames that differ most.

    Raises InputError as `boxes_of_drive`, and where a frame cannot be read.
    """
    of_frames, _ = boxes_of_drive(boxes, drive)
    looked_at = [_is_looked_at(place, drive) for place in range(len(drive.stamps))]
    in_run = [seen and seen.get((stamp.index, stamp.timestamp_ns)) for stamp in drive.stamps]
    if any(there and not looked for there, looked in zip(in_run, looked_at, strict=True)):
        looked_at = [True] * len(looked_at)  # the model's own detector saw every frame

    def frames() -> Iterator[tuple[Frame, Boxes3D, Mapping[str, Boxes2D] | None]]:
        for place, own in enumerate(of_frames):
            if own is None:
                continue
            if not looked_at[place]:
                yield drive.ground_truth_frame(place), own, None
            elif seen is None:
                frame = drive.load(place)
                yield frame, own, load_witness().seen(frame)
            else:
                there = in_run[place] or {}
                in_cameras = {name: there.get(cell_of(name), NO_BOXES) for name in drive.rig.names}
                yield drive.ground_truth_frame(place), own, in_cameras

    classes: Mapping[str, ObjectClass] = boxes.classes or NUSCENES_CLASSES
    limit = range_m or RANGE_M
    return agreement(list(compared(frames(), classes, limit, has_poses=drive.has_ego_motion)), worst)


def _is_looked_at(place: int, drive: Drive) -> bool:
    return place % EVERY == 0 or len(drive.stamps) <= SHORT


def as_document(
    together: Agreement, drives: Sequence[tuple[str, Agreement]], reference: Agreement | None = None
) -> dict[str, Any]:
    """The agreement of all drives, for JSON; with their names that of each in its "drives"."""
    each = [{"name": name, **one.to_dict()} for name, one in drives]
    return {"agreement": {**together.to_dict(), "drives": each, "reference": reference and reference.to_dict()}}
