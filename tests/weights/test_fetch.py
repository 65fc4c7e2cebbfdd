"""Weights by name from a server that breaks off, stalls, lies, redirects, and sends other or hostile bytes."""

import contextlib
import hashlib
import io
import os
import pickle
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import safetensors.torch
import torch
from command_line import MINI_TOML, command
from file_server import serving

from bevcli.checkpoints import bundled_weights
from bevcli.cli.progress import load_with_bar
from bevcli.config import load_config
from bevcli.errors import BevcliError, ConfigError, OutputError, WeightsError
from bevcli.inference import ModelOptions
from bevcli.inference.load import load_model
from bevcli.model.temporal_model import build_model
from bevcli.published import all_weights, named_weights, own_table, read_sources
from bevcli.workshop.weights import fetch
from bevcli.workshop.weights.fetch import download_weights, fetch_weights


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("model") / "mini.toml"
    path.write_text(MINI_TOML)
    return path


@pytest.fixture(scope="module")
def content(model) -> bytes:
    torch.manual_seed(0)
    state = build_model(load_config(model)).state_dict()
    return safetensors.torch.save({key: tensor.contiguous() for key, tensor in state.items()})


@pytest.fixture
def server(content, monkeypatch, tmp_path):
    """A server, folders of a user, and short pauses."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "settings"))
    monkeypatch.setenv("BEVCLI_WEIGHTS_DIR", str(tmp_path / "weights"))
    monkeypatch.setattr(fetch, "PAUSE_S", 0.0)
    monkeypatch.setattr(fetch, "STALL_S", 1)
    for name in [name for name in os.environ if name.lower().endswith("_proxy")]:
        monkeypatch.delenv(name)
    with serving(content) as found:
        yield found


def add_source(of_model: Path, source: str, name: str = "own", **facts: object) -> None:
    """A table in the user's own file."""
    own_table().parent.mkdir(parents=True, exist_ok=True)
    facts = {"model": str(of_model), "source": source, **facts}
    lines = [f"{key} = {value!r}" for key, value in facts.items()]
    with own_table().open("a") as file:
        file.write("\n".join([f"[{name}]", *lines, ""]))


def left(tmp_path: Path) -> list[str]:
    return sorted(path.name for path in (tmp_path / "weights").rglob("*") if path.is_file())


@pytest.mark.parametrize(
    ("how", "requests"),
    [("whole", 1), ("cut", 3), ("changing", 2), ("without_ranges", 2), ("rest_in_parts", 6), ("no_rest", 3),
     ("long_tag", 2), ("redirect", 2), ("busy_once", 2)],
)  # fmt: skip
def test_the_file_arrives_as_it_is(server, model, content, tmp_path, how, requests):
    url, handler = server
    add_source(model, f"{url}/{how}/weights.safetensors")
    seen = list(download_weights(named_weights("own")))
    found = fetch_weights(named_weights("own"))
    assert found.path == tmp_path / "weights/own/weights.safetensors"
    assert found.path.read_bytes() == content
    assert found.known.sha256 == hashlib.sha256(content).hexdigest()
    assert found.checked == "nothing"
    assert seen[-1] == (len(content), len(content))
    assert len(handler.asked) == requests
    assert left(tmp_path) == ["hashes.json", "weights.safetensors"]
    if how == "cut":  # it goes on where it ended
        thirds = len(content) // 3, len(content) * 2 // 3
        assert [asked for _, asked in handler.asked] == ["", *(f"bytes={third}-" for third in thirds)]


def test_weights_that_are_here_need_no_download(monkeypatch):
    for name in ("bevcli.workshop.weights.fetch", "bevcli.workshop.engines.engine"):
        monkeypatch.setitem(sys.modules, name, None)
    assert load_model("demo").bundled


def test_a_download_that_ends_keeps_what_came(server, model, content, tmp_path, monkeypatch):
    url, handler = server
    monkeypatch.setattr(fetch, "BLOCK", 1 << 16)
    add_source(model, f"{url}/whole/weights.safetensors")
    with contextlib.closing(download_weights(named_weights("own"))) as steps:
        assert next(steps) == (0, len(content))
        next(steps)
    kept = (tmp_path / "weights/own/.partial-weights.safetensors").stat().st_size
    assert 0 < kept < len(content)
    assert fetch_weights(named_weights("own")).path.read_bytes() == content
    assert handler.asked[1] == ("whole", f"bytes={kept}-")


