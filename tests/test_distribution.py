"""The distributions: two builds are equal, the index page leads to files, the installed wheel works without a clone.

The wheel is installed into two environments:

- "as here": bevcli comes from the wheel, its dependencies from the environment of the tests (a .pth file names it).
- "lowest": everything comes from the index, in the lowest versions that the wheel allows. Skipped without an index.
"""

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from email import message_from_bytes
from email.message import Message
from pathlib import Path
from zipfile import ZipFile

import pytest
import yaml

import bevcli

ROOT = Path(__file__).parents[1]
TOOLS = ("git", "pyproject-build", "twine", "check-wheel-contents")
PATH = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
NO_INDEX = re.compile(r"NewConnectionError|NameResolutionError|\(from versions: none\)")
# Files of the package that are no code. NOTICE states where each comes from.
DATA = re.compile(
    r"bevcli/(py\.typed|configs/[\w-]+\.toml|weights/((demo|photographs)\.safetensors|sources\.toml)"
    r"|samples/(street/.*|first_steps\.ipynb))"
)
TEST_PROGRAMS = ("pytest", "pytest-timeout", "hypothesis", "mcap-ros2-support")
EXTRAS = "ros,video,onnx,openvino,tensorboard,ray,hub"
# These tests run with the lowest versions, too. They use OpenCV, numba, PyTorch, SciPy, Shapely, trimesh, rerun, mcap,
# rosbags, protobuf, PyAV, ONNX and its runtime, and OpenVINO.
WITH_LOWEST = (
    "geometry/test_transforms.py",
    "model/test_deformable_attention.py",
    "inference/test_tracking.py",
    "sequences/test_write_nuscenes.py",
    "recording/test_vehicle.py",
    "recording/test_write_mcap.py",
    "recording/test_video_images.py",
    "sequences/test_ros.py",
    "engines/test_engines.py",
    "weights/test_fetch.py",
)


