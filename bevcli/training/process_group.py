"""Data-parallel training: several processes train one model, each on clips of its own, with averaged gradients.

`torchrun --nproc-per-node N -m bevcli train …` starts the processes, one for each GPU or CPU core. Each process holds
the whole model. Only the leader writes files and prints.
"""

from __future__ import annotations

import os
from dataclasses import dataclass

import torch
import torch.distributed
from torch import Tensor, nn


@dataclass(frozen=True)
class ProcessGroup:
    """This process among those that train together.

    Attributes:
        rank: of this process, 0 to size - 1; the leader has rank 0.
        size: the number of processes, 1 without torchrun.
    """

    rank: int = 0
    size: int = 1

    @property
    def leads(self) -> bool:
        """Whether this process is the leader, which writes files and prints."""
        return self.rank == 0

    def average_gradients(self, trained: nn.Module) -> None:
        """Replaces each gradient by its mean over the processes; a missing gradient counts as zero."""
        if self.size > 1:
            for parameter in trained.parameters():
                if parameter.grad is None:
                    parameter.grad = torch.zeros_like(parameter)
            self._average([parameter.grad for parameter in trained.parameters() if parameter.grad is not None])

    def average_statistics(self, trained: nn.Module) -> None:
        """Replaces the running statistics of batch norms (all float buffers) by their mean over the processes."""
        if self.size > 1:
            self._average([buffer for buffer in trained.buffers() if buffer.is_floating_point()])

    def _average(self, tensors: list[Tensor]) -> None:
        flat = torch.cat([tensor.flatten() for tensor in tensors])
        torch.distributed.all_reduce(flat)
        flat /= self.size
        for tensor, mean in zip(tensors, flat.split([tensor.numel() for tensor in tensors]), strict=True):
            tensor.copy_(mean.view_as(tensor))


def join_process_group(device: torch.device) -> ProcessGroup:
    """Joins the group in which torchrun started this process; a group of one without torchrun.

    On GPUs each process takes the one of its local rank.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        return ProcessGroup()
    if device.type == "cuda":
        torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
    torch.distributed.init_process_group("nccl" if device.type == "cuda" else "gloo")
    return ProcessGroup(torch.distributed.get_rank(), torch.distributed.get_world_size())


def leave_process_group(group: ProcessGroup) -> None:
    """Ends the communication with the other processes."""
    if group.size > 1:
        torch.distributed.destroy_process_group()
