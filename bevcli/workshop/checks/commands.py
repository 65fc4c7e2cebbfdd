"""`bevcli checks`: the facts about this installation and machine.

Each check returns a text, or texts by name, and may raise anything.
"""

import getpass
import json
import os
import platform
import re
import sys
import textwrap
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path

from bevcli._version import __version__
from bevcli.cli.bridge import Json
from bevcli.options import option, options
from bevcli.printing import one_line, print_note, reason_of, say
from bevcli.writing import user_cache, weights_folder

PANEL = "Start"
Facts = str | dict[str, str]
WIDTH, INDENT = 80, 11
TIED = "\xa0"  # a space where no line ends
SHORT = 16  # characters; a fact whose texts are no longer stands on one line
LOOPS = Path(__file__).parents[2] / "model/kernels/__pycache__"  # where numba keeps what it has compiled
MOST_FILES = 100_000  # of a cache that are counted
# Extras that a user of bevcli installs; the others are for its developers.
NOT_FOR_USERS = ("dev", "docs")
_REQUIREMENT = re.compile(r"([\w.-]+).*?(?:extra == ['\"]([\w-]+)['\"])?$")


def tell(check: Callable[[], Facts]) -> Facts:
    """The facts of a check without the user's name, or why they cannot be told."""
    try:
        told = check()
    except Exception as error:  # a broken package may raise anything, and the other checks go on
        return without_user(f"cannot be told ({type(error).__name__}: {reason_of(error):.200})")
    if isinstance(told, str):
        return without_user(told)
    return {without_user(name): without_user(text) for name, text in told.items()}


def without_user(text: str) -> str:
    """The text with ~ in place of the user's home folder, and USER in place of the user's name in other paths."""
    names = set()
    with suppress(Exception):  # no entry in the system's list of users
        names.add(getpass.getuser())
    with suppress(RuntimeError):  # no home
        home = Path.home()
        names.add(home.name)
        text = text.replace(str(home), "~") if home.name else text
    for name in names - {""}:
        text = re.sub(rf"(?<=[/\\]){re.escape(name)}(?![\w.-])", "USER", text)
    return one_line(text)


def _lines(title: str, fact: Facts) -> Iterator[str]:
    if isinstance(fact, dict) and all(len(text) <= SHORT for text in fact.values()):
        fact = ", ".join(f"{name}{TIED}{text}" for name, text in fact.items())
    texts = [fact] if isinstance(fact, str) else [f"{name}: {text}" for name, text in fact.items()]
    for index, text in enumerate(texts):
        head = f"{'' if index else title:<{INDENT}}"
        indent = " " * (INDENT if len(texts) == 1 else INDENT + 2)
        how = {"subsequent_indent": indent, "break_on_hyphens": False, "break_long_words": False}
        lines = textwrap.wrap(head + text, WIDTH, **how)  # type: ignore[arg-type]
        yield from (line.replace(TIED, " ") for line in lines)


def versions() -> Facts:
    """Those of bevcli, Python and the system."""
    origin = " of a checkout" if (Path(__file__).parents[3] / "pyproject.toml").is_file() else ""
    metadata = installed("bevcli")
    if metadata != __version__:  # an editable installation keeps the requirements of its day
        origin += f" (its metadata are of {metadata or 'no version'}: install it again)"
    return f"{__version__}{origin}, Python {platform.python_version()}, {platform.platform()}"


def required() -> Iterator[tuple[str, str]]:
    """The packages that bevcli requires, each with the extra that does, "" for none."""
    for text in requires("bevcli") or ():
        match = _REQUIREMENT.match(text)
        if match:
            yield match[1], match[2] or ""


