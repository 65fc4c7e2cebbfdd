"""The exported form of a BEVFormerV2: one step whose window ends with the current frame."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from bevcli.errors import BevcliError
from bevcli.model.deformable_attention import FeatureMaps
from bevcli.model.step import PreparedFrame, model_inputs
from bevcli.workshop.bevformer_v2.window import (
    BEVFormerV2Config,
    FeatureWindow,
    FrameFeatures,
    WindowFrame,
    frames_at,
    kept,
)
from bevcli.workshop.engines.export_form import ExportedStep, ExportForm, Port, camera_feed, camera_ports


class WindowStep(ExportedStep):
    """One step of a BEVFormerV2 whose window ends with the current frame: `BEVFormerV2.forward`.

    The image features of the earlier frames enter, and those of the current frame come out. All frames are encoded,
    also those that do not exist, because a graph has no optional parts; a frame without any image then takes the map
    of the next one, as in `fill_window`.
    """

    def forward(
        self,
        images: Tensor,
        image_from_bev: Tensor,
        camera_index: Tensor,
        has_image: Tensor,
        previous_features: Tensor | None = None,
    ) -> tuple[Tensor, ...]:
        """One step; `WindowForm` documents every input and output."""
        network = self.network
        image_features = self.image_features(images, camera_index)
        tokens = [*([] if previous_features is None else previous_features), image_features.tokens]
        hits = [self.hits(image_from_bev[:, index], has_image[:, index]) for index in range(len(tokens))]
        maps = [
            network.encoder(
                bev_query=network.bev_queries.embedding[None],
                position=network.bev_queries.position(),
                image_features=FeatureMaps(frame_tokens, image_features.level_shapes),
                hits=frame_hits,
            )
            for frame_tokens, frame_hits in zip(tokens, hits, strict=True)
        ]
        for index in reversed(range(len(maps) - 1)):
            maps[index] = torch.where(has_image[:, index].any(), maps[index], maps[index + 1])
        bev = maps[0] if network.fusion is None else network.fusion(maps)
        most_cameras = torch.cat([frame_hits.most_cameras for frame_hits in hits]).amax(0, keepdim=True)
        outputs = self.outputs(network.detect(bev), most_cameras)
        return outputs if previous_features is None else (*outputs, image_features.tokens)


class WindowForm(ExportForm):
    """The form of one step of a BEVFormerV2.

    Attributes:
        frames: of the window, relative to the current one, which is the last.
    """

    step = WindowStep

    def __init__(self, config: BEVFormerV2Config, cameras: int) -> None:
        """Raises BevcliError for a model that looks at later frames."""
        if config.later_frames:
            raise BevcliError(
                f"{config.name}: a model that looks at later frames cannot be exported: frames is "
                f"{list(config.frames)} (expected a window that ends with 0, the current frame)"
            )
        super().__init__(config, cameras)
        self.frames = config.frames

    @property
    def inputs(self) -> tuple[Port, ...]:
        lead, bev_frame = (1, len(self.frames), self.cameras), "the current frame's bev frame"
        images, projection, camera_index, has_image = camera_ports(self.config, lead, "1, F, N", bev_frame)
        window = (
            " For the cameras of each of the window's F frames, which are, relative to the current one: "
            f"{_listed(self.frames)}."
        )
        absent = (
            " All false for a frame that does not exist, such as before a scene's first frame or before a gap in "
            "time of more than max_gap_s: the BEV map of the next frame takes the place of its own."
        )
        projection = replace(projection, meaning=projection.meaning + window)
        ports = (images, projection, camera_index, replace(has_image, meaning=has_image.meaning + absent))
        if len(self.frames) == 1:
            return ports
        meaning = (
            "(F - 1, N, S, C): the output image_features of the window's earlier frames "
            f"{_listed(self.frames[:-1])}, in this order; ignored for a frame that does not exist."
        )
        return (*ports, Port("previous_features", (len(self.frames) - 1, *self._features_shape), meaning))

    def outputs(self, *, decode: bool) -> tuple[Port, ...]:
        ports = super().outputs(decode=decode)
        if len(self.frames) == 1:
            return ports
        meaning = "(N, S, C): of the current frame's images, for previous_features of the next frames."
        return (*ports, Port("image_features", self._features_shape, meaning))

    def facts(self) -> dict[str, Any]:
        return {"window": self.frames}

    def feed(self, prepared: PreparedFrame, memory: FeatureWindow | None) -> dict[str, Tensor]:
        """See `ExportForm`. Of a frame that does not exist no camera has an image."""
        past = self._past(prepared, memory)
        current = model_inputs(prepared, None, self.config)
        indices = [len(past) + offset for offset in self.frames[:-1]]
        absent = WindowFrame(
            FeatureMaps(torch.zeros(self._features_shape), self.config.level_shapes),
            torch.zeros_like(current.image_from_bev),
            torch.zeros_like(current.has_image),
            current.image_size,
        )
        earlier = [frame or absent for frame in frames_at(past, indices, prepared)]
        feed = camera_feed(current) | {
            "image_from_bev": torch.stack(
                [*(frame.image_from_bev for frame in earlier), current.image_from_bev], dim=1
            ),
            "has_image": torch.stack([*(frame.has_image for frame in earlier), current.has_image], dim=1),
        }
        if earlier:
            feed["previous_features"] = torch.stack([frame.image_features.tokens for frame in earlier])
        return feed

    def memory(
        self, prepared: PreparedFrame, memory: FeatureWindow | None, by_name: Mapping[str, Tensor]
    ) -> FeatureWindow:
        past = self._past(prepared, memory)
        if "image_features" not in by_name:
            return kept(past, len(past), -self.frames[0])
        features = FeatureMaps(by_name["image_features"], self.config.level_shapes)
        return kept([*past, FrameFeatures.of(prepared, features)], len(past), -self.frames[0])

    def _past(self, prepared: PreparedFrame, memory: FeatureWindow | None) -> list[FrameFeatures]:
        return [] if memory is None else memory.before(prepared.frame.stamp, -self.frames[0])

    @property
    def _features_shape(self) -> tuple[int, int, int]:
        cells = sum(height * width for height, width in self.config.level_shapes)
        return self.cameras, cells, self.config.channels


def _listed(frames: tuple[int, ...]) -> str:
    return ", ".join(map(str, frames))
