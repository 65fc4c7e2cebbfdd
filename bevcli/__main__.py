"""`bevcli`, and `python -m bevcli`."""

import atexit
import os
import sys

from bevcli.cli.stop_signals import EndSignals


def main() -> None:
    """The program. Ctrl-C and SIGTERM end it without a traceback, also while it imports packages."""
    # Streams that are closed, as by `>&-`, become /dev/null: the next file would take their place.
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(descriptor)
    for number, name in ((1, "stdout"), (2, "stderr")):
        if getattr(sys, name) is None:
            stream = open(number, "w", encoding="utf-8", closefd=False)  # noqa: SIM115, open until the program ends
            setattr(sys, name, stream)
    signals = EndSignals()
    signals.start()
    atexit.register(signals.stop)  # Python waits for threads before this
    from bevcli.cli.main import app, program

    with program():
        app()


if __name__ == "__main__":
    main()
