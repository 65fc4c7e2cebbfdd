"""The times of images from the numbers in their names, whose unit is found, or from a text beside them.

A number that is a time since 1970 shows its unit by its size. For other numbers, at most one unit gives the rate of a
camera, 0.5 to 240 Hz: units differ by a factor of 1000. Numbers that may be indices, too, need the poses or the user.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from decimal import Decimal
from functools import cached_property
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.geometry.ego_motion import EgoMotion
from bevcli.parsing.documents import CSV_BYTES, LARGEST_INTEGER
from bevcli.parsing.files import is_there, read_text
from bevcli.sequences.native import TimeKind

Times = NDArray[np.int64]
Texts = Mapping[str, Sequence[str]]  # by camera, one of each image
UNITS_NS: dict[TimeKind, int] = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
WORDS: dict[TimeKind, str] = {
    "s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds", "date": "dates",
    "index": "indices",
}  # fmt: skip
SINCE_1970_NS = (978_307_200 * 10**9, 4_102_444_800 * 10**9)  # the years 2001 to 2099
LONGEST_NS = 24 * 3600 * 10**9  # of a drive
PERIODS_NS = (1e9 / 240 / 1.1, 1e9 / 0.5 * 1.1)  # of a camera, with a tenth for jitter
LONGEST_PERIOD_NS = 60e9  # of images since 1970 that are taken at intervals
JITTER, STEADY = 0.3, 0.8  # of a period; share of the steps that are whole periods
DENSE_STEP, LARGEST_STEP, SPARSE_STEP = 5, 100, 1000  # of indices: surely, possibly, only if they are no times
LARGEST_INDEX = 10**9
SMALLEST_TIMESTAMP = 10**13  # of a lone image: nanoseconds from this value on (hours after 1970), an index below it
HOURS_FROM_UTC = range(-12, 15)
TIMES, TIMESTAMPS = "times.txt", "timestamps.txt"  # of KITTI, beside the images
NUMBER, DECIMAL = re.compile(r"[0-9]+"), re.compile(r"[0-9]+(?:\.[0-9]+)?")
SECONDS_AND_FRACTION = re.compile(r"(?<!\d)(\d{10})[._-](\d{9}|\d{6}|\d{3})(?!\d)", re.ASCII)
DATE = re.compile(
    r"(?<!\d)((?:19|20)\d\d)[-_.]?(\d\d)[-_.]?(\d\d)[-_ .T]?(\d\d)[-_:.h]?(\d\d)[-_:.m]?(\d\d)"
    r"(?:[.,](\d{1,9})|[-_s]?(\d{9}|\d{6}|\d{3}))?(?!\d)",
    re.ASCII,
)


@dataclass(frozen=True)
class Reading:
    """One way to read the names of images."""

    kind: TimeKind  # the unit; "index" for numbers that are no times
    values: Mapping[str, Times]  # by camera, of each image: nanoseconds, or indices
    since: str = ""  # text that follows the unit: " since 1970", " in UTC", or ""

    @property
    def words(self) -> str:
        """The unit and its origin, such as "microseconds since 1970"."""
        return WORDS[self.kind] + self.since

    @property
    def is_known_origin(self) -> bool:
        """True for times since 1970 and dates."""
        return bool(self.since)

    @cached_property
    def steps(self) -> list[Times]:
        """Of each camera with two or more images, the steps from one to the next."""
        ordered = [np.sort(times) for times in self.values.values() if len(times) > 1]
        return [times[1:] - times[:-1] for times in ordered]

    @cached_property
    def has_rate(self) -> bool:
        """True for times at the rate of a camera."""
        shortest, longest = PERIODS_NS
        return bool(self.steps) and all(shortest <= np.median(steps) <= longest for steps in self.steps)

    @property
    def is_steady(self) -> bool:
        """True where most steps are whole periods of the camera, more than one where an image was lost."""
        periods = [steps / np.median(steps) for steps in self.steps]
        return all(
            (np.abs(of_camera - np.maximum(np.round(of_camera), 1)) <= JITTER).mean() >= STEADY for of_camera in periods
        )

    @property
    def ends(self) -> tuple[int, int]:
        """The smallest and the largest value."""
        together = np.concatenate(list(self.values.values()))
        return int(together.min()), int(together.max())

    def is_covered(self, motion: EgoMotion) -> bool:
        """True where the poses cover at least half of the times."""
        return bool(motion.covered(np.concatenate(list(self.values.values()))).mean() >= 0.5)


def read_names(where: Path, names: Texts, motion: EgoMotion | None, kind: TimeKind | None) -> Reading:
    """The times or indices of images, in the order of their names.

    Args:
        where: the folder, for messages.
        names: by camera, file names without suffix, at least one; each has a number.
        motion: the poses, which decide where two readings are possible. None without.
        kind: what the user states.

    Raises InputError where no reading is possible, or more than one.
    """
    columns = list(_columns(where, names))
    if kind is not None:
        return _in_unit(where, columns, names, kind)
    dates = _read(names, "date")
    if dates is not None and (dates.has_rate or not dates.steps):
        return _in_time_zone(dates, motion)
    candidates = [readings for column in columns if (readings := _readings(column))]
    if not candidates:
        first = next(iter(names.values()))
        raise InputError(
            f"{where}: the names {first[0]} to {first[-1]} are no times of a camera in any unit (expected 0.5 to 240 "
            "images per second) and no different indices: state their unit by `times` (`--times`), or list the images "
            "in frames.csv"
        )
    sure = [readings[0] for readings in candidates if len(readings) == 1]
    if not sure:
        return _decided(where, names, candidates[0], motion)
    # A time since 1970 goes before another time, and this before an index.
    return min(sure, key=lambda reading: (not reading.is_known_origin, reading.kind == "index"))


def _decided(where: Path, names: Texts, readings: list[Reading], motion: EgoMotion | None) -> Reading:
    """The one of several readings that fits the poses: times that they cover, or else the indices."""
    times = [reading for reading in readings if reading.kind != "index"]
    if motion is not None:
        fitting = [reading for reading in times if reading.is_covered(motion)]
        fitting = fitting or [reading for reading in readings if reading.kind == "index"]
        if len(fitting) == 1:
            return fitting[0]
    words = [f"{each.words} ({1e9 / np.median(each.steps[0]):.3g} Hz)" for each in times]
    words += ["indices of images"] if len(times) < len(readings) else []
    options = " or ".join(f'`times="{each.kind}"` (`--times`)' for each in readings)
    first = next(iter(names.values()))
    raise InputError(
        f"{where}: the numbers in the image names {first[0]} to {first[-1]} may be {' or '.join(words)}: pass {options}"
    )


def _columns(where: Path, names: Texts) -> Iterator[Texts]:
    """The numbers of the names that differ from image to image, the last ones first; decimals before their parts."""
    for pattern in (DECIMAL, NUMBER):
        split = {camera: [pattern.findall(name) for name in of_camera] for camera, of_camera in names.items()}
        counts = {camera: {len(numbers) for numbers in of_camera} for camera, of_camera in split.items()}
        if pattern is NUMBER:
            _check_counts(where, names, split)
        if any(len(of_camera) > 1 for of_camera in counts.values()):
            continue
        columns = []
        for position in range(-1, -1 - min(chain.from_iterable(counts.values())), -1):
            column = {camera: [numbers[position] for numbers in of_camera] for camera, of_camera in split.items()}
            if pattern is NUMBER or any("." in text for text in chain.from_iterable(column.values())):
                columns.append(column)
        varying = [column for column in columns if any(len(set(texts)) > 1 for texts in column.values())]
        yield from varying or (columns[:1] if pattern is NUMBER else ())
        if pattern is DECIMAL:
            matches = {camera: [SECONDS_AND_FRACTION.search(name) for name in each] for camera, each in names.items()}
            if all(chain.from_iterable(matches.values())):
                yield {camera: [f"{m[1]}.{m[2]}" for m in each if m] for camera, each in matches.items()}


def _check_counts(where: Path, names: Texts, split: Mapping[str, list[list[str]]]) -> None:
    for camera, numbers in split.items():
        for name, in_name in zip(names[camera], numbers, strict=True):
            if len(in_name) != len(numbers[0]):
                raise InputError(
                    f"{where}: camera {camera}: the name {name} has {len(in_name)} numbers, and {names[camera][0]} has "
                    f"{len(numbers[0])}: rename one, or list the images in frames.csv"
                )


def _readings(column: Texts) -> list[Reading]:
    """The possible readings of a column. One that is a time since 1970 at the rate of a camera is the only one."""
    readings, slow = list[Reading](), list[Reading]()
    for reading in filter(None, (_read(column, unit) for unit in UNITS_NS)):
        medians = [float(np.median(steps)) for steps in reading.steps]
        if reading.is_known_origin and (reading.has_rate or not medians):
            return [reading]
        if reading.is_known_origin and min(medians) >= PERIODS_NS[0]:
            (readings if max(medians) <= LONGEST_PERIOD_NS else slow).append(reading)  # if no other unit fits
        elif reading.has_rate and reading.is_steady and np.ptp(reading.ends) <= LONGEST_NS:
            readings.append(reading)
    readings = readings or slow
    index = _read(column, "index")
    if index is None:
        return readings
    largest = index.ends[1]
    if not index.steps:  # each camera has one image
        return [_read(column, "ns") or index if largest >= SMALLEST_TIMESTAMP else index]
    if largest >= LARGEST_INDEX:
        return readings
    pooled = np.concatenate(index.steps)
    step = np.median(pooled)
    if step < DENSE_STEP or (not readings and step <= SPARSE_STEP):
        return [index]
    is_regular = (pooled % step == 0).mean() >= STEADY and step <= LARGEST_STEP
    return [*readings, index] if is_regular else readings


def _read(column: Texts, kind: TimeKind) -> Reading | None:
    """Texts of one kind; None where one is of another or too large, or two images of a camera have the same."""
    values = {}
    for camera, texts in column.items():
        numbers = [_number(text, kind) for text in texts]
        whole = [number for number in numbers if number is not None and number < 1 << 62]
        if len(set(whole)) < len(texts):
            return None
        values[camera] = np.array(whole, dtype=np.int64)
    first, last = SINCE_1970_NS
    is_known = kind in UNITS_NS and all(((v >= first) & (v < last)).all() for v in values.values())
    return Reading(kind, values, " in UTC" if kind == "date" else " since 1970" if is_known else "")


def _number(text: str, kind: TimeKind) -> int | None:
    if kind == "date":
        return date_ns(text)
    if kind == "index":
        return None if "." in text else int(text)
    return scaled(text, UNITS_NS[kind])


def scaled(number: str, factor: int = 10**9) -> int | None:
    """A decimal number times a factor, such as 1.5 or 1.5e+00 seconds in nanoseconds; None for another text."""
    try:
        return round(Decimal(number) * factor)
    except (ArithmeticError, ValueError):
        return None


def date_ns(name: str) -> int | None:
    """The time, ns since 1970, of a date in UTC that a text has; None where it has none."""
    date = DATE.search(name)
    if date is None:
        return None
    try:
        time = datetime(*map(int, date.groups()[:6]), tzinfo=UTC)  # type: ignore[arg-type,misc]
    except ValueError:
        return None
    return int(time.timestamp()) * 10**9 + int((date[7] or date[8] or "").ljust(9, "0"))


def _in_time_zone(dates: Reading, motion: EgoMotion | None) -> Reading:
    """Dates in UTC or, where only those of one time zone are covered by the poses, in this one."""
    if motion is None or dates.is_covered(motion):
        return dates
    zones = []
    for hours in HOURS_FROM_UTC:
        moved = {camera: times - hours * 3600 * 10**9 for camera, times in dates.values.items()}
        zones.append(replace(dates, values=moved, since=f" in UTC{hours:+d}, as the poses"))
    fitting = [zone for zone in zones if zone.is_covered(motion)]
    return fitting[0] if len(fitting) == 1 else dates


def _in_unit(where: Path, columns: list[Texts], names: Texts, kind: TimeKind) -> Reading:
    """The reading of the kind that the user states, of the column that fits best."""
    columns = [names] if kind == "date" else columns
    possible = [reading for column in columns if (reading := _read(column, kind)) is not None]
    if not possible:
        example = next(iter(names.values()))[0]
        expected = "dates such as 20260301120000" if kind == "date" else WORDS[kind]
        raise InputError(
            f'{where}: `times="{kind}"` (`--times {kind}`): no numbers in the names are possible (expected '
            f"{expected}, different in each image of a camera, found {example}): pass another unit"
        )
    if kind == "index":
        return min(possible, key=lambda each: any(np.median(steps) > LARGEST_STEP for steps in each.steps))
    return min(possible, key=lambda each: (not each.is_known_origin, not each.has_rate))


def listed_times(drive: Path, images: Path, numbers: Iterable[int]) -> tuple[dict[int, int], str] | None:
    """The time, ns, of each number of a camera's images, and the name of the file; None where no file fits.

    images: the folder of the images. Line n is the time of number n, or of the n-th image where there are as many.
    """
    numbers = sorted(numbers)
    files = (images / TIMESTAMPS, images.parent / TIMESTAMPS, drive / TIMES)
    file = next((each for each in files if is_there(each)), None)
    if file is None:
        return None
    times = read_times(file).tolist()
    if len(times) == len(numbers):
        return dict(zip(numbers, times, strict=True)), file.name
    return ({number: times[number] for number in numbers}, file.name) if numbers[-1] < len(times) else None


def read_times(file: Path) -> NDArray[np.int64]:
    """(N,) times of the lines of a file, ns: seconds, or dates. Raises InputError."""
    times = list[int]()
    for number, line in enumerate(read_text(file, CSV_BYTES).splitlines(), 1):
        if not (text := line.strip()):
            continue
        time = date_ns(text) if ":" in text else scaled(text)
        if time is None or abs(time) > LARGEST_INTEGER or (times and time <= times[-1]):
            raise InputError(f'{file}: line {number}: expected a later time in seconds, or a date, found "{text:.40}"')
        times.append(time)
    return np.array(times, dtype=np.int64)
