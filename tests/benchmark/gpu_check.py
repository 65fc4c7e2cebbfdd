"""`make gpu-check`: everything that only a GPU can tell, as a report in Markdown to paste into an issue.

    python tests/benchmark/gpu_check.py [--device cuda] [--out gpu-report.md] [--model NAME]...

It runs the tests marked `gpu`, compares CPU and GPU for every model and precision, trains five steps and measures the
speed. Each part is a process of its own with a time limit, so that one that fails or hangs does not end the others.
"""

import argparse
import csv
import json
import math
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from datetime import date
from pathlib import Path
from typing import Any, get_args

import torch

from bevcli._version import __version__
from bevcli.benchmark.made_up import MadeUpDrive, made_up_model
from bevcli.benchmark.result import markdown_table, measure
from bevcli.benchmark.versions import Version, difference, largest_differences, textbook_version
from bevcli.config import known_models, load_config
from bevcli.errors import BevcliError
from bevcli.inference.load import choose_device
from bevcli.inference.machine import describe_machine
from bevcli.inference.preprocess import Preprocessor
from bevcli.model.prepare import Precision, prepare_for_inference
from bevcli.printing import say
from bevcli.writing import write_whole

ROOT = Path(__file__).parents[2]  # of the repository
PRECISIONS: tuple[Precision, ...] = get_args(Precision)
COMPARED_FRAMES = 2  # the second has history
TRAINED_MODEL, TRAINED_STEPS, TRAINED_ON = "demo", 5, "samples/street"
BENCH_FRAMES = 20
LIMIT_S = 1800  # of each process
# What CPU and GPU may differ by at most.
MIN_SHARE_WITHIN_TENTH_M, MAX_SCORE_DIFFERENCE = 0.99, 0.02
SHOWN_LINES = 15  # of what a failed process printed


class CheckFailed(Exception):
    """A part of the check found something wrong, or could not run; the message is Markdown."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the check. Returns the exit code: 0 if everything passed, else 1."""
    parser = argparse.ArgumentParser(prog="make gpu-check", description="Check bevcli on a GPU and write a report.")
    parser.add_argument("--device", default="auto", help='auto, cuda, cuda:N or mps; "cpu" tries the check itself')
    parser.add_argument("--out", type=Path, default=Path("gpu-report.md"), help="the report")
    parser.add_argument("--model", action="append", help="only this model (repeatable); default: all known models")
    parser.add_argument("--compare", metavar="MODEL", help=argparse.SUPPRESS)  # one part, in a process of its own
    asked = parser.parse_args(arguments)
    try:
        device = gpu_of(asked.device)
        if asked.compare is not None:
            say(json.dumps(compare(asked.compare, device)))
            return 0
        text, failed = check(device, tuple(asked.model or known_models()))
        write_whole(asked.out, text.encode())
    except BevcliError as error:
        say(f"error: {error}", err=True)
        return 1
    say(f"wrote {asked.out}: {'failed: ' + ', '.join(failed) if failed else 'everything passed'}")
    return 1 if failed else 0


def gpu_of(name: str) -> torch.device:
    """The device to check; "auto" takes a CUDA GPU, else the GPU of a Mac. Raises BevcliError if there is neither."""
    if name == "auto" and not torch.cuda.is_available():
        if not torch.backends.mps.is_available():
            raise BevcliError(f"gpu-check: PyTorch {torch.__version__} sees no GPU here, so there is nothing to check")
        name = "mps"
    return choose_device(name)


def check(device: torch.device, models: tuple[str, ...]) -> tuple[str, list[str]]:
    """Run all parts of the check, one after another. Returns the report in Markdown, and the parts that failed."""
    parts: dict[str, Callable[[], str]] = {
        "tests": run_tests,
        "CPU and GPU compared": lambda: compare_all(device, models),
        f"{TRAINED_STEPS} training steps": lambda: train(device),
        "speed": lambda: bench(device, models),
    }
    cuda = torch.version.cuda or "none"
    machine = f"{describe_machine(device)}, CUDA {cuda}, Python {sys.version.split()[0]}."
    lines = [f"# bevcli {__version__} on {device}", "", f"{date.today().isoformat()}: {machine}"]
    failed = []
    for title, part in parts.items():
        say(f"gpu-check: {title} …", err=True)
        try:
            text, verdict = part(), "passed"
        except CheckFailed as failure:
            text, verdict = str(failure), "FAILED"
            failed.append(title)
        lines += ["", f"## {title}: {verdict}", "", text]
    return "\n".join(lines) + "\n", failed


def run_tests() -> str:
    """The tests marked `gpu`. Raises CheckFailed."""
    printed = _run([sys.executable, "-m", "pytest", "-m", "gpu", "-q", "--durations=0"], "the tests")
    return f"`{printed.strip().splitlines()[-1]}`"


