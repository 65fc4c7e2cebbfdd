"""The state of a run that can be resumed: its file, and the fingerprint of the run that it is of.

PyTorch writes and reads the file. The reader names the type that it expects: of other classes than those in its fields
nothing is made.
"""

import hashlib
import pickle
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, is_dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar, get_args, get_origin, get_type_hints

import msgspec
import numpy as np
import torch

from bevcli._version import __version__
from bevcli.errors import InputError, OutputError
from bevcli.frame import Drive
from bevcli.inference.load import Model
from bevcli.inference.runner import Memory, RunnerState
from bevcli.model.upload import exchanged, tensors_in
from bevcli.parsing.files import read_bytes
from bevcli.parsing.pth import load_data
from bevcli.recording.writer import RecordingState
from bevcli.runs.folder import RunFolder
from bevcli.runs.summary import Counts
from bevcli.writing import write_whole

FORMAT = b"bevcli-state/9\n"
LARGEST_BYTES = 8 << 30
HASHED_BYTES = 1 << 24  # files up to this size are hashed; of larger ones size and modification time count
DIGITS = 12  # of a hash in a text
START_ANEW = "pass `force=True` (`--force`) to start anew"
NUMPY = [bytes, np.ndarray, np.dtype, *(getattr(np.dtypes, name) for name in np.dtypes.__all__)]
NUMPY += [np.zeros(0).__reduce__()[0], np.float64().__reduce__()[0]]  # what makes arrays and numbers of a pickle


class _HasFingerprint(Protocol):
    @property
    def fingerprint(self) -> Mapping[str, str]: ...


Loaded = TypeVar("Loaded")
State = TypeVar("State", bound=_HasFingerprint)


@dataclass(frozen=True)
class FilesState:
    """Sizes and states with which the files of an interrupted run go on.

    Attributes:
        recording: of recording.rrd.
        sizes: name -> bytes of each other file that grows.
        map_frames: indices of the frames that have a map.
        bev_frames: indices of the frames that have BEV features.
    """

    recording: RecordingState
    sizes: dict[str, int]
    map_frames: list[int]
    bev_frames: list[int]


@dataclass(frozen=True)
class RunState(Generic[Memory]):
    """A run after a number of finished frames.

    Attributes:
        fingerprint: of the run, see `run_fingerprint`.
        files: None as long as nothing can be kept; the run then starts anew.
        counts: of the summary so far.
        runner: what the next frame needs; nothing before the first frame and after the last one.
    """

    fingerprint: dict[str, str]
    files: FilesState | None
    counts: Counts
    runner: RunnerState[Memory] = field(default_factory=RunnerState)


def run_fingerprint(model: Model, drive: Drive, options: object) -> dict[str, str]:
    """Name -> hash or value of all that the results of a run depend on.

    options: the dataclass of the run's options; each of its fields is part of the fingerprint.
    """
    return {
        "version of bevcli": __version__,
        "model": f"{model.name}, {model.config_hash[:DIGITS]}",
        "weights": f"{model.weights or 'random'}, {model.weights_hash[:DIGITS]}",
        "device": model.device.type,
        "precision": f"{model.precision}, {model.engine}" if model.is_exported else model.precision,
        **{f"option {name.replace('_', '-')}": repr(value) for name, value in vars(options).items()},
        "frames of the input": f"{len(drive.stamps)}, {digest(drive.stamps)[:DIGITS]}",
        "calibration": digest(drive.rig)[:DIGITS],
        "ego-motion": "measured from the images" if drive.facts.motion_measured else "of the input",
        "files of the input": digest(tuple(map(_described, drive.input_files)))[:DIGITS],
        "images of the input": _described_images(drive),
    }


