"""The inputs and outputs of an exported file: their names, shapes and units, as its metadata states them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from bevcli import __version__
from bevcli.model.bevformer import BEVFormerConfig
from bevcli.model.bevformer_v2 import BEVFormerV2Config
from bevcli.model.segmentation import STUFF_CLASSES

# The part of the metadata that bevcli itself reads, to run the file: the contents of the model's TOML file as JSON,
# the number of cameras that may see one cell, whether the weights are random or those of the package, and the precision
# of backbone and neck.
METADATA = ("config", "cameras_per_cell", "untrained", "bundled", "precision")


@dataclass(frozen=True)
class Port:
    """An input or an output of an exported file.

    Attributes:
        name: in the file.
        shape: of the tensor.
        dtype: of the tensor.
        meaning: axes, units and frames, for the file's metadata.
    """

    name: str
    shape: tuple[int, ...]
    dtype: torch.dtype
    meaning: str

    def example(self) -> Tensor:
        """Zeros of the shape and type."""
        return torch.zeros(self.shape, dtype=self.dtype)


def input_ports(config: BEVFormerConfig, cameras: int) -> tuple[Port, ...]:
    """The inputs, in the order of the arguments of the step's `forward`. cameras: N."""
    if isinstance(config, BEVFormerV2Config):
        features = _features_port(config, cameras)
        return _camera_ports(config, cameras) + (() if features is None else (features,))
    return _camera_ports(config, cameras) + _history_ports(config)


def _camera_ports(config: BEVFormerConfig, cameras: int) -> tuple[Port, ...]:
    """The images of the current frame, and the cameras in it or, for a BEVFormerV2, in every frame of its window."""
    image = config.image
    width, height = image.padded_size
    left, top, right, bottom = image.crop_box
    pad = ", ".join(f"{value:g}" for value in pad_value_bgr(config))
    cropped = "" if image.crop is None else f", cropped to columns {left} to {right - 1} and rows {top} to {bottom - 1}"
    level = f", level, {config.bev_frame.height_m:g} m above the ground" if config.bev_frame.level else ""
    names = ", ".join(f"{index} {name}" for index, name in enumerate(config.cameras))
    lead: tuple[int, ...]
    if isinstance(config, BEVFormerV2Config):
        axes, lead = "1, F, N", (1, len(config.frames), cameras)
        bev_frame = "the current frame's bev frame"
        window = (
            f" For the cameras of each of the window's F frames, which are, relative to the current one: "
            f"{_listed(config.frames)}."
        )
        absent = (
            " All false for a frame that does not exist, such as before a scene's first frame or before a gap in time "
            "of more than max_gap_s: the BEV map of the next frame takes the place of its own."
        )
    else:
        axes, lead = "1, N", (1, cameras)
        bev_frame, window, absent = "the bev frame", "", ""
    return (
        Port(
            "images",
            (1, cameras, height, width, 3),
            torch.float32,
            f"(1, N, H, W, 3): undistorted images, channels B G R, 0 to 255, not normalised. Each image is resized by "
            f"min({image.size[0]} / width, {image.size[1]} / height) as float32{cropped} and written to the top left "
            f"corner; all other pixels are {pad}.",
        ),
        Port(
            "image_from_bev",
            (*lead, 4, 4),
            torch.float32,
            f"({axes}, 4, 4): from (x, y, z, 1) in metres of {bev_frame} to (u d, v d, d, 1), with {_pixel(config)} "
            f"and depth d in metres. Bev frame: x to the right, y ahead, z up{level}.{window}",
        ),
        Port("camera_index", (cameras,), torch.int64, f"(N,): the camera embedding of each image: {names}."),
        Port(
            "has_image",
            lead,
            torch.bool,
            f"({axes}): false for a camera without an image, which then sees nothing.{absent}",
        ),
    )


