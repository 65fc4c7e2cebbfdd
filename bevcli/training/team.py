"""Processes that train one model together: each learns from clips of its own, all update with the mean gradient.

`torchrun --nproc-per-node N -m bevcli train …` starts them, a process a GPU or a CPU core. Every process holds the
whole model; only the leader writes files and prints.
"""

from __future__ import annotations

import os
from dataclasses import dataclass

import torch
import torch.distributed
from torch import Tensor, nn


@dataclass(frozen=True)
class Team:
    """place: of this process, 0 for the leader. size: how many there are; 1 where torchrun started none."""

    place: int = 0
    size: int = 1

    @property
    def leads(self) -> bool:
        """Whether this process writes files and prints."""
        return self.place == 0

    def average_gradients(self, learning: nn.Module) -> None:
        """Puts the mean over the processes in place of every gradient; one that is missing counts as zero."""
        if self.size > 1:
            for parameter in learning.parameters():
                if parameter.grad is None:
                    parameter.grad = torch.zeros_like(parameter)
            self._average([parameter.grad for parameter in learning.parameters() if parameter.grad is not None])

    def average_statistics(self, learning: nn.Module) -> None:
        """The same for running statistics, which no gradient moves."""
        if self.size > 1:
            self._average([buffer for buffer in learning.buffers() if buffer.is_floating_point()])

    def _average(self, tensors: list[Tensor]) -> None:
        flat = torch.cat([tensor.flatten() for tensor in tensors])
        torch.distributed.all_reduce(flat)
        flat /= self.size
        for tensor, mean in zip(tensors, flat.split([tensor.numel() for tensor in tensors]), strict=True):
            tensor.copy_(mean.view_as(tensor))


def join_team(device: torch.device) -> Team:
    """The team that torchrun started this process in; a team of one where it did not. Each takes a GPU of its own."""
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        return Team()
    if device.type == "cuda":
        torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
    torch.distributed.init_process_group("nccl" if device.type == "cuda" else "gloo")
    return Team(torch.distributed.get_rank(), torch.distributed.get_world_size())


def leave_team(team: Team) -> None:
    """Says goodbye to the others."""
    if team.size > 1:
        torch.distributed.destroy_process_group()
