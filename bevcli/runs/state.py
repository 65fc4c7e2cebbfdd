"""The state of a run that can be resumed: its file, when it is saved, and if it fits the run that wants to go on.

A state is a dataclass with its tensors, arrays and plain values in a .safetensors file. Tensors and arrays of numbers
are tensors of the file. Everything else is one more tensor, MessagePack that msgspec writes and reads. The reader names
the type that it expects, so that nothing in a file decides what is made of it.
"""

import contextlib
import hashlib
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar, get_origin

import msgspec
import numpy as np
import torch
from safetensors.torch import save
from torch import Tensor

from bevcli._version import __version__
from bevcli.checkpoints import read_safetensors
from bevcli.errors import InputError, OutputError
from bevcli.frame import Drive, Frame, Prediction
from bevcli.inference.load import Model, hash_of
from bevcli.inference.runner import Memory, RunnerState
from bevcli.model.upload import tensors_in
from bevcli.parsing.files import read_bytes
from bevcli.runs.files import FilesState, RunFiles
from bevcli.runs.folder import RunFolder
from bevcli.runs.summary import Counts, RunSummary
from bevcli.writing import write_whole

FORMAT = "bevcli-state/8"
LARGEST_STRINGS = 1 << 28  # bytes of an array of strings: a short text may state an array of gigabytes
SHARE = 0.02  # of the run's time that saving may take
ASSUMED_BYTES_PER_S, ASSUMED_S = 3e8, 0.002  # how long the first save takes
HASHED_BYTES = 1 << 24  # files up to this size are hashed; of larger ones size and modification time count
DIGITS = 12  # of a hash in a text
START_ANEW = "pass `force=True` (`--force`) to start anew"
_TREE = "tree"


class _HasFacts(Protocol):
    @property
    def facts(self) -> Mapping[str, str]: ...


Loaded = TypeVar("Loaded")
State = TypeVar("State", bound=_HasFacts)


@dataclass(frozen=True)
class RunState(Generic[Memory]):
    """A run after a number of finished frames.

    Attributes:
        facts: what the run was made of, see `run_facts`.
        files: None as long as nothing can be kept; the run then starts anew.
        counts: of the summary so far.
        runner: what the next frame needs; nothing before the first frame and after the last one.
    """

    facts: Mapping[str, str]
    files: FilesState | None
    counts: Counts
    runner: RunnerState[Memory] = field(default_factory=RunnerState)


def run_facts(model: Model, sequence: Drive, options: object) -> dict[str, str]:
    """Name -> hash or value of all that the results of a run depend on.

    options: the dataclass of the run's options; each of its fields is a fact.
    """
    return {
        "version of bevcli": __version__,
        "model": f"{model.name}, {model.config_hash[:DIGITS]}",
        "weights": f"{model.weights or 'random'}, {model.weights_hash[:DIGITS]}",
        "device": model.device.type,
        "precision": f"{model.precision}, {model.engine}" if model.is_exported else model.precision,
        **{f"option {name.replace('_', '-')}": repr(value) for name, value in vars(options).items()},
        "frames of the input": f"{len(sequence.stamps)}, {digest(sequence.stamps)[:DIGITS]}",
        "calibration": digest(sequence.rig)[:DIGITS],
        "ego-motion": "measured from the images" if sequence.facts.motion_measured else "of the input",
        "files of the input": digest(tuple(map(_file_facts, sequence.input_files)))[:DIGITS],
        "images of the input": _image_facts(sequence),
    }


def saved_state(folder: RunFolder, facts: Mapping[str, str], kind: type[State]) -> State | None:
    """The state of a kind in a folder, None if there is none.

    Raises OutputError if it is damaged, of another kind, or of a run with other facts.
    """
    if not folder.state_path.exists():
        return None
    try:
        state = load_state(folder.state_path, kind)
    except InputError as error:
        raise OutputError(f"`resume` (`--resume`): {error}; {START_ANEW}") from None
    names = [name for name in {**state.facts, **facts} if state.facts.get(name) != facts.get(name)]
    if names:
        pairs = (f"{name}: was {state.facts.get(name)}, is {facts.get(name)}" for name in names)
        raise OutputError(
            f"{folder.path}: `resume` (`--resume`): the interrupted run differs from this one ({'; '.join(pairs)}): "
            f"pass the same model, options and input, or {START_ANEW.removeprefix('pass ')}"
        )
    return state


