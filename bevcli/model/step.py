"""The data of one step: a preprocessed frame with its cameras in the model's order, and the tensors of a network."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Protocol, Self

import numpy as np
import torch
from torch import Tensor

from bevcli.errors import InputError
from bevcli.frame import Frame
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import NUSCENES_YAWS_DEG, CameraRig
from bevcli.geometry.transforms import Pose, wrap_angle
from bevcli.model.config import ModelConfig
from bevcli.model.decoder import best_boxes
from bevcli.model.ego_motion import ego_motion_inputs
from bevcli.model.image_boxes import ImageBoxes
from bevcli.model.road_slopes import FollowedPoints, GreyView, RoadSlopes
from bevcli.model.segmentation import STUFF_CLASSES, SegmentationOutputs
from bevcli.model.upload import upload


@dataclass(frozen=True)
class CameraAssignment:
    """The cameras of a rig, assigned to the cameras that the model was trained with."""

    cameras: tuple[str, ...]  # the rig's cameras in the model's order
    embeddings: tuple[str, ...]  # for each of them, the model's camera whose embedding it takes


@dataclass(frozen=True)
class PreparedFrame:
    """A frame and the network's input made of it, for N cameras.

    Attributes:
        frame: the frame as it was read, but for the bev frame of its rig: see `BevFrameConfig.level`.
        assignment: the N cameras and the model cameras whose embeddings they use.
        scales: (N,) pixels of the resized image per pixel of the camera's image.
        images: (1, N, 3, H, W) float32, normalised; zero where an image is missing. Uploaded ahead to a CUDA GPU. With
            `pixels`, before normalisation: B G R, 0 to 255, the mean where an image is missing.
        image_from_bev: (1, N, 4, 4) float64, to network pixels.
        camera_index: (N,) int64, index of each camera's embedding.
        has_image: (1, N) bool.
        pixels: the images are as an exported file takes them, which normalises them itself.
        grey: the images once more, for a model that levels the rig of each frame.
        points: followed ahead from the frame before; None where the step follows them.
    """

    frame: Frame
    assignment: CameraAssignment
    scales: tuple[float, ...]
    images: Tensor
    image_from_bev: Tensor
    camera_index: Tensor
    has_image: Tensor
    pixels: bool = False
    grey: GreyView | None = None
    points: FollowedPoints | None = None


@dataclass(frozen=True)
class ModelInputs:
    """One step of B sequences with N cameras."""

    images: Tensor  # (B, N, 3, H, W), normalised and padded
    image_from_bev: Tensor  # (B, N, 4, 4) float32, bev metres to pixels of the network's input (rows u·d, v·d, d, 1)
    camera_index: Tensor  # (N,) int64, the camera embedding of each image; (B, N) where the sequences differ
    has_image: Tensor  # (B, N) bool; a camera without an image sees no BEV cell
    image_sizes: Tensor  # (B, N, 2) float32, width and height of the images within their padding
    can_bus: Tensor  # (B, 18) float32, the translation and the change of heading since the previous frame included
    # (B, 2) float32, translation of the history (x, y) in normalised BEV coordinates; zero without history
    shift: Tensor
    rotation_deg: Tensor  # (B,) float32, rotation of the history map
    # of the road, before the boxes of the frame are looked at; None where nothing is known
    expected_slopes: RoadSlopes | None = None

    @property
    def image_size(self) -> tuple[int, int]:
        """(height, width) of the network's input, pixels."""
        return self.images.shape[-2], self.images.shape[-1]

    def to(self, device: torch.device) -> "ModelInputs":
        """The same inputs on a device, but for what is read on the CPU."""
        kept = ("image_from_bev", "has_image", "rotation_deg", "expected_slopes")
        names = [field.name for field in fields(self) if field.name not in kept]
        moved: dict[str, Any] = {name: upload(getattr(self, name), device) for name in names}
        return replace(self, **moved)


class Clip(Protocol):
    """B training clips.

    Attributes:
        inputs: of each frame.
        world_from_bev: (frames, B, 4, 4) float64.
    """

    @property
    def inputs(self) -> Sequence[ModelInputs]: ...

    @property
    def world_from_bev(self) -> Tensor: ...


