"""A trace: one frame through the model, with the intermediate results that the figures show."""

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from bevcli.errors import InputError
from bevcli.frame import Frame, Prediction, Sequence
from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.transforms import Array, inverse
from bevcli.inference.commands import read_commands
from bevcli.inference.preprocess import Preprocessor
from bevcli.inference.runner import Runner, RunnerState, StepOptions
from bevcli.model.config import ModelConfig
from bevcli.model.network import Network
from bevcli.model.step import ModelInputs, ModelOutputs, PreparedFrame
from bevcli.model.temporal_model import TemporalModel
from bevcli.registry import for_model
from bevcli.sequences.selection import scenes_of

RECENT = 4  # frames that the figure of the recurrence shows, the traced one included
DEFAULT_DISTANCE_M = 10.0  # of the default cell, ahead of the vehicle, where no box is


@dataclass(frozen=True)
class Trace:
    """One frame's way through the model. Batch axes of size 1 are removed.

    Attributes:
        config: of the model.
        recent: the last frames and their predictions, oldest first; the traced frame is the last one.
        prepared: the traced frame as the network's input.
        inputs: the same as a step of the model (B = 1).
        outputs: of the model (B = 1).
        feature_maps: the neck's maps, (N, C, H_l, W_l) per level.
        bev_embedding: (Y·X, C), the learned BEV queries before the can-bus embedding is added.
        position: (Y·X, C), the position embedding of the cells.
        layer_maps: (Y·X, C) per encoder layer, its output.
        aligned_history: (Y·X, C), the rotated history map; None without history.
        first_reference_points: (Q, 3), where the object queries start, 0 to 1 over the grid's ranges.
        visible: (N, Y·X, Z) bool, which pillar points each camera sees.
        cell: row and column of the BEV cell that the figures follow.
        attentions: to objects and lines by the attending part, of a model that has such parts; that of an object is
            of the one nearest to the cell.
    """

    config: ModelConfig
    recent: tuple[tuple[Frame, Prediction], ...]
    prepared: PreparedFrame
    inputs: ModelInputs
    outputs: ModelOutputs
    feature_maps: tuple[Tensor, ...]
    bev_embedding: Tensor
    position: Tensor
    layer_maps: tuple[Tensor, ...]
    aligned_history: Tensor | None
    first_reference_points: Tensor
    visible: Tensor
    cell: tuple[int, int]
    attentions: Mapping[str, Any]

    @property
    def frame(self) -> Frame:
        """The traced frame."""
        return self.recent[-1][0]

    @property
    def prediction(self) -> Prediction:
        """The prediction of the traced frame."""
        return self.recent[-1][1]

    @property
    def grid(self) -> BevGrid:
        """The model's BEV grid."""
        return self.config.bev_grid

    @property
    def extent_m(self) -> Array:
        """(2,) extent of the grid along x and y, metres."""
        return np.diff([self.grid.x_range_m, self.grid.y_range_m])[:, 0]

    @property
    def cell_index(self) -> int:
        """Index of the followed cell in Y·X."""
        return self.cell[0] * self.grid.columns + self.cell[1]

    @property
    def cell_center(self) -> Array:
        """(2,) x, y of the followed cell, metres, bev frame."""
        return np.asarray(self.grid.cell_centers()[self.cell])

    def cell_map(self, tokens: Tensor) -> np.ndarray:
        """Tokens (Y·X, C) -> array (Y, X, C) float32, rows from the smallest y."""
        return tokens.detach().float().cpu().numpy().reshape(self.grid.rows, self.grid.columns, -1)


def trace(
    model: TemporalModel,
    device: torch.device,
    sequence: Sequence,
    place: int,
    cell_xy: tuple[float, float] | None,
    command: str | None = None,
) -> Trace:
    """Runs the model over the frames of one scene up to a place, with its recurrent state, and traces the last one.

    model: the plain model, not a prepared one. place: index in `sequence.stamps`.
    cell_xy: x, y of the cell to follow, metres, bev frame; None takes the cell under the best box ahead of the
    vehicle. command: of the driver, or a file of commands, for a model that plans.
    Raises InputError when the cell lies outside the grid, when the frame has no image, for a model without figures, or
    for an unknown command.
    """
    if not next(iter(for_model("figures", type(model))), None):
        kind = model.config.architecture
        raise InputError(
            f"model {model.config.name} is a {kind}, which has no figures "
            f"(use tiny, small, base or demo; docs/bevformer.md explains {kind})"
        )
    cell = None if cell_xy is None else cell_at(cell_xy, model.config.bev_grid)
    runner = Runner(model, device, StepOptions(commands=read_commands(command, model.config)))
    preprocessor = Preprocessor(model.config)
    scene = next(places for places in scenes_of(sequence.stamps) if place in places)
    places = range(scene[0], place)
    state: RunnerState[Any] | None = None
    recent: list[tuple[Frame, Prediction]] = []
    for frame, prediction, state in runner.run(sequence, places, preprocessor):  # noqa: B007
        recent = [*recent, (frame, prediction)][-RECENT + 1 :]
    prepared = preprocessor(sequence.load(place))
    if not prepared.frame.images:
        raise InputError(f"frame {prepared.frame.stamp.index} has no image: choose another frame")
    with torch.inference_mode():
        if cell is None:
            _, prediction = runner.step(state, prepared)
            cell = cell_at(_default_cell(prepared.frame, prediction), model.config.bev_grid)
        return _traced_step(runner, state, prepared, recent, cell)


