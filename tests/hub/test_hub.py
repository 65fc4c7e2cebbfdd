"""Models of the Hugging Face Hub: what is packed is loaded, from a server of its kind, its cache, and offline."""

import json
import os
import subprocess
import sys
import warnings
from contextlib import suppress
from pathlib import Path

import pytest
import safetensors.torch
import torch
import yaml
from command_line import MINI_TOML, command
from hub_server import serving

import bevcli
from bevcli.checkpoints import bundled_weights
from bevcli.config import load_config
from bevcli.errors import BevcliError, InputError, OutputError, WeightsError
from bevcli.inference.load import load_model
from bevcli.model.temporal_model import build_model
from bevcli.workshop.weights import fetch
from bevcli.workshop.weights.hub import import_hub, pack_model

FIRST, SECOND = "1" * 40, "2" * 40


def files_in(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def packed_mini(folder: Path, seed: int) -> Path:
    """A small model of one's own, packed."""
    folder.mkdir()
    (folder / "mini.toml").write_text(MINI_TOML + "[training]\nlearning_rate = 0.25\n")
    torch.manual_seed(seed)
    state = build_model(load_config(folder / "mini.toml")).state_dict()
    safetensors.torch.save_file({key: tensor.contiguous() for key, tensor in state.items()}, folder / "w.safetensors")
    pack_model(folder / "mini.toml", folder / "packed", weights=folder / "w.safetensors", licence="MIT")
    return folder / "packed"


@pytest.fixture(scope="module")
def versions(tmp_path_factory) -> list[dict[str, bytes]]:
    """The files of two packed models, which differ in their weights."""
    folder = tmp_path_factory.mktemp("packed")
    return [files_in(packed_mini(folder / str(seed), seed)) for seed in (0, 1)]


@pytest.fixture
def hub(versions, tmp_path, monkeypatch):
    """A server with the first version as its newest commit."""
    try:
        constants = import_hub().constants
    except BevcliError as error:
        pytest.skip(str(error))
    for name in [name for name in os.environ if name.lower().endswith("_proxy")]:
        monkeypatch.delenv(name)
    with serving() as (address, handler):
        handler.commits[FIRST] = versions[0]
        monkeypatch.setattr(constants, "ENDPOINT", address)
        template = f"{address}/{{repo_id}}/resolve/{{revision}}/{{filename}}"
        monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", template)
        monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
        monkeypatch.setattr(constants, "HF_HUB_OFFLINE", False)
        yield handler


def same_weights(model: bevcli.Model, content: bytes) -> bool:
    stored, state = safetensors.torch.load(content), model.network.state_dict()
    return stored.keys() == state.keys() and all(torch.equal(state[key], stored[key]) for key in stored)


def test_the_model_of_the_package_is_the_same_from_a_folder(tmp_path):
    pack_model("demo", tmp_path / "demo")
    there, here = load_model(f"hf:{tmp_path}/demo"), load_model("demo")
    assert (there.config, there.tracker, there.facts) == (here.config, here.tracker, here.facts)
    assert there.weights_hash == here.weights_hash
    assert there.source.endswith("rendered streets (`bevcli render`) and do not work on real images.")
    stored = [safetensors.torch.load_file(path) for path in (there.weights, bundled_weights("demo"))]
    assert {key: (t.dtype, t.tolist()) for key, t in stored[0].items() if t.ndim < 2} == {
        key: (t.dtype, t.tolist()) for key, t in stored[1].items() if t.ndim < 2
    }


def test_a_model_is_downloaded_once_then_used_from_the_cache(hub, versions, monkeypatch):
    model = load_model("hf:team/model")
    assert model.name == "mini"
    assert model.source == f"model hf:team/model, commit {FIRST[:12]} (main)"
    assert same_weights(model, versions[0]["model.safetensors"])
    assert not [path for path in hub.asked if "/api/" in path]  # no telemetry
    hub.asked.clear()
    hub.commits[SECOND] = versions[1]  # a newer version, which nobody has asked for
    assert same_weights(load_model("hf:team/model"), versions[0]["model.safetensors"])
    monkeypatch.setattr(sys.modules["huggingface_hub"].constants, "HF_HUB_OFFLINE", True)
    assert same_weights(load_model("hf:team/model"), versions[0]["model.safetensors"])
    assert hub.asked == []


def test_fetch_looks_for_a_newer_version_and_a_commit_stays(hub, versions, tmp_path):
    fetched = command(tmp_path, "weights", "fetch", "hf:team/model").stdout
    assert f"model hf:team/model, commit {FIRST[:12]} (main)\n" in fetched
    hub.commits[SECOND] = versions[1]
    assert same_weights(load_model("hf:team/model", fetch=True), versions[1]["model.safetensors"])
    assert same_weights(load_model("hf:team/model"), versions[1]["model.safetensors"])
    assert same_weights(load_model(f"hf:team/model@{FIRST}"), versions[0]["model.safetensors"])


def test_training_settings_and_weights_by_a_hubs_name(hub, versions):
    from bevcli.config import read_model_file
    from bevcli.inference.load import weights_file

    assert read_model_file("hf:team/model")[0]["training"] == {"learning_rate": 0.25}
    assert weights_file(Path("hf:team/model")).read_bytes() == versions[0]["model.safetensors"]


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("hf:team", "expected hf:OWNER/NAME, hf:OWNER/NAME@REVISION or hf:./FOLDER"),
        ("hf:team/../model", "is no model of the Hugging Face Hub"),
        ("hf:team/none", "hf:team/none: there is no such model, or it is private"),
        ("hf:team/model@v9", "hf:team/model@v9: the repository has no branch, tag or commit v9"),
        ("hf:team/model@empty", "is no model of bevcli: it lacks config.json or model.safetensors"),
        ("hf:team/model@other", "config.json: is not of `bevcli weights pack`"),
        ("hf:team/model@later", "this bevcli cannot read it (expected library bevcli, format 1; found"),
        ("hf:team/model@damaged", "has the SHA-256"),
        ("hf:team/model@mesh", "names a mesh, a file of this machine: refused"),
    ],
)
def test_what_is_no_model_is_one_line(hub, versions, tmp_path, name, said):
    files = versions[0]
    config = json.loads(files["config.json"])
    mesh = config["model"] | {"class_settings": {"car": {"mesh": "/etc/passwd"}}}
    hub.commits |= {
        "empty": {},
        "other": {**files, "config.json": b'{"model_type": "bert"}'},
        "later": {**files, "config.json": json.dumps(config | {"format": 2}).encode()},
        "damaged": {**files, "model.safetensors": files["model.safetensors"][:-1] + b"x"},
        "mesh": {**files, "config.json": json.dumps(config | {"model": mesh}).encode()},
    }
    done = command(tmp_path, "weights", "inspect", "--model", name)
    assert done.returncode == 1
    assert len(done.stderr.splitlines()) == 1
    assert said in done.stderr


