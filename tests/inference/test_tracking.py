"""The tracker: identities that last, births, deaths, duplicates, and the state as an argument and a result."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from made_boxes import made_boxes

from bevcli.config import TRACKING, settings_of_table
from bevcli.errors import ConfigError
from bevcli.frame import FrameStamp
from bevcli.geometry.boxes import Boxes3D
from bevcli.inference.tracking import TrackerConfig, step
from bevcli.sequences.files.boxes_file import read_boxes
from bevcli.workshop.scores.tracking import evaluate_tracking

STREET = Path(__file__).parents[2] / "samples" / "street" / "ground_truth.json"
STANDING = (0.0, 0.0)


def box(x, y, velocity=STANDING, score=0.9, name="car"):
    return made_boxes([(x, y, 0.5)], name, velocities=np.array(velocity, dtype=np.float64), scores=score)


def frame(*boxes):
    return Boxes3D.concatenate(boxes)


def track(frames, config=None, state=None, scenes=None, period_s=0.5, start=0):
    """The tracked boxes of frames, and the state after the last one."""
    config = TrackerConfig() if config is None else config
    scenes = "a" * len(frames) if scenes is None else scenes
    tracked = []
    for k, (boxes, scene) in enumerate(zip(frames, scenes, strict=True), start):
        state, found = step(config, state, boxes, FrameStamp(k, scene, round(k * period_s * 1e9)))
        tracked.append(found)
    return tracked, state


def identities(frames, **options):
    """The identities of each frame's boxes."""
    return [list(boxes.instances) for boxes in track(frames, **options)[0]]


def moving(count, velocity=(8.0, 0.0), period_s=0.5):
    vx, vy = velocity
    return [box(vx * k * period_s, vy * k * period_s, velocity) for k in range(count)]


def crossing_cars():
    """Two cars at right angles: where one was, the other is half a second later."""
    return [frame(box(8 * t - 12, 0, (8, 0)), box(2, 8 * t - 14, (0, 8))) for t in np.arange(0, 3.5, 0.5)]


def out_of_view(boxes, *unseen):
    return replace(boxes, unseen=np.array(unseen))


def seen_in_single_images(speed, count=6, noise_m=0.0):
    """A car ahead of others, whose boxes state no velocity, with noise along the road."""
    noise = noise_m * np.random.default_rng(1).normal(size=count)
    return [frame(box(speed * k / 2 + noise[k], 0), box(0, 20)) for k in range(count)]


def test_boxes_without_velocities_get_those_of_their_tracks():
    tracked, state = track(seen_in_single_images(8.0))
    assert {boxes.instances[0] for boxes in tracked} == {"0"}
    assert [boxes.velocities[0, 0] for boxes in tracked[:3]] == pytest.approx([0, 4, 8 * 2 / 3])
    assert tracked[-1].velocities[0] == pytest.approx((8, 0), abs=2.5)
    assert (tracked[-1].velocities[1] == 0).all()
    assert state.tracks.velocities[0] == pytest.approx(tracked[-1].velocities[0])


def test_a_slow_track_may_as_well_stand():
    tracked, _ = track(seen_in_single_images(0.0, count=20, noise_m=0.3))
    assert all((boxes.velocities == 0).all() for boxes in tracked[3:])


def test_a_stated_velocity_is_kept():
    tracked, _ = track([box(4.0 * k, 0, (6.5, 0.5)) for k in range(4)])
    assert all((boxes.velocities == (6.5, 0.5)).all() for boxes in tracked)


def test_a_box_where_no_camera_looks_starts_no_track():
    seen, unseen = (out_of_view(frame(box(0, 0), box(9, 0)), False, hidden) for hidden in (False, True))
    assert identities([unseen, unseen, seen]) == [["0", ""], ["0", ""], ["0", "1"]]


