"""The exported form of a model: names, shapes and units of a file's inputs and outputs, as its metadata states them."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from bevcli.model.config import ImageConfig, ModelConfig
from bevcli.model.step import ModelInputs, PreparedFrame, model_inputs
from bevcli.model.temporal_model import model_class
from bevcli.workshop.engines.export_step import ExportedStep, RecurrentStep, with_most_cameras


@dataclass(frozen=True)
class Port:
    """An input or an output of an exported file.

    Attributes:
        name: in the file.
        shape: of the tensor.
        meaning: axes, units and frames, for the file's metadata.
        dtype: of the tensor.
    """

    name: str
    shape: tuple[int, ...]
    meaning: str
    dtype: torch.dtype = torch.float32


MOST_CAMERAS = Port(
    "most_cameras_per_cell",
    (1,),
    "(1,): the largest number of cameras that see one cell of the BEV map. If it exceeds the metadata's "
    "cameras_per_cell, cameras are left out, and the results are wrong: export with more.",
    torch.int64,
)


class ExportForm:
    """One step of a model as an exported file: its inputs and outputs, and the memory between them.

    Attributes:
        step: class of the module that is exported, an `ExportedStep`.
        config: of the model.
        cameras: N, the number of cameras.
    """

    step: ClassVar[type[ExportedStep]]

    def __init__(self, config: ModelConfig, cameras: int) -> None:
        self.config, self.cameras = config, cameras

    @property
    def inputs(self) -> tuple[Port, ...]:
        """The inputs, in the order of the arguments of the step's `forward`."""
        raise NotImplementedError

    def outputs(self, *, decode: bool) -> tuple[Port, ...]:
        """The outputs, in the order of the results of the step's `forward`. decode: with boxes."""
        boxes = _box_ports(self.config) if decode else ()
        own = [Port(*port) for port in model_class(self.config).outputs_type.ports(self.config)]
        return (*with_most_cameras(own, MOST_CAMERAS), *boxes)

    def facts(self) -> dict[str, Any]:
        """Further metadata of the file."""
        return {}

    def feed(self, prepared: PreparedFrame, memory: Any) -> dict[str, Tensor]:
        """The inputs of one frame by name.

        prepared: with `pixels`. memory: after the frame before; None where the history starts anew.
        """
        raise NotImplementedError

    def memory(self, prepared: PreparedFrame, memory: Any, by_name: Mapping[str, Tensor]) -> Any:
        """The memory after a frame. memory: before it. by_name: the file's outputs by name."""
        raise NotImplementedError


def camera_ports(
    config: ModelConfig, lead: tuple[int, ...], axes: str = "1, N", bev_frame: str = "the bev frame"
) -> tuple[Port, ...]:
    """The images of the current frame of N cameras, their projections, and which of them there are.

    lead: shape of what there is for each image, 1 and N, with more axes between them where a model sees more frames.
    axes: their names. bev_frame: the frame that is projected.
    """
    image = config.image
    width, height = image.padded_size
    left, top, right, bottom = image.crop_box
    pad = ", ".join(f"{value:g}" for value in image.pad_bgr)
    cropped = "" if image.crop is None else f", cropped to columns {left} to {right - 1} and rows {top} to {bottom - 1}"
    levels = ", their grey levels moved as by bevcli.inference.image_repair.auto_levels" if image.auto_levels else ""
    levels += ", fog removed as by bevcli.inference.image_repair.defogged" if image.defog else ""
    levels += ", strong noise smoothed as by bevcli.inference.image_repair.denoised" if image.denoise else ""
    level = f", level, {config.bev_frame.height_m:g} m above the ground" if config.bev_frame.level else ""
    names = ", ".join(f"{index} {name}" for index, name in enumerate(config.cameras))
    return (
        Port(
            "images",
            (1, lead[-1], height, width, 3),
            f"(1, N, H, W, 3): undistorted images, channels B G R, 0 to 255, not normalised{levels}. Each image is "
            f"resized by min({image.size[0]} / width, {image.size[1]} / height) as float32{cropped} and written to the "
            f"top left corner; all other pixels are {pad}.",
        ),
        Port(
            "image_from_bev",
            (*lead, 4, 4),
            f"({axes}, 4, 4): from (x, y, z, 1) in metres of {bev_frame} to (u d, v d, d, 1), with {_pixel(config)} "
            f"and depth d in metres. Bev frame: x to the right, y ahead, z up{level}.",
        ),
        Port("camera_index", lead[-1:], f"(N,): the camera embedding of each image: {names}.", torch.int64),
        Port("has_image", lead, f"({axes}): false for a camera without an image, which then sees nothing.", torch.bool),
    )


def _box_ports(config: ModelConfig) -> Iterator[Port]:
    """The boxes that a file may have, decoded."""
    count = min(config.decoder.max_boxes, config.object_queries * len(config.classes))
    yield Port(
        "boxes",
        (1, count, 9),
        "(1, K, 9): centre x, y, z, length, width, height in metres, yaw in radians counter-clockwise from x, "
        "velocity x, y in m/s; bev frame.",
    )
    yield Port("scores", (1, count), "(1, K): 0 to 1, falling.")
    yield Port("classes", (1, count), "(1, K): index into the metadata's classes.", torch.int64)


def _image_sizes_port(lead: tuple[int, int]) -> Port:
    """An input of a model on a detector. lead: 1 and N."""
    meaning = "(1, N, 2): width and height of each image within its padding, pixels of the resized image."
    return Port("image_sizes", (*lead, 2), meaning)


