"""The exported form of a model: names, shapes and units of a file's inputs and outputs, as its metadata states them."""

import copy
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from bevcli.model.bevformer import BEVFormer
from bevcli.model.config import ImageConfig, ModelConfig
from bevcli.model.decoder import best_boxes
from bevcli.model.deformable_attention import FeatureMaps
from bevcli.model.deformable_convolution import ModulatedDeformableConvolution, split_offsets_and_mask
from bevcli.model.ego_motion import rotate_history
from bevcli.model.encoder import EncoderLayer, SpatialCrossAttention
from bevcli.model.kernels.choose import fold_batch_norms
from bevcli.model.road_slopes import SPREAD, RoadSlopes, upright_cameras
from bevcli.model.step import ModelInputs, ModelOutputs, PreparedFrame, model_inputs
from bevcli.model.temporal_model import model_class

Output = TypeVar("Output")


class ExportedStep(nn.Module):
    """The base of the exported steps, for batches of one. Images enter before normalisation."""

    network: Any
    image_mean: Tensor
    image_std: Tensor

    def __init__(
        self, model: Any, deformable_convolution: "DeformableConvolution", slots: int, *, decode: bool
    ) -> None:
        """A copy of the model, with its parts replaced; the model itself stays unchanged.

        slots: K of `SlottedHits`, at most the number of cameras.
        """
        super().__init__()
        self.network = copy.deepcopy(model).cpu().float().eval().requires_grad_(False)
        self.config, self.slots, self.decode = model.config, slots, decode
        fold_batch_norms(self.network, torch.device("meta"))  # for no device: with standard operators
        replace_parts(self.network, deformable_convolution)
        image = self.config.image
        width, height = image.padded_size
        self.image_size = height, width
        self.register_buffer("image_mean", torch.tensor(image.mean)[:, None, None])
        self.register_buffer("image_std", torch.tensor(image.std)[:, None, None])

    def image_features(self, images: Tensor, camera_index: Tensor) -> FeatureMaps:
        """The tokens of images (1, N, H, W, 3) BGR, 0 to 255; camera_index: (N,)."""
        return self.network.image_features(self.normalised(images), camera_index)

    def normalised(self, images: Tensor) -> Tensor:
        """Images (1, N, H, W, 3) BGR, 0 to 255 -> (1, N, 3, H, W) as the network takes them."""
        planes = images.permute(0, 1, 4, 2, 3)
        if self.config.image.color_order == "rgb":
            planes = planes.flip(2)
        return (planes - self.image_mean) / self.image_std

    def hits(self, image_from_bev: Tensor, has_image: Tensor) -> "SlottedHits":
        """The cameras that see each cell, for a batch of one; arguments as for `Pillars.project`."""
        projection = self.network.pillars.project(image_from_bev, self.image_size, has_image)
        hit = projection.hit[0].float()  # (N, Y·X)
        cells = hit.shape[1]
        filled, camera = hit.t().topk(self.slots, dim=1)
        index = camera * cells + torch.arange(cells)[:, None]  # index in N·Y·X
        points = projection.reference_points[0].flatten(0, 1).index_select(0, index.flatten())
        count = hit.sum(0)
        return SlottedHits(
            camera=camera,
            filled=filled,
            reference_points=points.unflatten(0, (cells, self.slots)),
            cameras_per_cell=count.clamp(min=1)[:, None],
            most_cameras=count.max()[None].long(),
        )

    def outputs(self, outputs: ModelOutputs, most_cameras: Tensor) -> tuple[Tensor, ...]:
        """The outputs in the order of `ExportForm.outputs`. most_cameras: (1,), see `SlottedHits`."""
        named = outputs.by_name
        listed = with_most_cameras(tuple(named.values()), most_cameras)
        if not self.decode:
            return listed
        best = best_boxes(named["class_logits"], named["box_codes"], self.config.decoder)  # as `ModelOutputs.boxes`
        x, y, log_width, log_length, z, log_height, sin, cos, *velocity = best.codes.unbind(-1)
        # The code's angle a is clockwise from -y: yaw = -a - pi / 2, whose sine is -cos a and whose cosine is -sin a.
        yaw = torch.atan2(-cos, -sin)
        sizes = [log.exp() for log in (log_length, log_width, log_height)]
        boxes = torch.stack([x, y, z, *sizes, yaw, *velocity], dim=-1)  # (1, K, 9)
        return (*listed, boxes, best.scores, best.label)


def with_most_cameras(outputs: Sequence[Output], most_cameras: Output) -> tuple[Output, ...]:
    """The model's outputs with one that only exported files have, after the BEV map, the logits and the box codes."""
    return (*outputs[:3], most_cameras, *outputs[3:])


