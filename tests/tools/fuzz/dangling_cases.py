"""Cases of references that lead nowhere: tokens of nuScenes' tables, and numbers of a training's checkpoint."""

import json
import shutil
from pathlib import Path
from random import Random
from typing import Any

import torch

from bevcli.sequences.open import open_sequence
from bevcli.workshop.formats.nuscenes_output import TABLES
from bevcli.workshop.training.trainer import load_checkpoint

VALUES = (-6, 0, 2**70, float("nan"), float("inf"), "2", None, [], {})


def dangling_tokens(seeds: Path, case: Path, random: Random) -> None:
    """The frames that are read have all boxes, or a note or a warning says how many are left out."""
    name, folder = random.choice((("t4", "annotation"), ("nuscenes", "v1.0-mini")))
    shutil.copytree(seeds / name, case / name)
    whole = sum(open_sequence(case / name).class_counts.values())
    for _ in range(random.choice((1, 1, 2))):
        path = case / name / folder / f"{random.choice(TABLES)}.json"
        if path.is_file():
            rows = json.loads(path.read_text())
            path.write_text(json.dumps(_changed(rows, random, removes=path.stem != "sample_annotation")))
    drive = open_sequence(case / name)
    frames = [drive.load(place) for place in range(len(drive.stamps))]
    found = sum(len(frame.ground_truth or ()) for frame in frames)
    said = any("boxes are left out" in note for note in drive.notes) or any(frame.impossible_boxes for frame in frames)
    assert found == whole or said


def _changed(rows: list[dict[str, Any]], random: Random, *, removes: bool) -> list[dict[str, Any]]:
    """The rows of a table without one of them, or with another token, own or of another row, in one."""
    if not rows:
        return rows
    place = random.randrange(len(rows))
    tokens = [key for key in rows[place] if key.endswith("token")]
    if removes and (random.random() < 0.3 or not tokens):
        return rows[:place] + rows[place + 1 :]
    key = random.choice(tokens)
    return [*rows[:place], {**rows[place], key: random.choice(("", "f" * 32, 7, None))}, *rows[place + 1 :]]


def damaged_checkpoint(seeds: Path, case: Path, random: Random) -> None:
    """A checkpoint that is loaded has a step of 0 or more, and the training goes on with finite numbers."""
    contents = torch.load(seeds / "checkpoint.pt")
    _damage(contents, random)
    torch.save(contents, case / "checkpoint.pt")
    model = torch.nn.Linear(2, 1)
    optimizer = torch.optim.AdamW(model.parameters())
    assert load_checkpoint(case / "checkpoint.pt", model, optimizer) >= 0
    model(torch.ones(1, 2)).sum().backward()
    optimizer.step()
    assert all(torch.isfinite(parameter).all() for parameter in model.parameters())


def _damage(tree: Any, random: Random) -> None:
    """Change or remove a random value, or some of the numbers of a tensor."""
    key = random.choice(list(tree) if isinstance(tree, dict) else range(len(tree)))
    value = tree[key]
    if isinstance(value, dict | list) and value and random.random() < 0.9:
        _damage(value, random)
    elif isinstance(value, torch.Tensor) and random.random() < 0.6:
        value.fill_(random.choice((-1.0, torch.nan, torch.inf)))
    elif isinstance(value, torch.Tensor):
        tree[key] = torch.zeros(random.choice(((), (3,), (2, 2, 2))))
    else:
        tree[key] = random.choice(VALUES)
