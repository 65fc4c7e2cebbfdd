"""The part of a nuScenes dataset that is read: version, official split, scenes, and keyframes or sweeps."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from bevcli.errors import InputError
from bevcli.sequences.nuscenes.format import versions_in
from bevcli.sequences.nuscenes.index import Ints, NuScenesIndex

# Scene numbers of the official splits, as published on nuscenes.org. All other scenes are in train and mini_train.
VAL = (
    "3 12-18 35-36 38-39 92-110 221 268-278 329-332 344-346 519-524 552-565 625-627 629-630 632-638 770-771 775 "
    "777-778 780-784 794-800 802 904-917 919-931 962-963 966-969 971-972 1059-1073"
)
TEST = (
    "77-91 111-119 140 142-148 265-266 279-282 307-314 333-343 481-498 547-551 601-604 606-624 827-831 833-842 "
    "844-846 932-933 935-943 1026-1043"
)
MINI_VAL = "103 916"
SPLITS = ("train", "val", "test", "mini_train", "mini_val")
LEADING_CAMERA = "CAM_FRONT"
# The cameras run at 12 Hz, triggered by the lidar's rotation. An image further away belongs to another rotation.
NEAR_US = 60_000


def tables_of(root: Path, version: str | None) -> Path:
    """The folder with a version's tables. Raises InputError if it is missing, or if the choice is not unique."""
    return root / choose_version(root, versions_in(root), version)


def choose_version(root: object, versions: Sequence[str], version: str | None) -> str:
    """The version with a name, or the only one. root: for messages. Raises InputError as `tables_of`."""
    chosen = [one for one in versions if version in (None, one)]
    if len(chosen) == 1:
        return chosen[0]
    found = ", ".join(versions) or "none"
    wanted = f'has no version "{version}"' if version else "has several versions"
    raise InputError(f"{root}: {wanted} (found: {found}): choose one with `version`")


def chosen_scenes(index: NuScenesIndex, tables: Path, split: str | None, scene: str | None = None) -> list[int]:
    """Indices of the scenes with images of a split (None: all), or of one scene. Raises InputError without any."""
    names = [str(name) for name in index.scenes.names]
    if split is not None and split not in SPLITS:
        raise InputError(f'`split` "{split}": expected one of {", ".join(SPLITS)}')
    if scene is not None and scene not in names:
        few = ", ".join(names[:6]) + (f", ... ({len(names)} scenes)" if len(names) > 6 else "")
        raise InputError(f'{tables}: has no scene "{scene}" (found: {few})')
    mini = (split or "").startswith("mini")
    scenes = [
        number
        for number, name in enumerate(names)
        if scene in (None, name) and split in (None, split_of(name, mini=mini))
    ]
    if not scenes:
        what = f"scene {scene} is not in" if scene else "has no scene of"
        raise InputError(f"{tables}: {what} the split {split}: choose another `split` or `version`")
    with_frames = (np.diff(index.scenes.first_sample) > 0) & (np.diff(index.scenes.first_image) > 0)
    filled = [number for number in scenes if with_frames[number]]
    if not filled:
        raise InputError(f"{tables / 'sample_data.json'}: scene {names[scenes[0]]} has no image of a camera")
    return filled


def split_of(scene: str, *, mini: bool) -> str:
    """The split of a scene such as "scene-0103"; "" for a name that does not belong to nuScenes.

    mini: whether to name the split of the mini version (mini_train, mini_val) instead of train, val or test.
    """
    number = scene.removeprefix("scene-")
    if not (number.isascii() and number.isdigit() and len(number) < 10):
        return ""
    if mini:
        return "mini_val" if int(number) in numbers(MINI_VAL) else "mini_train"
    if int(number) in numbers(VAL):
        return "val"
    return "test" if int(number) in numbers(TEST) else "train"


def numbers(ranges: str) -> frozenset[int]:
    """The numbers in ranges such as "3 12-18"."""
    found: set[int] = set()
    for part in ranges.split():
        first, _, last = part.partition("-")
        found |= set(range(int(first), int(last or first) + 1))
    return frozenset(found)


def keyframes(index: NuScenesIndex, scene: int) -> Iterator[tuple[int, int, Ints]]:
    """Time in us, sample and image rows of each keyframe of a scene."""
    first, last = index.scenes.first_image[scene : scene + 2]
    keys = first + np.flatnonzero(index.images.keys[first:last])
    samples = index.images.samples[keys]
    keys = keys[np.argsort(samples, kind="stable")]
    start, end = index.scenes.first_sample[scene : scene + 2]
    bounds = np.searchsorted(np.sort(samples), np.arange(start, end + 1))
    for place, sample in enumerate(range(start, end)):
        yield int(index.samples.times_us[sample]), sample, keys[bounds[place] : bounds[place + 1]]


def sweep_frames(index: NuScenesIndex, scene: int) -> Iterator[tuple[int, int | None, Ints]]:
    """Time in us, sample (None between keyframes) and image rows of every frame of a scene.

    There is one frame for each image of the front camera. A frame between keyframes follows its front image by the
    same delay as a keyframe, and has the image of each camera that is nearest in time.
    """
    first, last = index.scenes.first_image[scene : scene + 2]
    rows = np.arange(first, last)
    images = index.images
    cameras = index.sensors.channels[images.sensors[first:last]]
    names = sorted(set(cameras.tolist()))
    leading = rows[cameras == (LEADING_CAMERA if LEADING_CAMERA in names else names[0])]
    sample_times = index.samples.times_us[images.samples[leading]]
    keys = images.keys[leading]
    lag = int(np.median((sample_times - images.times_us[leading])[keys])) if keys.any() else 0
    by_camera = [rows[cameras == name] for name in names]
    key_rows = rows[images.keys[first:last]]
    time = -1
    for row, is_key in zip(leading, keys, strict=True):
        earlier, sample = time, int(images.samples[row])
        if is_key:
            time = int(index.samples.times_us[sample])
            found = key_rows[images.samples[key_rows] == sample]
        else:
            time = int(images.times_us[row]) + lag
            found = _nearest(index, by_camera, time)
        if time > earlier:
            yield time, sample if is_key else None, found


def _nearest(index: NuScenesIndex, by_camera: list[Ints], time: int) -> Ints:
    """Rows of each camera's image nearest to a time in us, without images that are too far away."""
    times = index.images.times_us
    nearest = np.array([rows[np.argmin(np.abs(times[rows] - time))] for rows in by_camera])
    return nearest[np.abs(times[nearest] - time) <= NEAR_US]
