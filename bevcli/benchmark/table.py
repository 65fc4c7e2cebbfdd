"""The table of docs/speed.md: every model in every precision, each measured in a separate process."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Mapping
from datetime import date
from pathlib import Path
from typing import Any

import torch

from bevcli.config import known_models
from bevcli.errors import BevcliError
from bevcli.parsing.files import MIB, read_text

MODEL_TIMEOUT_S = 4 * 3600.0
LARGEST_DOCUMENT = 16 * MIB
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


def write_table(path: Path, device: torch.device, frames: int) -> None:
    """Measures, and writes the table between the lines BEGIN and END of a Markdown file.

    Raises BevcliError where an existing file lacks these lines.
    """
    text = read_text(path, LARGEST_DOCUMENT) if path.is_file() else f"{BEGIN}\n{END}\n"
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        raise BevcliError(f"{path}: cannot find where to write the table (expected the lines {BEGIN} and {END})")
    precisions = ("bf16", "fp16") if device.type == "cuda" else ("fp32", "bf16")
    results = [measure(model, precision, device, frames) for model in known_models() for precision in precisions]
    path.write_text(f"{before}{begin}\n{markdown_table(results)}\n{end}{after}")


def measure(
    model: str, precision: str, device: torch.device, frames: int, limit_s: float = MODEL_TIMEOUT_S
) -> dict[str, Any]:
    """What `bevcli bench --against plain --json` prints, in a process of its own.

    Raises BevcliError if it fails or takes longer than limit_s.
    """
    print(f"measuring {model}, {precision} …", file=sys.stderr)
    options = ["--model", model, "--precision", precision, "--device", str(device), "--frames", str(frames)]
    command = [sys.executable, "-m", "bevcli", "bench", *options, "--against", "plain", "--json"]
    # In a separate process, so that its peak memory is that of this model.
    try:
        answer = subprocess.run(command, check=True, capture_output=True, text=True, timeout=limit_s)
    except subprocess.TimeoutExpired:
        raise BevcliError(f"bench: {model}, {precision}: not done within {limit_s / 3600:g} h") from None
    except subprocess.CalledProcessError as error:
        last = (error.stderr.strip().splitlines() or ["no message"])[-1]
        raise BevcliError(f"bench: {model}, {precision}: failed with exit code {error.returncode} ({last})") from None
    found: dict[str, Any] = json.loads(answer.stdout)
    return found


def markdown_table(results: list[dict[str, Any]]) -> str:
    """The machine and a table of results in Markdown, one row a result of `measure`."""
    machine = f"Measured on {date.today().isoformat()}: {results[0]['machine']}."
    rows = [" | ".join(column(result) for column in COLUMNS.values()) for result in results]
    lines = [" | ".join(COLUMNS), " | ".join("---" for _ in COLUMNS), *rows]
    return "\n".join([machine, "", *(f"| {line} |" for line in lines)])
