"""How two workers share the tests. Their fixtures are in shared_fixtures.py."""

import gc
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

# Files that one worker runs, because they share what takes long: processes to fork from, an exported model, a rendered
# drive, syntax trees, and the shapes of the weights of all known models.
GROUPS = {
    "processes": (
        *("test_engines", "test_in_engine", "test_export_onnx", "test_export_window", "test_fuzz"),
        *("test_extend", "test_interrupted_run", "test_no_answer", "test_no_connections", "test_process_group"),
    ),
    "rendered": ("test_drive", "test_export", "test_random_rig", "test_material", "test_body", "test_catalog"),
    "weights": ("test_checkpoints", "test_ego_motion_inputs", "test_system_errors", "test_fetch"),
}
TOGETHER = {file: group for group, files in GROUPS.items() for file in files}
# What takes longest comes first, so that no worker ends with it.
FIRST = ("processes", "rendered", "test_resume", "test_equals_original", "test_run_batch", "test_faults")


def pytest_configure(config: pytest.Config) -> None:
    """Only a process that runs tests imports the fixtures: PyTorch takes seconds."""
    if hasattr(config, "workerinput") or not config.getoption("numprocesses", None):
        gc.disable()  # until all modules are imported, whose objects stay
        config.pluginmanager.import_plugin("shared_fixtures")


def group_of(file: str) -> str:
    return TOGETHER.get(Path(file).stem, Path(file).stem)


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector: pytest.Collector) -> Iterator[pytest.CollectReport]:
    """The second worker imports the files from the last to the first: in a fresh clone each compiles half of them."""
    report = yield
    if isinstance(collector, pytest.Dir) and os.environ.get("PYTEST_XDIST_WORKER") == "gw1":
        report.result.reverse()
    return report


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    rank = {group: place for place, group in enumerate(FIRST)}
    items.sort(key=lambda item: (rank.get(group_of(item.location[0]), len(rank)), item.location[0]))


def pytest_collection_finish() -> None:
    gc.freeze()  # the garbage collector need not visit the million objects of the modules again and again
    gc.set_threshold(10_000)
    gc.enable()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: object) -> object:
    from xdist.scheduler import LoadFileScheduling

    class GroupScheduling(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return group_of(super()._split_scope(nodeid))

    return GroupScheduling(config, log)
