"""Thousands of drives: distributes drives to workers, each of which runs a drive as `bevcli run` does.

In the order of a batch: `storage`, `job` (the drives, what they are run with, and their records), `worker` (one drive,
here or on Ray), `run_batch` (the loop), `report` (the tables and the page).
"""
