"""Two frames between which the vehicle moved: points of each camera that match in both of its images."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from bevcli.frame import Drive
from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import Array
from bevcli.workshop.correspondence.points import (
    FEWEST_IN_PAIR,
    Features,
    GreyImage,
    features,
    grey_image,
    matched,
    reduced,
)

WIDTH = 800  # pixels of the reduced images
SHORTEST_M, LONGEST_M = 0.7, 12.0  # of a step between two frames
LONGEST_NS = 2_500_000_000
UNSEEN_NS = 400_000_000  # between two frames of a drive without poses
MOST = 4  # pairs of frames


@dataclass(frozen=True)
class CameraPair:
    """Two images of one camera."""

    pair: int  # the index of the pair of frames
    camera: Camera  # of the reduced images
    times_ns: tuple[int, int]  # of the images
    rays_a: Array  # (m, 3) unit directions of matched points in the first image
    rays_b: Array  # (m, 3) of the same points in the second one
    images: tuple[GreyImage, GreyImage]  # grey, reduced


@dataclass(frozen=True)
class _Seen:
    """An image of a frame."""

    time_ns: int
    image: GreyImage
    features: Features


def camera_pairs(drive: Drive, pairs: Sequence[tuple[int, int]]) -> Iterator[CameraPair]:
    """The matched points of pairs of frames (their places in the drive), of each camera that has both images."""
    seen: dict[int, dict[str, _Seen]] = {}
    cameras = [reduced(camera, min(WIDTH, camera.width)) for camera in drive.rig.cameras]
    for number, (first, second) in enumerate(pairs):
        for index in (first, second):
            if index not in seen:
                seen[index] = _seen(drive, index, cameras)
        for camera in cameras:
            a, b = seen[first].get(camera.name), seen[second].get(camera.name)
            if a is not None and b is not None:
                rays_a, rays_b = matched(a.features, b.features, camera, camera)
                if len(rays_a) >= FEWEST_IN_PAIR:
                    times = a.time_ns, b.time_ns
                    yield CameraPair(number, camera, times, rays_a, rays_b, (a.image, b.image))


def _seen(drive: Drive, index: int, cameras: Sequence[Camera]) -> dict[str, _Seen]:
    frame = drive.load(index)
    seen = {}
    for camera in cameras:
        image = frame.images.get(camera.name)
        grey = None if image is None else grey_image(image.pixels_bgr, camera)
        if image is not None and grey is not None:
            seen[camera.name] = _Seen(image.timestamp_ns, grey, features(grey))
    return seen


def moving_pairs(times_ns: NDArray[np.int64], lengths: Array, turns: Array) -> list[tuple[int, int]]:
    """Pairs of successive frames that tell most: those that turn, and others all over the drive.

    Args:
        times_ns: (F,) of the frames.
        lengths: (F,) metres, the way of the vehicle up to each frame.
        turns: (F,) radians, by how much it turned up to each frame.
    """
    possible = []
    for first in range(len(times_ns) - 1):
        later = np.flatnonzero(lengths[first + 1 :] - lengths[first] >= SHORTEST_M)
        second = first + 1 + int(later[0]) if len(later) else 0
        if (
            second
            and lengths[second] - lengths[first] <= LONGEST_M
            and times_ns[second] - times_ns[first] <= LONGEST_NS
        ):
            possible.append((first, second))
    if len(possible) <= MOST:
        return possible
    turning = sorted(possible, key=lambda pair: -abs(turns[pair[1]] - turns[pair[0]]))[: MOST // 2]
    spread = [possible[index] for index in np.linspace(0, len(possible) - 1, MOST - len(turning) + 2)[1:-1].astype(int)]
    return sorted({*turning, *spread})


def timed_pairs(times_ns: NDArray[np.int64]) -> list[tuple[int, int]]:
    """Pairs of frames of a drive without poses, all over it."""
    every = next((step for step in range(1, len(times_ns)) if times_ns[step] - times_ns[0] >= UNSEEN_NS), 1)
    possible = list(pairwise(range(0, len(times_ns), every)))
    return (
        [possible[index] for index in sorted({int(at) for at in np.linspace(0, len(possible) - 1, MOST)})]
        if possible
        else []
    )
