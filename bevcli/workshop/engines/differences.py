"""`check_exported`: runs a drive through an exported file and through our model, and compares what they compute."""

import contextlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from bevcli.frame import Sequence
from bevcli.inference.load import Model
from bevcli.inference.preprocess import Preprocessor
from bevcli.inference.runner import Runner, RunnerState
from bevcli.model.prepare import prepare_for_inference
from bevcli.model.segmentation import SegmentationOutputs
from bevcli.model.step import ModelOutputs, PreparedFrame
from bevcli.model.temporal_model import TemporalModel
from bevcli.workshop.engines.engine import load_exported

NEAR_M = 0.1
CENTER = (0, 1, 4)  # columns of box codes


@dataclass(frozen=True)
class FrameDifference:
    """The largest differences between the two runs in one frame.

    Attributes:
        frame: index of the frame.
        bev: of the BEV map.
        logits: of the class logits.
        box_m: of the box centres, metres.
        near: share of the box centres that differ by at most 0.1 m, 0 to 1.
        code: of the other numbers of the box codes: logarithms of sizes, sine and cosine, m/s.
        masks: of the probabilities of the map's cells; 0 without segmentation.
        further: of each output that only this model has, by its name in the file.
    """

    frame: int
    bev: float
    logits: float
    box_m: float
    near: float
    code: float
    masks: float
    further: Mapping[str, float] = field(default_factory=dict)


def check_exported(
    file: Path, reference: Model | Path, sequence: Sequence, engine: str = "onnxruntime"
) -> Iterator[FrameDifference]:
    """Runs both over a drive, each with the state of its own last frame, and yields the differences frame by frame.

    Args:
        file: an exported file of the model.
        reference: the model, which runs on the CPU in float32; or another exported file of it.
        sequence: the drive. Frames without any image are left out.
        engine: the program that runs the file.

    Raises WeightsError where the file cannot be loaded, InputError where a frame cannot be read.
    """
    network: TemporalModel
    if isinstance(reference, Path):
        network = load_exported(reference, engine)
    else:
        network = prepare_for_inference(reference.network, torch.device("cpu"))
    exported = load_exported(file, engine)
    preprocess = Preprocessor(exported.config)  # of the exported file, whose images have one size
    frames = (preprocess(sequence.load(index)) for index in range(len(sequence.stamps)))
    for prepared, ours, theirs in paired_steps(network, exported, frames):
        yield compare_outputs(prepared.frame.stamp.index, ours, theirs)


def paired_steps(
    one: TemporalModel, other: TemporalModel, frames: Iterable[PreparedFrame]
) -> Iterator[tuple[PreparedFrame, ModelOutputs, ModelOutputs]]:
    """Step two versions of a model on the CPU over the same frames, each with its own history.

    Yields each frame that has an image, and the outputs of both.
    """
    runners = [Runner(network, torch.device("cpu")) for network in (one, other)]
    states: list[RunnerState[Any]] = [RunnerState(), RunnerState()]
    outputs: dict[Runner, ModelOutputs] = {}  # of the last step of each
    with contextlib.ExitStack() as hooks:
        for runner in runners:
            hook = runner.model.register_forward_hook(lambda *call, of=runner: outputs.update({of: call[2]}))
            hooks.enter_context(hook)
        for prepared in frames:
            if prepared.frame.images:
                states = [runner.step(state, prepared)[0] for runner, state in zip(runners, states, strict=True)]
                yield prepared, outputs[runners[0]], outputs[runners[1]]


def compare_outputs(frame: int, ours: ModelOutputs, theirs: ModelOutputs) -> FrameDifference:
    """The largest differences of the last layers and the BEV map of a frame."""
    codes = (ours.box_codes[-1] - theirs.box_codes[-1]).abs()
    distances = codes[..., CENTER].norm(dim=-1)
    others = [index for index in range(codes.shape[-1]) if index not in CENTER]
    probabilities = [
        _probabilities(outputs.segmentation) for outputs in (ours, theirs) if outputs.segmentation is not None
    ]
    return FrameDifference(
        frame=frame,
        bev=_largest(ours.bev, theirs.bev),
        logits=_largest(ours.class_logits[-1], theirs.class_logits[-1]),
        box_m=distances.max().item(),
        near=(distances <= NEAR_M).float().mean().item(),
        code=codes[..., others].max().item(),
        masks=_largest(*probabilities) if len(probabilities) == 2 else 0.0,
        further={name: _largest(tensor, theirs.further[name]) for name, tensor in ours.further.items()},
    )


def difference_lines(differences: list[FrameDifference]) -> list[str]:
    """A table, one line a frame, and the largest of each column; of the share of boxes, the smallest."""
    columns = ("bev", "logits", "box_m", "code", "masks")
    numbers = [(*(getattr(row, name) for name in columns), *row.further.values()) for row in differences]
    written = [[f"{number:.1e}" for number in row] for row in (*numbers, map(max, zip(*numbers, strict=True)))]
    near = [row.near for row in differences]
    firsts = [*((str(row.frame), f"{row.near:.1%}") for row in differences), ("largest", f"{min(near):.1%}")]
    heads = ("frame", "in 0.1 m", "BEV map", "logits", "centres m", "codes", "masks", *differences[0].further)
    rows = [heads, *((*first, *row) for first, row in zip(firsts, written, strict=True))]
    widths = [max(9, len(head)) for head in heads]
    return ["  ".join(text.rjust(width) for text, width in zip(row, widths, strict=True)) for row in rows]


def _probabilities(segmentation: SegmentationOutputs) -> Tensor:
    return segmentation.mask_logits[-1].sigmoid() * segmentation.class_logits[-1].sigmoid()[..., None]


def _largest(ours: Tensor, theirs: Tensor) -> float:
    return (ours - theirs).abs().max().item()