def test_a_track_is_carried_out_of_view_for_some_seconds():
    """Seen at 0 s; at 0.5 to 2 s within `carry_s`, at 2.5 s no more, and anew where a camera sees it again."""
    hidden = [out_of_view(box(0, 0), unseen) for unseen in (False, True, True, True, True, True, False)]
    carried = identities(hidden, config=TrackerConfig(carry_s=2.0))
    assert carried == [["0"], ["0"], ["0"], ["0"], ["0"], [""], ["0"]]
    assert [len(boxes.shown(0.5)) for boxes in track(hidden, TrackerConfig(carry_s=2.0))[0]] == [1, 1, 1, 1, 1, 0, 1]


def test_a_box_in_view_is_no_duplicate_of_one_out_of_view():
    better = out_of_view(frame(box(0, 0, score=0.9), box(0.5, 0, score=0.5)), True, False)
    ((tracked,), _) = track([better])
    assert tracked.duplicates.tolist() == [True, False]
    assert tracked.instances.tolist() == ["", "0"]


def test_crossing_objects_keep_their_identities_by_velocity():
    assert identities(crossing_cars()) == [["0", "1"]] * 7
    without = identities(crossing_cars(), config=TrackerConfig(use_velocity=False))
    assert without != [["0", "1"]] * 7


def test_identities_follow_the_objects_of_a_rendered_drive():
    file = read_boxes(STREET)
    truth = [entry.boxes for entry in file.frames]
    stamps = [entry.stamp for entry in file.frames]
    ego_xy = np.array([entry.world_from_ego.matrix[:2, 3] for entry in file.frames])
    random = np.random.default_rng(0)
    state, tracked = None, []
    for boxes, stamp in zip(truth, stamps, strict=True):
        noisy = boxes.centers + random.normal(0, 0.1, boxes.centers.shape)
        predicted = replace(boxes, centers=noisy, scores=np.full(len(boxes), 0.9), instances=None)
        state, found = step(TrackerConfig(duplicate_widths=0), state, predicted, stamp)
        tracked.append(found)
    scores = evaluate_tracking(tracked, truth, stamps, ego_xy=ego_xy).overall
    assert scores["recall"] > 0.99
    assert scores["ids"] <= 2
    assert scores["amota"] > 0.95


def test_a_new_scene_starts_new_tracks():
    assert identities(moving(4), scenes="aabb") == [["0"], ["0"], ["1"], ["1"]]


def test_time_that_stands_still_or_jumps_starts_new_tracks():
    config = TrackerConfig(coast_s=1.0)
    state, _ = step(config, None, box(0, 0), FrameStamp(0, "a", 0))
    for seconds in (0, -1, 1.5):
        _, found = step(config, state, box(0, 0), FrameStamp(1, "a", round(seconds * 1e9)))
        assert list(found.instances) == ["1"]
    _, found = step(config, state, box(0, 0), FrameStamp(1, "a", 10**9))
    assert list(found.instances) == ["0"]


def test_a_run_cut_in_two_equals_the_whole():
    frames = crossing_cars()
    whole, end = track(frames)
    first, state = track(frames[:3])
    second, end_of_second = track(frames[3:], state=state, start=3)
    for one, other in zip(whole, first + second, strict=True):
        assert list(one.instances) == list(other.instances)
        assert np.array_equal(one.track_scores, other.track_scores)
    assert end.next_number == end_of_second.next_number


def test_a_step_changes_neither_its_state_nor_the_boxes():
    boxes = crossing_cars()[0]
    state, _ = step(TrackerConfig(), None, boxes, FrameStamp(0, "a", 0))
    centers, frames = state.tracks.centers_xy.copy(), state.tracks.frames.copy()
    _, found = step(TrackerConfig(), state, crossing_cars()[1], FrameStamp(1, "a", 500_000_000))
    assert np.array_equal(state.tracks.centers_xy, centers)
    assert np.array_equal(state.tracks.frames, frames)
    for column in fields(Boxes3D):
        if column.name not in ("instances", "track_scores", "duplicates"):
            assert np.array_equal(getattr(found, column.name), getattr(crossing_cars()[1], column.name))


def test_gates_belong_to_classes():
    config = TrackerConfig(gates_m={"car": 0.5, "bus": 3.0, "other": 1.0})
    frames = [frame(*(box(10 * k, y, name=name) for k, name in enumerate(("car", "bus", "tram")))) for y in (0, 2)]
    assert identities(frames, config=config) == [["0", "1", "2"], ["3", "1", "4"]]