def cell_at(cell_xy: tuple[float, float], grid: BevGrid) -> tuple[int, int]:
    """Row and column of the cell at x, y (metres, bev frame). Raises InputError outside the grid."""
    row, column = (int(number) for number in grid.cell_of(cell_xy))
    if row < 0:
        (x0, x1), (y0, y1) = grid.x_range_m, grid.y_range_m
        raise InputError(
            f"cell {cell_xy[0]:g},{cell_xy[1]:g} is outside the BEV grid (x {x0:g} to {x1:g} m, y {y0:g} to {y1:g} m)"
        )
    return row, column


def _default_cell(frame: Frame, prediction: Prediction) -> tuple[float, float]:
    """The centre of the best-scored box ahead of the vehicle; without one, a place ahead of the vehicle."""
    boxes = prediction.boxes
    ahead = prediction.boxes_ego.centers[:, 0] > 0
    inside = (prediction.grid.cell_of(boxes.centers[:, :2]) >= 0).all(-1)
    chosen = np.flatnonzero(ahead & inside)
    x, y = (inverse(frame.rig.ego_from_bev) @ [DEFAULT_DISTANCE_M, 0.0, 0.0, 1.0])[:2]
    if boxes.scores is not None and len(chosen) and boxes.scores[chosen[0]] > 0.25:
        x, y = boxes.centers[chosen[0], :2]
    return float(x), float(y)


def _traced_step(
    runner: Runner,
    state: RunnerState[Any] | None,
    prepared: PreparedFrame,
    recent: list[tuple[Frame, Prediction]],
    cell: tuple[int, int],
) -> Trace:
    model, config, grid = runner.model, runner.config, runner.config.bev_grid
    assert isinstance(model, Network)
    x, y = grid.cell_centers()[cell]
    runner.options = replace(runner.options, ask_attention=True, probes=((float(x), float(y)),))
    with _seen(model, model.neck, model.encoder, *model.encoder.layers) as (arguments, outputs):
        _, prediction = runner.step(state, prepared)
    inputs: ModelInputs = arguments[model][0][0].to(runner.device)
    history = arguments[model.encoder][1]["history"]
    attentions: Mapping[str, Any] = {}
    for attend in for_model("scene_attentions", type(model)):
        attentions = attend(model, outputs[model], (float(x), float(y)))
    return Trace(
        config=config,
        recent=(*recent, (prepared.frame, prediction)),
        prepared=prepared,
        inputs=inputs,
        outputs=outputs[model],
        feature_maps=tuple(outputs[model.neck]),
        bev_embedding=model.bev_queries.embedding,
        position=model.bev_queries.position(),
        layer_maps=tuple(outputs[layer][0] for layer in model.encoder.layers),
        aligned_history=None if history is None else history[0],
        first_reference_points=model.decoder.object_queries(batch=1).reference_points[0],
        visible=model.pillars.project(inputs.image_from_bev, inputs.image_size, inputs.has_image).visible[0],
        cell=cell,
        attentions=attentions,
    )


@contextmanager
def _seen(*modules: nn.Module) -> Iterator[tuple[dict, dict]]:
    """Two dicts that are filled with each module's arguments (positional, by name) and output inside the context."""
    arguments: dict = {}
    outputs: dict = {}

    def keep(module: nn.Module, positional: object, by_name: object, output: object) -> None:
        arguments[module], outputs[module] = (positional, by_name), output

    with ExitStack() as hooks:
        for module in modules:
            hooks.enter_context(module.register_forward_hook(keep, with_kwargs=True))
        yield arguments, outputs
