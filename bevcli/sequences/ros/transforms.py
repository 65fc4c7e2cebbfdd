"""The tree of transforms between the frames of a vehicle."""

from __future__ import annotations

from collections.abc import Iterable

from bevcli.errors import InputError
from bevcli.geometry.transforms import Array, inverse, rigid
from bevcli.sequences.ros.bag import Bag
from bevcli.sequences.ros.messages import Transform, transforms_of

SAMPLED_MESSAGES = 200  # from the start of each topic with transforms: enough to see every frame once


class TransformTree:
    """Frames and the transforms between them, each frame with one parent. The first transform of a frame counts."""

    def __init__(self, transforms: Iterable[Transform] = ()) -> None:
        self._parents: dict[str, tuple[str, Array]] = {}
        for one in transforms:
            if one.child != one.parent:
                self._parents.setdefault(one.child, (one.parent, one.parent_from_child.matrix))

    @property
    def frames(self) -> list[str]:
        """Names of all frames, sorted."""
        return sorted({*self._parents, *(parent for parent, _ in self._parents.values())})

    def path_up(self, frame: str) -> list[str]:
        """A frame and its ancestors, the root last."""
        path = [frame]
        while path[-1] in self._parents and self._parents[path[-1]][0] not in path:
            path.append(self._parents[path[-1]][0])
        return path

    def between(self, a: str, b: str) -> Array | None:
        """(4, 4) a_from_b in metres, None if the tree does not connect the frames."""
        up_a, up_b = self.path_up(a), self.path_up(b)
        common = next((frame for frame in up_b if frame in up_a), None)
        if common is None:
            return None
        return inverse(self._down(up_a[: up_a.index(common)])) @ self._down(up_b[: up_b.index(common)])

    def _down(self, frames: list[str]) -> Array:
        """(4, 4) ancestor_from_frame along frames, of which each is the child of the next."""
        matrix = rigid()
        for frame in frames:
            matrix = self._parents[frame][1] @ matrix
        return matrix


def read_transforms(bag: Bag, topic: str, indices: Iterable[int]) -> list[Transform]:
    """The transforms of some messages of a topic. Raises InputError if one is broken."""
    found: list[Transform] = []
    for index in indices:
        try:
            found += transforms_of(bag.message(topic, index))
        except (AttributeError, ValueError) as error:
            raise InputError(f"{bag.path}: {topic}: message {index} is not a transform ({error})") from None
    return found


def is_static(topic: str) -> bool:
    """Whether a topic has transforms that never change."""
    return topic.rstrip("/").endswith("static")


def sampled_transforms(bag: Bag, topics: Iterable[str]) -> tuple[list[Transform], list[Transform]]:
    """Static transforms, and the first ones of the topics with transforms that change."""
    static: list[Transform] = []
    changing: list[Transform] = []
    for topic in topics:
        first = range(min(len(bag.times(topic)), SAMPLED_MESSAGES))
        (static if is_static(topic) else changing).extend(read_transforms(bag, topic, first))
    return static, changing
