"""Copies from the CPU to a device that the CPU does not wait for."""

import torch
from torch import Tensor


def upload(tensor: Tensor, device: torch.device) -> Tensor:
    """The tensor on a device; itself where it is there already.

    A CUDA GPU copies from pinned memory when it gets there, while the CPU goes on. Without pinned memory the CPU would
    wait for the GPU.
    """
    if device.type == "cuda" and tensor.device.type == "cpu":
        return pinned(tensor).to(device, non_blocking=True)
    return tensor.to(device)


def pinned(tensor: Tensor) -> Tensor:
    """A copy of a CPU tensor in memory that a GPU reads by itself. Needs a CUDA GPU."""
    return tensor.pin_memory()