@pytest.mark.parametrize("how", ["cut_for_ever", "stalling", "too_long"])
def test_the_next_command_goes_on_with_what_was_kept(server, model, content, monkeypatch, how, tmp_path):
    url, handler = server
    monkeypatch.setattr(fetch, "ATTEMPTS", 1)
    add_source(model, f"{url}/{how}/weights.safetensors")
    with pytest.raises(WeightsError, match=r"the download broke off \d times \(.+\); [\d,]+ bytes are kept: the same"):
        fetch_weights(named_weights("own"))
    kept = len(content) if how == "too_long" else len(content) // 2
    assert (tmp_path / "weights/own/.partial-weights.safetensors").stat().st_size == kept
    assert named_weights("own").here is None
    monkeypatch.setattr(fetch, "ATTEMPTS", 2)
    monkeypatch.setattr(handler, how, handler.whole)
    handler.asked.clear()
    assert fetch_weights(named_weights("own")).path.read_bytes() == content
    assert handler.asked[0] == (how, f"bytes={kept}-")


@pytest.mark.parametrize(
    ("how", "requests", "kept"),
    [
        ("one_byte_more", 5, "5 bytes are kept"),
        ("half_without_ranges", 6, "bytes are kept"),
        ("rest_of_another_version", 6, "does not go on from what is there"),
        ("rest_from_elsewhere", 6, "does not go on from what is there"),
        ("part_without_a_range", 5, "does not go on from what is there"),
        ("redirect_for_ever", 11, "infinite loop"),
    ],
)
def test_a_server_that_brings_nothing_is_left(server, model, tmp_path, how, requests, kept):
    url, handler = server
    add_source(model, f"{url}/{how}/weights.safetensors")
    with pytest.raises(WeightsError, match=kept):
        fetch_weights(named_weights("own"))
    assert len(handler.asked) == requests
    assert not set(left(tmp_path)) & {"weights.safetensors", "hashes.json"}


@pytest.mark.parametrize(
    ("how", "limits", "reason"),
    [
        ("slow_for_ever", {"WHOLE_S": 0.2}, "timed out"),
        ("slow_for_ever", {"STALL_S": 0.2, "ATTEMPTS": 1, "STALL_BYTES": 1e9}, "slower than"),
        ("no_header_ends", {"HEADERS_S": 0.2, "ATTEMPTS": 1}, "no answer within 0.2 s"),
    ],
)
def test_a_slow_download_has_an_end(server, model, monkeypatch, how, limits, reason):
    url, _ = server
    for name, value in limits.items():
        monkeypatch.setattr(fetch, name, value)
    add_source(model, f"{url}/{how}/weights.safetensors")
    with pytest.raises(WeightsError, match=rf"broke off \d times? \({reason}"):
        fetch_weights(named_weights("own"))


def test_a_file_without_a_length_does_not_fill_the_disk(server, model, content, monkeypatch, tmp_path):
    url, _ = server
    monkeypatch.setattr(fetch, "MOST_BYTES", len(content) // 2)
    add_source(model, f"{url}/endless/weights.safetensors")
    with pytest.raises(WeightsError, match=r"sends more than [\d,]+ bytes: refused \(a larger file needs its size"):
        fetch_weights(named_weights("own"))
    assert (tmp_path / "weights/own/.partial-weights.safetensors").stat().st_size == 0


def test_notes_that_cannot_be_read_start_the_download_anew(server, model, content, tmp_path):
    url, _ = server
    add_source(model, f"{url}/whole/weights.safetensors")
    partial = tmp_path / "weights/own/.partial-weights.safetensors"
    partial.parent.mkdir(parents=True)
    partial.write_bytes(b"x")
    partial.with_name(f"{partial.name}.json").write_bytes(b"{" * 100_000)
    assert fetch_weights(named_weights("own")).path.read_bytes() == content


@pytest.mark.parametrize(
    ("how", "facts", "message"),
    [
        ("missing", {}, "the server answers with status 404"),
        ("no_content", {}, "the server answers with status 204"),
        ("redirect_to_a_file", {}, "cannot be downloaded"),
        ("too_long", {"bytes": "true size"}, r"the server sends more than [\d,]+ bytes: refused"),
        ("endless", {"bytes": "true size"}, "the server sends more than"),
        ("length_of_16_digits", {}, "the server sends more than"),
        ("absurd_length", {}, "the server sends more than"),
        ("too_short", {}, "refused, and deleted: the file .*"),
        ("other", {}, "refused, and deleted: the file .*"),
        ("other", {"sha256": "true hash"}, "refused, and deleted: the file has the SHA-256"),
        ("whole", {"sha256": "0" * 8}, r"has the SHA-256 \w+ \(expected 00000000\)"),
        ("whole", {"model": "demo"}, "does not fit model own"),
    ],
)
def test_another_file_is_refused_in_one_line(server, model, content, tmp_path, how, facts, message):
    url, _ = server
    true = {"true size": len(content), "true hash": hashlib.sha256(content).hexdigest()}
    facts = {key: true.get(value, value) for key, value in facts.items()}
    add_source(model, f"{url}/{how}/weights.safetensors", **facts)
    with pytest.raises(WeightsError, match=message) as raised:
        fetch_weights(named_weights("own"))
    assert str(raised.value).startswith(url)
    assert not set(left(tmp_path)) & {"weights.safetensors", "hashes.json"}


@pytest.mark.skipif(shutil.which("openssl") is None, reason="no openssl to make a certificate")
def test_certificates_are_checked_and_https_stays_https(model, content, server, tmp_path, monkeypatch):
    certificate = tmp_path / "certificate.pem"
    make = "openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -days 2 -subj /CN=test"
    make += " -addext subjectAltName=IP:127.0.0.1 -keyout"
    subprocess.run([*make.split(), certificate, "-out", tmp_path / "public.pem"], check=True, timeout=60)
    certificate.write_text(certificate.read_text() + (tmp_path / "public.pem").read_text())
    with serving(content, certificate) as (url, handler):
        add_source(model, f"{url}/whole/weights.safetensors")
        add_source(model, f"{url}/redirect_to_http/weights.safetensors", "down")
        with pytest.raises(WeightsError, match=r"cannot be downloaded \(.*certificate"):
            fetch_weights(named_weights("own"))
        assert handler.asked == []
        monkeypatch.setenv("SSL_CERT_FILE", str(tmp_path / "public.pem"))
        with pytest.raises(WeightsError, match=r"cannot be downloaded .*http"):
            fetch_weights(named_weights("down"))
        assert fetch_weights(named_weights("own")).path.read_bytes() == content


def test_a_hostile_pickle_is_refused_and_runs_nothing(model, server, tmp_path):
    class Harm:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "harm"),)

    for name, hostile in [("pickle", pickle.dumps(Harm())), ("zip", torch_file({"state_dict": {"a": Harm()}}))]:
        with serving(hostile) as (url, _):
            add_source(model, f"{url}/whole/weights.pth", name)
            with pytest.raises(WeightsError, match="refused, and deleted"):
                fetch_weights(named_weights(name))
    assert not (tmp_path / "harm").exists()
    assert left(tmp_path) == []


