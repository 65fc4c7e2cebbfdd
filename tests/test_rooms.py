"""Rooms: a model is known by its own folder only, and found through the registry."""

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from source_code import ROOT, trees
from test_layers import WINGS

from bevcli.model.temporal_model import TemporalModel
from bevcli.registry import entries, load, own

MODULES = [value.partition(":")[0] for value in own("bevcli.models").values()]
FOLDERS = sorted(ROOT.joinpath(*module.split(".")[1:-1]) for module in MODULES)


def classes_of(folder: Path) -> set[str]:
    inside = [tree for path, tree in trees().items() if path.is_relative_to(folder)]
    return {node.name for tree in inside for node in ast.walk(tree) if isinstance(node, ast.ClassDef)}


def trees_outside() -> dict[Path, ast.Module]:
    """The files outside of the models' folders, but for those that are registered for a use of a model."""
    registered = {value.partition(":")[0] for value in own("bevcli.model_uses").values()}
    left = {ROOT.joinpath(*name.split(".")[1:]).with_suffix(".py") for name in registered}
    return {
        path: tree
        for path, tree in trees().items()
        if path not in left and not any(path.is_relative_to(one) for one in FOLDERS)
    }


@cache
def names_in(path: Path) -> frozenset[str]:
    """Every name and imported module in a file's code; texts and comments are free to speak of models."""
    return frozenset(_names(trees()[path]))


def _names(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Name):
            yield node.id
        elif isinstance(node, ast.Attribute):
            yield node.attr
        elif isinstance(node, ast.ImportFrom):
            yield from (node.module or "", *(alias.name for alias in node.names))
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_no_other_room_names_a_model(folder):
    """UniAD extends BEVFormer, so that the models' folders may name each other; a wing may name what it states."""
    own, module = classes_of(folder), ".".join(("bevcli", *folder.relative_to(ROOT).parts))
    named = [
        f"{path.relative_to(ROOT)}: {name}"
        for path in trees_outside()
        if folder.name not in WINGS.get(path.parent.name, ())
        for name in names_in(path)
        if name in own or name == module or name.startswith(f"{module}.")
    ]
    assert not named


def test_no_other_room_asks_for_the_kind_of_a_model():
    """`Network` has the shared parts, which training, timing and figures need."""
    kinds = {name for folder in FOLDERS for name in classes_of(folder)} | {"ExportedModel"}
    asked = []
    for path, tree in trees_outside().items():
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "isinstance":
                asked += [path for name in ast.walk(node.args[1]) if isinstance(name, ast.Name) and name.id in kinds]
    assert not asked


def test_a_model_has_at_most_9_members():
    """What else is asked of a model is registered by its class, where it is asked."""
    declared = {*vars(TemporalModel), *TemporalModel.__annotations__, "config"}
    assert len([name for name in declared if not name.startswith("_")]) <= 9


@pytest.mark.parametrize("name", entries("bevcli.models"))
def test_registry_and_configuration_name_the_same_model(name):
    model: type[TemporalModel] = load("bevcli.models", name)
    assert model.config_class.architecture == name
