"""`bevcli eval --csv` and `--latex`: every printed table in files, for one model and for two."""

import csv
import math
import re
from pathlib import Path

import pytest
from command_line import invoked
from random_boxes import as_predictions, random_truth
from test_eval_command import evaluated, tracked_files, write_frames

from bevcli.errors import InputError, OutputError
from bevcli.geometry.transforms import Pose
from bevcli.workshop.scores.tables import Table, write_csv, write_latex

__all__ = ["tracked_files"]  # a fixture


def values_in(path: Path) -> dict[tuple[str, str, str], str]:
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    values = {(row["table"], row["row"], row["column"]): row["value"] for row in rows}
    assert len(values) == len(rows)  # each names one number
    return values


def test_tables_of_one_model_have_the_numbers_of_the_json(tmp_path: Path, tracked_files: tuple[Path, Path]) -> None:
    out = tmp_path / "made" / "scores.csv"
    scores = evaluated(*tracked_files, "--tracking", "--csv", out, "--latex", tmp_path / "scores.tex")
    values = values_in(out)
    assert float(values["classes", "car", "AP"]) == scores["mean_dist_aps"]["car"]
    assert float(values["classes", "all", "NDS"]) == scores["nd_score"]
    assert float(values["AP by range", "mAP", "0-10 m"]) == scores["by_range"][0]["mean_ap"]
    assert float(values["tracks", "all", "AMOTA"]) == scores["tracking"]["amota"]
    assert float(values["errors of tracks", "car", "IDS"]) == scores["tracking"]["label_metrics"]["ids"]["car"]
    assert values["classes", "traffic_cone", "AVE m/s"] == ""
    text = (tmp_path / "scores.tex").read_text()
    tables = re.findall(r"^% (.*)\n\\begin\{tabular\}", text, flags=re.MULTILINE)
    assert tables == list(dict.fromkeys(table for table, _, _ in values))
    assert r"traffic\_cone & " in text


def test_tables_of_two_models_have_both(tmp_path: Path) -> None:
    truth = random_truth(41, frames=5, per_class=2)
    sides = (as_predictions(truth, 42, noise_m=1.0), as_predictions(truth, 43, noise_m=0.3), truth)
    files = [write_frames(tmp_path / f"{k}.json", side, pose=Pose.identity()) for k, side in enumerate(sides)]
    scores = evaluated(*files, "--csv", tmp_path / "s.csv", "--latex", tmp_path / "s.tex")
    values, of_car = values_in(tmp_path / "s.csv"), scores["mean_dist_aps"]["car"]
    columns = ("AP A", "AP B", "95 % interval low", "95 % interval high")
    expected = [*of_car["values"], *of_car["interval"]]
    assert [float(values["classes", "car", column]) for column in columns] == expected
    worst = scores["worst_frames"]["difference"][0]
    frame = f"largest difference frame {worst['frame']}"
    assert int(values["worst frames", frame, "B invented"]) == worst["b_invented"]
    bins = [model["by_range"][0]["mean_ap"] for model in scores["scores"]]
    assert [float(values["AP by range", f"mAP {model}", "0-10 m"]) for model in "AB"] == bins
    assert r"95 \% interval" in (tmp_path / "s.tex").read_text()


def test_a_table_is_printed_and_written() -> None:
    rows = [("*a_b & c", 2, 1 / 3, (-0.5, math.nan)), ("", "", math.nan, (0.0, 1.0))]
    table = Table("t", ("name", "boxes", "AP", "B - A"), rows, {"AP": 1}, signed=("B - A",), below="\n(50 %)")
    assert str(table).splitlines() == [
        "name      boxes   AP             B - A",
        "*a_b & c      2  0.3       -0.500 to -",
        "                   -  +0.000 to +1.000",
        "(50 %)",
    ]
    assert [row[1:] for row in table.csv_rows()][:3] == [
        ("*a_b & c", "boxes", 2),
        ("*a_b & c", "AP", 1 / 3),
        ("*a_b & c", "B - A low", -0.5),
    ]
    assert r"{*}a\_b \& c & 2 & 0.3 & -0.500 to - \\" in table.latex()
    assert table.latex().endswith("\\bottomrule\n\\end{tabular}\n\\par (50 \\%)\n")


@pytest.mark.parametrize("write", [write_csv, write_latex])
def test_a_table_replaces_tables_only(tmp_path: Path, write) -> None:
    table, path = Table("t", ("name", "AP"), [("=a", 0.5)]), tmp_path / "file"
    write([table], path)
    write([table], path)
    assert write is write_latex or "t,'=a,AP,0.5" in path.read_text()  # a spreadsheet would compute =a
    path.write_text("timestamp_ns,x,y\n")  # of a drive
    with pytest.raises(OutputError, match="is there, and is no table of scores"):
        write([table], path)
    assert path.read_text() == "timestamp_ns,x,y\n"


def test_two_tables_do_not_go_into_one_file(tmp_path: Path, tracked_files: tuple[Path, Path]) -> None:
    one = tmp_path / "one"
    with pytest.raises(InputError, match=r"--latex: .*one is the file of --csv too"):
        invoked("eval", *tracked_files, "--csv", one, "--latex", one)
