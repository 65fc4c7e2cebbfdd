"""Commands of the driver, such as "straight": each chooses one of the paths that a model plans."""

from pathlib import Path

from bevcli.errors import InputError
from bevcli.frame import FrameResult
from bevcli.model.config import ModelConfig
from bevcli.parsing.documents import read_json

# Commands over a drive: index of a frame and the command from it on, by rising index, until the next one.
Commands = tuple[tuple[int, str], ...]


def with_command(results: tuple[FrameResult, ...], commands: Commands, frame: int) -> tuple[FrameResult, ...]:
    """The results, plans with the command at a frame, "" for none."""
    command = next((command for first, command in reversed(commands) if first <= frame), "")
    return tuple(result.with_command(command) for result in results)


def read_commands(command: str | None, config: ModelConfig) -> Commands:
    """The commands of the option `command`: one name, or a JSON file {"0": "straight", "40": "left"} by frame index.

    None: no command. Raises InputError for a model that does not plan, an unknown command, or a wrong file.
    """
    if command is None:
        return ()
    path = Path(command)
    if path.suffix != ".json":
        return one_command(command, config)
    known = _known(command, config)
    found = read_json(path)
    if not isinstance(found, dict) or not found:
        raise InputError(f'{path}: is not a file of commands (expected {{"0": "{known[0]}"}}, by frame index)')
    for frame, name in found.items():
        if not (frame.isascii() and frame.isdigit() and len(frame) < 10) or name not in known:
            expected = f"expected {', '.join(known)}, by frame index"
            raise InputError(f'{path}: "{frame}": {name!r:.40}: is no command ({expected})')
    return tuple(sorted((int(frame), name) for frame, name in found.items()))


def one_command(command: str, config: ModelConfig) -> Commands:
    """A command by its name, for all frames. Raises InputError for a model that does not plan, or another name."""
    known = _known(command, config)
    if command not in known:
        raise InputError(f"`command={command}`: is unknown (expected {', '.join(known)} or a FILE.json)")
    return ((0, command),)


def _known(command: str, config: ModelConfig) -> tuple[str, ...]:
    known = next((names for kind, names in config.results.items() if kind.takes_command), ())
    if not known:
        raise InputError(f"`command={command}`: {config.name} plans no path: leave out the option")
    return known