def _pixel(config: BEVFormerConfig) -> str:
    """The pixels of the network's input, and how those of the camera's image become them."""
    image = config.image
    if image.crop is None and not image.half_pixel_shift:
        return "pixel (u, v) of the resized image"
    # Of pixels whose centres have whole numbers, see `ImageConfig.half_pixel_shift`.
    shift = " + (scale - 1) / 2" if image.half_pixel_shift else ""
    corner = zip("uv", image.crop_box, strict=False)
    moved = ", ".join(f"{axis} = scale * {axis} of the camera{shift}{f' - {at}' if at else ''}" for axis, at in corner)
    return f"pixel (u, v) of the {'resized' if image.crop is None else 'cropped'} image, {moved},"


def _features_port(config: BEVFormerV2Config, cameras: int) -> Port | None:
    """The image features of the window's earlier frames; None for a window of one frame."""
    if len(config.frames) == 1:
        return None
    return Port(
        "previous_features",
        (len(config.frames) - 1, *_features_shape(config, cameras)),
        torch.float32,
        f"(F - 1, N, S, C): the output image_features of the window's earlier frames {_listed(config.frames[:-1])}, in "
        "this order; ignored for a frame that does not exist.",
    )


def _features_shape(config: BEVFormerV2Config, cameras: int) -> tuple[int, int, int]:
    return cameras, sum(height * width for height, width in config.level_shapes), config.channels


def _listed(frames: tuple[int, ...]) -> str:
    return ", ".join(map(str, frames))


def _history_ports(config: BEVFormerConfig) -> tuple[Port, ...]:
    """Ego-motion and history of a BEVFormer."""
    cells = config.bev_grid.rows * config.bev_grid.columns
    quaternion = "quaternion w x y z" if config.ego_motion.can_bus_quaternion == "wxyz" else "quaternion w w w w"
    return (
        Port(
            "can_bus",
            (1, 18),
            torch.float32,
            "(1, 18): 0-2 translation since the previous frame, metres, world frame; 3-6 "
            f"{quaternion} of world_from_ego; 7-9 acceleration with gravity, m/s^2; 10-12 angular rate, rad/s; "
            "13-15 velocity, m/s, ego frame; 16 yaw in radians, 0 to 2 pi; 17 change of yaw since the previous "
            "frame, degrees. 0-2 and 17 are zero without a previous frame.",
        ),
        Port(
            "shift",
            (1, 2),
            torch.float32,
            "(1, 2): translation since the previous frame to the right and ahead, as fractions of the extent of the "
            "BEV map in x and y.",
        ),
        Port("rotation", (1,), torch.float32, "(1,): change of yaw since the previous frame, degrees."),
        Port(
            "previous_bev",
            (1, cells, config.channels),
            torch.float32,
            "(1, Y*X, C): the output bev of the previous frame; ignored where use_previous is false.",
        ),
        Port("use_previous", (1,), torch.bool, "(1,): false in the first frame of a scene and after a gap in time."),
    )


