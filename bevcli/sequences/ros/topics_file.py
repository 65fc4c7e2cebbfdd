"""The TOML of --topics: topics and frames that cannot be found by type and name.

ego_frame = "base_link"                                  # the frame of the vehicle
world_frame = "map"                                      # the frame that poses from /tf refer to
ego_motion = "/localization/kinematic_state"             # a topic with poses, or /tf
[cameras]                                                # only these cameras are used
CAM_FRONT = "/sensing/camera/camera0/image_raw/compressed"
[calibration]                                            # a camera's CameraInfo
CAM_FRONT = "/sensing/camera/camera0/camera_info"
[frames]                                                 # a camera's optical frame
CAM_FRONT = "camera0/camera_optical_link"
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from bevcli.errors import InputError


@dataclass(frozen=True)
class StatedTopics:
    """What the user states about the topics of a bag. "" and missing cameras: to be found.

    Attributes:
        ego_frame: name of the vehicle's frame.
        world_frame: name of the frame that poses refer to, for poses from transforms.
        ego_motion: topic of the vehicle's poses.
        cameras: camera -> image topic; if there are any, only these cameras are used.
        calibration: camera -> topic of its calibration.
        frames: camera -> name of its optical frame.
        renamed: camera -> image topic, as --topic states it; other cameras are still found.
    """

    ego_frame: str = ""
    world_frame: str = ""
    ego_motion: str = ""
    cameras: Mapping[str, str] = field(default_factory=dict)
    calibration: Mapping[str, str] = field(default_factory=dict)
    frames: Mapping[str, str] = field(default_factory=dict)
    renamed: Mapping[str, str] = field(default_factory=dict)


def read_topics_file(path: Path | None, topics: Mapping[str, str]) -> StatedTopics:
    """The statements of a TOML file (None: no file) and of --topic.

    topics: camera -> image topic. Raises InputError for broken TOML, an unknown key or a wrong type.
    """
    if path is None:
        return StatedTopics(renamed=topics)
    try:
        stated = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InputError(f"{path}: cannot be read as TOML ({error})") from None
    known = [one.name for one in fields(StatedTopics) if one.name != "renamed"]
    for key, value in stated.items():
        if key not in known:
            raise InputError(f'{path}: unknown key "{key}" (known: {", ".join(known)})')
        _check(path, key, value)
    return StatedTopics(**stated, renamed=topics)


def _check(path: Path, key: str, value: Any) -> None:
    if key in ("cameras", "calibration", "frames"):
        if not isinstance(value, dict) or not all(isinstance(entry, str) for entry in value.values()):
            raise InputError(f'{path}: "{key}": expected a table of names, such as CAM_FRONT = "..."')
    elif not isinstance(value, str):
        raise InputError(f'{path}: "{key}": expected a name, found {value!r:.40}')