def compare_all(device: torch.device, models: tuple[str, ...]) -> str:
    """A table of CPU against GPU. Raises CheckFailed if any model and precision fails."""
    lines = ["| model | precision | boxes within 0.1 m | largest difference, m | largest score difference | |"]
    lines += ["| --- | --- | --- | --- | --- | --- |"]
    passed = True
    for model in models:
        command = [sys.executable, __file__, "--compare", model, "--device", str(device)]
        try:
            rows = json.loads(_run(command, f"model {model}").splitlines()[-1])
        except CheckFailed as failure:
            rows = [{"precision": "", "error": " ".join(str(failure).split())[-300:].replace("|", "/")}]
        for row in rows:
            passed = passed and "error" not in row
            formats = {"share": ".1%", "distance_m": ".3g", "score": ".3g", "error": ""}
            cells = [format(row[name], kind) if name in row else "" for name, kind in formats.items()]
            lines.append(f"| {' | '.join([model, row['precision'], *cells])} |")
    if not passed:
        raise CheckFailed("\n".join(lines))
    return "\n".join(lines)


def compare(name: str, device: torch.device) -> list[dict[str, Any]]:
    """Compare device and CPU outputs; return one row per precision.

    A row has `share` (of the boxes within 0.1 m), `distance_m` and `score` (the largest differences), and `error` where
    they are too large or the model failed.
    """
    config, cpu = load_config(name), torch.device("cpu")
    model, drive, preprocess = made_up_model(config), MadeUpDrive(COMPARED_FRAMES), Preprocessor(config)
    frames = [preprocess(drive.load(place)) for place in range(COMPARED_FRAMES)]
    plain = Version(textbook_version(model, cpu), cpu)
    expected = []
    for frame in frames:
        plain.step(frame)
        expected.append(plain.queries)
    rows = []
    for precision in PRECISIONS:
        row: dict[str, Any] = {"precision": precision}
        try:
            fast = Version(prepare_for_inference(model, device, precision), device)
            found = []
            for frame, queries in zip(frames, expected, strict=True):
                fast.step(frame)
                found.append(difference(fast.queries, queries))
            row |= _differences(found)
        except Exception as error:  # whatever a GPU raises is what the report is for
            row["error"] = f"{type(error).__name__}: {' '.join(str(error).split())[:200].replace('|', '/')}"
        rows.append(row)
    return rows


def _differences(frames: Sequence[tuple[torch.Tensor, torch.Tensor]]) -> dict[str, Any]:
    distance_m, share, score = largest_differences(frames)
    row: dict[str, Any] = {"share": share, "distance_m": distance_m, "score": score}
    if not (share >= MIN_SHARE_WITHIN_TENTH_M and score <= MAX_SCORE_DIFFERENCE):
        row["error"] = "differs too much"
    return row


def train(device: torch.device, model: str = TRAINED_MODEL) -> str:
    """Five training steps on the sample drive. Raises CheckFailed unless every loss is finite."""
    drive = ROOT / TRAINED_ON
    with tempfile.TemporaryDirectory(prefix="bevcli-gpu-check-") as folder:
        out = Path(folder) / "train"
        options = ["--data", str(drive), "--held-out", "0", "--steps", str(TRAINED_STEPS), "--out", str(out)]
        command = [sys.executable, "-m", "bevcli", "train", "--model", model, *options, "--device", str(device)]
        _run(command, "the training")
        with (out / "loss.csv").open(newline="") as file:
            losses = [float(row["loss"]) for row in csv.DictReader(file)]
    text = f"Losses of {model}: {', '.join(f'{loss:.3g}' for loss in losses)}."
    if len(losses) != TRAINED_STEPS or not all(map(math.isfinite, losses)):
        raise CheckFailed(text)
    return text


def bench(device: torch.device, models: tuple[str, ...]) -> str:
    """The table of `bevcli bench`. Raises CheckFailed if any model and precision fails."""
    results, failures = [], []
    for model in models:
        for precision in PRECISIONS:
            try:
                results.append(measure(model, precision, device, BENCH_FRAMES, LIMIT_S))
            except BevcliError as error:
                failures.append(f"- {model}, {precision}: {error}")
    text = "\n".join([*([markdown_table(results)] if results else []), *failures])
    if failures:
        raise CheckFailed(text)
    return text


def _run(command: list[str], what: str) -> str:
    """The output of a process. Raises CheckFailed if it fails or takes too long."""
    try:
        answer = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=LIMIT_S)
    except subprocess.TimeoutExpired:
        raise CheckFailed(f"{what}: not done after {LIMIT_S} s") from None
    if answer.returncode:
        last = "\n".join((answer.stdout + answer.stderr).strip().splitlines()[-SHOWN_LINES:])
        raise CheckFailed(f"{what}: exit code {answer.returncode}\n\n```\n{last}\n```")
    return answer.stdout


if __name__ == "__main__":
    sys.exit(main())