class RecurrentStep(ExportedStep):
    """`BEVFormer.forward` as a graph, which has no optional inputs: `use_previous` says whether there is a history."""

    def forward(  # noqa: PLR0913 - the inputs of the file
        self,
        images: Tensor,
        image_from_bev: Tensor,
        camera_index: Tensor,
        has_image: Tensor,
        can_bus: Tensor,
        shift: Tensor,
        rotation: Tensor,
        previous_bev: Tensor,
        use_previous: Tensor,
        image_sizes: Tensor | None = None,
        expected_slopes: Tensor | None = None,
        expected_covariance: Tensor | None = None,
    ) -> tuple[Tensor, ...]:
        """One step; `RecurrentForm` documents every input and output."""
        network = self.network
        images = self.normalised(images)
        expected = None
        if expected_slopes is not None and expected_covariance is not None:
            expected = RoadSlopes(expected_slopes, expected_covariance)
        looked = network.look(images, has_image, image_from_bev, image_sizes, expected)
        boxes, image_from_level, slopes, expected = looked
        upright_from_level, image_from_upright = image_from_level, None
        if slopes is not None:
            upright_from_level, image_from_upright = upright_cameras(image_from_bev, image_from_level)
        maps = network.image_maps(images, image_from_upright, image_sizes)
        image_features = network.tokens_of(maps, camera_index)
        if network.calibration_embedding is not None:
            rays = upright_from_level, image_features.level_shapes, self.image_size
            image_features = image_features.scaled(*network.calibration_embedding(*rays))
        bev_query = network.bev_queries(can_bus)
        position = network.bev_queries.position()
        center = self.config.ego_motion.history_rotation_center
        history = rotate_history(previous_bev, rotation, self.config.bev_grid, center)
        centers = network.encoder.cell_centers.expand(1, 2, -1, -1)
        reference_points = torch.where(use_previous, network.encoder.reference_points(shift), centers)
        hits = self.hits(upright_from_level, has_image)
        with_history = torch.stack([history, bev_query], dim=1)
        bev = bev_query
        for layer in network.encoder.layers:
            assert isinstance(layer, EncoderLayer)
            bev_maps = torch.where(use_previous, with_history, torch.stack([bev, bev], dim=1))
            bev = layer(bev, position, bev_maps, reference_points, image_features, hits)
        boxes = boxes or network.backbone.image_boxes(maps, has_image, image_sizes)
        outputs = network.detect_with_images(bev, boxes, image_from_bev, image_from_level, image_sizes, expected)
        boxes, outputs = outputs.image_boxes, replace(outputs, road_slopes=slopes)
        return (*self.outputs(outputs, hits.most_cameras), *(boxes.by_name.values() if boxes else ()))


DeformableConvolution = Literal["operator", "gridsample"]


@dataclass(frozen=True)
class SlottedHits:
    """The cameras that see each cell, in K slots a cell, so that every shape is fixed. A slot may be empty."""

    camera: Tensor  # (Y·X, K) int64, the camera of each slot, any camera where it is empty
    filled: Tensor  # (Y·X, K) float32, 1 for a slot with a camera that sees the cell, else 0
    reference_points: Tensor  # (Y·X, K, Z, 2) float32, of the pillars in their cameras, 0 to 1 over the padded image
    cameras_per_cell: Tensor  # (Y·X, 1) float32, the number of cameras that see a cell, at least 1
    most_cameras: Tensor  # (1,) int64, the largest number of cameras that see one cell. Those beyond K have no slot


