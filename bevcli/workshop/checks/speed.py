"""The table of `bevcli checks --speed`: a model's step on the default device, measured for about a minute."""

import os
import time
from statistics import median

from bevcli.config import load_config
from bevcli.inference.load import choose_device
from bevcli.model.precision import Precision
from bevcli.model.prepare import prepare_for_inference
from bevcli.printing import counted
from bevcli.workshop.benchmark.made_up import MadeUpDrive, made_up_model
from bevcli.workshop.benchmark.measure import measure_limits
from bevcli.workshop.benchmark.versions import WARM_UP_FRAMES, Version

BUDGET_S = 40.0  # no further frame is begun after it
FRAMES = 20  # that are timed, at most
ROW_S = 8.0  # of the timed frames of a row
MODELS = ("demo", "tiny")
PRECISIONS: tuple[Precision, ...] = ("fp32", "bf16")


def measure_speed() -> dict[str, str]:
    """Median, fastest and slowest frame of each model and precision, and the machine's peak throughput."""
    began = time.perf_counter()
    device, drive = choose_device("auto"), MadeUpDrive(WARM_UP_FRAMES + FRAMES)
    limits = measure_limits(device, "fp32")
    rows = {"matrix products, copying": f"{limits.gemm_gflops:.0f} G operations/s in fp32, {limits.copy_gbs:.1f} GB/s"}
    for model in MODELS:
        network = made_up_model(load_config(model))
        for precision in PRECISIONS:
            if time.perf_counter() - began > BUDGET_S:
                rows[f"{model} {precision}"] = "not measured: the minute is over"
                continue
            version = Version(prepare_for_inference(network, device, precision), device)
            for index in range(len(drive.stamps)):
                version.step(version.runner.preprocess(drive.load(index)))
                timed = version.seconds[WARM_UP_FRAMES:]
                if timed and (sum(timed) > ROW_S or time.perf_counter() - began > BUDGET_S):
                    break
            timed = version.seconds[WARM_UP_FRAMES:]
            span = f"{1000 * min(timed):.0f} to {1000 * max(timed):.0f}"
            rows[f"{model} {precision}"] = (
                f"{1000 * median(timed):.0f} ms a frame ({span}, {counted(len(timed), 'frames')})"
            )
    return rows | {"load": _load()}


def _load() -> str:
    if not hasattr(os, "getloadavg"):
        return "not known on this system"
    return f"{os.getloadavg()[0]:.1f} processes wanted a core in the last minute, this one included"