class RunWriter(contextlib.AbstractContextManager["RunWriter"]):
    """`with RunWriter(…) as writer: writer.write(frame, prediction, after)`.

    Writes frames to the files of a run, counts them, and saves the state as often as SHARE of its time allows. The end
    of the block, whatever causes it, saves the state after the last whole frame.
    """

    def __init__(self, path: Path, facts: Mapping[str, str], files: RunFiles, summary: RunSummary) -> None:
        """path: of the state file. facts: of `run_facts`."""
        self._path, self._facts, self._files, self._summary = path, facts, files, summary
        self._began = self._frame_began = time.perf_counter()
        self._spent_s = 0.0
        self._longest_s: float | None = None
        self._after: RunnerState[Any] | None = None  # the state after a frame that is not saved yet
        self._is_whole = True

    def __exit__(self, *_error: object) -> None:
        if self._is_whole and self._after is not None:
            self.save(self._after)

    def write(self, frame: Frame, prediction: Prediction, after: RunnerState[Any]) -> None:
        """Write the next frame. after: the state of the runner after it."""
        self._is_whole, began = False, time.perf_counter()
        self._files.write(frame, prediction)
        now = time.perf_counter()
        self._summary.add(frame, prediction, recording_s=now - began, whole_s=now - self._frame_began)
        self._after, self._is_whole, self._frame_began = after, True, now
        if self.is_due(after):
            self.save(after)

    def is_due(self, runner: RunnerState[Any]) -> bool:
        """Time has been long enough for another save."""
        assumed_s = ASSUMED_S + sum(tensor.nbytes for _, tensor in tensors_in(runner)) / ASSUMED_BYTES_PER_S
        next_s = assumed_s if self._longest_s is None else self._longest_s
        return self._spent_s + next_s <= SHARE * (time.perf_counter() - self._began)

    def save(self, runner: RunnerState[Any]) -> None:
        """Save the state after the last frame, if the files can go on from there. Raises OutputError."""
        parts, summary, began = self._files.state(), self._summary, time.perf_counter()
        if parts is None:
            return
        kept = RunnerState() if summary.is_complete else runner  # nothing comes after the last frame
        save_state(self._path, RunState(self._facts, parts, summary.counts, kept))
        took = time.perf_counter() - began
        self._after = None
        self._spent_s += took
        self._longest_s = max(self._longest_s or 0.0, took)


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


def _image_facts(sequence: Drive) -> str:
    """Number, and hash of names, sizes and times of change, of the image files and videos of all frames."""
    paths = dict.fromkeys(path for index in range(len(sequence.stamps)) for path in sequence.image_files(index))
    facts_hash = hashlib.sha256()
    for path in paths:
        try:
            facts = path.stat()
            facts_hash.update(f"{path.name} {facts.st_size} {facts.st_mtime_ns}\n".encode(errors="surrogateescape"))
        except OSError as error:
            facts_hash.update(f"{path.name} {error.errno}\n".encode(errors="surrogateescape"))
        except ValueError:  # a null byte in the name
            facts_hash.update(b"no name\n")
    return f"{len(paths)}, {facts_hash.hexdigest()[:DIGITS]}"


def save_state(path: Path, state: object) -> None:
    """Write a state. The file is replaced at once, so that it is whole at every moment. Raises OutputError."""
    tensors = _tensors_of(state)
    write_whole(path, save(tensors, {"format": FORMAT, "sha256": hash_of(sorted(tensors.items()))}), regular=True)


def load_state(path: Path, kind: type[Loaded]) -> Loaded:
    """Read a state that `save_state` wrote; tensors are on the CPU.

    kind: the type of the state. Its dataclasses state the type of every field.
    Raises InputError for a changed or damaged file, and for a state of another type.
    """
    tensors, metadata = read_safetensors(path)
    if metadata.get("format") != FORMAT:
        raise InputError(
            f'{path}: is not a state file of this version: "format" must be "{FORMAT}", '
            f'found "{metadata.get("format", ""):.40}"'
        )
    if _TREE not in tensors or metadata.get("sha256") != hash_of(sorted(tensors.items())):
        raise InputError(f"{path}: the state cannot be read: the file is damaged")

    def decoded(expected: type, packed: Any) -> Any:
        if expected is Tensor:
            return tensors[packed]
        assert get_origin(expected) is np.ndarray, expected
        return tensors[packed].numpy() if isinstance(packed, str) else _strings(*packed)

    try:
        return msgspec.msgpack.decode(tensors[_TREE].numpy().tobytes(), type=kind, dec_hook=decoded)
    except (msgspec.MsgspecError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(f"{path}: the state cannot be read ({error})") from None


def digest(tree: object) -> str:
    """The hash of a tree that `save_state` could write."""
    return hash_of(sorted(_tensors_of(tree).items()))


def _tensors_of(tree: object) -> dict[str, Tensor]:
    """The tensors of a state file."""
    tensors: dict[str, Tensor] = {}

    def encoded(value: Any) -> Any:
        if isinstance(value, np.generic):
            return value.item()
        if isinstance(value, np.ndarray) and value.dtype.kind == "U":
            return value.tolist(), value.dtype.str
        if isinstance(value, np.ndarray):
            value = torch.from_numpy(np.array(value, order="C"))
        assert isinstance(value, Tensor), f"a state cannot hold a {type(value).__name__}"
        name = str(len(tensors))
        tensors[name] = value.detach().cpu().clone(memory_format=torch.contiguous_format)
        return name

    text = msgspec.msgpack.encode(tree, enc_hook=encoded)
    return tensors | {_TREE: torch.frombuffer(bytearray(text), dtype=torch.uint8)}


def _strings(content: Any, dtype: str) -> np.ndarray:
    """An array of strings of a type such as "<U20"."""
    width = int(dtype.removeprefix("<U"))
    if width < 0 or 4 * width * len(content) > LARGEST_STRINGS:
        raise ValueError(f"an array of the type {dtype:.20}")
    return np.array(content, dtype=f"<U{width}")
