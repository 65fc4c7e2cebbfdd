"""A captured function, on a simulated device: replays give the function's results, and what cannot be captured runs."""

import logging
from dataclasses import dataclass

import pytest
import torch
from simulated_device import SimulatedDevice, pinned, simulated
from torch import Tensor, nn

from bevcli.model.kernels.gpu import KEPT_GRAPHS, Captured
from bevcli.model.upload import upload_together

NAME = "cuda:0"


@dataclass(frozen=True)
class Inputs:
    numbers: Tensor
    factor: Tensor
    others: tuple[Tensor, int] | None = None


class Scaled(nn.Module):
    """A function with a part that can be observed; it counts the runs of its Python code."""

    def __init__(self) -> None:
        super().__init__()
        self.part, self.runs = nn.Linear(3, 3), 0
        self.requires_grad_(False)

    def scaled(self, inputs: Inputs) -> tuple[Tensor, str]:
        self.runs += 1
        found = self.part(inputs.numbers * inputs.factor)
        return (found if inputs.others is None else found + inputs.others[0]), "name"

    def uploading(self, inputs: Inputs) -> Tensor:
        return self.scaled(upload_together(inputs, self.part.weight.device))[0]

    def waiting(self, inputs: Inputs) -> Tensor:
        return inputs.numbers * inputs.factor.item()


@pytest.fixture
def device(monkeypatch):
    with simulated(NAME, monkeypatch, lambda *_, **__: None) as device:
        yield device


def on(device: SimulatedDevice, *numbers: float) -> Tensor:
    return device.tensor(torch.tensor(numbers))


def test_a_replay_computes_with_the_new_numbers(device):
    model = Scaled().to(device.device)
    captured = Captured(model.scaled, model, device.device, rounds=True)
    device.waits.clear()
    kept = []
    for step in range(5):
        inputs = Inputs(on(device, step, 2.0, 3.0), on(device, 10.0 + step))
        expected, _ = model.scaled(inputs)
        found, name = captured(inputs)
        kept.append((found, expected))
        assert name == "name"
    assert model.runs == 5 + 1 + 2  # those that are compared with, as ever, warm-up and capture
    for found, expected in kept:  # no replay has overwritten earlier results
        torch.testing.assert_close(found.held, expected.held, rtol=0, atol=0)
    assert device.waits == []


def test_arguments_on_the_cpu_are_uploaded_in_one_copy(device, monkeypatch):
    model, copies = Scaled().to(device.device), []
    captured = Captured(model.uploading, model, device.device, rounds=True)
    device.waits.clear()
    monkeypatch.setattr("bevcli.model.upload.pinned", lambda x: copies.append(len(x)) or pinned(x))
    for step in range(5):
        numbers, factor, offset = (
            torch.tensor([step, 2.0, 3.0]),
            torch.tensor([10.0 + step]),
            torch.tensor([float(step), step, step]),
        )
        found = captured(Inputs(on(device, *numbers), factor, (offset, 1)))
        inputs = Inputs(on(device, *numbers), on(device, *factor), (on(device, *offset), 1))
        torch.testing.assert_close(found.held, model.scaled(inputs)[0].held, rtol=0, atol=0)
    assert copies == [16] * 6  # one more in the capture
    assert device.waits == []


def test_other_shapes_and_numbers_are_captured_for_themselves(device):
    model = Scaled().to(device.device)
    captured = Captured(model.scaled, model, device.device, rounds=False)
    for others in (None, (on(device, 1.0, 2.0, 3.0), 1), (on(device, 1.0, 2.0, 3.0), 2)):
        inputs = Inputs(on(device, 1.0, 2.0, 3.0), on(device, 2.0), others)
        results = {tuple(captured(inputs)[0].held.tolist()) for _ in range(3)}
        assert results == {tuple(model.scaled(inputs)[0].held.tolist())}
    assert [graph is not None for graph in captured.graphs.values()] == [True] * 3
    for rows in range(1, 2 * KEPT_GRAPHS):
        captured(Inputs(device.tensor(torch.ones(rows, 3)), on(device, 2.0)))
    assert len(captured.graphs) == KEPT_GRAPHS


def test_a_failed_capture_is_told_once_and_runs_as_ever(device, caplog):
    model = Scaled().to(device.device)
    captured = Captured(model.waiting, model, device.device, rounds=False)
    with caplog.at_level(logging.WARNING, logger="bevcli"):
        found = [captured(Inputs(on(device, 1.0, 2.0), on(device, 3.0))).held.tolist() for _ in range(4)]
    assert found == [[3.0, 6.0]] * 4
    assert [record.getMessage() for record in caplog.records] == [
        "no CUDA graph could be captured, steps take longer: item: the CPU waits for cuda:0 in a capture"
    ]


def test_an_observed_part_is_called_in_every_step(device):
    model = Scaled().to(device.device)
    captured = Captured(model.scaled, model, device.device, rounds=False)
    inputs = Inputs(on(device, 1.0, 2.0, 3.0), on(device, 2.0))
    for _ in range(3):
        captured(inputs)
    seen = []
    with model.part.register_forward_hook(lambda *call: seen.append(call[2])):
        captured(inputs)
        captured(inputs)
    captured(inputs)
    assert len(seen) == 2
