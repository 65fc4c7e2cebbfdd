"""Which scene belongs to which of nuScenes' official splits (nuscenes.org; numbers of the published lists)."""

from __future__ import annotations

VAL = (
    "3 12-18 35-36 38-39 92-110 221 268-278 329-332 344-346 519-524 552-565 625-627 629-630 632-638 770-771 775 "
    "777-778 780-784 794-800 802 904-917 919-931 962-963 966-969 971-972 1059-1073"
)
TEST = (
    "77-91 111-119 140 142-148 265-266 279-282 307-314 333-343 481-498 547-551 601-604 606-624 827-831 833-842 "
    "844-846 932-933 935-943 1026-1043"
)
MINI_TRAIN = "61 553 655 757 796 1077 1094 1100"
MINI_VAL = "103 916"
SPLITS = ("train", "val", "test", "mini_train", "mini_val")


def split_of(scene: str, *, mini: bool) -> str:
    """The split of a scene such as "scene-0103": in the mini version one of the mini splits, else train, val or test.

    "" for a name that is no nuScenes scene.
    """
    number = scene.removeprefix("scene-")
    if not number.isdigit():
        return ""
    if mini:
        return "mini_val" if int(number) in numbers(MINI_VAL) else "mini_train"
    if int(number) in numbers(VAL):
        return "val"
    return "test" if int(number) in numbers(TEST) else "train"


def numbers(ranges: str) -> frozenset[int]:
    """The numbers of ranges such as "3 12-18"."""
    found: set[int] = set()
    for part in ranges.split():
        first, _, last = part.partition("-")
        found |= set(range(int(first), int(last or first) + 1))
    return frozenset(found)
