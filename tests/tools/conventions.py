"""One drive in the conventions of many programs: is it read right, at once or after the options that a question names?

    python -m tests.tools.conventions DRIVE --trials 40 --seed 1 [--unnamed]

DRIVE is a drive whose calibration, poses and images are true, without lens distortion. `--unnamed` gives its cameras
names that say nothing. Prints a line for each trial and the counts; exit code 1 where anything is wrong.
"""

import argparse
import sys
import tempfile
from pathlib import Path

from tests.readings.stated_drive import Convention, choices_of, opened, write, wrong

from bevcli.errors import InputError
from bevcli.sequences.open import open_sequence


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("drive", type=Path)
    parser.add_argument("--trials", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--unnamed", action="store_true")
    given = parser.parse_args()
    truth = open_sequence(given.drive, rate_hz="all", ground_truth=False)
    names = {name: f"cam{index}" for index, name in enumerate(truth.rig.names)} if given.unnamed else None
    counts = {"right": 0, "asked, then right": 0, "asked in vain": 0, "WRONG": 0}
    for trial in range(given.trials):
        convention = Convention.drawn(1000 * given.seed + trial)
        with tempfile.TemporaryDirectory() as folder:
            result, why = judged(Path(folder), truth, convention, names)
        counts[result] += 1
        print(f"{trial:03d} {result:17} {' '.join(map(str, vars(convention).values()))} | {why[:200]}", flush=True)
    print(", ".join(f"{name} {count}" for name, count in counts.items()))
    sys.exit(counts["WRONG"] > 0 or counts["asked in vain"] > 0)


def judged(folder: Path, truth, convention: Convention, names) -> tuple[str, str]:
    """The result of a convention, and why."""
    options = write(truth, folder, convention, names)
    try:
        why = wrong(opened(folder, options), truth)
    except InputError as error:
        results = [answered(folder, options, answer, truth) for answer in choices_of(error)]
        return ("asked, then right" if "" in results else "asked in vain"), str(error)
    return ("WRONG" if why else "right"), why


def answered(folder: Path, options, answer, truth) -> str:
    """What is wrong after an answer, also to the questions that follow."""
    try:
        return wrong(opened(folder, options, **answer), truth)
    except InputError as error:
        following = [answer | more for more in choices_of(error) if not more.keys() <= answer.keys()]
        return "" if "" in (answered(folder, options, more, truth) for more in following) else str(error)


if __name__ == "__main__":
    main()
