"""Thousands of drives: distributes drives to workers, each of which runs a drive as `bevcli run` does.

In the order of a batch: `storage`, `drives`, `job`, `worker` (one drive), `ray_workers`, `run_batch` (the loop and the
tables), `report`.
"""