@pytest.mark.parametrize("header", ["ETag", "X-Linked-Etag", "X-Repo-Commit", "X-Xet-Hash"])
@pytest.mark.parametrize(
    "name", ['"../../../../escaped"', 'W/"../escaped"', '"{0}/escaped"', '".."', '"x\\y"', '"a b/"']
)
def test_a_server_names_no_file_outside_the_cache(hub, tmp_path, header, name):
    hub.lies[header] = name.format(tmp_path)
    with pytest.raises(WeightsError, match=f"hf:team/model: cannot be downloaded .*{header}.* is no name of a file"):
        load_model("hf:team/model")
    assert not list(tmp_path.rglob("*"))
    hub.commits[FIRST] = {}  # a missing file is noted under the commit
    with pytest.raises(WeightsError):
        load_model("hf:team/model")
    assert not list(tmp_path.rglob("*"))


@pytest.mark.parametrize(
    ("lies", "pause_s", "said"),
    [
        ({"Retry-After": "100000"}, 0, "too many requests: try again in 100000 s"),
        ({"Content-Length": "1" + "0" * 15}, 0, r"the server sends more than 4,294,967,296 bytes: refused"),
        ({}, 0.1, "slower than 4096 bytes a second"),
        ({}, -1, "no answer within 0.3 s"),
    ],
)
def test_a_server_lets_nobody_wait(hub, monkeypatch, lies, pause_s, said):
    hub.lies.update(lies)
    hub.status = 429 if "Retry-After" in lies else 200
    hub.pause_s = pause_s
    monkeypatch.setattr(fetch, "STALL_S", 0.2)
    monkeypatch.setattr(fetch, "HEADERS_S", 0.3 if pause_s < 0 else 60)
    warnings.simplefilter("error")  # of huggingface_hub, beside the error
    with pytest.raises(WeightsError, match=f"hf:team/model: cannot be downloaded .*{said}"):
        load_model("hf:team/model")


