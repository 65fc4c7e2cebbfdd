"""Measure every model in every precision: `python docs/site/speed_table.py docs/speed.md`.

The table is written between two lines of the document. Nothing else should run on the machine.
"""

import json
import subprocess
import sys
from collections.abc import Callable, Mapping
from datetime import date
from itertools import product
from pathlib import Path
from typing import Any

import torch
import typer

from bevcli.inference.load import choose_device
from bevcli.model.kernels.onednn import has_onednn
from bevcli.registry import known_models

MODEL_TIMEOUT_S = 4 * 3600.0
BEGIN, END = "<!-- table: begin -->", "<!-- table: end -->"
COLUMNS: Mapping[str, Callable[[dict[str, Any]], str]] = {
    "model": lambda r: r["model"],
    "precision": lambda r: r["precision"],
    "frame, ms": lambda r: f"{r['frame_ms']:.0f}",
    "frames a second": lambda r: f"{r['fps']:.3g}",
    "plain, ms": lambda r: f"{r['plain_frame_ms']:.0f}",
    "times faster": lambda r: f"{r['speedup']:.2f}",
    "times the limit": lambda r: f"{r['limits']['times_limit']:.2f}",
    "G operations": lambda r: f"{r['operations_g']:.0f}",
    "matrix products, G/s": lambda r: f"{r['limits']['gemm_gflops']:.0f}",
    "run / model": lambda r: f"{r['run_over_model']:.2f}",
    "memory, MB": lambda r: f"{r['peak_memory_mb']:.0f}",
    "boxes within 0.1 m": lambda r: f"{r['share_within_0.1_m']:.1%}",
    "largest score difference": lambda r: f"{r['max_score_difference']:.1g}",
}


def write_table(path: Path, device: str = "auto", frames: int = 5) -> None:
    """Measure all models, and write the table between the lines BEGIN and END of a document after each measurement.

    A measurement that fails is printed and left out. On a CPU without bfloat16 instructions only float32 is measured.
    Raises SystemExit where the document lacks these lines, and at the end where a measurement failed.
    """
    before, begin, rest = path.read_text().partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        raise SystemExit(f"{path}: cannot find where to write the table (expected the lines {BEGIN} and {END})")
    on_cpu = ("fp32", "bf16") if has_onednn(torch.bfloat16) else ("fp32",)
    results, failures = [], 0
    is_gpu = choose_device(device).type == "cuda"
    for model, precision in product(known_models(), ("bf16", "fp16") if is_gpu else on_cpu):
        try:
            results.append(measure(model, precision, device, frames))
        except subprocess.SubprocessError as error:
            print(f"{model}, {precision}: {error}", file=sys.stderr)
            failures += 1
        else:
            path.write_text(f"{before}{begin}\n{markdown_table(results)}\n{end}{after}")
    if failures:
        raise SystemExit(f"{path}: {failures} of {failures + len(results)} measurements failed and are left out")


def measure(model: str, precision: str, device: str, frames: int) -> dict[str, Any]:
    """Results of `bevcli bench --against plain --json` in a process of its own, whose peak memory is that model's."""
    print(f"measuring {model}, {precision} …", file=sys.stderr)
    options = ["--model", model, "--precision", precision, "--device", device, "--count", str(frames)]
    command = [sys.executable, "-m", "bevcli", "bench", *options, "--against", "plain", "--json"]
    answer = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, timeout=MODEL_TIMEOUT_S)
    return dict(json.loads(answer.stdout))


def markdown_table(results: list[dict[str, Any]]) -> str:
    """The machine and a table of results in Markdown, one row a result of `measure`."""
    machine = f"Measured on {date.today().isoformat()}: {results[0]['machine']}."
    rows = [" | ".join(column(result) for column in COLUMNS.values()) for result in results]
    lines = [" | ".join(COLUMNS), " | ".join("---" for _ in COLUMNS), *rows]
    return "\n".join([machine, "", *(f"| {line} |" for line in lines)])


if __name__ == "__main__":
    typer.run(write_table)
