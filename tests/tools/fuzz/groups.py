"""Groups of semantic fuzz cases: files that are well formed, or whole, and wrong in what they say.

A case is a number. `Group.run` derives everything from it, in a folder that is empty before: it makes the case from the
seeds, and does what a user's command would do. It fails by any exception but a BevcliError; an assertion says that a
command succeeded with damaged output. The worker adds the limits on time and memory.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from random import Random

from dangling_cases import damaged_checkpoint, dangling_tokens
from file_cases import batch_record, mesh, onnx_file, sqlite_schema
from server_cases import server_behaviour


@dataclass(frozen=True)
class Group:
    """A group of cases.

    Attributes:
        run: (folder of the seeds, empty folder, source of all choices) -> nothing.
        cases: in `make fuzz`.
    """

    run: Callable[[Path, Path, Random], None]
    cases: int


GROUPS = {
    "dangling tokens": Group(dangling_tokens, 400),
    "damaged checkpoint": Group(damaged_checkpoint, 400),
    "ONNX": Group(onnx_file, 600),
    "mesh with siblings": Group(mesh, 400),
    "batch record": Group(batch_record, 1000),
    "SQLite schema": Group(sqlite_schema, 700),
    "servers of weights": Group(server_behaviour, 1000),
}
