"""Broken files of every format are read or refused in one line, within 10 s and 1 GB: no traceback, no hang.

So end semantic cases, see groups.py. BEVCLI_FUZZ_CASES sets the number of cases of each reader, BEVCLI_FUZZ_SHARE the
share of those of each group (`make fuzz`: 1). BEVCLI_FUZZ_SAVE names a folder that gets the broken files.
"""

import hashlib
import os
from math import ceil
from pathlib import Path

import pytest
from groups import GROUPS
from hypothesis import HealthCheck, given, settings
from mutations import edits, mutated
from readers import READERS
from seed_files import write_seeds
from worker import Worker

CASES = int(os.environ.get("BEVCLI_FUZZ_CASES", "4"))  # of each of the readers: more than 200 in all
SHARE = float(os.environ.get("BEVCLI_FUZZ_SHARE", "0"))
SAVE = os.environ.get("BEVCLI_FUZZ_SAVE")

pytestmark = pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="limits are measured on Linux")


@pytest.fixture(scope="session")
def seeds(tmp_path_factory):
    folder = tmp_path_factory.mktemp("seeds")
    write_seeds(folder)
    return folder


@pytest.fixture(scope="session")
def worker(seeds):
    worker = Worker(seeds)
    yield worker
    worker.close()


@pytest.mark.parametrize("name", READERS)
def test_a_broken_file_is_read_or_refused_in_one_line(name, seeds, worker):
    reader = READERS[name]
    whole = (seeds / reader.file).read_bytes()

    @settings(
        max_examples=CASES,
        deadline=None,
        database=None,
        derandomize=CASES < 100,
        suppress_health_check=list(HealthCheck),
        report_multiple_bugs=False,
    )
    @given(edits(reader.kind))
    def check(changes):
        data = mutated(whole, changes)
        if SAVE:
            folder = Path(SAVE) / name.replace(" ", "_")
            folder.mkdir(parents=True, exist_ok=True)
            (folder / hashlib.sha256(data).hexdigest()[:16]).write_bytes(data)
        outcome = worker.run(name, data)
        assert outcome == "read" or outcome.startswith("refused: "), outcome

    check()


@pytest.mark.slow
@pytest.mark.parametrize("name", GROUPS)
def test_a_wrong_case_ends_well_or_is_refused_in_one_line(name, seeds):
    worker = Worker(seeds, name)
    outcomes = {number: worker.run(name, number) for number in range(max(10, ceil(SHARE * GROUPS[name].cases)))}
    worker.close()
    wrong = {number: said for number, said in outcomes.items() if said != "read" and not said.startswith("refused: ")}
    assert not wrong, f"{len(wrong)} of {len(outcomes)} cases; {dict(list(wrong.items())[:5])}"
