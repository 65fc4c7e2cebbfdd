"""A frame whose numbers become NaN or infinite is marked with the place where this happens; the next frame recovers."""

import copy
from dataclasses import replace

import pytest
import torch
from memory_drive import MemoryDrive

from bevcli.errors import WeightsError
from bevcli.inference.preprocess import Preprocessor
from bevcli.inference.runner import Runner, RunnerState
from bevcli.model.prepare import prepare_for_inference

CPU = torch.device("cpu")


def run(model, frames=3):
    steps = Runner(model, CPU).run(MemoryDrive(frames))
    return [prediction for _, prediction, _ in steps]


@pytest.mark.parametrize(
    ("module", "where"),
    [
        ("backbone", "backbone"),
        ("neck", "neck"),
        ("encoder.layers.1.norms.0", "encoder layer 1 (encoder.layers.1.norms.0)"),
        ("decoder.layers.1", "decoder layer 1"),
    ],
)
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize("prepared", [False, True], ids=["plain", "prepared"])
def test_the_module_where_numbers_stop_being_finite_is_named(mini_model, module, where, value, prepared):
    model = prepare_for_inference(mini_model, CPU) if prepared else mini_model

    def spoil(module, arguments, output):
        first = output[0] if isinstance(output, tuple | list) else output
        first[0] = value

    hook = model.get_submodule(module).register_forward_hook(spoil)
    try:
        found = run(model, frames=1)[0]
    finally:
        hook.remove()
    assert where in found.not_finite
    assert not len(found.boxes)
    assert found.bev is None
    assert not found.skipped


def test_frames_after_a_failed_one_are_those_of_a_fresh_start(mini_model):
    sequence, calls = MemoryDrive(4), []

    def spoil_second(module, arguments, output):
        calls.append(module)
        if len(calls) in (2, 3):  # the second frame, and the search in it
            output.fill_(float("nan"))

    hook = mini_model.neck.output[0].register_forward_hook(spoil_second)
    try:
        predictions = run(mini_model, frames=4)
    finally:
        hook.remove()
    assert [bool(p.not_finite) for p in predictions] == [False, True, False, False]
    runner = Runner(mini_model, CPU)
    fresh = [p for _, p, _ in runner.run(sequence, range(2, 4))]
    for after, expected in zip(predictions[2:], fresh, strict=True):
        assert torch.equal(after.bev, expected.bev)


@pytest.mark.parametrize("prepared_model", [False, True], ids=["plain", "prepared"])
def test_an_input_that_is_not_finite_is_named(mini_model, prepared_model):
    model = prepare_for_inference(mini_model, CPU) if prepared_model else mini_model
    runner, preprocessor, sequence = Runner(model, CPU), Preprocessor(mini_model.config), None
    sequence = MemoryDrive(1)
    prepared = preprocessor(sequence.load(0))
    images = prepared.images.clone()
    images[0, 0, 0, 0, 0] = float("nan")
    state, prediction = runner.step(None, replace(prepared, images=images))
    assert state == RunnerState()
    assert prediction.not_finite == "input images"


def test_a_batch_norm_of_negative_variance_is_refused_at_once(mini_model):
    model = copy.deepcopy(mini_model)
    model.backbone.bn1.running_var[3] = -1.0  # finite, but its root is not
    with pytest.raises(WeightsError, match=r"backbone\.conv1\.weight: has NaN or infinity"):
        prepare_for_inference(model, CPU)
