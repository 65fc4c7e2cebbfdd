"""Several processes that train one model."""

from pathlib import Path

import pytest
import torch
import torch.distributed
from forks import FORKS
from painted_drives import CONFIG, PaintedDrives
from torch import nn

from bevcli.model.bevformer import BEVFormer
from bevcli.workshop.training.job import (
    ProcessGroup,
    TrainingConfig,
    TrainingJob,
    join_process_group,
)
from bevcli.workshop.training.samples import ClipConfig
from bevcli.workshop.training.trainer import Trainer

SHORT = TrainingConfig(
    steps=2, held_out=0, evaluate_every=2, checkpoint_every=2, clips=ClipConfig(frames=2, batch=1, short_share=0.0)
)


def train_in_a_group_of_two(rank: int, folder: Path) -> None:
    torch.set_num_threads(1)
    torch.distributed.init_process_group("gloo", f"file://{folder}/meet", rank=rank, world_size=2)
    group = ProcessGroup(rank, 2)
    assert_averages(group)
    train(group, folder)
    group.leave()


def assert_averages(group: ProcessGroup) -> None:
    layers = nn.Sequential(nn.Linear(2, 1), nn.BatchNorm1d(1))
    if group.leads:
        layers[0].weight.grad = torch.full((1, 2), 4.0)  # the other process has no gradient
    layers[1].running_mean.fill_(group.rank)
    group.average_gradients(layers)
    group.average_statistics(layers)
    assert torch.equal(layers[0].weight.grad, torch.full((1, 2), 2.0))
    assert layers[1].running_mean.item() == 0.5


def train(group: ProcessGroup, folder: Path) -> None:
    torch.manual_seed(0)
    drives = PaintedDrives(2)
    trainer = Trainer(TrainingJob(BEVFormer(CONFIG), SHORT, drives, drives, folder, torch.device("cpu"), 0, group))
    list(trainer.run())
    torch.save(trainer.job.model.state_dict(), folder / f"{group.rank}-of-{group.size}.pt")


@pytest.mark.slow
def test_two_processes_train_one_model_and_the_leader_writes(tmp_path: Path) -> None:
    group = [FORKS.Process(target=train_in_a_group_of_two, args=(rank, tmp_path)) for rank in range(2)]
    for process in group:
        process.start()
    for process in group:
        process.join(300)
        assert process.exitcode == 0
    leader, other = (torch.load(tmp_path / f"{rank}-of-2.pt") for rank in (0, 1))
    assert all(torch.equal(leader[key], other[key]) for key in leader)
    assert len((tmp_path / "loss.csv").read_text().splitlines()) == 1 + SHORT.steps
    assert (tmp_path / "weights.safetensors").is_file()
    alone = tmp_path / "alone"
    alone.mkdir()
    train(ProcessGroup(), alone)
    one = torch.load(alone / "0-of-1.pt")
    assert any(not torch.equal(leader[key], one[key]) for key in one)  # the clips of the second process had an effect


def test_without_torchrun_a_process_is_its_own_leader(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    group = join_process_group(torch.device("cpu"))
    assert group == ProcessGroup(0, 1)
    assert group.leads
    group.leave()
