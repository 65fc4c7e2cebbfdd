"""The checks of `bevcli checks` that need PyTorch."""

import os
import re
from pathlib import Path

import torch

from bevcli.config import load_config
from bevcli.inference.load import choose_device, installed_engines
from bevcli.model.kernels.choose import choose_kernels, has_triton
from bevcli.model.kernels.onednn import has_matrix_unit, has_onednn
from bevcli.model.network import build_network
from bevcli.workshop.benchmark.versions import describe_machine


def processor() -> str | dict[str, str]:
    """Name, cores, memory, and what multiplies bfloat16."""
    affinity = getattr(os, "sched_getaffinity", None)
    cores = f"{len(affinity(0)) if affinity else os.cpu_count()} of {os.cpu_count()} cores"
    meminfo = Path("/proc/meminfo")
    total = re.match(r"MemTotal:\s*(\d+) kB", meminfo.read_text(encoding="utf-8")) if meminfo.is_file() else None
    memory = f", {int(total[1]) / 2**20:.0f} GiB" if total else ""
    rounds = "instructions for bfloat16" if has_onednn(torch.bfloat16) else "no instructions for bfloat16"
    amx = "AMX" if has_matrix_unit() else "no AMX"
    return f"{describe_machine(torch.device('cpu'))}; {cores}{memory}; {rounds}, {amx}"


def gpu() -> str | dict[str, str]:
    """The GPUs that PyTorch sees, and the CUDA that it was built for."""
    if not torch.cuda.is_available():
        build = f"built for CUDA {torch.version.cuda}" if torch.version.cuda else "a build without CUDA"
        mps = "; an Apple GPU is there (mps)" if torch.backends.mps.is_available() else ""
        return f"none that PyTorch sees ({build}){mps}"
    gpus = {}
    for index in range(torch.cuda.device_count()):
        device = torch.cuda.get_device_properties(index)
        capability = f"compute capability {device.major}.{device.minor}"
        gpus[f"cuda:{index}"] = f"{device.name}, {device.total_memory / 2**30:.0f} GiB, {capability}"
    return gpus | {"CUDA": f"{torch.version.cuda} of PyTorch"}


def kernels() -> str | dict[str, str]:
    """The faster parts that a model gets on the default device, and why these."""
    device = choose_device("auto")
    with torch.device("meta"):
        network = build_network(load_config("demo")).eval()
    choose_kernels(network, device)
    kinds = {type(part) for part in network.modules()}
    kinds |= {type(sampling) for part in network.modules() if (sampling := getattr(part, "sampling", None)) is not None}
    names = sorted(kind.__name__ for kind in kinds if kind.__module__.startswith("bevcli.model.kernels"))
    if device.type == "cpu":
        why = "loops compiled by numba, as no GPU is there"
        products = "oneDNN" if has_onednn(torch.float32) else "plain PyTorch, as this build lacks operators of oneDNN"
    else:
        why = "Triton" if has_triton(device) else "plain PyTorch, as Triton is not installed or the GPU is not of CUDA"
        products = "PyTorch, replayed as CUDA graphs" if device.type == "cuda" else "PyTorch"
    rows = {"attention": f"{', '.join(names) or 'as in the paper'} ({why})", "convolutions": products}
    if device.type == "cpu":
        parts = "images and products of encoder and decoder (AMX)" if has_matrix_unit() else "images only (no AMX)"
        rows["bf16"] = f"for {parts}" if has_onednn(torch.bfloat16) else "slow: the processor lacks instructions for it"
    return rows


def engines() -> str | dict[str, str]:
    """The other engines that are installed, and INT8."""
    names = ", ".join(installed_engines())
    return f"torch, {names}; INT8 runs in {names.partition(',')[0]}" if names else "torch only, so no INT8"
