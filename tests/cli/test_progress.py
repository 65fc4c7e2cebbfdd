"""Progress on a pipe and on a terminal."""

import contextlib
import io

import pytest

from bevcli.cli.progress import Progress, duration


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
