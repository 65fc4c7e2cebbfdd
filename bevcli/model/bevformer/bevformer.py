"""BEVFormer (Li et al. 2022): camera images and ego-motion in, a BEV map and objects out. Then its exported form."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from bevcli.geometry.transforms import Pose
from bevcli.model.config import ModelConfig
from bevcli.model.ego_motion import map_rotation, rotate_history, turned_history
from bevcli.model.encoder import EncoderLayer
from bevcli.model.network import Network
from bevcli.model.pillar_projection import PillarHits
from bevcli.model.step import ClipInputs, ModelInputs, ModelOutputs, PreparedFrame, model_inputs
from bevcli.model.upload import upload, upload_together
from bevcli.workshop.engines.export_form import ExportForm, Port, camera_feed, camera_ports
from bevcli.workshop.engines.export_step import ExportedStep


@dataclass(frozen=True)
class BevHistory:
    """The last BEV map, which the next frame attends to.

    Attributes:
        bev: (1, Y·X, C), the BEV map of the last frame.
        pose: world_from_ego of that frame.
    """

    bev: Tensor
    pose: Pose


@dataclass(frozen=True)
class EncoderInputs:
    """All that the device part of a step reads, on the device or, small tensors, on the CPU.

    Attributes:
        images: see `ModelInputs`, as for camera_index, can_bus and shift.
        hits: the cells that each camera sees.
        rays: scale and shift of the image features, of the calibration embedding; None without one.
        history: (B, Y·X, C), the BEV map of the previous frame; None without history.
        rotation: (B, 2, 3), of the history, see `map_rotation`; None without history.
    """

    images: Tensor
    camera_index: Tensor
    can_bus: Tensor
    shift: Tensor
    hits: PillarHits
    rays: tuple[Tensor, Tensor] | None
    history: Tensor | None
    rotation: Tensor | None


class BEVFormer(Network):
    """The whole model: a recurrence, in which the BEV map of a frame is the history of the next."""

    memory_type: ClassVar[type] = BevHistory
    device_parts: ClassVar[tuple[str, ...]] = ("device_part",)
    figures: ClassVar[tuple[str, ...]] = ("bevcli.workshop.explain.overview:FIGURES",)

    def forward(self, inputs: ModelInputs, history: Tensor | None = None) -> ModelOutputs:
        """One step. history: (B, Y·X, C), the BEV map of the previous frame, or None for a scene's first frame."""
        found: ModelOutputs = self.device_part(self.host_part(inputs, history))
        return found

    def bev_map(self, inputs: ModelInputs, history: Tensor | None) -> Tensor:
        """The BEV map (B, Y·X, C): the part of `forward` before the decoder and the heads."""
        return self.encode(self.host_part(inputs, history))

    def host_part(self, inputs: ModelInputs, history: Tensor | None) -> "EncoderInputs":
        """What a step needs of calibration and poses, as tensors. Arguments as for `forward`."""
        size = inputs.image_size
        rays = rotation = None
        if self.calibration_embedding is not None:
            rays = self.calibration_embedding(inputs.image_from_bev, self.config.level_shapes_of(size), size)
        if history is not None:
            center = self.config.ego_motion.history_rotation_center
            rotation = map_rotation(inputs.rotation_deg, self.config.bev_grid, center)
        return EncoderInputs(
            images=inputs.images,
            camera_index=inputs.camera_index,
            can_bus=inputs.can_bus,
            shift=inputs.shift,
            hits=self.pillars(inputs.image_from_bev, size, inputs.has_image),
            rays=rays,
            history=history,
            rotation=rotation,
        )

    def device_part(self, inputs: "EncoderInputs") -> Any:
        """The outputs of a step: a function of tensors without a wait for the device, of the same shapes every time."""
        return self.detect(self.encode(inputs))

    def encode(self, inputs: "EncoderInputs") -> Tensor:
        """The BEV map (B, Y·X, C)."""
        inputs = upload_together(inputs, self.device)
        image_features = self.image_features(inputs.images, inputs.camera_index)
        if inputs.rays is not None:
            image_features = image_features.scaled(*inputs.rays)
        history = inputs.history
        if history is not None:
            assert inputs.rotation is not None
            history = turned_history(history, inputs.rotation, self.config.bev_grid)
        bev: Tensor = self.encoder(
            bev_query=self.bev_queries(inputs.can_bus),
            position=self.bev_queries.position(),
            image_features=image_features,
            hits=inputs.hits,
            history=history,
            shift=inputs.shift,
        )
        return bev

    def align_history(self, history: Tensor, rotation_deg: Tensor) -> Tensor:
        """The history map (B, Y·X, C), rotated by rotation_deg (B,) to the current heading."""
        center = self.config.ego_motion.history_rotation_center
        return rotate_history(history, rotation_deg, self.config.bev_grid, center)

    def step(
        self, prepared: PreparedFrame, memory: BevHistory | None, upcoming: Sequence[PreparedFrame] = ()
    ) -> tuple[ModelOutputs, BevHistory]:
        inputs = model_inputs([prepared], [None if memory is None else memory.pose], self.config)
        inputs = replace(inputs, images=upload(inputs.images, self.device))
        outputs = self(inputs, None if memory is None else memory.bev)
        return outputs, BevHistory(outputs.bev, prepared.frame.world_from_ego)

    def remember(self, clip: ClipInputs, place: int, memory: Tensor | None) -> Tensor:
        """See `Network`; the memory of a clip is its BEV map (B, Y·X, C)."""
        return self.bev_map(clip.inputs[place], memory)

    def learn(self, clip: ClipInputs, place: int, memory: Tensor | None) -> tuple[ModelOutputs, Tensor]:
        outputs = self(clip.inputs[place], memory)
        return outputs, outputs.bev.detach()

    def run_on_shapes(self, images: Tensor, camera_index: Tensor, hits: PillarHits) -> Tensor:
        features = self.image_features(images, camera_index)
        query, position = self.bev_queries(torch.empty(1, 18)), self.bev_queries.position()
        bev: Tensor = self.encoder(query, position, features, hits, torch.empty_like(query), torch.empty(1, 2))
        self.decoder(bev, self.detection_head)
        if self.segmentation_head is not None:
            self.segmentation_head(bev, position)
        return bev

    @classmethod
    def export_form(cls, config: ModelConfig, cameras: int) -> "RecurrentForm":
        return RecurrentForm(config, cameras)