class SlottedSpatialCrossAttention(nn.Module):
    """Takes the place of `SpatialCrossAttention`, for batches of one and hits in slots.

    The maps of all cameras are stacked into one tall map, with a row of zeros between them, so that GridSample can
    sample another camera at every point.
    """

    def __init__(self, original: SpatialCrossAttention) -> None:
        super().__init__()
        self.points, self.attention = original.points, original.attention

    def forward(self, query: Tensor, image_features: FeatureMaps, hits: SlottedHits) -> Tensor:
        """As `SpatialCrossAttention.forward`."""
        offsets, logits = (part[:, :, 0] for part in self.attention.predict(query[0]))
        weights = self.attention.sampling.weights(logits)
        heads, levels = self.attention.shape[0], image_features.level_shapes
        values = self.attention.value_projection(image_features.tokens).unflatten(-1, (heads, -1))
        points = hits.reference_points
        points = points.repeat(1, 1, self.points // points.shape[2], 1)[:, None]  # (Y·X, 1, K, P, 2)
        summed = torch.zeros(())
        maps = values.split([height * width for height, width in levels], dim=1)
        for level, ((height, width), level_map) in enumerate(zip(levels, maps, strict=True)):
            x = points[..., 0] + offsets[:, :, None, level, :, 0] / width  # (Y·X, heads, K, P)
            y = points[..., 1] * height + offsets[:, :, None, level, :, 1] - 0.5
            # One row above or below a map is zero, and so is everything beyond.
            y = y.clamp(-1, height) + (hits.camera * (height + 1)).float()[:, None, :, None]
            planes = level_map.permute(2, 3, 0, 1).unflatten(-1, (height, width))  # (heads, D, N, height, width)
            tall = F.pad(planes, (0, 0, 0, 1)).flatten(2, 3)  # (heads, D, N·(height + 1), width)
            grid = torch.stack([2 * x - 1, (2 * y + 1) / tall.shape[2] - 1], dim=-1)
            sampled = F.grid_sample(tall, grid.transpose(0, 1).flatten(2, 3), align_corners=False)
            weight = weights[:, :, None, level] * hits.filled[:, None, :, None]  # (Y·X, heads, K, P)
            summed = summed + (sampled * weight.transpose(0, 1).flatten(2)[:, None]).sum(-1)  # (heads, D, Y·X)
        attended = summed.permute(2, 0, 1).flatten(1)  # (Y·X, C)
        return self.attention.output_projection(attended / hits.cameras_per_cell)[None]


class DeformConvOperator(nn.Module):
    """Takes the place of a `ModulatedDeformableConvolution`: the operator DeformConv of ONNX, opset 19."""

    def __init__(self, original: ModulatedDeformableConvolution) -> None:
        super().__init__()
        self.weight, self.bias, self.stride = original.weight, original.bias, original.stride
        self.offset_and_mask = original.offset_and_mask

    def forward(self, x: Tensor) -> Tensor:
        """x: (B, C, H, W) -> (B, O, H', W'). Only for export: in PyTorch its result is zero."""
        offsets, mask = split_offsets_and_mask(self.offset_and_mask(x))
        bias = x.new_zeros(len(self.weight)) if self.bias is None else self.bias
        return torch.onnx.ops.symbolic(
            "DeformConv",
            [x, self.weight, offsets.flatten(1, 2), bias, mask],
            {"kernel_shape": [3, 3], "pads": [1, 1, 1, 1], "strides": [self.stride, self.stride]},
            dtype=x.dtype,
            shape=(len(x), len(self.weight), *mask.shape[-2:]),
            version=19,
        )


def replace_parts(network: nn.Module, deformable_convolution: "DeformableConvolution") -> None:
    """Replaces, in place, the spatial cross-attentions and, for "operator", the deformable convolutions."""
    for name, module in list(network.named_modules()):
        if isinstance(module, SpatialCrossAttention):
            network.set_submodule(name, SlottedSpatialCrossAttention(module))
        elif isinstance(module, ModulatedDeformableConvolution) and deformable_convolution == "operator":
            network.set_submodule(name, DeformConvOperator(module))


@dataclass(frozen=True)
class Port:
    """An input or an output of an exported file."""

    name: str  # in the file
    shape: tuple[int, ...]  # of the tensor
    meaning: str  # axes, units and frames, for the file's metadata
    dtype: torch.dtype = torch.float32  # of the tensor


MOST_CAMERAS = Port(
    "most_cameras_per_cell",
    (1,),
    "(1,): the largest number of cameras that see one cell of the BEV map. If it exceeds the metadata's "
    "cameras_per_cell, cameras are left out, and the results are wrong: export with more.",
    torch.int64,
)


EXPECTED_SLOPES = (  # inputs of a model that levels the rig
    Port(
        "expected_slopes",
        (1, 2),
        "(1, 2): of the road along x and y of the bev frame, as bevcli.model.road_slopes expects them by the frame "
        "before; 0 where nothing is known.",
    ),
    Port(
        "expected_covariance",
        (1, 2, 2),
        f"(1, 2, 2): of expected_slopes; {SPREAD**2:g} times the identity where nothing is known.",
    ),
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
        meaning = "(1, N, 2): width and height of each image within its padding, pixels of the resized image."
        sizes = (Port("image_sizes", (*lead, 2), meaning),) if self.config.image_classes else ()
        slopes = EXPECTED_SLOPES if self.config.levels else ()
        return (*camera_ports(self.config, lead), *_history_ports(self.config), *sizes, *slopes)

    def outputs(self, *, decode: bool) -> tuple[Port, ...]:
        return (*super().outputs(decode=decode), *_image_box_ports(self.config, self.cameras))

    def feed(self, prepared: PreparedFrame, memory: Any) -> dict[str, Tensor]:
        inputs = model_inputs(prepared, None if memory is None else memory.pose, self.config)
        inputs = replace(inputs, expected_slopes=BEVFormer.slopes_before(prepared, memory))
        return recurrent_feed(inputs, None if memory is None else memory.bev, self.config)

    def memory(self, prepared: PreparedFrame, memory: Any, by_name: Mapping[str, Tensor]) -> Any:
        return BEVFormer.history_after(prepared, by_name["bev"], RoadSlopes.of_names(by_name))


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
    if config.levels:
        expected = inputs.expected_slopes or RoadSlopes.unknown()
        sizes |= {"expected_slopes": expected.mean, "expected_covariance": expected.covariance}
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
