"""Names from outside in CSV files. A spreadsheet would compute a cell such as `=1+1` or `-1` as a formula."""

import re

_FORMULA = re.compile(r"'*[=+\-@\t\r]")


def cell_of(name: str) -> str:
    """The cell of a name, with an apostrophe in front of what would be a formula."""
    return f"'{name}" if _FORMULA.match(name) else name


def name_of(cell: str) -> str:
    """The name in a cell of `cell_of`."""
    return cell[1:] if cell.startswith("'") and _FORMULA.match(cell) else cell