@dataclass(frozen=True)
class ModelOutputs:
    """The outputs of one step.

    Attributes:
        stay_on_device: names of the fields that are decoded on the model's device. The last layers of all others are
            copied to the CPU first.
        bev: (B, Y·X, C), the BEV map; (B, 0, C) of a model without one.
        class_logits: (L, B, Q, classes) of the L decoder layers.
        box_codes: (L, B, Q, 10): cx, cy, log w, log l, cz, log h, sin, cos, vx, vy; centres in metres, bev frame.
        segmentation: outputs of the segmentation head, None without one.
        image_boxes: boxes in the images, None where the backbone is no detector.
        road_slopes: on the CPU, None of a model that does not level the rig.
    """

    stay_on_device: ClassVar[tuple[str, ...]] = ("bev",)

    bev: Tensor
    class_logits: Tensor
    box_codes: Tensor
    segmentation: SegmentationOutputs | None = None
    image_boxes: ImageBoxes | None = None
    road_slopes: RoadSlopes | None = None

    @property
    def by_name(self) -> dict[str, Tensor]:
        """The last layers' outputs by their names in an exported file, in the order of `ports`."""
        named = {"bev": self.bev, "class_logits": self.class_logits[-1], "box_codes": self.box_codes[-1]}
        if self.segmentation is not None:
            named["mask_logits"] = self.segmentation.mask_logits[-1]
            named["mask_class_logits"] = self.segmentation.class_logits[-1]
        if self.road_slopes is not None:
            named |= {"road_slopes": self.road_slopes.mean, "road_covariance": self.road_slopes.covariance}
        return named

    @classmethod
    def of_names(cls, tensors: Mapping[str, Tensor]) -> Self:
        """The inverse of `by_name`, with one decoder layer."""
        segmentation = None
        if "mask_logits" in tensors:
            masks, classes = tensors["mask_logits"][None], tensors["mask_class_logits"][None]
            segmentation = SegmentationOutputs(masks, classes, locations=torch.zeros(0, 1, 0, 4))
        logits, codes = tensors["class_logits"][None], tensors["box_codes"][None]
        slopes = RoadSlopes.of_names(tensors)
        return cls(tensors["bev"], logits, codes, segmentation, ImageBoxes.of_names(tensors), slopes)

    @classmethod
    def ports(cls, config: ModelConfig) -> Iterator[tuple[str, tuple[int, ...], str]]:
        """Name, shape and meaning of each output of an exported file, see `by_name`."""
        cells, queries = config.bev_grid.rows * config.bev_grid.columns, config.object_queries
        yield (
            "bev",
            (1, cells, config.channels),
            "(1, Y*X, C): the BEV map; cell row * columns + column, rows by rising y, columns by rising x.",
        )
        yield "class_logits", (1, queries, len(config.classes)), "(1, Q, classes): of the last decoder layer."
        yield (
            "box_codes",
            (1, queries, 10),
            "(1, Q, 10): cx, cy, log w, log l, cz, log h, sin, cos, vx, vy; metres and m/s, bev frame; "
            "yaw = -atan2(sin, cos) - pi / 2.",
        )
        if "segmentation" in config.heads:
            masks = len(STUFF_CLASSES) + config.segmentation.thing_queries
            yield (
                "mask_logits",
                (1, masks, cells),
                f"(1, Q, Y*X): masks of {', '.join(STUFF_CLASSES)}, then of vehicles.",
            )
            yield (
                "mask_class_logits",
                (1, masks),
                "(1, Q): that the object exists. A cell's probability is sigmoid(mask) * sigmoid(class).",
            )
        if config.levels:
            yield "road_slopes", (1, 2), "(1, 2): of the road along x and y of the bev frame."
            yield "road_covariance", (1, 2, 2), "(1, 2, 2): of road_slopes."

    def boxes(self, config: ModelConfig) -> Boxes3D:
        """The boxes with the best scores of the last decoder layer, by falling score, bev frame; of a batch of one.

        There are at most config.decoder.max_boxes. No box is removed: training matches each object to one query. A
        query gives one box for each of its classes that is among the best scores.
        """
        best = best_boxes(self.class_logits[-1].detach(), self.box_codes[-1].detach(), config.decoder)
        return best.decoded(config.classes)

    def with_queries(self, class_logits: Tensor, box_codes: Tensor) -> Self:
        """The outputs with further queries after those of the decoder, the same ones in all layers.

        class_logits: (B, H, classes). box_codes: (B, H, 10).
        """
        logits, codes = (x.expand(len(self.class_logits), *x.shape) for x in (class_logits, box_codes))
        return replace(
            self,
            class_logits=torch.cat([self.class_logits, logits], 2),
            box_codes=torch.cat([self.box_codes, codes], 2),
        )

    def last_layers(self) -> Self:
        """The outputs of the last layers, all that results are decoded from."""
        segmentation = None if self.segmentation is None else self.segmentation.last_layers()
        logits, codes = self.class_logits[-1:], self.box_codes[-1:]
        return replace(self, class_logits=logits, box_codes=codes, segmentation=segmentation, road_slopes=None)


