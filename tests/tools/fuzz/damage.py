"""Damages a file or a folder as a full disk, a careless user or an attacker does."""

import os
import shutil
from pathlib import Path
from random import Random

from mutations import BYTES, TEXT, mutated

HUGE = 10**6


def damage(path: Path, random: Random, others: list[Path]) -> str:
    """Damages `path`, which may be missing, and returns how. others: files of other runs, which may take its place."""
    how = random.choice(list(HOW))
    others = [each for each in others if each.is_file() and each != path]
    content = path.read_bytes() if path.is_file() else b""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
    HOW[how](path, content, random, others)
    return f"{path.name}: {how}"


def edited(content: bytes, random: Random, kinds: tuple[str, ...] = BYTES) -> bytes:
    """The content after one to three small changes."""
    return mutated(
        content,
        [
            (random.choice(kinds), random.randrange(HUGE), random.randrange(HUGE))
            for _ in range(random.choice((1, 1, 3)))
        ],
    )


def _made(path: Path) -> Path:
    path.mkdir()
    return path


def _zeroed(path: Path, content: bytes, random: Random, others: list[Path]) -> None:
    start = random.randrange(len(content) + 1)
    size = random.choice((1, 512, HUGE))
    path.write_bytes(content[:start] + bytes(len(content[start : start + size])) + content[start + size :])


HOW = {
    "deleted": lambda path, content, random, others: None,
    "empty": lambda path, content, random, others: path.write_bytes(b""),
    "cut": lambda path, content, random, others: path.write_bytes(content[: random.randrange(len(content) + 1)]),
    "longer": lambda path, content, random, others: path.write_bytes(content + random.randbytes(999)),
    "zeros": _zeroed,
    "edited": lambda path, content, random, others: path.write_bytes(edited(content, random)),
    "words": lambda path, content, random, others: path.write_bytes(edited(content, random, TEXT)),
    "other's": lambda path, content, random, others: shutil.copy(random.choice(others), path),
    "link to a file": lambda path, content, random, others: path.symlink_to(random.choice(others)),
    "link to nothing": lambda path, content, random, others: path.symlink_to("/nonexistent/file"),
    "link to itself": lambda path, content, random, others: path.symlink_to(path.name),
    "link to a device": lambda path, content, random, others: path.symlink_to("/dev/zero"),
    "pipe": lambda path, content, random, others: os.mkfifo(path),
    "folder": lambda path, content, random, others: path.mkdir(),
    "full folder": lambda path, content, random, others: shutil.copy(others[0], _made(path)),
}  # fmt: skip
