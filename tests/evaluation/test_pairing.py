"""Frames of two files are paired, and their boxes are moved into one frame of reference."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from random_boxes import as_predictions, random_truth

from bevcli.errors import InputError
from bevcli.frame import FrameStamp
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import default_ego_from_bev
from bevcli.geometry.transforms import Pose, inverse, rigid, rotation_about_z
from bevcli.sequences.files.boxes_file import BoxesFile, FrameBoxes
from bevcli.workshop.scores.detection import evaluate_detections
from bevcli.workshop.scores.inputs import FramePairs, pair_frames

TRUTH = random_truth(11, frames=4)
PREDICTIONS = as_predictions(TRUTH, 12, noise_m=0.5, false_per_frame=10)
POSES = [Pose.from_matrix(rigid((500 + 10 * k, -20.0, 1.0), rotation_about_z(0.4 * k))) for k in range(4)]


def boxes_file(frames: list[Boxes3D], reference: str = "ego", **stamps: Any) -> BoxesFile:
    """A file of boxes given in the ego frame, in another frame of reference.

    stamps: scene, first (frame index), start_ns, poses.
    """
    bev = Pose.from_matrix(default_ego_from_bev())
    rows = []
    for place, boxes in enumerate(frames):
        from_ego = {"ego": np.eye(4), "world": POSES[place].matrix, "bev": inverse(default_ego_from_bev())}[reference]
        stamp = FrameStamp(
            stamps.get("first", 0) + place, stamps.get("scene", "a"), stamps.get("start_ns", 0) + 500_000_000 * place
        )
        pose = POSES[place] if stamps.get("poses", reference == "world") else None
        rows.append(FrameBoxes(stamp, pose, boxes.transformed(from_ego)))
    return BoxesFile(reference, tuple(rows), bev if reference == "bev" else None)


def nds(pairs: FramePairs) -> float:
    found, true = ([frame.boxes for frame in side] for side in (pairs.predictions, pairs.ground_truth))
    return evaluate_detections(found, true, None, pairs.ego_xy).overall.nd_score


@pytest.mark.parametrize("one", ["world", "ego", "bev"])
@pytest.mark.parametrize("other", ["world", "ego", "bev"])
def test_the_frame_of_reference_does_not_matter(one: str, other: str) -> None:
    expected = nds(pair_frames(boxes_file(PREDICTIONS), boxes_file(TRUTH)))
    pairs = pair_frames(boxes_file(PREDICTIONS, one), boxes_file(TRUTH, other))
    assert nds(pairs) == pytest.approx(expected)
    assert pairs.ego_pose_known == ("world" in (one, other))


def test_boxes_without_a_pose_to_transform_by_are_an_error() -> None:
    world = boxes_file(TRUTH, "world")
    bev = replace(boxes_file(PREDICTIONS, "bev"), ego_from_bev=None)
    with pytest.raises(InputError, match=r'frame 0: boxes in the bev frame .* add "ego_from_bev"'):
        pair_frames(bev, world)


@pytest.mark.parametrize(
    ("stamps", "matched_by"),
    [
        ({}, "scene and timestamp_ns"),
        ({"first": 7}, "scene and timestamp_ns"),
        ({"scene": "b"}, "timestamp_ns"),
        ({"start_ns": 1}, "scene and frame index"),
        ({"start_ns": 1, "scene": "b"}, "frame index"),
    ],
)
def test_the_key_that_frames_are_matched_by(stamps: dict[str, Any], matched_by: str) -> None:
    pairs = pair_frames(boxes_file(PREDICTIONS, **stamps), boxes_file(TRUTH))
    assert pairs.matched_by == matched_by
    assert len(pairs.predictions) == 4
    assert len(pairs.notes) == (0 if matched_by == "scene and timestamp_ns" else 1)


def test_sample_tokens_go_first() -> None:
    def with_tokens(file: BoxesFile, order: list[int]) -> BoxesFile:
        rows = [replace(frame, extras={"sample_token": f"t{k}"}) for frame, k in zip(file.frames, order, strict=True)]
        return replace(file, frames=tuple(rows))

    mixed = [PREDICTIONS[place] for place in (2, 0, 3, 1)]
    pairs = pair_frames(with_tokens(boxes_file(mixed), [2, 0, 3, 1]), with_tokens(boxes_file(TRUTH), [0, 1, 2, 3]))
    assert pairs.matched_by == "sample_token"
    assert nds(pairs) == pytest.approx(nds(pair_frames(boxes_file(PREDICTIONS), boxes_file(TRUTH))))


def test_frames_of_one_side_are_left_out_or_counted_with_a_note() -> None:
    half = boxes_file(PREDICTIONS[:2])
    left_out = pair_frames(half, boxes_file(TRUTH))
    assert len(left_out.predictions) == 2
    found = "2 of 4 ground-truth frames have no prediction: left out"
    assert left_out.notes == (f"{found} (`count_missing=True` (`--count-missing`) counts them)",)
    counted = pair_frames(half, boxes_file(TRUTH), count_missing=True)
    assert [len(frame.boxes) for frame in counted.predictions[2:]] == [0, 0]
    assert "count as missed" in counted.notes[0]
    more = pair_frames(boxes_file(PREDICTIONS), boxes_file(TRUTH[:1]))
    assert more.notes == ("3 of 4 predicted frames have no ground truth: left out",)


def test_files_of_different_drives_are_refused() -> None:
    other = boxes_file(TRUTH, scene="b", first=100, start_ns=10**18)
    with pytest.raises(InputError, match='no frame in common: predictions start with scene "a" frame 0 at 0 ns'):
        pair_frames(boxes_file(PREDICTIONS), other)
    with pytest.raises(InputError, match="the predictions contain no frame"):
        pair_frames(BoxesFile("ego", ()), boxes_file(TRUTH))
