"""Semantic cases, see groups.py: each ends well or is refused in one line, within 10 s and 1 GB.

BEVCLI_FUZZ_SHARE sets the share of the cases of each group (`make fuzz`: 1).
"""

import os
from math import ceil
from pathlib import Path

import pytest
from groups import GROUPS
from seed_files import write_seeds
from worker import Worker

SHARE = float(os.environ.get("BEVCLI_FUZZ_SHARE", "0"))

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="limits are measured on Linux"),
]


@pytest.fixture(scope="module")
def seeds(tmp_path_factory):
    folder = tmp_path_factory.mktemp("seeds")
    write_seeds(folder)
    return folder


@pytest.mark.parametrize("name", GROUPS)
def test_a_wrong_case_ends_well_or_is_refused_in_one_line(name, seeds):
    worker = Worker(seeds, name)
    outcomes = {number: worker.run(name, number) for number in range(max(10, ceil(SHARE * GROUPS[name].cases)))}
    worker.close()
    wrong = {number: said for number, said in outcomes.items() if said != "read" and not said.startswith("refused: ")}
    assert not wrong, f"{len(wrong)} of {len(outcomes)} cases; {dict(list(wrong.items())[:5])}"