def model_inputs(prepared: PreparedFrame, previous_pose: Pose | None, config: ModelConfig) -> ModelInputs:
    """A frame as a batch of one. previous_pose: see `ego_motion_inputs`."""
    frame = prepared.frame
    motion = ego_motion_inputs(
        frame.world_from_ego, previous_pose, frame.kinematics, config.bev_grid, config.ego_motion
    )
    return ModelInputs(
        images=prepared.images,
        # Without the noise of the poses' products (1e-14), so that frames of one rig have equal projections.
        image_from_bev=prepared.image_from_bev.round(decimals=12).float(),
        camera_index=prepared.camera_index,
        has_image=prepared.has_image,
        image_sizes=_image_sizes(prepared, config),
        can_bus=torch.from_numpy(motion.can_bus)[None],
        shift=torch.from_numpy(motion.shift)[None],
        rotation_deg=torch.tensor([motion.rotation_deg], dtype=torch.float32),
    )


def _image_sizes(prepared: PreparedFrame, config: ModelConfig) -> Tensor:
    """See `ModelInputs.image_sizes`."""
    left, top, right, bottom = config.image.crop_box if config.image.crop is not None else (0, 0, np.inf, np.inf)
    cameras = [prepared.frame.rig[name] for name in prepared.assignment.cameras]
    sizes = [
        (min(scale * camera.width, right) - left, min(scale * camera.height, bottom) - top)
        for camera, scale in zip(cameras, prepared.scales, strict=True)
    ]
    return torch.tensor(sizes, dtype=torch.float32)[None]


def assign_cameras(
    rig: CameraRig, model_cameras: tuple[str, ...], chosen: Mapping[str, str] | None = None
) -> CameraAssignment:
    """Assigns each camera of a rig to a camera of the model: as `chosen`, else by name, else by viewing direction.

    Args:
        model_cameras: the names of the model's cameras, in the order of their embeddings.
        chosen: camera of the rig -> camera of the model.

    Raises InputError for an unknown camera in `chosen`, or where the model's cameras have no known viewing direction.
    """
    chosen = chosen or {}
    for name, embedding in chosen.items():
        if name not in rig.names:
            raise InputError(f"camera {name}: is not in the rig (it has {', '.join(rig.names)})")
        if embedding not in model_cameras:
            raise InputError(
                f"camera {name}: the model has no camera {embedding} (expected {', '.join(model_cameras)})"
            )
    yaws = np.radians([NUSCENES_YAWS_DEG.get(name, np.nan) for name in model_cameras])
    embeddings = {}
    for camera in rig.cameras:
        embedding = chosen.get(camera.name, camera.name if camera.name in model_cameras else "")
        if not embedding:
            distances = np.abs(wrap_angle(yaws - camera.yaw))
            if np.isnan(distances).all():
                raise InputError(
                    f"camera {camera.name}: the model has no camera of this name; pass "
                    f"`cameras={{'{camera.name}': 'NAME'}}` (`--camera {camera.name}=NAME`)"
                )
            embedding = model_cameras[int(np.nanargmin(distances))]
        embeddings[camera.name] = embedding
    order = sorted(rig.names, key=lambda name: (model_cameras.index(embeddings[name]), name != embeddings[name], name))
    return CameraAssignment(tuple(order), tuple(embeddings[name] for name in order))
