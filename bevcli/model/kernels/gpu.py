"""A model prepared for inference on a GPU: parts with fewer passes over the memory, and CUDA graphs.

Nothing waits for the GPU. A graph is one launch of the device part of a step by the CPU in the place of hundreds.
"""

import logging
import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from bevcli.geometry.bev_grid import BevGrid
from bevcli.jit import njit
from bevcli.model import segmentation, upload
from bevcli.model.deformable_attention import FeatureMaps
from bevcli.model.image_tokens import CalibrationEmbedding, ImageTokens
from bevcli.model.kernels import rounded_products
from bevcli.model.kernels.choose import KeptCalibrationEmbedding, LastCall, has_triton, triton_kernels
from bevcli.model.kernels.compiled import in_threads
from bevcli.model.pillar_projection import MIN_DEPTH, PillarHits, Pillars
from bevcli.model.resnet import Bottleneck, ResNet
from bevcli.model.temporal_model import TemporalModel

PLACES = 128  # numbers of padded hits are multiples of this


def gpu_kinds(device: torch.device) -> dict[type[nn.Module], type[nn.Module]]:
    """The classes that take the place of plain ones on a GPU, beside those of `choose_kernels`."""
    kinds: dict[type[nn.Module], type[nn.Module]] = {
        Pillars: KeptPaddedPillars,
        CalibrationEmbedding: KeptCalibrationEmbedding,
    }
    if device.type == "cuda":
        kinds |= {
            ImageTokens: TokensInOnePass,
            segmentation.MaskDecoderLayer: AttentionByProducts,
            segmentation.SegmentationHead: MapOnDevice,
        }
        kinds |= {Bottleneck: FusedBottleneck} if torch.version.hip is None else {}  # cuDNN is NVIDIA's
    if has_triton(device):
        kinds |= {ResNet: triton_kernels()[1].FusedStem}
    return kinds


def finish_gpu_parts(network: TemporalModel, points_on_cpu: Mapping[str, Tensor]) -> None:
    """Gives the exchanged parts, in place, what the plain ones do not know. points_on_cpu: of the pillars, by name."""
    for name, module in network.named_modules():
        if isinstance(module, KeptPaddedPillars):
            module.points_on_cpu, module.sizes = points_on_cpu[name], {}
        if isinstance(module, FusedBottleneck):
            module.fuse()
        if isinstance(module, MapOnDevice):
            module.config, module.grid = network.config.segmentation, network.config.bev_grid


class FusedBottleneck(Bottleneck):
    """A `Bottleneck` with folded batch norms: cuDNN adds bias and shortcut, and applies ReLU, at once."""

    def fuse(self) -> None:
        """Moves the bias of the shortcut's convolution into the last one, in place, as both are added to the result."""
        if isinstance(self.downsample, nn.Sequential):
            shortcut = self.downsample[0]
            assert isinstance(shortcut, nn.Conv2d)
            assert shortcut.bias is not None
            assert self.conv3.bias is not None
            self.conv3.bias = nn.Parameter(self.conv3.bias + shortcut.bias, requires_grad=False)
            shortcut.bias = None

    def forward(self, x: Tensor) -> Tensor:
        """As `Bottleneck.forward`."""
        y = convolution_with_relu(self.conv1, x)
        y = convolution_with_relu(self.conv2, y)
        return convolution_with_relu(self.conv3, y, self.downsample(x))


def convolution_with_relu(convolution: nn.Module, x: Tensor, shortcut: Tensor | None = None) -> Tensor:
    """ReLU of the convolution of x plus the shortcut, which has the shape of the result."""
    if not isinstance(convolution, nn.Conv2d):
        assert shortcut is None
        result: Tensor = convolution(x)
        return result.relu_()
    assert not isinstance(convolution.padding, str)
    rest = convolution.stride, convolution.padding, convolution.dilation, convolution.groups
    if shortcut is None:
        return torch.cudnn_convolution_relu(x, convolution.weight, convolution.bias, *rest)
    return torch.cudnn_convolution_add_relu(x, convolution.weight, shortcut, 1.0, convolution.bias, *rest)