def torch_file(contents: object) -> bytes:
    file = io.BytesIO()
    torch.save(contents, file)
    return file.getvalue()


def test_a_later_download_must_equal_the_first_one(server, model, content, tmp_path):
    url, handler = server
    add_source(model, f"{url}/whole/weights.safetensors")
    first = fetch_weights(named_weights("own"))
    assert fetch_weights(named_weights("own"), force=True).checked == "as at its first download"
    assert len(handler.asked) == 2
    state = safetensors.torch.load(content)
    handler.content = safetensors.torch.save({key: 2 * tensor for key, tensor in state.items()})
    with pytest.raises(WeightsError, match=f"the first download had {first.known.sha256}: the file at the source has"):
        fetch_weights(named_weights("own"), force=True)
    assert first.path.read_bytes() == content
    first.path.write_bytes(content[:-1])
    assert named_weights("own").here is None


def test_a_known_hash_is_checked(server, model, content):
    url, _ = server
    sha256 = hashlib.sha256(content).hexdigest()
    add_source(model, f"{url}/whole/weights.safetensors", sha256=sha256, bytes=len(content))
    add_source(model, f"{url}/whole/weights.safetensors", "start", sha256=sha256[:8])
    assert fetch_weights(named_weights("start")).checked == "the first 8 digits"
    assert fetch_weights(named_weights("own")).checked == "all"


def test_a_full_disk_is_told_before_anything_is_sent(server, model, tmp_path):
    url, handler = server
    add_source(model, f"{url}/whole/weights.safetensors", bytes=10**15)
    with pytest.raises(OutputError, match="the disk has too little space: 1000000000 MB are needed"):
        fetch_weights(named_weights("own"))
    assert handler.asked == []


def test_a_second_process_does_not_write_the_same_file(server, model, tmp_path):
    fcntl = pytest.importorskip("fcntl")
    url, handler = server
    add_source(model, f"{url}/whole/weights.safetensors")
    (tmp_path / "weights/own").mkdir(parents=True)
    with (tmp_path / "weights/own/.partial-weights.safetensors").open("ab") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        with pytest.raises(WeightsError, match="another process is downloading it"):
            fetch_weights(named_weights("own"))
    assert handler.asked == []


def test_a_path_is_used_where_it_lies(server, model, content, tmp_path):
    file = tmp_path / "mine.safetensors"
    add_source(model, str(file))
    with pytest.raises(WeightsError, match="weights file not found"):
        fetch_weights(named_weights("own"))
    file.write_bytes(content)
    assert fetch_weights(named_weights("own")).path == file
    assert load_model("own", device="cpu").weights == file


