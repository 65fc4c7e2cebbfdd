"""RunSummary: counts and times of a run, as summary.json and as a short table."""

import json
import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from bevcli._version import __version__
from bevcli.frame import Drive, Frame, Prediction
from bevcli.inference.image_repair import BLACK_SHARE, WHITE_SHARE, grey_levels, sampled
from bevcli.inference.load import Model
from bevcli.printing import counted, duration
from bevcli.runs import RunOptions
from bevcli.writing import write_whole

SUMMARY = "summary.json"
NEARLY_BLACK, NEARLY_WHITE = 24, 231  # grey levels that no image reaches whose numbers are stored in too many bits
RATIO = 1.01  # of two neighbouring bins of a `RunningMedian`


@dataclass
class RunningMedian:
    """A histogram with logarithmic bins. Its median is at most 0.5 % wrong."""

    count: int = 0  # number of values
    total_s: float = 0.0  # their sum, seconds
    # index of a bin -> number of values in it; a bin is at RATIO ** index seconds
    bins: dict[int, int] = field(default_factory=dict)

    def add(self, seconds: float) -> None:
        """Add a value. Values below 1 µs count as 1 µs."""
        index = round(math.log(max(seconds, 1e-6), RATIO))
        self.count += 1
        self.total_s += seconds
        self.bins[index] = self.bins.get(index, 0) + 1

    def value(self) -> float:
        """The median in seconds; of an even number of values the lower of the two in the middle. 0 without values."""
        before = 0
        for index in sorted(self.bins):
            before += self.bins[index]
            if 2 * before >= self.count:
                return float(RATIO**index)
        return 0.0


@dataclass
class Counts:
    """Counts and times of a run so far. A resumed run goes on from them."""

    seconds: dict[str, RunningMedian] = field(default_factory=dict)  # by stage
    whole: RunningMedian = field(default_factory=RunningMedian)  # of whole frames
    boxes: dict[str, int] = field(default_factory=dict)  # class -> number of boxes
    unseen: int = 0  # number of boxes that were left out, because no camera looks there
    tracks: dict[str, str] | None = None  # identity -> class; None without tracks
    dropped: list[tuple[int, str, str]] = field(default_factory=list)  # (frame, camera, reason) of each missing image
    skipped: list[int] = field(default_factory=list)  # frames without any image
    # (frame, where) of frames whose numbers stopped being finite
    not_finite: list[tuple[int, str]] = field(default_factory=list)
    started_anew: list[tuple[int, str]] = field(default_factory=list)  # (frame, reason) of frames without history
    embeddings: dict[str, str] = field(default_factory=dict)  # camera of the rig -> camera of the model
    flat: dict[str, int] = field(default_factory=dict)  # camera -> number of images that are nearly black or white


