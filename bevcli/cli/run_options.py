"""The options of the model and of the recording, the same for every command that runs a model."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

MODEL, RECORDING = "Model", "Recording"

DeviceOption = Annotated[
    str,
    typer.Option(
        metavar="auto|cpu|cuda|cuda:N|mps",
        help="auto uses a CUDA GPU if there is one; cuda:1 is the second one; mps is the GPU of a Mac (untried).",
        rich_help_panel=MODEL,
    ),
]
EngineOption = Annotated[
    Literal["onnxruntime", "openvino"] | None,
    typer.Option(
        help="Program that runs a FILE.onnx. Default: onnxruntime.", rich_help_panel=MODEL, show_default=False
    ),
]
WeightsOption = Annotated[
    Path | None,
    typer.Option(
        help="An official .pth file or a .safetensors file. Default: the weights in the package (demo).",
        rich_help_panel=MODEL,
        show_default=False,
    ),
]
UntrainedOption = Annotated[
    bool,
    typer.Option("--untrained", help="Use random weights; all outputs are labelled UNTRAINED.", rich_help_panel=MODEL),
]
PrecisionOption = Annotated[
    Literal["fp32", "bf16", "fp16"] | None,
    typer.Option(
        help="Precision of the image features. Default: fp32 on a CPU, bf16 on a GPU.",
        rich_help_panel=MODEL,
        show_default=False,
    ),
]
TemporalOption = Annotated[
    bool, typer.Option("--temporal/--no-temporal", help="Use the frames before (and after).", rich_help_panel=MODEL)
]
CameraOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME=MODEL_CAMERA",
        help="Use the embedding of MODEL_CAMERA for camera NAME. Repeatable. Default: the model's camera of the same "
        "name, else the one with the nearest viewing direction.",
        rich_help_panel=MODEL,
    ),
]
RecordOption = Annotated[
    Literal["minimal", "standard", "full"],
    typer.Option(help="How much a recording contains.", rich_help_panel=RECORDING),
]
ImagesOption = Annotated[
    Literal["jpeg", "av1"],
    typer.Option(
        help="jpeg keeps the bytes of the image files; av1 makes a recording smaller and needs bevcli\\[video].",
        rich_help_panel=RECORDING,
    ),
]
BevOption = Annotated[
    str,
    typer.Option(help="How the BEV features are drawn: norm, pca, channel:K or none.", rich_help_panel=RECORDING),
]
