"""`bevcli checks`: the facts about this installation and machine."""

import json

from bevcli.cli.bridge import Json
from bevcli.options import option, options
from bevcli.printing import print_note, say
from bevcli.workshop.checks.checks import CHECKS, as_text, tell

PANEL = "Start"


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
        from bevcli.workshop.checks.speed import measure_speed

        print_note("measuring for about a minute; nothing else should run on the machine")
        facts["speed"] = tell(measure_speed)
    say(json.dumps(facts, indent=1) if as_json else as_text(facts))
