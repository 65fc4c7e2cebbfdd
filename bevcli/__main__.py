"""`python -m bevcli`."""

from bevcli.cli.main import run_app

run_app()