def test_a_hugging_face_repository_is_an_address(server, model, content, monkeypatch):
    add_source(model, "hf://team/bev@v2/deep/weights.safetensors")
    monkeypatch.delenv("HF_ENDPOINT", raising=False)
    assert read_sources()["own"].url == "https://huggingface.co/team/bev/resolve/v2/deep/weights.safetensors"
    monkeypatch.setenv("HF_ENDPOINT", f"{server[0]}/whole/")
    assert fetch_weights(named_weights("own")).path.read_bytes() == content


def test_a_command_shows_the_download_of_its_models_weights(server, model, tmp_path, capsys):
    url, handler = server
    add_source(model, f"{url}/whole/weights.safetensors")
    options = ModelOptions(model="own", device="cpu", fetch=True)
    for _ in range(2):
        assert load_with_bar(options)[0].weights == tmp_path / "weights/own/weights.safetensors"
    assert capsys.readouterr().err.startswith(f"note: own: {url}/whole/weights.safetensors\n")
    assert len(handler.asked) == 1


def test_a_model_is_loaded_by_the_name_of_its_weights(server, model, tmp_path):
    url, handler = server
    add_source(model, f"{url}/whole/weights.safetensors")
    with pytest.raises(WeightsError, match="model own has no weights: run `bevcli weights fetch own`, which downloads"):
        load_model("own")
    assert handler.asked == []
    loaded = load_model("own", fetch=True, device="cpu", weights_dir=tmp_path / "elsewhere")
    assert (loaded.name, loaded.weights) == ("own", tmp_path / "elsewhere/own/weights.safetensors")
    assert not loaded.bundled
    assert load_model("own", device="cpu", weights_dir=tmp_path / "elsewhere").weights_hash == loaded.weights_hash
    assert len(handler.asked) == 1


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"urll": "x"}, "urll"),
        ({"source": "ftp://host/a.pth"}, "expected https://"),
        ({"source": "hf://nothing"}, "expected hf://OWNER/REPOSITORY/FILE"),
        ({"source": "https://host/a.exe"}, "ends in .pth"),
        ({"source": "https://host/.."}, "ends in .pth"),
        ({"sha256": "xyz"}, "8 to 64"),
        ({"bytes": -1}, "a positive number"),
    ],
)
def test_a_wrong_table_is_told_in_one_line(server, model, table, message):
    add_source(model, **{"source": "", **table})
    with pytest.raises(ConfigError, match=rf"weights\.toml: \[own\]: .*{message}"):
        named_weights("own")
    own_table().unlink()
    add_source(model, "https://host/a.pth", '"../own"')
    with pytest.raises(ConfigError, match=r"expected a name of letters, digits"):
        read_sources()


def test_every_name_of_the_package_has_a_model() -> None:
    for weights in all_weights().values():
        assert load_config(weights.model)
        assert weights.source.licence
        assert weights.source.url.startswith("https://") or weights.source.page


def test_the_commands_list_and_fetch(server, model, tmp_path, content):
    url, _ = server
    add_source(model, f"{url}/whole/weights.safetensors", published={})
    assert command(tmp_path, "weights", "list").stdout.count(str(tmp_path / "weights")) == 0
    done = command(tmp_path, "weights", "fetch", "own")
    assert done.returncode == 0, done.stderr
    assert hashlib.sha256(content).hexdigest() in done.stdout
    assert f"note: own: {url}/whole/weights.safetensors" in done.stderr
    listed = command(tmp_path, "weights", "list").stdout
    assert f"here: {tmp_path / 'weights/own/weights.safetensors'}" in listed
    assert "NDS 35.9, mAP 25.7" in listed
    done = command(tmp_path, "weights", "fetch", "nothing")
    assert done.stderr.startswith('error: no weights are known as "nothing" (expected one of tiny, tiny-fp16, ')
    done = command(tmp_path, "weights", "fetch", "v2-t8")
    assert done.stderr.startswith("error: v2-t8: can only be downloaded by hand, from https://github.com/")
    assert ": run the model with `weights` (`--weights FILE`), or state the file as `source` of " in done.stderr
    assert done.stderr.count("\n") == done.returncode == 1


def test_broken_hashes_are_told(server, model, tmp_path):
    add_source(model, f"{server[0]}/whole/weights.safetensors")
    (tmp_path / "weights").mkdir()
    (tmp_path / "weights/hashes.json").write_text("[1]")
    with pytest.raises(BevcliError, match=r"hashes\.json: broken .*: remove it"):
        fetch_weights(named_weights("own"))


def test_convert_overwrites_a_file_only_with_force(tmp_path):
    target = tmp_path / "weights.safetensors"
    target.touch()
    done = command(tmp_path, "weights", "convert", bundled_weights("demo"), target)
    assert (done.returncode, target.stat().st_size) == (1, 0)
    assert done.stderr.endswith("already exists; choose another name, or pass --force to overwrite it\n")
