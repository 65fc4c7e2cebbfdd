"""docs/fine-tune.md: every command runs, in the order of the page, on three drives of four frames with own labels."""

import csv
import re
import shlex
import shutil
from pathlib import Path

import pytest
from command_line import command

from bevcli.sequences.files.boxes_file import read_boxes
from bevcli.sequences.files.boxes_table import write_csv

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs/fine-tune.md").read_text()
BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```", PAGE, flags=re.MULTILINE | re.DOTALL)
OWN_NAMES = {"car": "PKW", "truck": "Lorry", "pedestrian": "person", "bicycle": "cyclist"}
SMALL = ["--steps", "1", "--set", "clips.batch=1", "--set", "clips.in_turn=1", "--set", "clips.frames=2"]


def make_drive(folder: Path, name: str) -> None:
    """A drive of four frames without ground truth, and the labels of a German spreadsheet."""
    street = ROOT / "samples" / "street"
    raw, labels = folder / "raw" / name, folder / "labels" / f"{name}.csv"
    shutil.copytree(street, raw, ignore=shutil.ignore_patterns("ground_truth*"))
    lines = (street / "frames.csv").read_text().splitlines()
    (raw / "frames.csv").write_text("\n".join(lines[:5]))
    labels.parent.mkdir(exist_ok=True)
    write_csv(read_boxes(street / "ground_truth.json"), labels)
    with labels.open(newline="") as file:
        header, *rows = csv.reader(file)
    kept = [row for row in rows if row[4] in OWN_NAMES and int(row[0]) < 4]
    table = [header, *([*row[:4], OWN_NAMES[row[4]], *row[5:]] for row in kept)]
    text = "".join(";".join(row).replace(".", ",") + "\r\n" for row in table)
    labels.write_bytes(("\ufeff" + text).encode())


@pytest.mark.slow
def test_the_page_leads_to_a_model_that_runs(tmp_path: Path) -> None:
    for name in ("monday", "tuesday", "friday"):
        make_drive(tmp_path, name)
    for language, block in BLOCKS:
        if language == "toml":
            (tmp_path / "split.toml").write_text(block)
        for line in block.splitlines() if language == "sh" else ():
            arguments = shlex.split(line)[1:]
            small = SMALL if line.startswith("bevcli train --model") else []
            done = command(tmp_path, *arguments, *small)
            assert done.returncode == 0, f"{line}\n{done.stdout}\n{done.stderr}"
            if small:
                assert all(f"{own} from {name}" in done.stdout for name, own in OWN_NAMES.items())
    with (tmp_path / "runs/friday-onnx/boxes.csv").open() as file:
        assert {row["class"] for row in csv.DictReader(file)} <= set(OWN_NAMES.values())
    assert (tmp_path / "my.onnx").is_file()