class TokensInOnePass(ImageTokens):
    """`ImageTokens`: each level is read once, and written to its place with both embeddings added."""

    def forward(self, maps: Sequence[Tensor], camera_index: Tensor) -> FeatureMaps:
        """As `ImageTokens.forward`."""
        images, channels = maps[0].shape[:2]
        levels = [x.flatten(2).transpose(1, 2) for x in maps]  # (B·N, S_l, C)
        tokens = maps[0].new_empty(images, sum(x.shape[1] for x in levels), channels)
        embedding = self.level_embedding[: len(maps), None]  # (L, 1, C)
        if self.camera_embedding is not None:
            of_cameras = self.camera_embedding[camera_index].reshape(-1, channels)  # (N, C) or (B·N, C)
            embedding = embedding + of_cameras.repeat(images // len(of_cameras), 1)  # (L, B·N, C)
        parts = tokens.split([x.shape[1] for x in levels], dim=1)
        for level, output, added in zip(levels, parts, embedding, strict=True):
            torch.add(level, added[:, None], out=output)
        return FeatureMaps(tokens, tuple((x.shape[-2], x.shape[-1]) for x in maps))


class AttentionByProducts(segmentation.MaskDecoderLayer):
    """A `MaskDecoderLayer` with its table of attention weights in memory.

    With few queries and many keys this is faster: PyTorch's kernel gives each block of queries to one multiprocessor.
    """

    def attend(self, queries: Tensor, keys: Tensor, values: Tensor) -> Tensor:
        """As `MaskDecoderLayer.attend`."""
        scores = (queries * queries.shape[-1] ** -0.5) @ keys.transpose(-1, -2)
        return scores.softmax(-1) @ values


class MapOnDevice(segmentation.SegmentationHead):
    """A `SegmentationHead`: the GPU merges the masks, so that neither masks are copied nor the CPU does it.

    Attributes:
        config: of the head.
        grid: of the BEV map.
    """

    config: segmentation.SegmentationConfig
    grid: BevGrid

    def forward(self, bev: Tensor, position: Tensor) -> segmentation.SegmentationOutputs:
        """As `SegmentationHead.forward`, for a batch of one, with map layers."""
        outputs = super().forward(bev, position)
        masks, classes = outputs.mask_logits[-1, 0].float(), outputs.class_logits[-1, 0].float()
        return replace(outputs, map_layers=segmentation.map_layers(masks, classes, self.config, self.grid))


class PillarsOfCpu(Pillars):
    """`Pillars` on a GPU, for training: the CPU finds the hits, so that it never waits for the GPU to count them.

    Attributes:
        points_on_cpu: the points, on the CPU.
    """

    points_on_cpu: Tensor

    def forward(self, image_from_bev: Tensor, image_size: tuple[int, int], has_image: Tensor) -> PillarHits:
        """As `Pillars.forward`; the hits are on the device."""
        hits = hits_on_cpu(image_from_bev, self.points_on_cpu, image_size, has_image)
        return upload.upload_together(hits, self.points.device)


class PaddedPillars(PillarsOfCpu):
    """`Pillars` on a GPU, for inference: the tensors of the hits keep their shapes too.

    Attributes:
        sizes: by number of cameras and size of the images, the number of hits of each camera, added ones included.
    """

    sizes: dict[tuple[int, tuple[int, int]], tuple[int, ...]]

    def forward(self, image_from_bev: Tensor, image_size: tuple[int, int], has_image: Tensor) -> PillarHits:
        """As `Pillars.forward`; the hits are on the device."""
        hits = hits_on_cpu(image_from_bev, self.points_on_cpu, image_size, has_image)
        key = len(hits.hits_per_camera), image_size
        sizes = self.sizes.get(key, (0,) * key[0])
        if any(count > size for count, size in zip(hits.hits_per_camera, sizes, strict=True)):
            roomy = (min(len(self.points), _roomy(count)) for count in hits.hits_per_camera)
            sizes = self.sizes[key] = tuple(map(max, roomy, sizes))
        return upload.upload_together(hits.padded(sizes), self.points.device)


def hits_on_cpu(image_from_bev: Tensor, points: Tensor, image_size: tuple[int, int], has_image: Tensor) -> PillarHits:
    """`find_hits` of `project_pillars`, by a compiled loop that keeps nothing of the points that no camera sees.

    points: (Y·X, Z, 3) on the CPU; other arguments as for `project_pillars`.
    """
    batch, cameras = has_image.shape
    (total, heights, _), images = points.shape, batch * cameras
    cells = np.empty((images, total), dtype=np.int64)
    reference_points = np.empty((images, total, heights, 2), dtype=np.float32)
    counts = np.zeros(images, dtype=np.int64)
    matrices = image_from_bev.float().cpu().flatten(0, 1).contiguous().numpy()
    size = np.asarray(image_size, dtype=np.float32)
    read = matrices, points.float().contiguous().numpy(), has_image.cpu().flatten().numpy(), size
    written = cells, reference_points, counts
    in_threads(partial(find_hits, *read, np.float32(MIN_DEPTH), *written), images, min_range=1)
    cells_of_images = [cells[image, :count] + image // cameras * total for image, count in enumerate(counts)]
    cell = np.concatenate(cells_of_images)
    return PillarHits(
        cell=torch.from_numpy(cell),
        reference_points=torch.from_numpy(
            np.concatenate([reference_points[image, :count] for image, count in enumerate(counts)])
        ),
        hits_per_camera=tuple(counts.tolist()),
        cameras_per_cell=torch.from_numpy(np.bincount(cell, minlength=batch * total)),
    )


@njit(nogil=True, error_model="numpy")
def find_hits(images_from_bev, points, has_image, image_size, min_depth, cells, reference_points, counts, begin, end):  # type: ignore[no-untyped-def]
    """Writes the cells that cameras begin to end - 1 see, and the points of their pillars, in the order of the cells.

    images_from_bev: (G, 4, 4) float32. points: (Y·X, Z, 3) float32. has_image: (G,) bool. image_size: (2,) float32
    height, width. cells: (G, Y·X) int64. reference_points: (G, Y·X, Z, 2) float32. counts: (G,) int64, of the hits.
    """
    zero, one, height, width = np.float32(0), np.float32(1), image_size[0], image_size[1]
    for camera in range(begin, end):
        matrix, count = images_from_bev[camera], 0
        for cell in range(len(points) if has_image[camera] else 0):
            is_seen = False
            for point in range(points.shape[1]):
                x, y, z = points[cell, point, 0], points[cell, point, 1], points[cell, point, 2]
                u = matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z + matrix[0, 3]
                v = matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z + matrix[1, 3]
                depth = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z + matrix[2, 3]
                divisor = max(depth, min_depth)
                column, row = u / divisor / width, v / divisor / height
                reference_points[camera, count, point, 0], reference_points[camera, count, point, 1] = column, row
                inside = (column > zero) & (column < one) & (row > zero) & (row < one)
                is_seen |= inside & (depth > min_depth)
            if is_seen:
                cells[camera, count] = cell
                count += 1
        counts[camera] = count


def _roomy(count: int) -> int:
    """A number of places for about `count` hits: the projections of a rig differ a little from frame to frame."""
    return -(-count * 9 // 8 // PLACES) * PLACES


class KeptPaddedPillars(LastCall, PaddedPillars):
    """`KeptPillars` for a GPU."""


KEPT_GRAPHS = 8  # of one function: for other numbers and sizes of images, with and without history
Function = Callable[..., Any]


class CudaGraph:
    """One captured call of a function, with input and output tensors of its own that every replay uses again."""

    def __init__(self, function: Function, arguments: tuple[Any, ...], device: torch.device, pool: Any) -> None:
        """Captures the call; tensors on the CPU are uploaded. pool: memory that all graphs of a function share, as
        never two of them run at once.

        Raises RuntimeError where an operation cannot be captured, such as a wait for the GPU.
        """
        self._sources = [tensor for _, tensor in upload.tensors_in(arguments)]
        small = [tensor for tensor in self._sources if tensor.device.type == "cpu"]
        self._uploaded = upload.upload(upload.packed(small), device) if small else None
        of_cpu = iter([] if self._uploaded is None else upload.unpacked(self._uploaded, small))
        self._inputs = [next(of_cpu) if x.device.type == "cpu" else x.clone() for x in self._sources]
        inputs = upload.exchanged(arguments, iter(self._inputs))
        with torch.cuda.device(device):
            stream = torch.cuda.Stream(device)
            stream.wait_stream(torch.cuda.current_stream(device))
            with torch.cuda.stream(stream):
                function(*inputs)  # libraries make their workspaces for this stream
            torch.cuda.current_stream(device).wait_stream(stream)
            self._graph = torch.cuda.CUDAGraph()
            # Other threads allocate and copy meanwhile: the one that uploads images, and those of other runs.
            with torch.cuda.graph(self._graph, pool=pool, stream=stream, capture_error_mode="thread_local"):
                self._outputs = function(*inputs)

    def replay(self, arguments: tuple[Any, ...]) -> Any:
        """The results for other arguments of the same shapes, in new memory."""
        small = []
        for index, (_, tensor) in enumerate(upload.tensors_in(arguments)):
            if tensor.device.type == "cpu":
                small.append(tensor)
            elif tensor is not self._sources[index]:  # hits of a rig stay the same for many frames
                self._inputs[index].copy_(tensor, non_blocking=True)
                self._sources[index] = tensor
        if self._uploaded is not None:
            self._uploaded.copy_(upload.pinned(upload.packed(small)), non_blocking=True)
        self._graph.replay()
        return upload.exchanged(self._outputs, (tensor.clone() for _, tensor in upload.tensors_in(self._outputs)))


class Captured:
    """Takes the place of a method that is a pure function of tensors on a CUDA GPU.

    The first call with arguments of some shapes computes as ever, which compiles kernels and makes tables. The second
    one captures a CUDA graph, which is replayed from then on. Where submodules are observed by hooks, or a capture
    has failed, nothing is replayed.

    Attributes:
        graphs: by shapes of the arguments, None before the second call; the last used at the end.
        failure: of a capture, after which there are no graphs.
    """

    def __init__(self, function: Function, model: nn.Module, device: torch.device, *, rounds: bool) -> None:
        """function: a method of the model, which is complete. rounds: see `rounded_products`."""
        self._function, self._device, self._rounds = function, device, rounds
        parts = [module for module in model.modules() if module is not model]
        # PyTorch does not tell by a public name whether a module has hooks.
        hooks = [hooks for module in parts for hooks in (module._forward_hooks, module._forward_pre_hooks)]
        self._no_hooks, self._own = [kind for kind in hooks if not kind], [kind for kind in hooks if kind]
        self._own_hooks = sum(map(len, self._own))
        self.graphs: OrderedDict[Any, CudaGraph | None] = OrderedDict()
        self._pool: Any = None
        self._lock = threading.Lock()  # runs in several threads share the inputs of a graph
        self.failure: BaseException | None = None

    def __call__(self, *arguments: Any) -> Any:
        """As the method itself. Arguments may be nested tuples and frozen dataclasses; tensors must not change."""
        with torch.inference_mode():
            if self.failure is None and not self._is_observed():
                with self._lock:
                    graph = self._graph_for(arguments)
                    if graph is not None:
                        return graph.replay(arguments)
            with rounded_products("cuda", enabled=self._rounds):
                return self._function(*arguments)

    def _graph_for(self, arguments: tuple[Any, ...]) -> CudaGraph | None:
        """The graph for arguments of these shapes; None where they come for the first time or cannot be captured."""
        key = upload.exchanged(
            arguments, ((tuple(x.shape), x.dtype, x.device) for _, x in upload.tensors_in(arguments))
        )
        if key not in self.graphs:
            self.graphs[key] = None
            if len(self.graphs) > KEPT_GRAPHS:
                self.graphs.popitem(last=False)
            return None
        self.graphs.move_to_end(key)
        if self.graphs[key] is None:
            self.graphs[key] = self._capture(arguments)
        return self.graphs[key]

    def _capture(self, arguments: tuple[Any, ...]) -> CudaGraph | None:
        try:
            if self._pool is None:
                self._pool = torch.cuda.graph_pool_handle()
            with rounded_products("cuda", enabled=self._rounds):
                return CudaGraph(self._function, arguments, self._device, self._pool)
        except Exception as error:  # whatever a driver, a library or a kernel raises: the model runs without a graph
            self.failure = error
            self.graphs.clear()
            reason = " ".join(str(error).split())[:200]
            logging.getLogger("bevcli").warning("no CUDA graph could be captured, steps take longer: %s", reason)
            return None

    def _is_observed(self) -> bool:
        return any(self._no_hooks) or sum(map(len, self._own)) != self._own_hooks
