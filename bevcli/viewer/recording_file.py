"""Is it a recording, and is it whole? One that was cut off is mended in a temporary copy, and that is said."""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from bevcli.errors import InputError
from bevcli.viewer.native import viewer_binary, viewer_environment

MAGIC, FOOTER = b"RRF2", b"RRF2FOOT"  # how rerun's files begin, and what stands 12 bytes before their end


@dataclass(frozen=True)
class WholeRecording:
    """A recording that any reader can read. path: the user's file or a mended copy. mended: it was cut off."""

    path: Path
    mended: bool


@contextmanager
def whole_recording(path: Path) -> Iterator[WholeRecording]:
    """The recording at a path; where its end is missing, a mended copy that lives as long as the context.

    Raises InputError, one line, for a file that is missing, is no recording, or holds nothing that can be read.
    """
    if _is_whole(path):
        yield WholeRecording(path, mended=False)
        return
    with tempfile.TemporaryDirectory(prefix="bevcli-") as folder:
        copy = Path(folder) / path.name
        command = [str(viewer_binary()), "rrd", "filter", "--continue-on-error", str(path), "-o", str(copy)]
        subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, env=viewer_environment(), check=False)
        if not copy.is_file() or copy.stat().st_size < 1000:
            raise InputError(f"{path}: the recording was cut off before its first frame; there is nothing to show")
        yield WholeRecording(copy, mended=True)


def _is_whole(path: Path) -> bool:
    if path.is_dir():
        raise InputError(f"{path}: this is a folder (expected a recording, such as {path / 'recording.rrd'})")
    try:
        with path.open("rb") as file:
            start = file.read(len(MAGIC))
            size = file.seek(0, 2)
            file.seek(max(0, size - 12))
            end = file.read(12)
    except FileNotFoundError:
        raise InputError(f"{path}: the recording is missing (`bevcli run` writes one)") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    if not start:
        raise InputError(f"{path}: this is no recording: the file is empty")
    if start != MAGIC:
        raise InputError(f"{path}: this is no recording (expected a file that starts with RRF2, found {start!r})")
    return end.startswith(FOOTER)