def installed(package: str) -> str:
    """The version of a package, "" for one that is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


def packages() -> Facts:
    """Versions of the packages that bevcli needs, and of those of its extras that are installed."""
    of_extras = [name for name, extra in required() if extra and extra not in NOT_FOR_USERS]
    needed = {name: installed(name) or "NOT INSTALLED" for name, extra in required() if not extra}
    return needed | {name: installed(name) for name in of_extras if installed(name)}


def _of_torch(name: str) -> Facts:
    """A check that needs PyTorch: where that is broken, each of them says so."""
    from bevcli.workshop.checks import torch_checks

    check: Callable[[], Facts] = getattr(torch_checks, name)
    return check()


def viewer() -> Facts:
    """The viewer, and whether it can open a window and draw for a screenshot."""
    from bevcli.viewer.rerun_viewer import display_is_there, viewer_binary

    binary = f"rerun {installed('rerun-sdk')}" if viewer_binary().is_file() else "the executable of rerun is missing"
    window = "in a window" if display_is_there() else "in the browser, as there is no display"
    return f"{binary}, opens {window}; screenshots: {_vulkan()}"


def _vulkan() -> str:
    if not sys.platform.startswith("linux"):
        return "by the system's graphics driver"
    listed = os.environ.get("VK_DRIVER_FILES") or os.environ.get("VK_ICD_FILENAMES")
    folders = [Path(folder, "vulkan/icd.d") for folder in ("/usr/share", "/usr/local/share", "/etc")]
    files = listed.split(":") if listed else [str(file) for folder in folders for file in sorted(folder.glob("*.json"))]
    if not files:
        return "no Vulkan driver (Debian, Ubuntu: apt-get install mesa-vulkan-drivers)"
    return f"Vulkan drivers {', '.join(Path(file).name.partition('.')[0] for file in files)}"


def video() -> Facts:
    """What decodes videos, and writes H.264."""
    import cv2

    built = dict(re.findall(r"^\s+(FFMPEG|avcodec):\s+(.*?)\s*$", cv2.getBuildInformation(), re.MULTILINE))
    ffmpeg = built.get("avcodec", "").removeprefix("YES ") if built.get("FFMPEG", "").startswith("YES") else ""
    opencv = (
        f"OpenCV with FFmpeg (avcodec {ffmpeg.strip('()')})" if ffmpeg else "OpenCV without FFmpeg: it reads no MP4"
    )
    pyav = f"PyAV {installed('av')}" if installed("av") else "no PyAV: recordings with AV1 and H.264 need bevcli[video]"
    return f"{opencv}; {pyav}"


def caches() -> Facts:
    """The folders that keep files from run to run, with their sizes."""
    home = Path.home()
    hub = os.environ.get("HF_HUB_CACHE") or Path(os.environ.get("HF_HOME") or home / ".cache/huggingface", "hub")
    folders = [user_cache(), Path(hub), Path(os.environ.get("NUMBA_CACHE_DIR") or LOOPS)]
    if not weights_folder().is_relative_to(user_cache()):
        folders.append(weights_folder())
    names = {
        folder: f"{folder} (compiled loops)" if index == 2 else str(folder) for index, folder in enumerate(folders)
    }
    return {name: _size(folder) for folder, name in names.items()}


def _size(folder: Path) -> str:
    if not folder.is_dir():
        return "none"
    total = count = 0
    for parent, _, files in os.walk(folder):
        for file in files:
            with suppress(OSError):  # it is gone
                total += os.lstat(os.path.join(parent, file)).st_size
            count += 1
        if count > MOST_FILES:
            return f"over {total / 1e6:.0f} MB"
    return f"{total / 1e6:.0f} MB"


def missing() -> Facts:
    """The extras that are not installed whole, and how to install them."""
    lacking: dict[str, list[str]] = {}
    for package, extra in required():
        if extra and extra not in NOT_FOR_USERS and not installed(package):
            lacking.setdefault(extra, []).append(package)
    return {
        extra: f"pip install 'bevcli[{extra}]' ({', '.join(names)})" for extra, names in lacking.items()
    } or "nothing"


CHECKS: dict[str, Callable[[], Facts]] = {
    "bevcli": versions,
    "packages": packages,
    "processor": partial(_of_torch, "processor"),
    "GPU": partial(_of_torch, "gpu"),
    "kernels": partial(_of_torch, "kernels"),
    "engines": partial(_of_torch, "engines"),
    "viewer": viewer,
    "video": video,
    "caches": caches,
    "missing": missing,
}


@options()
class ChecksOptions:
    """What is looked at."""

    speed: bool = option(
        default=False, help="Also time demo and tiny with random weights on made-up images, for about a minute."
    )


def checks(options: ChecksOptions, as_json: Json = False) -> None:
    """Print what an issue about bevcli should state: versions, machine, kernels, viewer, caches, what is missing.

    Each line that cannot be told says why; the command itself never fails. Names of the user and the environment are
    left out. Connects to no other machine.
    """
    facts = {title: tell(check) for title, check in CHECKS.items()}
    if options.speed:
        from bevcli.workshop.benchmark.measure import measure_speed

        print_note("measuring for about a minute; nothing else should run on the machine")
        facts["speed"] = tell(measure_speed)
    lines = (line for title, fact in facts.items() for line in _lines(title, fact))
    say(json.dumps(facts, indent=1) if as_json else "\n".join(lines))
