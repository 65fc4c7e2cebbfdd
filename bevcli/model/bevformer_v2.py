"""BEVFormerV2 (Yang et al. 2022): the BEV maps of a window of frames, each from its own images, fused into one.

There is no recurrence: every frame of the window is encoded in the current frame's BEV grid, without history.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from torch import Tensor

from bevcli.model.bev_fusion import BevFusion, BevFusionConfig
from bevcli.model.bevformer import BEVFormerBase, BEVFormerConfig, BEVFormerOutputs
from bevcli.model.deformable_attention import FeatureMaps
from bevcli.model.ego_motion import EgoMotionConfig

NO_EGO_MOTION = EgoMotionConfig(can_bus=False, shift=False, rotation=False)


@dataclass(frozen=True, kw_only=True)
class BEVFormerV2Config(BEVFormerConfig):
    """A whole BEVFormerV2. The neck may have more levels than there are level embeddings: those are for training only.

    Attributes:
        frames: the frames of the window, relative to the current one, in the order of fusion: [-1, 0] is the previous
            frame and the current one. Positive numbers are later frames (offline use).
        fusion: fuses the BEV maps of the window; unused where the window has only one frame.
        ego_motion: switched off; the poses enter by the projections of the window's frames.
    """

    frames: tuple[int, ...]
    fusion: BevFusionConfig = field(default_factory=BevFusionConfig)
    ego_motion: EgoMotionConfig = NO_EGO_MOTION

    def __post_init__(self) -> None:
        super().__post_init__()
        if 0 not in self.frames or list(self.frames) != sorted(set(self.frames)):
            raise ValueError("frames must be ascending, and hold 0, the current frame")
        if self.ego_motion.can_bus or self.ego_motion.shift or self.ego_motion.rotation:
            raise ValueError("ego_motion: can_bus, shift and rotation must be false: BEVFormerV2 has no recurrence")

    @property
    def past_frames(self) -> int:
        """How many frames before the current one the window reaches."""
        return -self.frames[0]

    @property
    def later_frames(self) -> int:
        """How many frames after the current one the window reaches."""
        return self.frames[-1]

    def _most_neck_levels(self) -> int:
        return self.neck.levels


@dataclass(frozen=True)
class WindowFrame:
    """One frame of the window of B sequences with N cameras.

    Attributes:
        image_features: tokens of the B·N images.
        image_from_bev: (B, N, 4, 4) float32, from the current frame's bev metres to pixels of this frame's images.
        has_image: (B, N) bool; a camera without an image sees no BEV cell.
        image_size: (height, width) of the network's input, pixels.
    """

    image_features: FeatureMaps
    image_from_bev: Tensor
    has_image: Tensor
    image_size: tuple[int, int]


class BEVFormerV2(BEVFormerBase):
    """The whole model: a window of frames."""

    config: BEVFormerV2Config

    def __init__(self, config: BEVFormerV2Config) -> None:
        super().__init__(config)
        grid, count = config.bev_grid, len(config.frames)
        self.fusion: BevFusion | None = None
        if count > 1:
            self.fusion = BevFusion(config.fusion, count, config.channels, (grid.rows, grid.columns))

    def forward(self, window: Sequence[WindowFrame | None]) -> BEVFormerOutputs:
        """One step.

        Args:
            window: the frames in the order of `config.frames`, None for one that does not exist, such as before the
                scene's first. Its BEV map is that of the nearest frame towards the current one.
        """
        return self.decode(self.bev_map(window))

    def bev_map(self, window: Sequence[WindowFrame | None]) -> Tensor:
        """The fused BEV map (B, Y·X, C): the part of `forward` before the decoder and the heads."""
        sources = fill_window(self.config.frames, [frame is not None for frame in window])
        current = self.config.frames.index(0)
        maps: dict[int, Tensor] = {}
        # One frame after the other: as a batch they would need the memory of all at once and, on a CPU, as much time.
        # The current frame is the last, so that observers of the encoder see it.
        for place in [*(place for place in sorted(set(sources)) if place != current), current]:
            frame = window[place]
            assert frame is not None
            maps[place] = self.encode(frame)
        if self.fusion is None:
            return maps[current]
        return self.fusion([maps[place] for place in sources])

    def encode(self, frame: WindowFrame) -> Tensor:
        """The BEV map (B, Y·X, C) of one frame's images, in the current frame's BEV grid."""
        return self.encoder(
            bev_query=self.bev_queries.embedding.expand(len(frame.has_image), -1, -1),
            position=self.bev_queries.position(),
            image_features=frame.image_features,
            hits=self.pillars(frame.image_from_bev, frame.image_size, frame.has_image),
        )


def fill_window(frames: Sequence[int], exists: Sequence[bool]) -> list[int]:
    """For each frame of the window, the place in the window of the frame whose BEV map it takes.

    That is its own, or, where it does not exist, that of the nearest existing frame towards the current one.

    Args:
        frames: frames of the window relative to the current one, ascending.
        exists: whether each of them exists; the current one, 0, does.
    """
    current = list(frames).index(0)
    sources = list(range(len(frames)))
    for place in (*range(current - 1, -1, -1), *range(current + 1, len(frames))):
        if not exists[place]:
            sources[place] = sources[place + (1 if place < current else -1)]
    return sources
