"""The time and memory of a training on this machine, measured on its first updates."""

import contextlib
import sys
import time
from dataclasses import dataclass, replace
from itertools import pairwise

import torch

from bevcli.printing import duration
from bevcli.training.job import TrainingConfig, TrainingJob
from bevcli.training.trainer import Trainer

LONGEST_S = 10.0  # of a measurement; an update that takes longer is still finished


class _EnoughMeasured(Exception):
    """Ends the training that is measured."""


@dataclass(frozen=True)
class Cost:
    """The cost of a training.

    Attributes:
        config: its settings.
        machine: the device, in words.
        update_s: time of an update of the weights, while another thread reads the next batch.
        reading_s: time until the first batch was read, at most.
        memory_bytes: the largest memory, of the process or of a GPU.
    """

    config: TrainingConfig
    machine: str
    update_s: float
    reading_s: float
    memory_bytes: int

    @property
    def step_s(self) -> float:
        """Time of a step: of its updates, or of reading its batches where this takes longer."""
        clips = self.config.clips
        return max(clips.updates * self.update_s, clips.in_turn * self.reading_s / self.config.loaders)

    def __str__(self) -> str:
        """The cost on one line."""
        steps, updates = self.config.steps, self.config.clips.updates
        step = f"{self.update_s:.2g} s an update"
        if updates > 1:
            step += f", {duration(self.step_s)} a step of {updates}"
        whole = f"{duration(steps * self.step_s)} for {steps} steps without scoring"
        return f"{self.machine}: {step}, {whole}; memory {self.memory_bytes / 1e9:.1f} GB"


def measure_cost(job: TrainingJob, longest_s: float = LONGEST_S) -> Cost:
    """Train for some seconds, at least one update. Changes the job's model; writes curves into its folder.

    Raises BevcliError as the training would.
    """
    times = [time.perf_counter()]

    def after_update(loss: float) -> None:
        times.append(time.perf_counter())
        if times[-1] - times[0] >= longest_s:
            raise _EnoughMeasured

    config = replace(job.config, steps=10**6, evaluate_every=10**6, checkpoint_every=10**6)
    config = replace(config, clips=replace(config.clips, in_turn=1, short_share=0.0))
    _reset_peak(job.device)
    with contextlib.suppress(_EnoughMeasured):
        Trainer(replace(job, config=config)).run(after_update=after_update)
    spans = [later - earlier for earlier, later in pairwise(times)]
    update_s = sum(spans[1:]) / len(spans[1:]) if len(spans) > 1 else spans[0]
    reading_s = max(spans[0] - update_s, 0.0)
    return Cost(job.config, _machine(job.device), update_s, reading_s, _peak_bytes(job.device))


def _machine(device: torch.device) -> str:
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"{device.type}, {torch.get_num_threads()} threads"


def _reset_peak(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)


def _peak_bytes(device: torch.device) -> int:
    """The largest memory so far: of a GPU's tensors, or of this process."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
