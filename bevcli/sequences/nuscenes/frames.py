"""The frames of a nuScenes scene: its keyframes, or these and the sweeps between them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bevcli.sequences.nuscenes.index import Ints, NuScenesIndex

LEADING_CAMERA = "CAM_FRONT"
# The cameras run at 12 Hz, triggered by the lidar's rotation. An image further away belongs to another rotation.
NEAR_US = 60_000


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
