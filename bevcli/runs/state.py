"""The state of a run that can be resumed: its file, and the fingerprint of the run that it is of.

PyTorch writes and reads the file. The reader names the type that it expects: of other classes than those in its fields
nothing is made.
"""

import contextlib
import hashlib
import os
import pickle
import sys
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
from bevcli.parsing.files import MIB, read_bytes
from bevcli.parsing.pth import load_data
from bevcli.recording.writer import RecordingState
from bevcli.runs.summary import Counts
from bevcli.sequences.files.incremental_json import GrowingFile
from bevcli.writing import lock, output_errors, partial_path, write_whole

OWN = ".bevcli"
LARGEST_LIST = 64 * MIB  # of the list of written files


class RunFolder(contextlib.ExitStack):
    """`with RunFolder(out, force=…, resume=…) as folder:`; the folder is made if it is missing.

    Attributes:
        path: the folder.
        state_path: where the state of the run is saved.
    """

    def __init__(self, path: Path, *, force: bool = False, resume: bool = False) -> None:
        super().__init__()
        self.path, self.state_path = path, path / OWN / "state.pt"
        self._force, self._resume = force, resume
        self._written: GrowingFile | None = None
        self._names: dict[str, None] = {}  # in the order in which runs made them
        self._is_new, self._is_discarded = not path.exists(), False

    def __enter__(self) -> "RunFolder":
        """Raises OutputError: another run uses the folder, or it holds something already, or it cannot be written."""
        out = self.path
        if out.exists() and not out.is_dir():
            raise OutputError(f"{out}: is a file (expected a folder to write to)")
        written = out / OWN / "written"
        with contextlib.ExitStack() as stack, output_errors(out):  # unlocks the folder if this fails
            is_free = self._force or self._resume or not out.exists()
            if not is_free and (written.exists() or any(entry.name != OWN for entry in out.iterdir())):
                raise OutputError(
                    f"{out}: exists already; pass `force=True` (`--force`) to overwrite it, `resume=True` (`--resume`) "
                    "to go on with an interrupted run, or `out` (`--out DIR`) for another folder"
                )
            stack.callback(self._remove_folders)  # once the lock is gone
            stack.enter_context(folder_lock(out))
            if written.is_file():  # the files of earlier runs
                names = read_bytes(written, LARGEST_LIST, error=OutputError).decode(errors="replace").splitlines()
                # A path with ".." would leave the folder: no run of ours writes one.
                inside = (not Path(name).is_absolute() and ".." not in Path(name).parts for name in names)
                self._names = dict.fromkeys(name for name, good in zip(names, inside, strict=True) if name and good)
            self.push(stack.pop_all())
        return self

    def add(self, path: Path) -> None:
        """Put a file on the list before it is written, so that `force` may remove it later.

        Raises OutputError if the file exists and no run wrote it, leads out of the folder through a link, or the list
        cannot be written.
        """
        name = os.path.relpath(path, self.path)
        if path.is_symlink() or not self._holds(path):
            raise OutputError(f"{path}: is a link, or leads out of {self.path} through one: remove it")
        if name in self._names:
            return
        if path.exists():
            raise OutputError(f"{path}: exists already, and no run wrote it: move it, or pass `out` (`--out DIR`)")
        if self._written is None:
            file = self.path / OWN / "written"
            self._written = GrowingFile(file, file.stat().st_size if file.exists() else None)
            self.callback(self._written.close)
        self._written.append(f"{name}\n".encode())
        self._names[name] = None

    def has_files(self) -> bool:
        """Runs have written files."""
        return bool(self._names)

    def remove_written(self) -> None:
        """Remove the files that earlier runs wrote, in that order, and nothing else. Raises OutputError."""
        named = [path for name in self._names for path in (self.path / name, partial_path(self.path / name))]
        files = [path for path in named if self._holds(path)]
        for path in (*files, self.state_path, self.path / OWN / "written"):
            with output_errors(path, "removed"):
                if path.is_file() or path.is_symlink():
                    path.unlink()
        self._names = {}

    def discard(self) -> None:
        """Remove what this run wrote, and on exit the folder if this run made it. Raises OutputError."""
        if self._written is not None:
            self._written.close()
            self._written = None
        self.remove_written()
        self._is_discarded = True

    def _remove_folders(self) -> None:
        for folder in (self.path / OWN, self.path) if self._is_new and self._is_discarded else ():
            with contextlib.suppress(OSError):  # it holds something else
                folder.rmdir()

    def _holds(self, path: Path) -> bool:
        """The folder of a file is in this one after all links are followed."""
        return Path(os.path.realpath(path.parent)).is_relative_to(os.path.realpath(self.path))


@contextlib.contextmanager
def folder_lock(out: Path) -> Iterator[None]:
    """Lock a folder, made if it is missing, against other runs. Raises OutputError where it is locked already.

    The lock file names the process. Somebody may delete it; so the folder itself is locked too.
    """
    if (out / OWN).is_symlink():
        raise OutputError(f"{out / OWN}: is a link (expected a folder): remove it")
    with contextlib.ExitStack() as stack:
        with output_errors(out):
            (out / OWN).mkdir(parents=True, exist_ok=True)
            path, is_ours = out / OWN / "lock", False
            while not is_ours:  # else the run before has just ended and removed its lock file
                file = stack.enter_context(path.open("a+", encoding="utf-8", errors="replace"))
                if not lock(file.fileno()):
                    file.seek(0)
                    holder = file.read(500).strip() or "an unknown process"
                    raise OutputError(f"{out}: is in use by another run ({holder}): wait, or pass `out` (`--out DIR`)")
                with contextlib.suppress(FileNotFoundError):
                    is_ours = os.path.samestat(os.fstat(file.fileno()), path.stat())
            file.truncate(0)
            file.write(f"process {os.getpid()}: {' '.join(sys.argv)[:400]}\n")
            file.flush()
            stack.callback(_remove, file.name)
            if sys.platform != "win32":
                folder = os.open(out, os.O_RDONLY)
                stack.callback(os.close, folder)
                if not lock(folder):
                    raise OutputError(f"{out}: is in use by another run: wait, or pass `out` (`--out DIR`)")
        yield


def _remove(path: str) -> None:
    with contextlib.suppress(OSError):
        os.unlink(path)


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
    """Sizes and states with which the files of an interrupted run go on."""

    recording: RecordingState  # of recording.rrd
    sizes: dict[str, int]  # name -> bytes of each other file that grows
    map_frames: list[int]  # indices of the frames that have a map
    bev_frames: list[int]  # indices of the frames that have BEV features


@dataclass(frozen=True)
class RunState(Generic[Memory]):
    """A run after a number of finished frames."""

    fingerprint: dict[str, str]  # of the run, see `run_fingerprint`
    files: FilesState | None  # None as long as nothing can be kept; the run then starts anew
    counts: Counts  # of the summary so far
    # what the next frame needs; nothing before the first frame and after the last one
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