class RunSummary:
    """Counts and times of a run. It keeps no frame.

    Attributes:
        files: that the run wrote.
        counts: so far.
        input_errors: of the drive, one line for each, see `bevcli.rig.sequence_checks`.
    """

    def __init__(
        self, model: Model, drive: Drive, options: RunOptions, counts: Counts, input_errors: tuple[str, ...] = ()
    ) -> None:
        self.files: tuple[Path, ...] = ()
        self._model, self._drive, self._options, self.counts = model, drive, options, counts
        self.input_errors = input_errors

    def add(self, frame: Frame, prediction: Prediction, recording_s: float, whole_s: float) -> None:
        """Count a frame. recording_s: spent on writing. whole_s: since the frame before was done."""
        counts = self.counts
        counts.embeddings = counts.embeddings or dict(prediction.camera_embeddings)
        counts.whole.add(whole_s)
        for stage, seconds in {**prediction.stage_seconds, "recording": recording_s}.items():
            counts.seconds.setdefault(stage, RunningMedian()).add(seconds)
        if prediction.boxes.scores is not None:
            score = self._options.recording.score
            shown = prediction.boxes.shown(score)
            counts.unseen += len(prediction.boxes.scored(score)) - len(shown)
            counts.boxes = dict(Counter(counts.boxes) + Counter(shown.classes.tolist()))
            if shown.instances is not None:
                owners = zip(shown.instances.tolist(), shown.classes.tolist(), strict=True)
                counts.tracks = counts.tracks or {}
                counts.tracks.update({instance: name for instance, name in owners if instance})
        for name, image in frame.images.items():
            black, white = grey_levels(sampled(image.pixels_bgr), (BLACK_SHARE, WHITE_SHARE))
            if white < NEARLY_BLACK or black > NEARLY_WHITE:
                counts.flat[name] = counts.flat.get(name, 0) + 1
        index = frame.stamp.index
        counts.dropped += [(index, camera, reason) for camera, reason in frame.dropped.items()]
        if prediction.skipped:
            counts.skipped.append(index)
        if prediction.not_finite:
            counts.not_finite.append((index, prediction.not_finite))
        if prediction.started_anew:
            counts.started_anew.append((index, str(prediction.started_anew)))

    def _input_notes(self) -> list[str]:
        missing = Counter(camera for _, camera, _ in self.counts.dropped)
        flat = [name for name, count in self.counts.flat.items() if count == self.frames - missing[name]]
        notes = [f"all images of {name} are nearly black or white: are they 12 bits in 16?" for name in flat]
        return [*self.input_errors, *self._model.training_notes(self._drive.rig), *notes]

    @property
    def frames(self) -> int:
        """The number of frames that are done."""
        return self.counts.whole.count

    @property
    def is_complete(self) -> bool:
        """All frames are done."""
        return self.frames == len(self._drive.stamps)

    def to_dict(self) -> dict[str, object]:
        """The contents of summary.json."""
        model, counts = self._model, self.counts
        return {
            "bevcli_version": __version__,
            "sequence": self._drive.name,
            "model": model.name,
            "weights": None if model.weights is None else str(model.weights),
            "untrained": model.untrained,
            "device": model.device.type,
            "precision": model.precision,
            "engine": model.engine,
            "temporal": self._options.temporal,
            "frames": counts.whole.count,
            "frames_asked_for": len(self._drive.stamps),
            "score": self._options.recording.score,
            "boxes": sum(counts.boxes.values()),
            "boxes_by_class": dict(counts.boxes),
            "boxes_unseen": counts.unseen,
            "tracks": None if counts.tracks is None else len(counts.tracks),
            "tracks_by_class": dict(Counter((counts.tracks or {}).values())),
            "frames_per_second": self._rate(),
            "stage_ms": {stage: round(1000 * s.value(), 3) for stage, s in counts.seconds.items()},
            "camera_embeddings": counts.embeddings,
            "dropped_images": [{"frame": f, "camera": c, "reason": why} for f, c, why in counts.dropped],
            "skipped_frames": counts.skipped,
            "not_finite_frames": [{"frame": f, "where": layer} for f, layer in counts.not_finite],
            "started_anew": [{"frame": f, "reason": why} for f, why in counts.started_anew],
            "notes": [*self._drive.notes, *self._input_notes()],
            "files": [str(path) for path in self.files],
        }

    def write(self, folder: Path, files: Iterable[Path]) -> None:
        """Write summary.json into a folder. files: that the run wrote. Raises OutputError."""
        path = folder / SUMMARY
        self.files = (*files, path)
        write_whole(path, (json.dumps(self.to_dict(), indent=1) + "\n").encode(), regular=True)

    def table(self) -> str:
        """The summary as a few aligned lines."""
        counts = self.counts
        guessed = [f"{name} as {stand_in}" for name, stand_in in counts.embeddings.items() if name != stand_in]
        stages = ", ".join(f"{stage} {1000 * s.value():.0f} ms" for stage, s in counts.seconds.items())
        unseen = f"; {counts.unseen} more where no camera looks (`--unseen` shows them)" if counts.unseen else ""
        rows = [
            ("frames", f"{self.frames} in {duration(counts.whole.total_s)}, {self._rate():.2f} per second"),
            (
                "boxes",
                f"{sum(counts.boxes.values())} with a score of {self._options.recording.score:g} or more{unseen}",
            ),
            ("stages", f"{stages} (medians)"),
        ]
        if counts.tracks is not None:
            rows.insert(2, ("tracks", f"{counted(len(counts.tracks), 'objects')} with such boxes"))
        if guessed:
            rows.append(("cameras", f"{', '.join(guessed)} (embeddings; `cameras` (`--camera`) changes them)"))
        if counts.dropped:
            images, frames = counted(len(counts.dropped), "images"), counted(len(counts.skipped), "frames")
            rows.append(("dropped", f"{images}, {frames} without any"))
        if counts.not_finite:
            _, layer = counts.not_finite[0]
            rows.append(("failed", f"{counted(len(counts.not_finite), 'frames')}: NaN or infinity, first in {layer}"))
        if self._model.untrained:
            rows.append(("weights", "UNTRAINED: random weights, the boxes are meaningless"))
        rows += [("rig", note) for note in self._input_notes()]
        rows += [("written", str(path)) for path in self.files]
        return "\n".join(f"{name:<8} {text}" for name, text in rows)

    def _rate(self) -> float:
        whole = self.counts.whole
        return whole.count / whole.total_s if whole.total_s else 0.0