def test_the_better_box_chooses_first():
    frames = [box(0, 0), frame(box(0.5, 0, score=0.5), box(1.2, 2.3, score=0.8))]
    assert identities(frames) == [["0"], ["1", "0"]]


def test_a_confirmed_track_coasts_and_moves_on_without_boxes():
    ten = moving(10)
    frames = [*ten[:3], Boxes3D.empty(), Boxes3D.empty(), *ten[5:]]
    assert identities(frames) == [["0"]] * 3 + [[]] * 2 + [["0"]] * 5


def test_a_track_ends_after_the_longest_time_without_a_box():
    ten = moving(10)
    frames = [*ten[:3], *[Boxes3D.empty()] * 3, *ten[6:]]
    assert identities(frames)[-1] == ["1"]
    assert identities(frames, config=TrackerConfig(coast_s=2.0))[-1] == ["0"]


def test_a_track_that_is_not_confirmed_ends_with_the_first_miss():
    frames = [box(0, 0), Boxes3D.empty(), box(0, 0)]
    assert identities(frames) == [["0"], [], ["1"]]
    assert identities(frames, config=TrackerConfig(confirm_frames=1)) == [["0"], [], ["0"]]


def test_weak_boxes_continue_tracks_and_start_none():
    config = TrackerConfig(birth_score=0.4, keep_score=0.2)
    scores = (0.3, 0.5, 0.3, 0.1, 0.3)
    assert identities([box(0, 0, score=score) for score in scores], config=config) == [[""], ["0"], ["0"], [""], ["0"]]


def test_the_track_score_is_the_mean_score_so_far():
    tracked, _ = track([box(0, 0, score=score) for score in (0.9, 0.3, 0.6)])
    assert [float(boxes.track_scores[0]) for boxes in tracked] == pytest.approx([0.9, 0.6, 0.6])


def test_several_boxes_on_one_object_are_one_track():
    frames = [frame(box(0, 0), box(0.3, 0.3, score=0.5), box(0, 6, score=0.5)) for _ in range(3)]
    tracked, _ = track(frames)
    assert [list(boxes.instances) for boxes in tracked] == [["0", "", "1"]] * 3
    assert [list(boxes.duplicates) for boxes in tracked] == [[False, True, False]] * 3
    assert np.isnan(tracked[0].track_scores[1])


def test_a_duplicate_has_no_duplicates_and_classes_do_not_mix():
    row = frame(box(0, 0), box(0, 1.5, score=0.6), box(0, 3.0, score=0.5), box(0, 0, score=0.4, name="truck"))
    tracked, _ = track([row])
    assert list(tracked[0].duplicates) == [False, True, False, False]


def test_an_unknown_velocity_counts_as_standing():
    frames = [box(0, 0, (np.nan, np.nan)), box(0.5, 0)]
    assert identities(frames) == [["0"], ["0"]]


def test_a_frame_without_boxes_has_the_columns_too():
    tracked, state = track([Boxes3D.empty()])
    assert (len(tracked[0].instances), len(tracked[0].track_scores), len(state.tracks)) == (0, 0, 0)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"birth_score": 0.1, "keep_score": 0.2}, "keep_score must not be above birth_score; found 0.2 and 0.1"),
        ({"birth_score": 1.1}, '"tracking.birth_score" must be a number from 0 to 1, but is 1.1'),
        ({"confirm_frames": 0}, '"tracking.confirm_frames" must be an integer of 1 or more'),
        ({"coast_s": -1.0}, '"tracking.coast_s" must be a number of 0 or more'),
        ({"gates_m": {"car": 0.0}}, '"tracking.gates_m.car" must be a number above 0'),
    ],
)
def test_parameters_that_make_no_sense_are_errors(wrong, message):
    with pytest.raises(ConfigError, match=message):
        settings_of_table({TRACKING: wrong}, TRACKING, TrackerConfig, "own.toml")
