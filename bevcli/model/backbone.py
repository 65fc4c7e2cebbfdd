"""The image backbone: what a model, training and the faster kernels ask of one."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import ClassVar

from torch import Tensor, nn

from bevcli.model.image_boxes import ImageBoxes


class Backbone(nn.Module):
    """Images to feature maps of the configured output stages.

    A subclass makes the `stages` and has a `stem`, or overrides `forward`; no stage can then be frozen in a training.
    A batch norm is folded into the convolution before it in an `nn.Sequential`, and where a module states them:

        batch_norms = {"conv1": "bn1"}  # the convolution, and the batch norm that alone takes its result

    Everything else in a backbone is computed as it is written.

    Attributes:
        stem_parts: names of the modules of the stem.
        batch_norms: see above.
        output_stages: the stages, from 1, whose maps are returned.
        stages: each takes the map of the one before, the first that of the stem; up to the last whose map is returned.
        frozen_stages: so many first stages, and the stem, keep their weights and statistics in a training.
        frozen_maps: computes the maps of the first stages in place of the stem and these stages, during a training
            that keeps their weights.
    """

    stem_parts: ClassVar[tuple[str, ...]] = ()
    batch_norms: ClassVar[Mapping[str, str]] = {}
    output_stages: tuple[int, ...]
    stages: nn.ModuleList
    frozen_stages: int = 0
    frozen_maps: Callable[[Tensor], list[Tensor]] | None = None

    def stem(self, images: Tensor) -> Tensor:
        """images: (B, 3, H, W) -> the input of the first stage."""
        raise NotImplementedError

    def freeze(self, stages: int) -> None:
        """Keeps the stem and so many first stages as they are in a training; with 0 nothing is frozen."""
        self.frozen_stages = stages
        for part in self._frozen_parts():
            part.requires_grad_(False)

    def train(self, mode: bool = True) -> "Backbone":
        """As `nn.Module.train`; batch norms of frozen parts stay in evaluation mode."""
        super().train(mode)
        for part in self._frozen_parts():
            part.eval()
        return self

    def _frozen_parts(self) -> Iterator[nn.Module]:
        if self.frozen_stages:
            yield from map(self.get_submodule, self.stem_parts)
            yield from self.stages[: self.frozen_stages]

    def forward(self, images: Tensor) -> list[Tensor]:
        """images: (B, 3, H, W), H and W multiples of 32 -> (B, C_s, H / stride, W / stride) for each output stage."""
        maps: list[Tensor] = []
        if self.frozen_maps is not None:
            maps = self.frozen_maps(images)
        x = maps[-1] if maps else self.stem(images)
        for blocks in self.stages[len(maps) :]:
            x = blocks(x)
            maps.append(x)
        return [maps[stage - 1] for stage in self.output_stages]

    def image_boxes(self, maps: Sequence[Tensor], has_image: Tensor, sizes: Tensor | None = None) -> ImageBoxes | None:
        """The boxes in the images that the maps of `forward` tell, of a backbone that is a detector; else None.

        maps: for B·N images. has_image: (B, N) bool; the boxes of a camera without an image have the score 0.
        sizes: (B, N, 2) width and height of each image without its padding, pixels; default: with it.
        """
        return None


class Stage(nn.Sequential):
    """Blocks in a row. Nobody else reads what lies between two of them: a block may write its result over its input."""
