"""Boxes by object instead of by frame, for formats that list tracks."""

from collections.abc import Iterable

from bevcli.sequences.files.boxes_file import FrameBoxes

Place = tuple[int, int]  # of a box: its frame's place among the frames, and its index in the frame


def tracks_of(frames: Iterable[FrameBoxes]) -> list[list[Place]]:
    """The boxes of each object, in order of the frames; the objects in order of their first box.

    Boxes of a scene with the same identity are one object. A box without identity is an object of its own, and so is
    a further box with an identity that the frame has already.
    """
    found: dict[object, list[Place]] = {}
    for place, frame in enumerate(frames):
        boxes = frame.boxes
        names = [""] * len(boxes) if boxes.instances is None else boxes.instances.tolist()
        seen: set[str] = set()
        for box, name in enumerate(names):
            key = (frame.stamp.scene, name) if name and name not in seen else (place, box)
            seen.add(name)
            found.setdefault(key, []).append((place, box))
    return list(found.values())
