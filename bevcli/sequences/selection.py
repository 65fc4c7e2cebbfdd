"""A part of a sequence as a sequence: some scenes, a range of frames, or every so many."""

from __future__ import annotations

from collections.abc import Sequence as Places

from bevcli.frame import Frame, FrameStamp, Sequence


class Selection:
    """The frames of another sequence at some places, in their order."""

    def __init__(self, sequence: Sequence, places: Places[int], notes: tuple[str, ...] = ()) -> None:
        self._sequence = sequence
        self._places = tuple(places)
        self.name = sequence.name
        self.rig = sequence.rig
        self.has_ego_motion = sequence.has_ego_motion
        self.notes = (*sequence.notes, *notes)

    @property
    def stamps(self) -> tuple[FrameStamp, ...]:
        """When each frame is, in order."""
        stamps = self._sequence.stamps
        return tuple(stamps[place] for place in self._places)

    def load(self, place: int) -> Frame:
        """The frame at a place of the selection, its images decoded."""
        return self._sequence.load(self._places[place])


def select(sequence: Sequence, places: Places[int], notes: tuple[str, ...] = ()) -> Sequence:
    """The sequence of the frames at `places`; further notes are added to its own. All places: itself."""
    if not notes and list(places) == list(range(len(sequence.stamps))):
        return sequence
    return Selection(sequence, places, notes)