def saved_state(folder: RunFolder, fingerprint: Mapping[str, str], cls: type[State]) -> State | None:
    """The state of a kind in a folder, None if there is none.

    Raises OutputError if it is damaged, of another kind, or of a run with another fingerprint.
    """
    if not folder.state_path.exists():
        return None
    try:
        state = load_state(folder.state_path, cls)
    except InputError as error:
        raise OutputError(f"`resume` (`--resume`): {error}; {START_ANEW}") from None
    before, now = state.fingerprint, fingerprint
    if names := [name for name in {**before, **now} if before.get(name) != now.get(name)]:
        pairs = (f"{name}: was {before.get(name)}, is {now.get(name)}" for name in names)
        raise OutputError(
            f"{folder.path}: `resume` (`--resume`): the interrupted run differs from this one ({'; '.join(pairs)}): "
            f"pass the same model, options and input, or {START_ANEW.removeprefix('pass ')}"
        )
    return state


def save_state(path: Path, state: object) -> None:
    """Write a state. The file is replaced at once, so that it is whole at every moment. Raises OutputError."""
    copies = (tensor.detach().cpu().clone() for _, tensor in tensors_in(state))  # a view would bring its whole memory
    written = BytesIO()
    torch.save(exchanged(state, copies), written)
    content = written.getvalue()
    write_whole(path, FORMAT + hashlib.sha256(content).digest() + content, regular=True)


def load_state(path: Path, cls: type[Loaded]) -> Loaded:
    """Read a state that `save_state` wrote; tensors are on the CPU.

    cls: the type of the state. Its dataclasses state the type of every field.
    Raises InputError for a changed or damaged file, and for a state of another type.
    """
    written = read_bytes(path, LARGEST_BYTES)
    content = memoryview(written)[len(FORMAT) + hashlib.sha256().digest_size :]
    if not written.startswith(FORMAT):
        raise InputError(f"{path}: is not a state file of this version (expected one of {FORMAT.decode().strip()})")
    if hashlib.sha256(content).digest() != written[len(FORMAT) : -len(content)]:
        raise InputError(f"{path}: the state cannot be read: the file is damaged")
    try:
        state = load_data(BytesIO(content), [*NUMPY, *_classes_in(cls, set())])
    except (pickle.UnpicklingError, RuntimeError, ValueError, LookupError, TypeError, AttributeError) as error:
        reason = " ".join(str(error).rpartition("WeightsUnpickler error: ")[2].split())
        raise InputError(f"{path}: the state cannot be read ({reason:.200})") from None
    if not isinstance(state, get_origin(cls) or cls):
        raise InputError(f"{path}: the state cannot be read (expected {cls}, found a {type(state).__name__})")
    return state


def _classes_in(hint: Any, classes: set[Any]) -> Iterator[Any]:
    """The dataclasses in a type, and in the types of their fields."""
    for argument in get_args(hint):
        yield from _classes_in(argument, classes)
    cls = get_origin(hint) or hint
    if is_dataclass(cls) and cls not in classes:
        classes.add(cls)
        yield cls
        for of_field in get_type_hints(cls).values():
            yield from _classes_in(of_field, classes)


def digest(tree: object) -> str:
    """SHA-256 of plain values, dataclasses and arrays."""
    return hashlib.sha256(msgspec.msgpack.encode(tree, enc_hook=lambda array: array.tolist())).hexdigest()


def _described(path: Path) -> tuple[str, int, str]:
    """Name, size, and hash or time of a file of the input."""
    try:
        status = path.stat()
        if status.st_size > HASHED_BYTES:
            return path.name, status.st_size, str(status.st_mtime_ns)
        return path.name, status.st_size, hashlib.sha256(read_bytes(path, HASHED_BYTES)).hexdigest()
    except OSError as error:
        return path.name, -1, str(error.strerror)
    except InputError as error:
        return path.name, -1, str(error)


def _described_images(drive: Drive) -> str:
    """Number, and hash of names, sizes and times of change, of the image files and videos of all frames."""
    paths = dict.fromkeys(path for index in range(len(drive.stamps)) for path in drive.image_files(index))
    hashed = hashlib.sha256()
    for path in paths:
        try:
            status = path.stat()
            hashed.update(f"{path.name} {status.st_size} {status.st_mtime_ns}\n".encode(errors="surrogateescape"))
        except OSError as error:
            hashed.update(f"{path.name} {error.errno}\n".encode(errors="surrogateescape"))
        except ValueError:  # a null byte in the name
            hashed.update(b"no name\n")
    return f"{len(paths)}, {hashed.hexdigest()[:DIGITS]}"