@pytest.mark.parametrize(
    "name", ["a/b.git", "a--b/c", "a/..", "-a/b", "a/b-", "a/" + "b" * 97, "a/b@../../x", "a/b@..", "a/b@x//y", "./no"]
)
def test_a_name_that_the_hub_refuses_is_one_line(hub, tmp_path, name):
    with pytest.raises(WeightsError, match=r"is no model|no name of a model|is missing"):
        load_model(f"hf:{name}")
    assert hub.asked == []
    assert not list(tmp_path.rglob("*"))


@pytest.mark.parametrize("damage", [b"", b"\xff", b"../../..", b"x" * 5000])
def test_a_damaged_cache_is_an_error_or_fetched_anew(hub, versions, tmp_path, damage):
    load_model("hf:team/model")
    (tmp_path / "cache/models--team--model/refs/main").write_bytes(damage)
    with suppress(WeightsError):
        assert same_weights(load_model("hf:team/model"), versions[0]["model.safetensors"])


def test_a_server_that_is_gone_is_one_line(hub, monkeypatch):
    load_model("hf:team/model")
    template = "http://127.0.0.1:1/{repo_id}/resolve/{revision}/{filename}"
    monkeypatch.setattr(sys.modules["huggingface_hub"].constants, "HUGGINGFACE_CO_URL_TEMPLATE", template)
    with pytest.raises(WeightsError, match="hf:team/model: cannot be downloaded"):
        load_model("hf:team/model", fetch=True)
    monkeypatch.setattr(sys.modules["huggingface_hub"].constants, "HF_HUB_OFFLINE", True)
    with pytest.raises(WeightsError, match="is not in the cache, and cannot be downloaded: check the network"):
        load_model("hf:team/model@v2")


