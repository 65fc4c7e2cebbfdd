"""The options that say what an input is, the same for every command that reads one."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

PANEL = "Input"

SceneOption = Annotated[str | None, typer.Option(help="Only this scene, as scene-0103.", rich_help_panel=PANEL)]
StrictOption = Annotated[
    bool,
    typer.Option("--strict", help="A missing or unreadable image is an error, not a gap.", rich_help_panel=PANEL),
]
VersionOption = Annotated[
    str | None,
    typer.Option(help="nuScenes: the version, as v1.0-mini. Default: the only one there.", rich_help_panel=PANEL),
]
SplitOption = Annotated[
    str | None,
    typer.Option(
        help="nuScenes: only scenes of this split (train, val, test, mini_train, mini_val).", rich_help_panel=PANEL
    ),
]
SweepsOption = Annotated[
    bool,
    typer.Option(
        "--sweeps", help="nuScenes: the images between the keyframes too (12 a second).", rich_help_panel=PANEL
    ),
]
IntrinsicsOption = Annotated[
    Path | None,
    typer.Option(
        help="Kalibr camchain or ROS camera_info YAML (or a folder of these), in place of calibration.json.",
        rich_help_panel=PANEL,
    ),
]
ExtrinsicsOption = Annotated[
    Path | None,
    typer.Option(help='JSON with each camera\'s "ego_from_camera", to go with --intrinsics.', rich_help_panel=PANEL),
]
