"""Job: the model and the options that every drive of a batch is run with. And the record of a drive that was run."""

import contextlib
import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, NotRequired, TypedDict, TypeVar

import msgspec
from msgspec import Meta

from bevcli._version import __version__
from bevcli.errors import InputError
from bevcli.frame import Sequence
from bevcli.inference.load import Model, load_model
from bevcli.inference.options import ModelOptions
from bevcli.options import defaults, gather
from bevcli.published import weights_folder
from bevcli.runs.options import RunOptions
from bevcli.sequences.format import check_options, format_of, option_classes
from bevcli.sequences.open import open_sequence
from bevcli.sequences.options import FormatOptions, SequenceOptions
from bevcli.workshop.batch.drives import Drive
from bevcli.workshop.batch.storage import is_url

RESULTS, FAILED, ATTEMPTS = "drives", "failed", ".bevcli/attempts"  # folders of a batch
SCORE_BINS = 20  # of the histogram of a drive's scores, from 0 to 1
READING_THREADS = 16  # small files of a batch
RECORD = "drive.json"  # in the folder of a drive's results: its record. A folder with it is whole.
Record = dict[str, Any]  # of a drive after it was run; a row of batch.parquet
_Count = Annotated[int, Meta(ge=0, le=1 << 62)]
_Number = Annotated[float, Meta(ge=-1e12, le=1e12)]
Own = TypeVar("Own", bound=FormatOptions)


@dataclass(frozen=True)
class Job:
    """The model and the options of a batch. On a cluster, the paths in it must exist on every machine.

    Attributes:
        out: path or URL of the batch's folder.
        model: options of `load_model`.
        source: options of `open_sequence`; the scene is that of the drive.
        own: options of formats; a format that is missing has its defaults.
        run: options of `run_into_folder`.
        embed: whether a vector per frame is written.
        evaluate: whether drives with ground truth are scored.
        retries: further attempts after a drive has failed.
    """

    out: str
    model: ModelOptions = field(default_factory=ModelOptions)
    source: SequenceOptions = field(default_factory=SequenceOptions)
    own: tuple[FormatOptions, ...] = ()
    run: RunOptions = field(default_factory=RunOptions)
    embed: bool = False
    evaluate: bool = False
    retries: int = 2

    def load_model(self) -> Model:
        """The model with its weights. Raises BevcliError."""
        return load_model(options=self.model)

    def own_of(self, kind: type[Own]) -> Own:
        """The own options of a format. kind: their dataclass."""
        return next((each for each in self.own if type(each) is kind), kind())

    def open(self, path: Path, scene: str | None) -> Sequence:
        """A drive, or a scene of it. Raises InputError."""
        own = self.own_of(format_of(path).options)
        return open_sequence(path, replace(self.source, scene=scene), **vars(own))

    def check_options(self, drives: Iterable[Drive]) -> None:
        """Raise InputError for an option that no format of the drives has. One at a URL may have any format."""
        if any(is_url(drive.source) for drive in drives):
            return
        found = set()
        for drive in drives:
            with contextlib.suppress(InputError):  # a drive that cannot be opened becomes a row with its error
                found.add(format_of(Path(drive.source)))
        if found:
            given = {name: value for own in self.own for name, value in vars(own).items()}
            check_options(given, found, "the drives of the batch")

    def hash(self, model: Model) -> str:
        """SHA-256 of what the results of a drive depend on, its input excepted. model: of `load_model`, any device."""
        reading = {name: _fact(value) for part in (self.source, *self.own) for name, value in vars(part).items()}
        facts = {
            "version": __version__,
            "model": model.config_hash,
            "weights": model.weights_hash,
            "device": self.model.device,
            "precision": self.model.precision,
            "engine": (self.model.engine, _fact(self.model.calibrate_with)),
            "reading": reading,
            "run": {name: _fact(value) for name, value in vars(self.run).items()},
            "embed": self.embed,
            "evaluate": self.evaluate,
        }
        return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()


def all_own_options(values: Mapping[str, Any]) -> tuple[FormatOptions, ...]:
    """The own options of every format, from the options of all formats by name. Relative paths become absolute."""
    given = {name: value.absolute() if isinstance(value, Path) else value for name, value in values.items()}
    return tuple(
        gather(kind, None, {name: given[name] for name in defaults(kind) if name in given}) for kind in option_classes()
    )


def with_absolute_paths(model: ModelOptions) -> ModelOptions:
    """The options for workers in other folders: they take the downloaded weights of this process, and fetch none."""
    weights, drive = (None if path is None else path.absolute() for path in (model.weights, model.calibrate_with))
    folder = weights_folder(model.weights_dir).absolute()
    return replace(model, weights=weights, calibrate_with=drive, weights_dir=folder, fetch=False)


def _fact(value: object) -> str:
    """A value as text; of a file, its contents count and not its name."""
    if isinstance(value, Path) and value.is_file():
        return hashlib.sha256(value.read_bytes()).hexdigest()
    return repr(value)


class _Run(TypedDict):
    drive: str
    source: str
    scene: str | None
    result: str
    attempts: _Count
    error: str


class _Scores(TypedDict):
    ground_truth_boxes: _Count


class _Done(_Run):
    frames: _Count
    boxes: _Count
    boxes_by_class: dict[str, _Count]
    tracks: _Count | None
    dropped_images: _Count
    skipped_frames: _Count
    not_finite_frames: _Count
    seconds: _Number
    frames_per_second: _Number
    fetch_seconds: _Number
    output_bytes: _Count
    score_histogram: Annotated[list[_Count], Meta(min_length=SCORE_BINS, max_length=SCORE_BINS)]
    scores: dict[str, _Number | None] | None
    not_scored: str
    input_errors: NotRequired[str]


def read_record(content: bytes | None, result: str) -> Record | None:
    """A stored record, which may be damaged; None if there is none, or it is broken: its drive is then run again.

    result: name of the folder of the drive's results.
    """
    try:
        record: Record = msgspec.json.decode(content or b"")
        msgspec.convert(record, _Run if record["error"] else _Done)
        if record.get("scores"):
            msgspec.convert(record["scores"], _Scores)
    except (msgspec.MsgspecError, LookupError, TypeError, ValueError, RecursionError):
        return None
    return record if record["result"] == result else None
