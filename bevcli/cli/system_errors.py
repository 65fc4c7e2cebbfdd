"""Errors of other packages that the system causes, and no mistake of ours: one line in place of a traceback."""

import re
import traceback
from pathlib import Path

import bevcli
from bevcli.printing import one_line, reason_of

# Each library words it otherwise.
NO_MEMORY = re.compile(
    "map segment|out of memory|insufficient memory|bad_alloc|bad allocation|(?:cannot|can't|unable to) allocate"
    "|start new thread",
    re.I,
)
OURS = str(Path(bevcli.__file__).parent)


def system_error(error: Exception) -> str | None:
    """The message for a lack of memory, or for a package that cannot be imported; None for any other error."""
    reason = one_line(reason_of(error), 300)
    if _lacks_memory(error):
        return f"the system gives no more memory or threads: {reason}"
    package = _failed_import(error)
    if package:
        return f"the package {package} cannot be imported: {reason}; check its installation and environment variables"
    return None


def _lacks_memory(error: BaseException | None) -> bool:
    while error is not None:
        if isinstance(error, MemoryError) or NO_MEMORY.search(str(error)):
            return True
        error = error.__cause__ or error.__context__
    return False


def _failed_import(error: Exception) -> str:
    """The package of somebody else whose import has raised an error; "" for an error of anything else."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename.startswith(OURS)]
    words = (frames[-1].line or "").split() if frames else []
    package = words[1].partition(".")[0] if words[:1] in (["import"], ["from"]) else ""
    return "" if package == "bevcli" else package