def _image_box_ports(config: ModelConfig, cameras: int) -> Iterator[Port]:
    """The boxes in the images, of a backbone that is a detector."""
    if config.detector is None:
        return
    shape = (1, cameras, config.detector.max_boxes)
    yield Port(
        "image_boxes",
        (*shape, 4),
        "(1, N, K, 4): left, top, right and bottom edge of the boxes in the images, pixels of the resized image, whose "
        "first pixel has its centre at 0.",
    )
    yield Port("image_scores", shape, "(1, N, K): 0 to 1, falling; 0 for none.")
    names = ", ".join(f"{index} {name}" for index, name in enumerate(config.image_classes))
    yield Port("image_labels", shape, f"(1, N, K): {names}.", torch.int64)


def camera_feed(inputs: ModelInputs) -> dict[str, Tensor]:
    """The inputs of `camera_ports` by name. The images of `inputs` are those of `PreparedFrame.pixels`."""
    return {
        "images": inputs.images.movedim(2, -1).contiguous(),
        "image_from_bev": inputs.image_from_bev,
        "camera_index": inputs.camera_index,
        "has_image": inputs.has_image,
    }


def pixels_of(images: Tensor, image: ImageConfig) -> Tensor:
    """Normalised images (1, N, 3, H, W) -> the pixels of an exported file: B G R, 0 to 255."""
    pixels = images.movedim(2, -1) * torch.tensor(image.std) + torch.tensor(image.mean)
    return (pixels.flip(-1) if image.color_order == "rgb" else pixels).movedim(-1, 2)


def _pixel(config: ModelConfig) -> str:
    """The pixels of the network's input, and how those of the camera's image become them."""
    image = config.image
    if image.crop is None and not image.half_pixel_shift:
        return "pixel (u, v) of the resized image"
    # Of pixels whose centres have whole numbers, see `ImageConfig.half_pixel_shift`.
    shift = " + (scale - 1) / 2" if image.half_pixel_shift else ""
    corner = zip("uv", image.crop_box, strict=False)
    moved = ", ".join(f"{axis} = scale * {axis} of the camera{shift}{f' - {at}' if at else ''}" for axis, at in corner)
    return f"pixel (u, v) of the {'resized' if image.crop is None else 'cropped'} image, {moved},"


class RecurrentForm(ExportForm):
    """The exported form of a BEVFormer: the previous BEV map enters, the current one comes out."""

    step = RecurrentStep

    @property
    def inputs(self) -> tuple[Port, ...]:
        lead = (1, self.cameras)
        sizes = (_image_sizes_port(lead),) if self.config.image_classes else ()
        return (*camera_ports(self.config, lead), *_history_ports(self.config), *sizes)

    def outputs(self, *, decode: bool) -> tuple[Port, ...]:
        return (*super().outputs(decode=decode), *_image_box_ports(self.config, self.cameras))

    def feed(self, prepared: PreparedFrame, memory: Any) -> dict[str, Tensor]:
        inputs = model_inputs(prepared, None if memory is None else memory.pose, self.config)
        return recurrent_feed(inputs, None if memory is None else memory.bev, self.config)

    def memory(self, prepared: PreparedFrame, memory: Any, by_name: Mapping[str, Tensor]) -> Any:
        return model_class(self.config).memory_type(by_name["bev"], prepared.frame.world_from_ego)


def _history_ports(config: ModelConfig) -> Iterator[Port]:
    cells = config.bev_grid.rows * config.bev_grid.columns
    quaternion = "w x y z" if config.ego_motion.can_bus_quaternion == "wxyz" else "w w w w"
    yield Port(
        "can_bus",
        (1, 18),
        f"(1, 18): 0-2 translation since the previous frame, metres, world frame; 3-6 quaternion {quaternion} of "
        "world_from_ego; 7-9 acceleration with gravity, m/s^2; 10-12 angular rate, rad/s; 13-15 velocity, m/s, ego "
        "frame; 16 yaw in radians, 0 to 2 pi; 17 change of yaw since the previous frame, degrees. 0-2 and 17 are zero "
        "without a previous frame.",
    )
    yield Port(
        "shift",
        (1, 2),
        "(1, 2): translation since the previous frame to the right and ahead, as fractions of the extent of the BEV "
        "map in x and y.",
    )
    yield Port("rotation", (1,), "(1,): change of yaw since the previous frame, degrees.")
    yield Port(
        "previous_bev",
        (1, cells, config.channels),
        "(1, Y*X, C): the output bev of the previous frame; ignored where use_previous is false.",
    )
    yield Port("use_previous", (1,), "(1,): false in the first frame of a scene and after a gap in time.", torch.bool)


def recurrent_feed(inputs: ModelInputs, history: Tensor | None, config: ModelConfig) -> dict[str, Tensor]:
    """The inputs by name. history: (1, Y·X, C), the BEV map of the previous frame; None without one."""
    grid = config.bev_grid
    previous = torch.zeros(1, grid.rows * grid.columns, config.channels) if history is None else history
    sizes = {"image_sizes": inputs.image_sizes} if config.image_classes else {}
    return (
        camera_feed(inputs)
        | sizes
        | {
            "can_bus": inputs.can_bus,
            "shift": inputs.shift,
            "rotation": inputs.rotation_deg,
            "previous_bev": previous,
            "use_previous": torch.tensor([history is not None]),
        }
    )
