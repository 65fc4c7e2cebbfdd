import contextlib
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import command

import bevcli
from bevcli.cli.main import app, program
from bevcli.errors import InputError

ROOT = Path(__file__).parents[2]
SAMPLE = ROOT / "samples" / "street"
HEAVY = ("torch", "cv2", "rerun", "matplotlib", "trimesh", "scipy", "numba")


def test_version():
    assert command(ROOT, "--version").stdout.strip() == f"bevcli {bevcli.__version__}"


@pytest.mark.parametrize(
    ("name", "extra"), [("run", "video"), ("batch", "video"), ("export-onnx", "onnx"), ("quantize", "onnx")]
)
def test_help_names_the_extras_that_a_command_needs(name, extra):
    assert f"bevcli[{extra}]" in command(ROOT, name, "--help").stdout


def test_a_mistake_in_usage_exits_2():
    assert command(ROOT, "run").returncode == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("run", "nowhere", "--untrained"), "nowhere"),
        (("run", str(SAMPLE), "--model", "tiny"), "--untrained"),
    ],
)
def test_a_mistake_in_the_input_is_one_line_and_exits_1(arguments, message, tmp_path):
    done = command(tmp_path, *arguments)
    assert done.returncode == 1
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1
    assert message in done.stderr


MISSING = [
    ("run", "nope"),
    ("run", SAMPLE, "--weights", "nope"),
    ("run", SAMPLE, "--model", "nope.toml"),
    ("viz", "nope"),
    ("eval", SAMPLE, "nope"),
    ("export", "nope", "--format", "csv"),
    ("export-onnx", "--model", "nope.toml"),
    ("batch", "--list", "nope", "--out", "out"),
    ("bench", "--model", "nope.onnx"),
    ("convert", "nope", "out"),
    ("project-debug", "nope"),
    ("project-debug", SAMPLE, "--sequence", "nope"),
    ("quantize", "nope", "--int8-drive", SAMPLE),
    ("quantize", SAMPLE, "--int8-drive", "nope"),
    ("batch", "nope", "--out", "out"),
    ("batch", "nope/*", "--out", "out"),
    ("render", "out", "--rig", "nope.json"),
    ("render", "out", "--rig", "nope"),
    ("stress", "nope"),
    ("train", "--model", "nope.toml"),
    ("train", "--model", "demo", "--data", "nope"),
    ("validate", "--model", "demo", "--rig", "folder/nope"),
    ("weights", "inspect", "nope"),
    ("weights", "convert", "nope", "out"),
]


@pytest.mark.parametrize(
    ("arguments", "name"),
    [(("run", ""), "SEQUENCE"), (("run", SAMPLE, "--out="), "--out"), (("convert", SAMPLE, ""), "OUT")],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_an_empty_path_is_not_the_current_folder(arguments, name, tmp_path):
    done = command(tmp_path, *arguments)
    assert done.returncode == 2
    assert re.search(f"Invalid value for '{name}.*: is empty", done.stderr)


UNKNOWN = {
    ("run", SAMPLE, "--model", "tinny"): "^--model tinny: is unknown: did you mean tiny",
    ("train", "--model", "bas"): "^--model bas: is unknown: did you mean base",
    ("weights", "inspect", "--model", "x"): "^--model x: is unknown: expected one of base, demo, ",
    ("validate", "--rig", "randon"): "^--rig randon: is unknown: did you mean random",
}


@pytest.mark.parametrize(
    "arguments", [*MISSING, *UNKNOWN], ids=lambda arguments: "-".join(str(each) for each in arguments if each != SAMPLE)
)
def test_what_is_missing_or_unknown_is_refused_before_slow_imports(arguments, monkeypatch):
    for name in [name for name in sys.modules if name.partition(".")[0] in HEAVY]:
        monkeypatch.delitem(sys.modules, name)
    message = UNKNOWN.get(arguments, r"nope[.a-z]*: there is no such file|nope/\*: nothing matches")
    with pytest.raises(InputError, match=message):
        app([str(each) for each in arguments], standalone_mode=False)
    assert [name for name in HEAVY if name in sys.modules] == []


@pytest.mark.parametrize("other", ["KeyboardInterrupt", "RecursionError"])
def test_an_interrupt_of_an_import_exits_130_in_silence(tmp_path, other):
    (tmp_path / "slow_package.py").write_text(
        "import os, signal\n"
        "try:\n"
        "    os.kill(os.getpid(), signal.SIGINT)\n"
        "    for _ in range(1000): pass\n"
        "except KeyboardInterrupt:\n"
        f"    raise {other} from None\n"
    )
    code = (
        "import signal, bevcli.cli.main as cli, bevcli.__main__ as program\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "cli.app = lambda: __import__('slow_package')\n"
        "program.main()\n"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


@pytest.mark.parametrize(
    "arguments", [("run", "--help"), pytest.param(("weights", "inspect", "--model", "demo"), marks=pytest.mark.slow)]
)
def test_a_terminal_of_ascii_gets_every_text(arguments):
    environment = os.environ | {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    program = [sys.executable, "-m", "bevcli", *arguments]
    done = subprocess.run(program, env=environment, capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (0, b"")
    assert done.stdout.isascii()


def test_a_pipe_is_no_recording(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    done = command(tmp_path, "viz", "pipe", "--summary")
    assert done.returncode == 1
    assert done.stderr == "error: pipe: is not a regular file (expected no folder, pipe or device)\n"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["a b", "a'b\"c", "a\nb", "a*[?]b", "-r", "x" * 255, "日本", "%s{0}", "a#3", "\udcff"])
def test_a_drive_of_any_name_is_checked(tmp_path, name):
    shutil.copytree(SAMPLE, tmp_path / name)
    out = f"out{name[:9]}"
    assert command(tmp_path, "project-debug", tmp_path / name, "--out", out).returncode == 0
    assert (tmp_path / out / "findings.json").is_file()


NAME_OF_300 = "x" * 300


@pytest.mark.parametrize(
    "arguments",
    [
        ("run", SAMPLE, "--out", NAME_OF_300, "--frames", "0:1"),
        ("convert", SAMPLE, NAME_OF_300),
        ("project-debug", SAMPLE, "--no-motion", "--out", NAME_OF_300),
        pytest.param(("render", NAME_OF_300), marks=pytest.mark.slow),
    ],
    ids=lambda arguments: arguments[0],
)
def test_an_output_name_that_the_system_refuses_is_one_line(arguments, tmp_path):
    done = command(tmp_path, *arguments)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith("error: ")
    assert "Traceback" not in done.stderr


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no full device")
@pytest.mark.parametrize("arguments", [("--version",), ("--help",), ("weights", "list")])
def test_a_full_output_device_is_one_line(arguments, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["bevcli", *arguments])
    with (
        open("/dev/full", "w") as full,
        contextlib.redirect_stdout(full),
        pytest.raises(SystemExit, match="1"),
        program(),
    ):
        app()
    where = "of an output, or of the folder for temporary files, which TMPDIR names"
    assert capsys.readouterr().err == f"error: No space left on device ({where})\n"


@pytest.mark.parametrize(
    "options",
    [("--port", "99999"), ("--port", "0"), ("--host", ""), ("--host", "no.such.host.invalid"), ("--host", "192.0.2.1")],
)
def test_an_address_that_cannot_be_listened_on_is_a_usage_error(options, tmp_path):
    done = command(tmp_path, "viz", "recording.rrd", "--web", *options)
    assert done.returncode == 2
    assert options[0] in done.stderr
    assert "Traceback" not in done.stderr
