"""The state of a run that can be resumed: when it is saved, and whether it fits the run that wants to go on."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeVar

import torch

from bevcli import __version__
from bevcli.errors import InputError, OutputError
from bevcli.frame import Sequence
from bevcli.parsing.files import read_bytes
from bevcli.pipeline.model_loading import Model
from bevcli.pipeline.run_files import FilesState
from bevcli.pipeline.run_folder import RunFolder
from bevcli.pipeline.runner import BevState
from bevcli.pipeline.state_file import digest, load_state, save_state
from bevcli.pipeline.tracking import TrackerState

SHARE = 0.02  # of the run's time that saving may take
ASSUMED_BYTES_PER_S, ASSUMED_S = 3e8, 0.002  # how long the first save takes
HASHED_BYTES = 1 << 24  # files up to this size are hashed; of larger ones size and modification time count


class _HasFacts(Protocol):
    @property
    def facts(self) -> Mapping[str, str]: ...


State = TypeVar("State", bound=_HasFacts)


@dataclass(frozen=True)
class RunnerState:
    """What is carried from one frame to the next.

    Attributes:
        bev: of the model, None before the first frame.
        tracks: of the tracker, None before the first frame or without tracks.
    """

    bev: BevState | None = None
    tracks: TrackerState | None = None


@dataclass(frozen=True)
class RunState:
    """A run after a number of finished frames.

    Attributes:
        facts: what the run was made of, see `run_facts`.
        frames: number of finished frames.
        runner: what the next frame needs.
        files: None as long as nothing can be kept; the run then starts anew.
        summary: counts so far.
    """

    facts: Mapping[str, str]
    frames: int
    runner: RunnerState
    files: FilesState | None
    summary: Mapping[str, Any]


def run_facts(model: Model, sequence: Sequence, options: object) -> dict[str, str]:
    """Name -> hash or value of all that the results of a run depend on.

    options: the dataclass of the run's options; each of its fields is a fact.
    """
    return {
        "version of bevcli": __version__,
        "model": f"{model.name}, {_short(model.config_hash)}",
        "weights": f"{model.weights or 'random'}, {_short(model.weights_hash)}",
        "device": model.device.type,
        "precision": f"{model.precision}, {model.engine}" if model.is_exported else model.precision,
        **{f"option {name.replace('_', '-')}": repr(value) for name, value in vars(options).items()},
        "frames of the input": f"{len(sequence.stamps)}, {_short(digest(sequence.stamps))}",
        "calibration": _short(digest(sequence.rig)),
        "files of the input": _short(digest(tuple(map(_file_facts, getattr(sequence, "input_files", ()))))),
    }


def open_state(folder: RunFolder, facts: Mapping[str, str]) -> RunState | None:
    """The state to go on from, None if the folder has no run. Raises OutputError if its run was another one."""
    state = saved_state(folder, facts, RunState, "a run")
    if state is None and folder.has_files():
        raise OutputError(f"{folder.path}: --resume: its run saved no state; pass --force to start anew")
    return state


def saved_state(folder: RunFolder, facts: Mapping[str, str], kind: type[State], what: str) -> State | None:
    """The state of a kind in a folder, None if there is none.

    Raises OutputError if it is damaged, of another kind, or of a run with other facts. what: whose state it is.
    """
    path = folder.state_path
    if not path.exists():
        return None
    try:
        state = load_state(path)
    except InputError as error:
        raise OutputError(f"--resume: {error}; pass --force to start anew") from None
    if not isinstance(state, kind):
        raise OutputError(f"--resume: {path}: is not the state of {what}; pass --force to start anew")
    check_same_run(folder.path, state.facts, facts)
    return state


def check_same_run(out: Path, saved: Mapping[str, str], facts: Mapping[str, str]) -> None:
    """Raises OutputError if a saved run was made of something else than this one.

    saved: the facts of the run in `out`, see `run_facts`. facts: those of the run that wants to go on.
    """
    names = [name for name in {**saved, **facts} if saved.get(name) != facts.get(name)]
    if names:
        pairs = (f"{name}: was {saved.get(name)}, is {facts.get(name)}" for name in names)
        raise OutputError(
            f"{out}: --resume: the interrupted run differs from this one ({'; '.join(pairs)}): "
            "pass the same model, options and input, or --force to start anew"
        )


class StateSaver:
    """Saves the state of a run as often as SHARE of its time allows."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._began = time.perf_counter()
        self._spent_s = 0.0
        self._longest_s: float | None = None
        self.saved_frames: int | None = None

    def is_due(self, runner: RunnerState) -> bool:
        """Whether there has been time enough for another save."""
        next_s = _assumed_s(runner) if self._longest_s is None else self._longest_s
        return self._spent_s + next_s <= SHARE * (time.perf_counter() - self._began)

    def save(self, state: RunState) -> None:
        """Saves a state. Raises OutputError."""
        began = time.perf_counter()
        save_state(self._path, state)
        took = time.perf_counter() - began
        self.saved_frames = state.frames
        self._spent_s += took
        self._longest_s = max(self._longest_s or 0.0, took)


def _assumed_s(runner: RunnerState) -> float:
    """Seconds that the first save will take."""
    return ASSUMED_S + _bytes(runner) / ASSUMED_BYTES_PER_S


def _bytes(tree: Any) -> int:
    if isinstance(tree, torch.Tensor):
        return tree.numel() * tree.element_size()
    if isinstance(tree, tuple):
        return sum(map(_bytes, tree))
    return sum(map(_bytes, vars(tree).values())) if hasattr(tree, "__dataclass_fields__") else 0


def _file_facts(path: Path) -> tuple[str, int, str]:
    """Name, size, and hash or time of a file of the input."""
    try:
        facts = path.stat()
        if facts.st_size > HASHED_BYTES:
            return path.name, facts.st_size, str(facts.st_mtime_ns)
        return path.name, facts.st_size, hashlib.sha256(read_bytes(path, HASHED_BYTES)).hexdigest()
    except OSError as error:
        return path.name, -1, str(error.strerror)
    except InputError as error:
        return path.name, -1, str(error)


def _short(hexdigest: str) -> str:
    return hexdigest[:12]
