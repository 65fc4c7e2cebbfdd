"""Boxes in the images, of a backbone that is a detector: the decoding of its maps, with results of fixed sizes.

Pixels are those of the network's input; the centre of its first pixel is (0, 0), as in all projections. A box reaches
from the outer edge of its first pixels to that of its last ones: the whole image is (-0.5, -0.5, W - 0.5, H - 0.5).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

IMAGE_CLASSES = ("person", "bicycle", "car", "motorcycle", "bus", "truck", "traffic light")  # names of COCO
COCO_INDICES = (0, 1, 2, 3, 5, 7, 9)  # of them among COCO's 80 classes
BINS = 11  # the distance from a cell to a side of its box is the mean of 0 to 10 strides
CANDIDATES = 256  # of an image, the best ones, among which doubles are removed
ROUNDS = 8  # of the removal: exact unless nine boxes remove each other in a row


@dataclass(frozen=True)
class ImageBoxes:
    """The K best boxes in each of B·N images, by falling score; those with the score 0 are none.

    Attributes:
        boxes: (B, N, K, 4) x0, y0, x1, y1, pixels of the network's input, clipped to the image.
        scores: (B, N, K) 0 to 1.
        labels: (B, N, K) int64, index into `IMAGE_CLASSES`.
        logits: (B, N, K, 7) of all classes of `IMAGE_CLASSES` at the cell of the box.
        features: (B, N, K, C) of the map at this cell.
        cells: (B, N, K, 3) x and y of the centre of this cell, and its stride, pixels of the network's input.
    """

    boxes: Tensor
    scores: Tensor
    labels: Tensor
    logits: Tensor
    features: Tensor
    cells: Tensor

    @property
    def by_name(self) -> dict[str, Tensor]:
        """The outputs of an exported file."""
        return {"image_boxes": self.boxes, "image_scores": self.scores, "image_labels": self.labels}

    @classmethod
    def of_names(cls, tensors: Mapping[str, Tensor]) -> "ImageBoxes | None":
        """The inverse of `by_name`, without numbers of cells; None where there are no boxes in images."""
        if "image_boxes" not in tensors:
            return None
        boxes, scores, labels = (tensors[name] for name in ("image_boxes", "image_scores", "image_labels"))
        none = boxes.new_zeros(*scores.shape, 0)
        return cls(boxes, scores, labels, none, none, none)


def best_image_boxes(
    maps: Sequence[Tensor],
    predictions: Sequence[Tensor],
    strides: Sequence[int],
    has_image: Tensor,
    sizes: Tensor | None = None,
    most: int = 48,
    overlap: float = 0.6,
) -> ImageBoxes:
    """The best boxes of each image, of two boxes of a class at one place the better one.

    Args:
        maps: (B·N, C, H_l, W_l) each.
        predictions: (B·N, 7 + 4 · BINS, H_l, W_l): class logits, and logits of the distances to the four sides.
        strides: of the maps.
        has_image: (B, N) bool; cameras without an image have no boxes.
        sizes: (B, N, 2) width and height of the images within their padding, to which boxes are clipped; default:
            those with the padding.
        most: K.
        overlap: intersection over union of doubles.
    """
    classes, grid = len(IMAGE_CLASSES), cells_of(maps, strides)
    numbers = torch.cat([of_cells(x) for x in predictions], 1).float()  # (B·N, cells, 7 + 4 · BINS)
    every = numbers[..., :classes].flatten(1)
    best, index = every.topk(min(CANDIDATES, every.shape[1]))
    cell, labels = index // classes, index % classes
    numbers, places = rows(numbers, cell), grid[cell]
    sides = distances(numbers[..., classes:]) * places[..., 2:]
    boxes = torch.cat([places[..., :2] - sides[..., :2], places[..., :2] + sides[..., 2:]], -1)
    scores = best.sigmoid() * without_doubles(boxes, labels, overlap) * has_image.flatten()[:, None]
    scores, chosen = scores.topk(min(most, scores.shape[1]))
    size = sizes.flatten(0, 1)[:, None] if sizes is not None else strides[0] * grid.new_tensor(maps[0].shape[:1:-1])
    limit = size.to(boxes.dtype).repeat(*(1,) * (size.ndim - 1), 2) - 0.5
    boxes = torch.minimum(rows(boxes, chosen), limit).clamp(min=-0.5)
    cell = cell.gather(1, chosen)
    found = (
        *(boxes, scores, labels.gather(1, chosen), rows(numbers, chosen)[..., :classes]),
        *(features_at(maps, cell), grid[cell]),
    )
    return ImageBoxes(*(x.unflatten(0, has_image.shape) for x in found))


def distances(logits: Tensor) -> Tensor:
    """(..., 4 · BINS) -> (..., 4) from the centre of a cell to the left, upper, right and lower side, in its strides.

    Each is the mean of 0 to 10 strides under the distribution of its logits (generalised focal loss, Li et al. 2020).
    """
    bins = torch.arange(BINS, device=logits.device, dtype=logits.dtype)
    return (logits.unflatten(-1, (4, BINS)).softmax(-1) * bins).sum(-1)


def without_doubles(boxes: Tensor, labels: Tensor, overlap: float) -> Tensor:
    """1 for each box that stays, 0 for the others: greedy non-maximum suppression within a class, as matrix products.

    A box is removed by a better one that stays. After the n-th round this holds for all boxes with less than n better
    ones in a row that remove each other (cluster NMS, Zheng et al. 2020).

    boxes: (B, K, 4) by falling score. labels: (B, K). Returns (B, K).
    """
    low = torch.maximum(boxes[:, :, None, :2], boxes[:, None, :, :2])
    high = torch.minimum(boxes[:, :, None, 2:], boxes[:, None, :, 2:])
    shared = (high - low).clamp(min=0).prod(-1)
    area = (boxes[..., 2:] - boxes[..., :2]).prod(-1)
    rank = torch.arange(boxes.shape[1], device=boxes.device)
    doubles = shared > overlap * (area[:, :, None] + area[:, None] - shared)
    removes = (doubles & (labels[:, :, None] == labels[:, None]) & (rank[:, None] < rank)).to(boxes.dtype)
    stay = torch.ones_like(area)
    for _ in range(ROUNDS):
        stay = ((stay[:, None] @ removes)[:, 0] == 0).to(boxes.dtype)
    return stay


def cells_of(maps: Sequence[Tensor], strides: Sequence[int]) -> Tensor:
    """(cells, 3) x and y of the centres of the cells of all maps, row by row, and their strides, pixels."""
    grids = []
    for x, stride in zip(maps, strides, strict=True):
        row, column = (torch.arange(size, device=x.device, dtype=torch.float32) for size in x.shape[-2:])
        y, x = torch.meshgrid(stride * (row + 0.5) - 0.5, stride * (column + 0.5) - 0.5, indexing="ij")
        grids.append(torch.stack([x, y, torch.full_like(x, stride)], -1).flatten(0, 1))
    return torch.cat(grids)


def features_at(maps: Sequence[Tensor], cells: Tensor) -> Tensor:
    """The features at some cells. maps: (B, C, H_l, W_l). cells: (B, K), index among all maps' -> (B, K, C) float32."""
    found, first = torch.zeros((), device=cells.device), 0
    for x in maps:
        count = x.shape[-2] * x.shape[-1]
        is_here = (cells >= first) & (cells < first + count)
        here = rows(of_cells(x), (cells - first).clamp(0, count - 1)).float()
        found, first = found + here * is_here[..., None], first + count
    return found


def of_cells(x: Tensor) -> Tensor:
    """(B, C, H, W) -> (B, H·W, C)."""
    return x.flatten(2).transpose(1, 2)


def rows(x: Tensor, index: Tensor) -> Tensor:
    """x: (B, M, C), index: (B, K) -> (B, K, C)."""
    return x.gather(1, index[..., None].expand(-1, -1, x.shape[-1]))
