"""`estimate_score`: do the boxes of a model agree with a second witness, on a drive without ground truth?

`agreement_of_boxes` takes the boxes of a run that is done, or of any file.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bevcli.frame import Drive, Frame, Prediction
from bevcli.geometry.boxes import Boxes2D
from bevcli.geometry.object_classes import NUSCENES_CLASSES, ObjectClass
from bevcli.inference import run
from bevcli.inference.load import Model
from bevcli.workshop.scores.inputs import boxes_of_drive, open_predictions
from bevcli.workshop.trust.agreement import Agreement, FrameAgreement, Held, agreement, compared
from bevcli.workshop.trust.faults import find_faults
from bevcli.workshop.trust.witness import load_witness, seen_in_run

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
    steps = run(model, drive, temporal=temporal, track=False)
    frames = ((frame, one.boxes_world, witnessed(frame, one, drive).image_boxes) for frame, one in steps)
    classes, range_m = model.config.object_classes, model.config.bev_grid.nearest_side_m
    return compared(frames, classes, range_m, has_poses=drive.has_ego_motion)


def witnessed(frame: Frame, prediction: Prediction, drive: Drive) -> Prediction:
    """A prediction with what the witness sees as its boxes in the images; without any where it does not look."""
    if prediction.image_boxes is not None:  # of a model that has the detector
        return prediction
    seen = load_witness().seen(frame) if _is_looked_at(drive.stamps.index(frame.stamp), drive) else {}
    return replace(prediction, image_boxes=seen)


def agreement_of_boxes(
    path: Path, drive: Drive, class_map: Mapping[str, str] | None = None, worst: int = 0
) -> Agreement:
    """The agreement of the boxes of any model, or those of a run, with the witness.

    Args:
        path: file of boxes, as for `open_predictions`; or folder of a run, whose image_boxes.csv has what the witness
            saw. Else it looks now.
        drive: of the boxes; it needs no ground truth.
        class_map: of the file's classes.
        worst: length of the list of frames that differ most.

    Raises InputError where the files cannot be read, as `boxes_of_drive`, and where a frame cannot be read.
    """
    file, table = open_predictions(path, class_map), path / "image_boxes.csv"
    boxes, seen = file.boxes, seen_in_run(table) if table.exists() else None
    of_frames, _ = boxes_of_drive(boxes, drive)
    looked_at = [_is_looked_at(place, drive) for place in range(len(drive.stamps))]
    in_run = [seen and seen.get((stamp.index, stamp.timestamp_ns)) for stamp in drive.stamps]
    if any(there and not looked for there, looked in zip(in_run, looked_at, strict=True)):
        looked_at = [True] * len(looked_at)  # the model's own detector saw every frame

    def frames() -> Iterator[Held]:
        for place, own in enumerate(of_frames):
            if own is None:
                continue
            if looked_at[place] and seen is None:
                frame = drive.load(place)
                yield frame, own, load_witness().seen(frame)
            else:
                there, names = in_run[place] or {}, drive.rig.names if looked_at[place] else ()
                yield drive.ground_truth_frame(place), own, {name: there.get(name, NO_BOXES) for name in names}

    classes: Mapping[str, ObjectClass] = boxes.classes or NUSCENES_CLASSES
    held = compared(frames(), classes, file.range_m or RANGE_M, has_poses=drive.has_ego_motion)
    return agreement(list(held), worst)


def _is_looked_at(place: int, drive: Drive) -> bool:
    return place % EVERY == 0 or len(drive.stamps) <= SHORT


def as_document(
    together: Agreement, drives: Sequence[tuple[str, Agreement]], reference: Agreement | None = None
) -> dict[str, Any]:
    """The agreement of all drives, for JSON; with their names that of each in its "drives"."""
    each = [{"name": name, **one.to_dict()} for name, one in drives]
    return {"agreement": {**together.to_dict(), "drives": each, "reference": reference and reference.to_dict()}}
