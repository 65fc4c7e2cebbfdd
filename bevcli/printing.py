"""Texts for a terminal, and cells of tables.

They may hold names and contents of files, so control characters are printed as escapes.
"""

import difflib
import io
import math
import re
import sys
import unicodedata
from collections.abc import Collection, Iterable, Sequence
from typing import Any

LONGEST_MESSAGE, LONGEST_LIST, LONGEST_NAME = 1000, 300, 60  # characters
_FORMULA = re.compile(r"'*[=+\-@\t\r]")  # a spreadsheet would compute a cell such as `=1+1` or `-1`


def one_line(value: object, longest: int = LONGEST_MESSAGE) -> str:
    """The value as one line of text without control characters. Of a text that is too long, the middle is left out."""
    text = str(value)
    if not text.isprintable():
        text = "".join(map(_escaped, text))
    if len(text) <= longest:
        return text
    end = longest // 3  # a message ends with what to do
    return f"{text[: longest - end - 3]}...{text[len(text) - end :]}"


def shortened(names: Iterable[object], longest: int = LONGEST_LIST) -> str:
    """Names of a file as a list for a message, shortened."""
    return one_line(", ".join(one_line(name, LONGEST_NAME) for name in names), longest)


def valid_text(name: str) -> str:
    """The text with escapes for the bytes of a name that are not UTF-8, which no file or package can hold."""
    return name.encode(errors="backslashreplace").decode()


def reason_of(error: BaseException) -> str:
    """The message of a package's error on one line; the name of its class where it has none."""
    return " ".join(str(error).split()) or type(error).__name__


def say(*texts: object, err: bool = False) -> None:
    """Print texts, each on lines of its own. err: on stderr."""
    text = "\n".join(map(str, texts))
    if not text.replace("\n", "").isprintable():
        text = "".join(char if char in "\n\t" else _escaped(char) for char in text)
    print(text, file=sys.stderr if err else sys.stdout, flush=True)


def did_you_mean(name: str, candidates: Iterable[str], otherwise: str, quote: str = "") -> str:
    """The question for the known name that is most similar, or another text. quote: mark around the name."""
    near = difflib.get_close_matches(name, list(candidates), n=1)
    return f"did you mean {quote}{near[0]}{quote}?" if near else otherwise


def print_note(text: str) -> None:
    """Print a note of the library to stderr."""
    say(f"note: {one_line(text)}", err=True)


def counted(count: int | str, things: str) -> str:
    """A number of things, such as "6 cameras" or "1 camera". things: a plural, such as "cameras" or "boxes"."""
    ending = "es" if things.endswith(("xes", "ches")) else "s"
    return f"{count} {things.removesuffix(ending) if str(count) == '1' else things}"


def number(value: float, digits: int = 3) -> str:
    """A number for a table; "-" for NaN."""
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


class _Output(io.FileIO):
    """A stream whose reader may go away: what nobody reads is dropped, and the command goes on."""

    def write(self, data: Any) -> int:
        try:
            return super().write(data)
        except BrokenPipeError:
            return len(data)


def prepare_output() -> None:
    """Make stdout and stderr escape what a terminal does not know, such as "°", and outlive the reader of a pipe."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if isinstance(stream, io.TextIOWrapper):
            if stream is getattr(sys, f"__{name}__") and not stream.isatty():
                raw = io.BufferedWriter(_Output(stream.fileno(), "w", closefd=False))
                stream = io.TextIOWrapper(raw, stream.encoding, line_buffering=stream.line_buffering)
            stream.reconfigure(errors="backslashreplace")
            setattr(sys, name, stream)


def _escaped(char: str) -> str:
    """The character, or its escape if it could steer a terminal or cannot be seen."""
    shown = char.isprintable() or unicodedata.category(char) == "Zs"
    return char if shown else char.encode("unicode_escape").decode()


def aligned(rows: Sequence[Sequence[str]], left: Collection[int] = (0,)) -> str:
    """Rows as aligned columns. left: indices of the columns that are aligned to the left, all others to the right."""
    columns = []
    for index, column in enumerate(zip(*rows, strict=True)):
        pad, width = str.ljust if index in left else str.rjust, max(map(len, column))
        columns.append([pad(cell, width) for cell in column])
    return "\n".join("  ".join(row).rstrip() for row in zip(*columns, strict=True))


def duration(seconds: float) -> str:
    """Seconds in words: "8 s", "2 min 05 s", "1 h 12 min"."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


def cell_of(name: str) -> str:
    """The cell of a name from outside, with an apostrophe in front of what would be a formula."""
    return f"'{name}" if _FORMULA.match(name) else name


def name_of(cell: str) -> str:
    """The name in a cell of `cell_of`."""
    return cell[1:] if cell.startswith("'") and _FORMULA.match(cell) else cell


def quoted(value: object) -> object:
    """A value of a file for a message: a text is in quotes."""
    return f'"{value}"' if isinstance(value, str) else value
