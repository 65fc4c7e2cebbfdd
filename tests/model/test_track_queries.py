"""UniAD's tracks: births, misses and deaths, expected places, the memory bank, and boxes with identities."""

import math

import numpy as np
import pytest
import torch

from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.transforms import rigid, rotation_about_z
from bevcli.model.decoder import ObjectQueries
from bevcli.workshop.uniad.track_queries import (
    EGO,
    NO_TRACK,
    FrameMotion,
    Memories,
    MemoryBank,
    QueryInteraction,
    TrackQueries,
    TrackQueryConfig,
    expected_centers,
    live_and_die,
    with_tracks,
)

CONFIG = TrackQueryConfig(birth_score=0.4, keep_score=0.35, max_misses=5)
STANDING = FrameMotion(torch.eye(4), 0.5)


def step(ids: list[int], misses: list[int], scores: list[float], next_id: int = 7) -> tuple[list[int], list[int], int]:
    found, count, after = live_and_die(*map(torch.tensor, (ids, misses, scores)), next_id, CONFIG)
    return found.tolist(), count.tolist(), after


def test_queries_without_a_track_start_one_from_the_birth_score() -> None:
    ids, _, after = step([NO_TRACK] * 4, [0] * 4, [0.39, 0.4, 0.1, 0.9])
    assert ids == [NO_TRACK, 7, NO_TRACK, 8]
    assert after == 9


def test_the_ego_query_never_becomes_a_track() -> None:
    assert step([EGO], [0], [0.99]) == ([EGO], [0], 7)


def test_scores_between_the_thresholds_change_nothing() -> None:
    assert step([3, NO_TRACK], [2, 0], [0.37, 0.37]) == ([3, NO_TRACK], [2, 0], 7)


def test_a_high_score_forgets_the_misses() -> None:
    assert step([3], [4], [0.4]) == ([3], [0], 7)


def test_a_track_ends_with_its_fifth_miss_also_not_consecutive() -> None:
    ids, misses = [3], [0]
    for score, alive in [(0.1, True), (0.1, True), (0.37, True), (0.1, True), (0.1, True), (0.36, True), (0.1, False)]:
        ids, misses, _ = step(ids, misses, [score])
        assert (ids == [3]) is alive
    assert ids == [NO_TRACK]


def codes(*rows: tuple[float, float, float, float, float]) -> torch.Tensor:
    """Box codes of x, y, z, vx, vy."""
    found = torch.zeros(len(rows), 10)
    found[:, [0, 1, 4, 8, 9]] = torch.tensor(rows).float()
    return found


def test_an_object_is_expected_where_its_velocity_takes_it() -> None:
    found = expected_centers(codes((1, 2, 3, 4, -2)), STANDING)
    assert found[0].tolist() == pytest.approx([3, 1, 3])


def test_a_standing_object_is_expected_where_the_vehicle_sees_it() -> None:
    """The vehicle has driven 4 m ahead (y) and turned left by 90 degrees: what was 10 m ahead is 6 m to the right."""
    previous_from_now = rigid((0, 4, 0), rotation_about_z(math.pi / 2))
    matrix = torch.from_numpy(np.linalg.inv(previous_from_now)).float()
    found = expected_centers(codes((0, 10, -1, 0, 0)), FrameMotion(matrix, 0.5))
    assert found[0].tolist() == pytest.approx([6, 0, -1], abs=1e-5)


def tracks_of(box_codes: torch.Tensor, channels: int = 8) -> TrackQueries:
    count = len(box_codes)
    like = torch.zeros(count, channels)
    zeros = torch.zeros(count, dtype=torch.int64)
    return TrackQueries(like + 1, like + 2, box_codes, torch.arange(count), zeros, Memories.empty(like, 4), count)


def test_tracks_follow_the_learned_queries_and_stay_in_the_range() -> None:
    grid = BevGrid(10, 10, x_range_m=(-50, 50), y_range_m=(-20, 20))
    learned = ObjectQueries(torch.zeros(1, 3, 8), torch.zeros(1, 3, 8), torch.full((1, 3, 3), 0.5))
    tracks = tracks_of(codes((25, -10, 0, 0, 0), (1000, 0, 0, 0, 0)))
    found = with_tracks(learned, tracks, STANDING, torch.tensor([0.3, 0.4]), grid)
    assert found.position.shape == (1, 5, 8)
    assert found.content[0, 3:].unique().tolist() == [2]
    assert found.reference_points[0, :3].unique().tolist() == [0.5]
    assert found.reference_points[0, 3].tolist() == pytest.approx([0.75, 0.25, 0.3])
    assert found.reference_points[0, 4].tolist() == pytest.approx([1, 0.5, 0.4], abs=1e-4)


def test_ended_tracks_leave_only_the_next_identity() -> None:
    ended = tracks_of(codes((0, 0, 0, 0, 0))).ended()
    assert len(ended) == 0
    assert ended.next_id == 1


@pytest.fixture
def bank() -> MemoryBank:
    torch.manual_seed(0)
    return MemoryBank(channels=8, heads=2, interval=4).eval()


def test_a_track_saves_at_its_first_frame_and_then_each_fourth(bank: MemoryBank) -> None:
    memories = Memories.empty(torch.zeros(1, 8), length=4)
    filled = []
    for frame in range(20):
        _, memories = bank(torch.full((1, 8), float(frame)), memories)
        filled.append(int((~memories.is_empty).sum()))
    assert filled[:9] == [1, 1, 1, 1, 2, 2, 2, 2, 3]
    assert filled[-1] == 4


def test_the_newest_memory_is_last_and_the_oldest_is_dropped(bank: MemoryBank) -> None:
    memories = Memories.empty(torch.zeros(1, 8), length=2)
    saved = []
    for frame in range(9):
        embedding, memories = bank(torch.randn(1, 8), memories)
        if frame % 4 == 0:
            saved.append(bank.save_projection(embedding)[0])
    torch.testing.assert_close(memories.embeddings[0], torch.stack(saved[-2:]))


def test_a_track_without_memories_keeps_its_embedding(bank: MemoryBank) -> None:
    embedding = torch.randn(2, 8)
    _, after = bank(embedding, Memories.empty(embedding, length=4))
    memories = Memories.empty(embedding[:1], length=4).followed_by(after[1:])
    attended, _ = bank(embedding, memories)
    assert torch.equal(attended[0], embedding[0])
    assert not torch.allclose(attended[1], embedding[1])


def test_empty_slots_do_not_change_the_attention(bank: MemoryBank) -> None:
    embedding, slot = torch.randn(1, 8), torch.randn(1, 8)
    wait, is_empty = torch.ones(1, dtype=torch.int64), torch.tensor([[True, True, False]])
    slots = [torch.stack([torch.full((1, 8), value), torch.zeros(1, 8), slot], dim=1) for value in (0.0, 9.0)]
    one, other = (bank(embedding, Memories(part, is_empty, wait))[0] for part in slots)
    torch.testing.assert_close(one, other)


def test_a_query_learns_of_the_other_tracks() -> None:
    torch.manual_seed(0)
    module = QueryInteraction(channels=8, heads=2).eval()
    embedding, position, content = torch.randn(3, 3, 8)
    whole = module(embedding, position, content)
    alone = module(embedding[:1], position[:1], content[:1])
    assert not torch.allclose(whole[0][:1], alone[0], atol=1e-3)
    swapped = module(embedding.flip(0), position.flip(0), content.flip(0))
    torch.testing.assert_close(swapped[1].flip(0), whole[1])