def output_ports(config: BEVFormerConfig, cameras: int, *, decode: bool) -> tuple[Port, ...]:
    """The outputs, in the order of the results of the step's `forward`. cameras: N."""
    cells = config.bev_grid.rows * config.bev_grid.columns
    queries, classes = config.decoder.queries, len(config.classes)
    ports = [
        Port(
            "bev",
            (1, cells, config.channels),
            torch.float32,
            "(1, Y*X, C): the BEV map; cell row * columns + column, rows by rising y, columns by rising x.",
        ),
        Port("class_logits", (1, queries, classes), torch.float32, "(1, Q, classes): of the last decoder layer."),
        Port(
            "box_codes",
            (1, queries, 10),
            torch.float32,
            "(1, Q, 10): cx, cy, log w, log l, cz, log h, sin, cos, vx, vy; metres and m/s, bev frame; "
            "yaw = -atan2(sin, cos) - pi / 2.",
        ),
        Port(
            "most_cameras_per_cell",
            (1,),
            torch.int64,
            "(1,): the largest number of cameras that see one cell of the BEV map. If it exceeds the metadata's "
            "cameras_per_cell, cameras are left out, and the results are wrong: export with more.",
        ),
    ]
    if "segmentation" in config.heads:
        masks = len(STUFF_CLASSES) + config.segmentation.thing_queries
        stuff = ", ".join(STUFF_CLASSES)
        ports += [
            Port("mask_logits", (1, masks, cells), torch.float32, f"(1, Q, Y*X): masks of {stuff}, then of vehicles."),
            Port(
                "mask_class_logits",
                (1, masks),
                torch.float32,
                "(1, Q): that the object exists. A cell's probability is sigmoid(mask) * sigmoid(class).",
            ),
        ]
    if decode:
        count = min(config.decoder.max_boxes, queries * classes)
        ports += [
            Port(
                "boxes",
                (1, count, 9),
                torch.float32,
                "(1, K, 9): centre x, y, z, length, width, height in metres, yaw in radians counter-clockwise from x, "
                "velocity x, y in m/s; bev frame.",
            ),
            Port("scores", (1, count), torch.float32, "(1, K): 0 to 1, falling."),
            Port("classes", (1, count), torch.int64, "(1, K): index into the metadata's classes."),
        ]
    if isinstance(config, BEVFormerV2Config) and len(config.frames) > 1:
        ports.append(
            Port(
                "image_features",
                _features_shape(config, cameras),
                torch.float32,
                "(N, S, C): of the current frame's images, for previous_features of the next frames.",
            )
        )
    return tuple(ports)


def pad_value_bgr(config: BEVFormerConfig) -> tuple[float, ...]:
    """What the pixels outside the resized image hold: the mean, which normalisation turns into zero."""
    mean = config.image.mean
    return mean[::-1] if config.image.color_order == "rgb" else mean


def metadata(
    config: BEVFormerConfig,
    inputs: tuple[Port, ...],
    outputs: tuple[Port, ...],
    contents: Mapping[str, Any],
    *,
    slots: int,
    untrained: bool,
    bundled: bool,
) -> dict[str, str]:
    """The metadata of a file: text, or JSON where a value is not a name.

    Args:
        config: of the model.
        inputs: of the file.
        outputs: of the file.
        contents: of the model's TOML file.
        slots: the number of cameras that may see one cell.
        untrained: whether the weights are random.
        bundled: whether the weights are those of the package.
    """
    image, grid = config.image, config.bev_grid
    facts = {
        "inputs": {port.name: port.meaning for port in inputs},
        "outputs": {port.name: port.meaning for port in outputs},
        "classes": config.classes,
        "cameras": config.cameras,
        "image_size": image.size,
        "crop": image.crop_box,
        "padded_size": image.padded_size,
        "pad_value_bgr": pad_value_bgr(config),
        "x_range_m": grid.x_range_m,
        "y_range_m": grid.y_range_m,
        "bev_rows_columns": (grid.rows, grid.columns),
        "rate_hz": config.rate_hz,
        "max_gap_s": config.max_gap_s,
        "use_shift": config.ego_motion.shift,
        "use_rotation": config.ego_motion.rotation,
        "half_pixel_shift": image.half_pixel_shift,
        "bev_frame": {"level": config.bev_frame.level, "height_m": config.bev_frame.height_m},
        "cameras_per_cell": slots,
        "config": contents,
        "untrained": untrained,
        "bundled": bundled,
    }
    if isinstance(config, BEVFormerV2Config):
        facts["window"] = config.frames
    names = {
        "model": config.name,
        "precision": "fp32",
        "bevcli_version": __version__,
        "resize": image.resize,
        "can_bus_quaternion": config.ego_motion.can_bus_quaternion,
    }
    return names | {key: json.dumps(value) for key, value in facts.items()}
