"""A file has its old or its new contents, whatever happens while it is written."""

import multiprocessing
import os
import signal
import threading
from pathlib import Path

import pytest

from bevcli.errors import OutputError
from bevcli.writing import _remove_abandoned_once, check_output, whole_file, write_whole


def test_a_written_file_has_its_name_and_leaves_nothing_else(tmp_path):
    write_whole(tmp_path / "new" / "file.txt", b"text", parents=True)
    assert (tmp_path / "new" / "file.txt").read_bytes() == b"text"
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["file.txt"]
    before = os.umask(0o027)  # which gives the mode of a file
    try:
        with whole_file(tmp_path / "file") as unfinished:
            unfinished.touch(mode=0o600)
    finally:
        os.umask(before)
    assert (tmp_path / "file").stat().st_mode & 0o777 == 0o640


@pytest.mark.parametrize(("failure", "raised"), [(OSError(28, "disk full"), OutputError), (ValueError(), ValueError)])
def test_after_an_error_the_old_file_is_there(tmp_path, failure, raised):
    def fail(path, **how):
        with whole_file(path, **how) as unfinished:
            unfinished.write_text("half")
            raise failure

    path = tmp_path / "file.txt"
    path.write_text("old")
    with pytest.raises(raised):
        fail(path)
    assert path.read_text() == "old"
    with pytest.raises(raised):
        fail(tmp_path / "new" / "folder" / "file.txt", parents=True)
    assert list(tmp_path.iterdir()) == [path]


def kill_while_it_writes(path):
    with whole_file(path) as unfinished:
        unfinished.write_text("half")
        os.kill(os.getpid(), signal.SIGKILL)


def test_what_a_killed_process_left_is_deleted(tmp_path):
    path = tmp_path / "file.txt"
    process = multiprocessing.get_context("fork").Process(target=kill_while_it_writes, args=(path,))
    process.start()
    process.join()
    [left] = tmp_path.iterdir()
    (tmp_path / f"{left.name}.link").symlink_to(__file__)
    with whole_file(path) as unfinished:
        assert not left.exists()
        unfinished.write_text("new")
    assert list(tmp_path.iterdir()) == [path]
    assert Path(__file__).exists()


def test_two_processes_that_write_a_file_each_write_the_whole(tmp_path):
    with whole_file(tmp_path / "a") as one:
        one.write_text("one")
        _remove_abandoned_once.cache_clear()  # as in another process
        with whole_file(tmp_path / "a") as other:
            other.write_text("other")
        assert (tmp_path / "a").read_text() == "other"
    assert (tmp_path / "a").read_text() == "one"
    assert list(tmp_path.iterdir()) == [tmp_path / "a"]


def test_a_link_is_replaced_and_a_pipe_written_directly(tmp_path):
    target, link = tmp_path / "target", tmp_path / "link"
    target.write_text("old")
    link.symlink_to(target)
    write_whole(link, b"new")
    assert (target.read_text(), link.read_text(), link.is_symlink()) == ("old", "new", False)
    with pytest.raises(OutputError, match="cannot be written"):
        write_whole(tmp_path, b"")  # a folder
    pipe, found = tmp_path / "pipe", []
    os.mkfifo(pipe)
    reader = threading.Thread(target=lambda: found.append(pipe.read_bytes()))
    reader.start()
    write_whole(pipe, b"text")
    reader.join(10)
    assert found == [b"text"]
    assert pipe.is_fifo()


def test_an_input_is_not_replaced(tmp_path):
    path = tmp_path / "predictions.json"
    check_output(path, path)  # neither is there
    path.touch()
    check_output(tmp_path / "other", path)
    with pytest.raises(OutputError, match="is the input"):
        check_output(tmp_path / "." / "predictions.json", path)
