"""The options that select an input and its frames, the same for every command that reads one."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

PANEL = "Input"

SceneOption = Annotated[str | None, typer.Option(help="Only this scene, such as scene-0103.", rich_help_panel=PANEL)]
StrictOption = Annotated[
    bool,
    typer.Option("--strict", help="Treat a missing or unreadable image as an error.", rich_help_panel=PANEL),
]
AllowOutsideOption = Annotated[
    bool,
    typer.Option(
        "--allow-outside",
        help='Read images outside of the folder too: absolute paths, "..", and links that lead out of it.',
        rich_help_panel=PANEL,
    ),
]
VersionOption = Annotated[
    str | None,
    typer.Option(
        help="nuScenes: dataset version, such as v1.0-mini. Default: the only one present.",
        rich_help_panel=PANEL,
        show_default=False,
    ),
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
        "--sweeps",
        help="nuScenes: also read the images between keyframes (12 frames per second).",
        rich_help_panel=PANEL,
    ),
]
IntrinsicsOption = Annotated[
    Path | None,
    typer.Option(
        help="Kalibr camchain or ROS camera_info YAML, or a folder of these; replaces calibration.json.",
        rich_help_panel=PANEL,
    ),
]
ExtrinsicsOption = Annotated[
    Path | None,
    typer.Option(
        help='JSON with the "ego_from_camera" of each camera; required with --intrinsics.', rich_help_panel=PANEL
    ),
]
CalibrationOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE", help="A calibration.json that replaces the calibration of the input.", rich_help_panel=PANEL
    ),
]
EgoMotionOption = Annotated[
    Path | None,
    typer.Option(
        "--ego-motion",
        metavar="FILE",
        help="An ego_motion.csv that replaces the ego-motion of the input.",
        rich_help_panel=PANEL,
    ),
]
TopicOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="CAMERA=/TOPIC",
        help="ROS bags: the image topic of a camera, where it is not found. Repeatable.",
        rich_help_panel=PANEL,
    ),
]
TopicsOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE.toml",
        help="ROS bags: topics and frames of a vehicle (docs/other-inputs.md).",
        rich_help_panel=PANEL,
    ),
]
ClassMapOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME=CLASS|FILE.toml",
        help="Rename a class of the ground truth, such as Lorry=truck. Repeatable.",
        rich_help_panel=PANEL,
    ),
]
GroundTruthOption = Annotated[
    bool,
    typer.Option("--ground-truth/--no-ground-truth", help="Read the ground truth, if any.", rich_help_panel=PANEL),
]
FramesOption = Annotated[
    str | None,
    typer.Option(metavar="A:B", help="Frame range A:B after thinning; B is excluded.", rich_help_panel=PANEL),
]
RateOption = Annotated[
    str | None,
    typer.Option(
        metavar="HZ|all",
        help="Thin to this many frames per second. Default: the model's rate; all with --sweeps.",
        rich_help_panel=PANEL,
    ),
]
EveryOption = Annotated[
    int | None, typer.Option(min=1, help="Use every N-th frame instead of a frame rate.", rich_help_panel=PANEL)
]
StaticOption = Annotated[
    bool,
    typer.Option("--static", help="The vehicle stands still; ego_motion.csv is not needed.", rich_help_panel=PANEL),
]


def complete_model(incomplete: str) -> list[str]:
    """The known models that start with a text, for completion in a shell."""
    from importlib import resources  # not bevcli.config, which loads PyTorch: completion must be quick

    files = [file.name for file in resources.files("bevcli").joinpath("configs").iterdir()]
    return sorted(
        file.removesuffix(".toml") for file in files if file.endswith(".toml") and file.startswith(incomplete)
    )


def parse_frames(text: str | None) -> slice | None:
    """The value of --frames, "A:B" with optional ends, as a slice. Raises click's usage error."""
    if text is None:
        return None
    ends = text.split(":")
    if len(ends) != 2 or not all(end == "" or end.isdecimal() for end in ends):
        raise typer.BadParameter(f'"{text}" (expected A:B with integers, such as 0:10 or 5:)', param_hint="--frames")
    start, stop = (int(end) if end else None for end in ends)
    return slice(start, stop)


def parse_rate(text: str | None, *, default_hz: float | None) -> float | None:
    """The value of --rate in Hz; None for "all". Raises click's usage error.

    default_hz: the result if the option is not given.
    """
    if text is None:
        return default_hz
    if text == "all":
        return None
    try:
        rate_hz = float(text)
    except ValueError:
        rate_hz = 0.0
    if not 0 < rate_hz < float("inf"):
        raise typer.BadParameter(f'"{text}" (expected frames per second, such as 2, or all)', param_hint="--rate")
    return rate_hz


def parse_position(text: str, option: str) -> tuple[float, float]:
    """The value "X,Y" of an option in metres. Raises click's usage error."""
    try:
        x, y = map(float, text.split(","))
    except ValueError:
        raise typer.BadParameter(
            f'"{text}" is not a position (expected X,Y in metres, such as 10,-2.5)', param_hint=option
        ) from None
    return x, y


def parse_pairs(texts: list[str] | None, option: str, expected: str) -> dict[str, str]:
    """The values of a repeated option "NAME=VALUE" as a mapping. Raises click's usage error."""
    pairs = {}
    for text in texts or ():
        name, equals, value = text.partition("=")
        if not (name and equals and value):
            raise typer.BadParameter(f'"{text}" (expected {expected})', param_hint=option)
        pairs[name] = value
    return pairs


def parse_class_map(texts: list[str] | None) -> dict[str, str]:
    """The values of --class-map: "NAME=CLASS" or TOML files. Raises click's usage error, InputError for a file."""
    from bevcli.sequences.files.class_names import read_class_map

    files = [text for text in texts or () if text.endswith(".toml") and "=" not in text]
    pairs = parse_pairs([text for text in texts or () if text not in files], "--class-map", "NAME=CLASS or FILE.toml")
    merged: dict[str, str] = {}
    for file in files:
        merged |= read_class_map(Path(file))
    return merged | pairs


def parse_topics(texts: list[str] | None) -> dict[str, str]:
    """The values of --topic by camera. Raises click's usage error."""
    return parse_pairs(texts, "--topic", "CAMERA=/TOPIC, such as CAM_FRONT=/camera/front/image_raw")


def ego_motion_use(*, static: bool, temporal: bool) -> Literal["required", "optional", "static"]:
    """How ego_motion.csv is used with --static and --no-temporal; the type is `EgoMotionUse` of the library."""
    if static:
        return "static"
    return "required" if temporal else "optional"