class RecurrentStep(ExportedStep):
    """`BEVFormer.forward` as a graph, which has no optional inputs: `use_previous` says whether there is a history."""

    def forward(
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
    ) -> tuple[Tensor, ...]:
        """One step; `RecurrentForm` documents every input and output."""
        network = self.network
        image_features = self.image_features(images, camera_index)
        if network.calibration_embedding is not None:
            rays = image_from_bev, image_features.level_shapes, self.image_size
            image_features = image_features.scaled(*network.calibration_embedding(*rays))
        bev_query = network.bev_queries(can_bus)
        position = network.bev_queries.position()
        history = network.align_history(previous_bev, rotation)
        centers = network.encoder.cell_centers.expand(1, 2, -1, -1)
        reference_points = torch.where(use_previous, network.encoder.reference_points(shift), centers)
        hits = self.hits(image_from_bev, has_image)
        with_history = torch.stack([history, bev_query], dim=1)
        bev = bev_query
        for layer in network.encoder.layers:
            assert isinstance(layer, EncoderLayer)
            bev_maps = torch.where(use_previous, with_history, torch.stack([bev, bev], dim=1))
            bev = layer(bev, position, bev_maps, reference_points, image_features, hits)
        return self.outputs(bev, hits.most_cameras)


class RecurrentForm(ExportForm):
    """The exported form: the BEV map of the previous frame enters, that of the current one comes out."""

    step = RecurrentStep

    @property
    def inputs(self) -> tuple[Port, ...]:
        return (*camera_ports(self.config, (1, self.cameras)), *_history_ports(self.config))

    def feed(self, prepared: PreparedFrame, memory: BevHistory | None) -> dict[str, Tensor]:
        inputs = model_inputs([prepared], [None if memory is None else memory.pose], self.config)
        return recurrent_feed(inputs, None if memory is None else memory.bev, self.config)

    def memory(self, prepared: PreparedFrame, memory: BevHistory | None, found: Mapping[str, Tensor]) -> BevHistory:
        return BevHistory(found["bev"], prepared.frame.world_from_ego)


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
    return camera_feed(inputs) | {
        "can_bus": inputs.can_bus,
        "shift": inputs.shift,
        "rotation": inputs.rotation_deg,
        "previous_bev": previous,
        "use_previous": torch.tensor([history is not None]),
    }
