"""The files that only a host of repositories or a container engine reads."""

import json
import re
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parent.parent
WORKFLOWS = sorted((ROOT / ".github/workflows").glob("*.yml"))
MAKEFILE = (ROOT / "Makefile").read_text(encoding="utf-8")
DOCKERFILE = (ROOT / "Dockerfile").read_text(encoding="utf-8")


def workflow(path: Path) -> dict:
    return yaml.safe_load(path.read_text(encoding="utf-8"))


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_workflows_run_targets_of_the_makefile_only(path: Path) -> None:
    """What a workflow does can be done here."""
    targets = set(re.findall(r"^([a-z-]+(?: [a-z-]+)*):", MAKEFILE, flags=re.MULTILINE))
    names = {name for line in targets for name in line.split()}
    steps = [step for job in workflow(path)["jobs"].values() for step in job["steps"] if "run" in step]
    for step in steps:
        words = step["run"].split()
        assert words[0] == "make"
        assert set(words[1:]) <= names


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_workflows_may_read_and_state_what_else(path: Path) -> None:
    stated = workflow(path)
    assert stated["permissions"] == {"contents": "read"}
    written = {job: set(of.get("permissions", {})) for job, of in stated["jobs"].items()}
    assert {job for job, more in written.items() if more} <= {"publish", "deploy"}
    assert "secrets." not in path.read_text(encoding="utf-8")


def test_a_release_is_what_was_tested() -> None:
    release = workflow(ROOT / ".github/workflows/release.yml")["jobs"]
    run = [step["run"] for step in release["build"]["steps"] if "run" in step]
    assert run == ["make check", "make test-all", "make dist"]
    assert release["publish"]["needs"] == "build"
    assert release["publish"]["permissions"] == {"id-token": "write"}


def test_tests_run_on_three_systems() -> None:
    matrix = workflow(ROOT / ".github/workflows/test.yml")["jobs"]["test"]["strategy"]["matrix"]
    systems = {*matrix["system"], *(more["system"] for more in matrix["include"])}
    assert systems == {"ubuntu-latest", "macos-latest", "windows-latest"}


def test_a_report_of_a_fault_has_the_output_of_checks() -> None:
    form = workflow(ROOT / ".github/ISSUE_TEMPLATE/bug.yml")
    asked = [field for field in form["body"] if "bevcli checks" in field["attributes"]["label"]]
    assert len(asked) == 1
    assert asked[0]["validations"]["required"]


def test_the_image_copies_what_the_package_is_made_of() -> None:
    kept = {
        line[1:]
        for line in (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines()
        if line.startswith("!")
    }  # fmt: skip
    assert {"bevcli", "samples", "constraints.txt", "pyproject.toml", "README.md", "LICENSE"} <= kept
    assert all((ROOT / name).exists() for name in kept)


def test_the_image_installs_as_the_readme_says() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    cpu = "https://download.pytorch.org/whl/cpu"
    assert f"pip install torch --index-url {cpu}" in readme
    assert f"ARG TORCH_INDEX={cpu}" in DOCKERFILE
    installs = re.findall(r"pip install (.+?)(?: &&|$)", DOCKERFILE, flags=re.MULTILINE)
    constraint = "--constraint /source/constraints.txt"
    assert installs == [f"{constraint} torch --index-url ${{TORCH_INDEX}}", f"{constraint} /source"]


def test_the_container_for_developers_is_the_same_image() -> None:
    stated = json.loads((ROOT / ".devcontainer/devcontainer.json").read_text(encoding="utf-8"))
    assert (ROOT / ".devcontainer" / stated["build"]["dockerfile"]).resolve() == ROOT / "Dockerfile"
    assert stated["postCreateCommand"].endswith("make install")
