"""`Table`: scores in rows and columns, as text for a terminal, as CSV and as LaTeX."""

import csv
import io
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path

from bevcli.errors import OutputError
from bevcli.parsing.files import open_regular
from bevcli.printing import aligned, cell_of, number, one_line
from bevcli.writing import whole_file

Cell = str | int | float | tuple[float, float]  # a pair: the ends of an interval
CSV_COLUMNS = ("table", "row", "column", "value")
_ESCAPES = {char: f"\\{char}" for char in "&%$#_{}"} | {
    "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
    "<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}", "[": "{[}", "*": "{*}", '"': r"\textquotedbl{}",
}  # fmt: skip
_LATEX = str.maketrans(_ESCAPES)


@dataclass(frozen=True)
class Table:
    """A table of scores."""

    name: str  # of the table, in files
    columns: Sequence[str]  # the heads
    rows: Sequence[Sequence[Cell]]  # NaN is printed as "-"; cells of `left` stay empty below the same name
    digits: Mapping[str, int] = field(default_factory=dict)  # column -> decimals of its numbers; 3 for others
    signed: Collection[str] = ()  # columns whose numbers have a sign
    left: Collection[int] = (0,)  # the columns that name a row, aligned to the left
    names: Sequence[str] = ()  # of the columns in CSV; by default their heads
    below: str = ""  # printed text below the table
    sums: Mapping[str, float] = field(default_factory=dict)  # numbers of all rows, which stand in `below`

    def __str__(self) -> str:
        return aligned([self.columns, *self._texts()], self.left) + self.below

    def _texts(self) -> list[list[str]]:
        return [[self._text(*cell) for cell in zip(self.columns, row, strict=True)] for row in self.rows]

    def _text(self, column: str, cell: Cell) -> str:
        if isinstance(cell, tuple):
            return " to ".join(self._text(column, end) for end in cell)
        if isinstance(cell, float):
            text = number(cell, self.digits.get(column, 3))
            return f"+{text}" if column in self.signed and text[0] != "-" else text
        return str(cell)

    def csv_rows(self) -> Iterator[tuple[str, str, str, Cell]]:
        """One row a number, see CSV_COLUMNS; numbers are not rounded, and NaN is empty."""
        heading = ""
        for row in self.rows:
            heading = str(row[0]) or heading
            name = " ".join([heading, *(str(row[index]) for index in self.left if index)])
            for index, (column, cell) in enumerate(zip(self.names or self.columns, row, strict=True)):
                if index not in self.left and cell != "":
                    ends = zip((" low", " high"), cell, strict=True) if isinstance(cell, tuple) else [("", cell)]
                    for end, value in ends:
                        yield self.name, cell_of(name), column + end, value if value == value else ""  # not NaN
        for column, total in self.sums.items():
            yield self.name, "all", column, total if total == total else ""

    def latex(self) -> str:
        """A tabular with the rules of the package booktabs, and the text below it. Names are escaped."""
        head, *rows = (" & ".join(map(_escaped, row)) + r" \\" for row in (self.columns, *self._texts()))
        aligns = "".join("l" if index in self.left else "r" for index in range(len(self.columns)))
        begin, end = rf"\begin{{tabular}}{{{aligns}}}", r"\end{tabular}"
        lines = [f"% {self.name}", begin, r"\toprule", head, r"\midrule", *rows, r"\bottomrule", end]
        return "\n".join([*lines, *([rf"\par {_escaped(self.below)}"] if self.below else []), ""])


def _escaped(text: str) -> str:
    return " ".join(one_line(text.replace("\n", " ")).translate(_LATEX).split())


def write_csv(tables: Iterable[Table], path: Path) -> None:
    """Write the numbers of tables into one CSV file. Raises OutputError."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([CSV_COLUMNS, *chain.from_iterable(t.csv_rows() for t in tables)])
    _write(path, text.getvalue())


def write_latex(tables: Iterable[Table], path: Path) -> None:
    r"""Write tables into one file, for \input in a document that uses booktabs. Raises OutputError."""
    _write(path, "\n".join([r"% \usepackage[T1]{fontenc} and \usepackage{booktabs}", *(t.latex() for t in tables)]))


def _write(path: Path, text: str) -> None:
    """Write a file, also over an earlier one of its kind, and over no other: it may be an input."""
    start = text.partition("\n")[0].encode()
    if path.is_file() and open_regular(path, error=OutputError).read(len(start)) != start:
        raise OutputError(f"{path}: is there, and is no table of scores: name another file")
    with whole_file(path, parents=True) as unfinished:
        unfinished.write_text(text, encoding="utf-8", newline="\n")
