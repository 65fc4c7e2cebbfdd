"""`bevcli`, and `python -m bevcli`."""

from bevcli.cli.stop_signals import EndSignals


def main() -> None:
    """The program. Ctrl-C and SIGTERM end it without a traceback, also while it imports packages."""
    EndSignals().start()
    from bevcli.cli.main import run_app

    run_app()


if __name__ == "__main__":
    main()