def test_changelog_and_citation_name_this_version():
    newest = re.search(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), flags=re.MULTILINE)
    assert newest is not None
    assert newest[1] == bevcli.__version__
    assert str(yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"]) == bevcli.__version__


def ran(*command: object, folder: Path | None = None, umask: int = -1) -> subprocess.CompletedProcess:
    """The program with the tools of the tests, and without what says where bevcli is."""
    settings = {name: text for name, text in os.environ.items() if name not in ("PYTHONPATH", "MYPYPATH")}
    words = [str(word) for word in command]
    settings["PATH"] = PATH
    return subprocess.run(words, cwd=folder, env=settings, umask=umask, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two folders with the sdist and the wheel of the last commit, built with different rights of new files."""
    if missing := [tool for tool in TOOLS if shutil.which(tool, path=PATH) is None]:
        pytest.skip(f"{', '.join(missing)}: not installed; run pip install 'bevcli[dist]'")
    if not (ROOT / ".git").exists():
        pytest.skip("not a clone")
    folders = [tmp_path_factory.mktemp("dist") for _ in range(2)]
    for folder, umask in zip(folders, (0o022, 0o077), strict=True):
        done = ran(ROOT / ".ci/build-dist", folder, umask=umask)
        assert done.returncode == 0, done.stdout + done.stderr
    return folders


@pytest.fixture(scope="module")
def wheel(built: list[Path]) -> Path:
    [path] = built[0].glob("*.whl")
    return path


@pytest.fixture(scope="module")
def metadata(wheel: Path) -> Message:
    with ZipFile(wheel) as file:
        return message_from_bytes(file.read(f"bevcli-{bevcli.__version__}.dist-info/METADATA"))


@pytest.mark.slow
def test_two_builds_have_equal_bytes(built: list[Path]):
    first, second = ({path.name: path.read_bytes() for path in folder.iterdir()} for folder in built)
    assert len(first) == 2
    assert first == second


@pytest.mark.slow
def test_the_wheel_has_the_package_its_data_and_its_licence(wheel: Path):
    with ZipFile(wheel) as file:
        names = set(file.namelist())
    about = f"bevcli-{bevcli.__version__}.dist-info"
    assert {f"{about}/licenses/LICENSE", f"{about}/licenses/NOTICE", "bevcli/py.typed"} <= names
    modules = {str(path.relative_to(ROOT)) for path in (ROOT / "bevcli").rglob("*.py")}
    data = names - modules - {name for name in names if name.startswith(about)}
    assert modules <= names
    assert not [name for name in data if not DATA.fullmatch(name)]
    assert sum(name.endswith(".jpg") for name in data) == len(list((ROOT / "samples/street").rglob("*.jpg")))


@pytest.mark.slow
def test_the_index_page_leads_to_files_of_the_release(metadata: Message):
    hooks = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["metadata"]["hooks"]
    owner = hooks["custom"]["owner"]
    repository = f"https://github.com/{owner}/bevcli"
    page = metadata.get_payload()
    targets = re.findall(r"\]\(([^)]+)\)", page)
    assert len(targets) > 30
    assert all(target.startswith("https://") for target in targets)
    ours = [target.removeprefix(repository) for target in targets if target.startswith(repository)]
    tag = f"v{bevcli.__version__}"
    for target in ours:
        kind, path = re.fullmatch(rf"/(blob|raw)/{tag}/([^#]+)(?:#.*)?", target).groups()
        assert (ROOT / path).is_file(), target
        assert (kind == "raw") == path.endswith((".jpg", ".png", ".webp")), target
    urls = dict(line.split(", ") for line in metadata.get_all("Project-URL"))
    assert {"Documentation", "Source", "Issues", "Changelog"} == urls.keys()
    assert all(owner in url for url in urls.values())


@dataclass
class Environment:
    """A virtual environment with the wheel, and an empty folder to work in; neither sees the clone."""

    name: str
    folder: Path

    def python(self, *arguments: object, folder: Path | None = None) -> subprocess.CompletedProcess:
        return ran(self.folder / "bin/python", *arguments, folder=folder or self.folder / "work")

    def pip(self, *arguments: object) -> subprocess.CompletedProcess:
        return ran(sys.executable, "-m", "pip", "--python", self.folder / "bin/python", *arguments)

    def bevcli(self, *arguments: object) -> subprocess.CompletedProcess:
        return self.python(self.folder / "bin/bevcli", *arguments)


def lowest(metadata: Message) -> list[str]:
    """The lowest versions that the distribution allows of all that it may need, as pins of pip."""
    needs = [re.match(r"([\w.-]+)(?:\[.*?\])?(?:>=|~=)([\w.]+)", need) for need in metadata.get_all("Requires-Dist")]
    assert all(needs)
    return sorted({f"{need[1]}=={need[2]}" for need in needs})


@pytest.fixture(scope="module", params=["as here", "lowest"])
def installed(
    request: pytest.FixtureRequest, wheel: Path, metadata: Message, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Environment]:
    environment = Environment(request.param, tmp_path_factory.mktemp("environment"))
    (environment.folder / "work").mkdir()
    ran(sys.executable, "-m", "venv", "--without-pip", environment.folder)
    if environment.name == "as here":
        there = environment.python("-c", "import sysconfig; print(sysconfig.get_path('purelib'))").stdout.strip()
        Path(there, "dependencies.pth").write_text(sysconfig.get_path("purelib"))
        done = environment.pip("install", "--no-index", "--no-deps", wheel)
    else:
        pins = environment.folder / "lowest.txt"
        pins.write_text("\n".join(lowest(metadata)))
        done = environment.pip(
            "install", "--no-compile", "--constraint", pins, f"bevcli[{EXTRAS}] @ {wheel.as_uri()}", *TEST_PROGRAMS
        )
        if NO_INDEX.search(done.stderr):
            pytest.skip("no package index can be reached")
    assert done.returncode == 0, done.stderr
    yield environment
    shutil.rmtree(environment.folder)  # with PyTorch for CUDA it has 7 GB


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_the_wheel_runs_without_the_clone(installed: Environment):
    found = installed.python("-c", "import bevcli; print(bevcli.__file__, bevcli.__version__)").stdout.split()
    assert Path(found[0]).is_relative_to(installed.folder)
    assert found[1] == bevcli.__version__
    for command in (
        ("samples",),
        ("run", "samples/street", "--frames", "0:2", "--out", "runs/first"),
        ("demo", "--count", "2", "--no-view"),
        ("eval", "runs/first/predictions.json", "samples/street", "--max-range", "32"),
    ):
        done = installed.bevcli(*command)
        assert done.returncode == 0, done.stderr
    assert (installed.folder / "work/runs/demo").is_dir()


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_extras_are_added_to_the_installed_wheel(installed: Environment):
    """`pip install 'bevcli[ros]'` works where bevcli is on no index, but installed."""
    done = installed.pip("install", "--no-index", "--dry-run", "bevcli[ros]")
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_the_lowest_versions_pass_tests(installed: Environment):
    if installed.name != "lowest":
        pytest.skip("the versions of here: all other tests")
    tests = [ROOT / "tests" / name for name in WITH_LOWEST]
    options = ("-p", "no:cacheprovider", "-m", "not slow and not gpu", "--maxfail", "5")
    done = installed.python("-P", "-m", "pytest", *options, *tests, folder=ROOT)
    assert done.returncode == 0, done.stdout[-4000:]
