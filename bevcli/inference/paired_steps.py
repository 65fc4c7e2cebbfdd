"""`paired_steps`: two versions of a model on the same frames, each with its own history."""

from collections.abc import Iterable, Iterator

import torch

from bevcli.inference.runner import BevState, Runner
from bevcli.model.step import ModelOutputs, PreparedFrame
from bevcli.model.temporal_model import TemporalModel


def paired_steps(
    one: TemporalModel, other: TemporalModel, frames: Iterable[PreparedFrame]
) -> Iterator[tuple[PreparedFrame, ModelOutputs, ModelOutputs]]:
    """Yield each frame that has an image, and the outputs of both versions, which run on the CPU."""
    outputs: dict[int, ModelOutputs] = {}  # of the last step of each
    hooks = [
        network.observed.register_forward_hook(lambda *call, number=number: outputs.update({number: call[2]}))
        for number, network in enumerate((one, other))
    ]
    try:
        runners = [Runner(network, torch.device("cpu")) for network in (one, other)]
        states: list[BevState | None] = [None, None]
        for prepared in frames:
            if prepared.frame.images:
                states = [runner.step(state, prepared)[0] for runner, state in zip(runners, states, strict=True)]
                yield prepared, outputs[0], outputs[1]
    finally:
        for hook in hooks:
            hook.remove()
