"""Times of numbered images that a text beside them lists, one a line: KITTI's times.txt and timestamps.txt."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.parsing.documents import CSV_BYTES, LARGEST_INTEGER
from bevcli.parsing.files import is_there, read_text
from bevcli.workshop.formats.name_times import date_ns, scaled_ns

TIMES, TIMESTAMPS = "times.txt", "timestamps.txt"


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
        time = date_ns(text) if ":" in text else scaled_ns(text)
        if time is None or abs(time) > LARGEST_INTEGER or (times and time <= times[-1]):
            raise InputError(f'{file}: line {number}: expected a later time in seconds, or a date, found "{text:.40}"')
        times.append(time)
    return np.array(times, dtype=np.int64)
