"""The program that trains the horizon, on two small drives for a second."""

import horizon
import pytest
import safetensors.torch
import torch

from bevcli.model.horizon import Horizon


@pytest.mark.slow
def test_the_program_trains_and_goes_on(tmp_path, monkeypatch, capsys):
    for name, value in {"HELD_OUT": 1, "BATCH": 2}.items():
        monkeypatch.setattr(horizon, name, value)
    monkeypatch.setattr("bevcli.workshop.synth.drives.FRAMES_PER_DRIVE", 2)
    arguments = ["horizon.py", str(tmp_path), "--drives", "30004,30007,30011", "--seconds", "1"]
    for further in ((), ("--weights", str(tmp_path / "horizon.safetensors"))):
        monkeypatch.setattr("sys.argv", [*arguments, *further])
        assert horizon.main() == 0
    assert "degrees along x and y" in capsys.readouterr().out
    state = safetensors.torch.load_file(tmp_path / "horizon.safetensors")
    trained = Horizon()
    trained.load_state_dict({key.removeprefix("horizon."): value.float() for key, value in state.items()})
    ring = torch.randn(1, 112, 1440)
    assert torch.isfinite(trained.slopes(*trained.rises(ring, torch.ones_like(ring))).mean).all()
