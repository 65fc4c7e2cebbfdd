"""The files of a run: what `bevcli run` adds to `bevcli.run`."""
