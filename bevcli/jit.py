"""`njit` of numba for all compiled functions: no state of the disk keeps one from being compiled.

numba keeps compiled functions beside the source file, or in the user's cache folder. Where neither can be written, as
for a read-only installation without a home, numba itself raises an error at import; later on a full disk, and where a
file of the cache is damaged.
"""

import logging
import os
import stat
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import FunctionCache

from bevcli.errors import BevcliError


class _Cache(FunctionCache):
    """A cache whose damaged files count as missing and are written anew; on a full disk, none are written."""

    @contextmanager
    def _guard_against_spurious_io_errors(self) -> Iterator[None]:  # of all reading and writing
        try:
            yield
        except OSError:  # a full disk
            pass
        except Exception:  # pickle raises any for other contents
            with suppress(OSError):
                self.flush()


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """`numba.njit(**options)` with a cache, a temporary one or none where numba finds no place for it.

    Raises BevcliError if numba's compiler is switched off.
    """
    if getattr(numba.config, "DISABLE_JIT"):  # noqa: B009, an attribute that numba makes at run time
        raise BevcliError("NUMBA_DISABLE_JIT is set: unset it, because the functions here run compiled only")

    options["no_cfunc_wrapper"] = True  # nobody calls compiled functions from C

    def compiled(function: Callable[..., Any]) -> Any:
        dispatcher = numba.njit(**options)(function)
        for is_cached in (lambda: True, _temporary_cache):
            try:
                if is_cached():
                    dispatcher._cache = _Cache(function)
                break
            except RuntimeError as error:
                if "cannot cache function" not in str(error):
                    raise
        return dispatcher

    return compiled


@cache
def _temporary_cache() -> bool:
    """Sets numba's cache folder to one in the temporary folder, once. False where there is no such place."""
    user = os.getuid() if os.name == "posix" else None
    folder = None if user is None else _private_folder(Path(tempfile.gettempdir()) / f"bevcli-numba-{user}", user)
    note = "compiled functions are not cached: every start takes some seconds longer"
    if folder is not None:
        setattr(numba.config, "CACHE_DIR", str(folder))  # noqa: B010, an attribute that numba makes at run time
        note = f"compiled functions are cached in {folder}"
    logging.getLogger("bevcli").warning(
        "note: neither the installation nor the home folder can be written: %s (NUMBA_CACHE_DIR sets another folder)",
        note,
    )
    return folder is not None


def _private_folder(path: Path, user: int) -> Path | None:
    """The folder, made where it is missing. None where it is not this user's alone: cached functions are code."""
    try:
        path.mkdir(mode=0o700, exist_ok=True)
        status = path.lstat()
    except OSError:
        return None
    ours = stat.S_ISDIR(status.st_mode) and status.st_uid == user and not status.st_mode & 0o077
    return path if ours and os.access(path, os.W_OK) else None
