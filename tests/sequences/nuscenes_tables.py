"""Writes nuScenes tables of any size with known contents: python nuscenes_tables.py OUT [SCENES].

850 scenes give the size of the real train-val tables: 2.65 million rows of sample_data, 1.2 million annotations.
Every scene is a drive along world x at 5 m/s from x = 1000 * scene; every object of a scene moves along y at 2 m/s.
"""

import json
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

CAMERAS = ("CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_FRONT_LEFT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_BACK_RIGHT")
RADARS = ("RADAR_FRONT", "RADAR_FRONT_LEFT", "RADAR_FRONT_RIGHT", "RADAR_BACK_LEFT", "RADAR_BACK_RIGHT")
CHANNELS = (*CAMERAS, *RADARS, "LIDAR_TOP")
SAMPLE_US = 500_000
PERIODS_US = {"CAM": SAMPLE_US // 6, "RADAR": SAMPLE_US // 6, "LIDAR": SAMPLE_US // 10}
CATEGORIES = ("vehicle.car", "human.pedestrian.adult", "static_object.bicycle_rack", "animal")
START_US = 1_530_000_000_000_000
SCENE_US = 100_000_000


@dataclass(frozen=True)
class Size:
    """How much to write."""

    scenes: int = 850
    samples: int = 41
    objects: int = 34


def token(kind: int, number: int) -> str:
    """32 hex digits that look random and are never twice the same."""
    return f"{((kind << 96) + number) * 0x9E3779B97F4A7C15F39CC0605CEDC835 % (1 << 128):032x}"


def scene_name(scene: int) -> str:
    """scene-0001 and on."""
    return f"scene-{scene + 1:04d}"


def sample_time(scene: int, sample: int) -> int:
    """Microseconds of a keyframe."""
    return START_US + scene * SCENE_US + sample * SAMPLE_US


def ego_x(scene: int, time_us: int) -> float:
    """Where the vehicle is on world x."""
    return 1000.0 * scene + 5.0 * (time_us - sample_time(scene, 0)) / 1e6


def _kind(channel: str) -> str:
    return channel.split("_")[0]


def _sensor_data(size: Size) -> Iterator[tuple[int, int, str, int, int]]:
    """Number, scene, channel, sample and time of every row of sample_data."""
    number = 0
    for scene in range(size.scenes):
        for place, channel in enumerate(CHANNELS):
            period = PERIODS_US[_kind(channel)]
            # Cameras take their keyframe up to 40 ms before the lidar.
            lag = 0 if channel == "LIDAR_TOP" else 10_000 + 6_000 * (place % 6)
            for sample in range(size.samples):
                for time in range(0, SAMPLE_US - period + 1, period):
                    yield number, scene, channel, sample, sample_time(scene, sample) - lag + time
                    number += 1


def _sample_data_rows(size: Size) -> Iterator[str]:
    start = {scene: scene * size.samples for scene in range(size.scenes)}
    previous = None
    for number, scene, channel, sample, time in _sensor_data(size):
        lag_free = previous != (scene, channel, sample)
        previous = (scene, channel, sample)
        camera = channel in CAMERAS
        folder = "samples" if lag_free else "sweeps"
        own = token(3, number)
        yield (
            f'{{\n"token": "{own}",\n"sample_token": "{token(2, start[scene] + sample)}",\n'
            f'"ego_pose_token": "{own}",\n'
            f'"calibrated_sensor_token": "{token(4, scene * len(CHANNELS) + CHANNELS.index(channel))}",\n'
            f'"timestamp": {time},\n"fileformat": "{"jpg" if camera else "pcd"}",\n'
            f'"is_key_frame": {"true" if lag_free else "false"},\n"height": {900 if camera else 0},\n'
            f'"width": {1600 if camera else 0},\n'
            f'"filename": "{folder}/{channel}/n015-2018-07-18-11-07-57+0800__{channel}__{time}.jpg",\n'
            f'"prev": "{token(3, number - 1)}",\n"next": "{token(3, number + 1)}"\n}}'
        )


def _ego_pose_rows(size: Size) -> Iterator[str]:
    for number, scene, _, _, time in _sensor_data(size):
        yield (
            f'{{\n"token": "{token(3, number)}",\n"timestamp": {time},\n'
            f'"rotation": [\n1.0,\n0.0,\n0.0,\n0.0\n],\n"translation": [\n{ego_x(scene, time)!r},\n2000.5,\n0.0\n]\n}}'
        )


def _annotation_rows(size: Size) -> Iterator[str]:
    for scene in range(size.scenes):
        for thing in range(size.objects):
            instance = scene * size.objects + thing
            for sample in range(size.samples):
                number = instance * size.samples + sample
                before = token(5, number - 1) if sample else ""
                after = token(5, number + 1) if sample < size.samples - 1 else ""
                yield (
                    f'{{\n"token": "{token(5, number)}",\n'
                    f'"sample_token": "{token(2, scene * size.samples + sample)}",\n'
                    f'"instance_token": "{token(6, instance)}",\n"visibility_token": "{thing % 4 + 1}",\n'
                    f'"attribute_tokens": [\n{chr(34) + token(8, 0) + chr(34) if thing % 2 else ""}\n],\n'
                    f'"translation": [\n{1000.0 * scene + thing},\n{sample * SAMPLE_US / 1e6 * 2.0},\n1.0\n],\n'
                    '"size": [\n2.0,\n4.5,\n1.6\n],\n"rotation": [\n0.9238795325112867,\n0.0,\n0.0,\n'
                    f'0.3826834323650898\n],\n"prev": "{before}",\n"next": "{after}",\n'
                    f'"num_lidar_pts": {thing},\n"num_radar_pts": 1\n}}'
                )


def _write(path: Path, rows: Iterable[str]) -> None:
    with path.open("w") as file:
        file.write("[\n")
        for place, row in enumerate(rows):
            file.write((",\n" if place else "") + row)
        file.write("\n]")


def write_tables(folder: Path, size: Size = Size(), *, annotated: bool = True) -> None:
    """Write one version's tables into a folder such as ROOT/v1.0-trainval."""
    folder.mkdir(parents=True)
    count = size.scenes * len(CHANNELS)
    camera = {"camera_intrinsic": [[1200.0, 0, 800], [0, 1200.0, 450], [0, 0, 1]], "rotation": [0.5, -0.5, 0.5, -0.5]}
    other = {"camera_intrinsic": [], "rotation": [0.5**0.5, 0, 0, -(0.5**0.5)]}
    channels = [CHANNELS[number % len(CHANNELS)] for number in range(count)]
    tables = {
        "scene": [{"token": token(1, s), "name": scene_name(s), "log_token": token(9, s)} for s in range(size.scenes)],
        "sample": [
            {"token": token(2, s * size.samples + k), "scene_token": token(1, s), "timestamp": sample_time(s, k)}
            for s in range(size.scenes)
            for k in range(size.samples)
        ],
        "sensor": [
            {"token": token(7, k), "channel": channel, "modality": _kind(channel)} for k, channel in enumerate(CHANNELS)
        ],
        "calibrated_sensor": [
            {
                "token": token(4, number),
                "sensor_token": token(7, CHANNELS.index(channel)),
                "translation": [1.0, 0.0, 1.8],
                **(camera if channel in CAMERAS else other),
            }
            for number, channel in enumerate(channels)
        ],
        "category": [{"token": token(10, k), "name": name} for k, name in enumerate(CATEGORIES)],
        "attribute": [{"token": token(8, 0), "name": "vehicle.moving"}],
        "visibility": [
            {"token": str(k + 1), "level": level} for k, level in enumerate(("v0-40", "v40-60", "v60-80", "v80-100"))
        ],
        "instance": [
            {"token": token(6, k), "category_token": token(10, k % size.objects % len(CATEGORIES))}
            for k in range(size.scenes * size.objects if annotated else 0)
        ],
    }
    for name, rows in tables.items():
        (folder / f"{name}.json").write_text(json.dumps(rows))
    _write(folder / "sample_data.json", _sample_data_rows(size))
    _write(folder / "ego_pose.json", _ego_pose_rows(size))
    _write(folder / "sample_annotation.json", _annotation_rows(size) if annotated else ())


if __name__ == "__main__":
    write_tables(Path(sys.argv[1]), Size(scenes=int(sys.argv[2]) if len(sys.argv) > 2 else 850))
