"""`bevcli`, and `python -m bevcli`."""

import os
import signal
from types import FrameType

INTERRUPTED = 130  # exit code


def main() -> None:
    """The program. Ctrl-C ends it without a traceback, also while it imports packages."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # a background job ignores it
        signal.signal(signal.SIGINT, _interrupt)
    from bevcli.cli.main import run_app

    run_app()


def _interrupt(number: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt, but end the process at once during an import: packages turn it into other errors."""
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            os._exit(INTERRUPTED)
        frame = frame.f_back
    raise KeyboardInterrupt


if __name__ == "__main__":
    main()
