"""Texts from outside reach the terminal without control characters, on one line; progress on a pipe and a terminal."""

import contextlib
import io
import shutil
import time
from pathlib import Path

import pytest
from command_line import command

from bevcli.cli import progress as of_commands
from bevcli.cli.progress import Progress, duration, opening
from bevcli.config import load_config
from bevcli.errors import ConfigError, InputError
from bevcli.printing import LONGEST_MESSAGE, counted, one_line, print_note, say

SAMPLE = Path(__file__).parents[1] / "samples/street"
NASTY = "\x1b]0;owned\x07\r\n\u202e\x9b2J\udc80"
SHOWN = r"\x1b]0;owned\x07\r\n\u202e\x9b2J\udc80"


def test_control_characters_become_escapes():
    assert one_line(NASTY) == SHOWN
    assert one_line(SHOWN) == SHOWN
    assert one_line("Straße °\u3000日本") == "Straße °\u3000日本"


def test_a_long_text_keeps_its_beginning_and_its_end():
    text = one_line("error: " + "x" * 10_000 + " pass `force=True`")
    assert len(text) == LONGEST_MESSAGE
    assert text.startswith("error: xxx")
    assert text.endswith("xxx pass `force=True`")
    assert one_line(text) == text
    assert len(one_line(NASTY * 100, 60)) == 60


def test_errors_notes_and_progress_are_clean_and_short(capsys):
    text = f"column {NASTY} " + "xx " * 2_000
    assert str(InputError(text)) == one_line(text)
    print_note(text)
    with Progress(1, "frames", [text]) as progress:
        progress.message(text)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 3
    assert all(rf"column {SHOWN} xx" in line and len(line) < LONGEST_MESSAGE + 10 for line in lines)
    say("boxes\t1\nmodel\t\x1b[2J")  # a table keeps its lines
    assert capsys.readouterr().out == "boxes\t1\nmodel\t\\x1b[2J\n"
    assert [counted(count, "cameras") for count in (0, 1, 6)] == ["0 cameras", "1 camera", "6 cameras"]


def test_a_column_name_cannot_steer_the_terminal(tmp_path):
    shutil.copytree(SAMPLE, tmp_path / "drive")
    table = tmp_path / "drive/frames.csv"
    header, rest = table.read_text().split("\n", 1)
    table.write_text(f"{header},\x1b]0;owned\x07{'y' * 4000}\n{rest}")
    done = command(tmp_path, "run", "drive", "--out", "out")
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert r'unknown column "\x1b]0;owned\x07yyy' in done.stderr
    assert "\x1b" not in done.stderr
    assert len(done.stderr) < LONGEST_MESSAGE + 10
    done = command(tmp_path, "convert", SAMPLE, "out\x1b[2J" + "x" * 300)  # an error of the system
    assert done.returncode == 1
    assert r"out\x1b[2Jxxx" in done.stderr


def test_an_error_shortens_a_text_of_a_file_and_keeps_what_to_do():
    error = InputError(f'rig.yaml: key "{"x" * 1_000_000}" is unknown: remove it')
    assert str(error).startswith('rig.yaml: key "xxx')
    assert str(error).endswith('" is unknown: remove it')
    assert len(str(error)) == len(error.args[0]) < 400
    path = "/a" * 140
    assert str(InputError(f"{path}: is missing")) == f"{path}: is missing"


@pytest.mark.parametrize("name", ["x" * 300, f"{'x' * 300}.toml", "x" * 1_000_000, "a\0b"])
def test_a_name_that_is_too_long_for_a_file_is_one_line(name):
    with pytest.raises(ConfigError, match=r"unknown model|file not found|is too long"):
        load_config(name)


class Terminal(io.StringIO):
    """A stream that claims to be a terminal."""

    def isatty(self) -> bool:
        return True


def work(stream: io.StringIO, total: int) -> list[str]:
    """Runs a progress to its end with one message in the middle; returns what was written, line by line."""
    with contextlib.redirect_stderr(stream), Progress(total, "frames") as progress:
        for done in range(total):
            if done == total // 2:
                progress.message("note: [half] of it :car:")
            progress.advance()
    return stream.getvalue().splitlines()


def test_a_pipe_gets_about_ten_plain_lines():
    lines = work(io.StringIO(), 100)
    assert lines[5] == "note: [half] of it :car:"
    counts = [line for line in lines if "frames" in line]
    assert len(counts) == 10
    assert counts[0].startswith("10/100 frames, ")
    assert counts[-1].startswith("100/100 frames, ")
    assert counts[-1].endswith(" per second, 0 s left")
    assert not any("\x1b" in line or "\r" in line for line in lines)


def test_a_terminal_gets_a_bar_with_messages_above_it(monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "120")
    lines = work(Terminal(), 8)
    message = next(i for i, line in enumerate(lines) if "note: [half] of it :car:" in line)
    bars = [i for i, line in enumerate(lines) if "━" in line]
    assert "8/8 frames, " in lines[bars[-1]]
    assert message < bars[-1]


def test_a_terminal_without_cursor_movement_gets_plain_lines(monkeypatch):
    monkeypatch.setenv("TERM", "dumb")
    assert work(Terminal(), 2)[-1].startswith("2/2 frames, ")


@pytest.mark.parametrize(("seconds", "words"), [(7.6, "8 s"), (125, "2 min 05 s"), (4320, "1 h 12 min")])
def test_durations_in_words(seconds, words):
    assert duration(seconds) == words


def test_a_table_in_a_note_keeps_its_rows_and_nothing_else_makes_a_line(capsys):
    with Progress(1, "frames", ["topics:\n  CAM  /cam/image", "a name\nerror: forged"]):
        pass
    assert capsys.readouterr().err.splitlines() == [
        "note: topics:",
        "  CAM  /cam/image",
        "note: a name\\nerror: forged",
    ]


def test_an_input_that_opens_slowly_is_named_until_something_else_tells(capsys, monkeypatch):
    monkeypatch.setattr(of_commands, "OPENING_S", 0.01)
    printed = ""
    with opening(Path("my_drive")) as told:
        while "opening my_drive, 0 s so far\n" not in printed:
            time.sleep(0.005)
            printed += capsys.readouterr().err
        told.set()
    with opening(Path("quick")) as told:
        told.set()
    time.sleep(0.05)
    assert "quick" not in capsys.readouterr().err