def test_without_the_package_one_line_says_what_to_install(monkeypatch):
    for name in ("huggingface_hub", "huggingface_hub.constants"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(BevcliError, match=r"needs huggingface_hub: run pip install 'bevcli\[hub\]'"):
        load_model("hf:team/model")


def test_a_folder_of_ones_own_model_has_a_card(tmp_path):
    packed_mini(tmp_path / "own", 0)
    (tmp_path / "scores.json").write_text('{"mean_ap": 0.25, "nd_score": 0.5}')
    files = ["own/mini.toml", "own/packed", "--weights", "own/w.safetensors"]
    done = command(tmp_path, "weights", "pack", *files)
    assert "own/packed/config.json: already exists; choose another folder, or pass `force=True`" in done.stderr
    stated = ["--licence", "Our own terms", "--scores", "scores.json", "--scored-on", "our drives"]
    done = command(tmp_path, "weights", "pack", *files, *stated, "--datasets", "ours, nuscenes", "--force")
    assert done.stderr == ""
    assert "next: bevcli run SEQUENCE --model hf:./own/packed, and hf upload OWNER/NAME own/packed" in done.stdout
    _, front, text = (tmp_path / "own/packed/README.md").read_text().split("---\n", 2)
    front = yaml.safe_load(front)
    (result,) = front["model-index"][0]["results"]
    assert (front["library_name"], front["datasets"]) == ("bevcli", ["ours", "nuscenes"])
    assert (front["metrics"], result["dataset"]) == (["mAP", "NDS"], {"type": "ours", "name": "our drives"})
    assert result["metrics"] == [{"type": "mAP", "value": 0.25}, {"type": "NDS", "value": 0.5}]
    assert (front["license"], front["license_name"]) == ("other", "Our own terms")
    assert "| mAP | 0.250 |" in text
    assert "car, truck, construction_vehicle" in text


def test_what_a_card_lacks_is_said(tmp_path):
    own = packed_mini(tmp_path / "own", 0).parent
    done = command(tmp_path, "weights", "pack", own / "mini.toml", "out", "--weights", own / "w.safetensors")
    assert done.stderr.splitlines() == [
        "note: the model card states no licence: others may not use the weights: pass `licence` (`--licence NAME`)",
        "note: the model card states no data of the training: pass `datasets` (`--datasets NAME`)",
        "note: the model card states no scores: pass `scores` (`--scores FILE.json`)",
    ]
    assert "license" not in yaml.safe_load((tmp_path / "out/README.md").read_text().split("---\n")[1])


def test_the_hub_reads_the_front_matter(tmp_path):
    hub = pytest.importorskip("huggingface_hub")
    pack_model("demo", tmp_path)
    data = hub.ModelCard.load(tmp_path / "README.md").data
    assert (data.license, data.library_name, data.model_name) == ("apache-2.0", "bevcli", "demo")
    scores = {result.metric_type: result.metric_value for result in data.eval_results}
    card = (Path(__file__).parents[2] / "docs/model-card.md").read_text()
    assert f"| mAP over the ten classes | **{scores['mAP']}** |" in card
    assert f"| NDS | **{scores['NDS']}** |" in card


def test_mistakes_of_packing_are_one_line(tmp_path):
    packed_mini(tmp_path / "own", 0)
    with pytest.raises(WeightsError, match="a model file holds no weights: pass `weights`"):
        pack_model(tmp_path / "own/mini.toml", tmp_path / "out")
    with pytest.raises(WeightsError, match="run `bevcli weights fetch tiny`"):
        pack_model("tiny", tmp_path / "out")
    (tmp_path / "scores.json").write_text('{"mAP": 1}')
    with pytest.raises(InputError, match="has no scores"):
        pack_model("demo", tmp_path / "out", scores=tmp_path / "scores.json")
    (tmp_path / "file").touch()
    with pytest.raises(OutputError):
        pack_model("demo", tmp_path / "file")
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_the_program_runs_a_model_of_the_hub_and_offline(hub, tmp_path):
    environment = {**os.environ, "HF_ENDPOINT": sys.modules["huggingface_hub"].constants.ENDPOINT}
    environment |= {"HF_HOME": str(tmp_path / "home"), "OMP_NUM_THREADS": "1"}
    street = Path(__file__).parents[2] / "samples/street"
    arguments = [sys.executable, "-m", "bevcli", "run", str(street), "--frames", "0:1", "--model", "hf:team/model"]
    texts = []
    for more in ({}, {"HF_HUB_OFFLINE": "1", "HF_ENDPOINT": "http://127.0.0.1:1"}):
        done = subprocess.run(
            [*arguments, "--force"], cwd=tmp_path, env=environment | more, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        texts.append(json.loads((tmp_path / "runs/street-mini/predictions.json").read_text())["frames"])
        assert f"note: model hf:team/model, commit {FIRST[:12]} (main)" in done.stderr
    assert texts[0] == texts[1]
    assert not [path for path in hub.asked if "/api/" in path]  # no telemetry
