"""Cases of interrupted runs: outputs, inputs and states change between the interruption and `resume`, or under way."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path
from random import Random

import msgspec
import torch
from damage import HUGE, damage, edited
from memory_drive import MemoryDrive, make_camera
from mutations import TEXT, changed_tree
from safetensors.torch import save
from small_model import small_model

from bevcli.checkpoints import read_safetensors
from bevcli.geometry.cameras import CameraRig, default_ego_from_bev
from bevcli.inference.load import Model, hash_of
from bevcli.inference.tracking import TrackerConfig
from bevcli.recording.options import RecordingOptions
from bevcli.runs.options import RunOptions
from bevcli.runs.run_into_folder import run_into_folder
from bevcli.sequences.files.boxes_file import read_boxes
from bevcli.sequences.open import open_sequence
from bevcli.viewer.recording_reader import RecordingReader
from bevcli.workshop.formats.output import NativeWriter

FRAMES, STOP_AFTER = 4, 2
CAMERAS = ("CAM_FRONT", "CAM_BACK")
TRACKER = TrackerConfig(birth_score=0.0, keep_score=0.0)
SEEDS = "interrupted"  # folder: drive, out, out-bev


def resumed_after_damage(seeds: Path, case: Path, random: Random) -> None:
    """A resumed run ends in one line, or with the files of a run without interruption, but for those damaged."""
    whole = _fresh(seeds, case)
    others = [case / "drive/calibration.json", *sorted((seeds / "whole/out").rglob("*.[jrpc]*"))]
    names = [path for folder in ("out", "out-bev") for path in sorted((case / folder).rglob("*"))]
    damaged = [path for path in random.sample(names, random.choice((1, 1, 2))) if path.parent.is_dir()]
    done = [damage(path, random, others) for path in damaged if path.parent.is_dir()]
    for path in damaged:  # what stands in a file of finished frames is not read again
        whole = {name: text for name, text in whole.items() if not (case / name).is_relative_to(path)}
    _run(_models()["same"], case, resume=True)
    written = _contents(case)
    assert not [name for name, text in whole.items() if written.get(name) != text], f"{done}: the run succeeded"
    held = [case / "out" / name for name in ("recording.rrd", "predictions.json", "predictions.json.partial")]
    if not any(path.is_relative_to(each) for path in held for each in damaged):
        assert _frames(case) == list(range(FRAMES)), f"{done}: the recording lacks frames"


def exchanged_input(seeds: Path, case: Path, random: Random) -> None:
    """A resumed run refuses an input that changed, or ends with the files of a run without interruption."""
    whole = _fresh(seeds, case)
    models = _models()
    model, options, done = models["same"], {}, "time of change"
    names = sorted(path for path in (case / "drive").rglob("*") if path.is_file())
    path, kind = random.choice(names), random.randrange(8)
    if kind == 0:
        done = random.choice([name for name in models if name != "same"])
        model = models[done]
    elif kind == 1:
        options = random.choice(
            [{"track": False}, {"temporal": False}, {"save_bev": None}, {"cameras": {"CAM_BACK": "CAM_FRONT"}}]
        )
        done = str(options)
    elif kind == 2:
        os.utime(path, ns=(0, random.randrange(HUGE)))
    elif kind == 3 and path.suffix == ".json":
        path.write_bytes(_changed_document(path.read_bytes(), random))
        done = f"{path.name}: a value"
    elif kind <= 5 and path.suffix in (".csv", ".json"):
        path.write_bytes(edited(path.read_bytes(), random, TEXT))
        done = f"{path.name}: words"
    else:
        done = damage(path, random, [each for each in names if each != path])
    _resume(case, whole, done, model, **options)


def exchanged_under_way(seeds: Path, case: Path, random: Random) -> None:
    """A run whose inputs or outputs change while it runs ends in one line, or writes every frame."""
    _fresh(seeds, case)
    for name in ("out", "out-bev"):
        shutil.rmtree(case / name)
    at, done = random.randrange(FRAMES), []

    def change(frame: object, prediction: object) -> None:
        if len(done) == at:
            folder = random.choice(("drive", "drive", "out", "out-bev"))
            names = sorted(path for path in (case / folder).rglob("*") if path.name != "lock")
            done.append(damage(random.choice(names), random, sorted((seeds / "whole/out").glob("*.*"))))
        else:
            done.append("")

    summary = _run(_models()["same"], case, after_frame=change)
    assert summary.is_complete, done


def false_state(seeds: Path, case: Path, random: Random) -> None:
    """A resumed run refuses a state whose hash is right and whose content is not, or writes every frame."""
    _fresh(seeds, case)
    path = case / "out/.bevcli/state.safetensors"
    tensors, metadata = read_safetensors(path)
    if random.random() < 0.7:
        tree = msgspec.msgpack.decode(tensors["tree"].numpy().tobytes())
        text = json.dumps(tree).encode()
        for _ in range(random.choice((1, 1, 2))):
            text = _changed_document(text, random)
        tree = json.loads(text.replace(b"\\ud800", b"?"), parse_int=lambda digits: min(int(digits), 2**63))
        packed = msgspec.msgpack.encode(tree)  # of what MessagePack can hold
        tensors["tree"] = torch.frombuffer(bytearray(packed), dtype=torch.uint8)
    else:
        name = random.choice(sorted(tensors))
        tensors[name] = _changed_tensor(tensors[name], random)
    facts = dict(metadata, sha256=hash_of(sorted(tensors.items())))
    path.write_bytes(save({name: tensor.contiguous() for name, tensor in tensors.items()}, facts))
    _run(_models()["same"], case, resume=True)
    assert _frames(case) == list(range(FRAMES))


def _resume(case: Path, whole: dict[str, bytes], done: str, model: Model | None = None, **options: object) -> None:
    _run(model or _models()["same"], case, resume=True, **options)
    found = _contents(case)
    differing = sorted(name for name in {*found, *whole} if found.get(name) != whole.get(name))
    assert not differing, f"{done}: the run succeeded, but these differ: {differing}"
    assert _frames(case) == list(range(FRAMES)), f"{done}: the recording lacks frames"


def _run(model: Model, case: Path, *, track: bool = True, temporal: bool = True, **arguments: object):
    changed = {name: arguments.pop(name) for name in ("save_bev", "cameras") if name in arguments}
    options = RunOptions(
        recording=RecordingOptions(score=0.0), save_bev=case / "out-bev", track=track, temporal=temporal
    )
    sequence = open_sequence(case / "drive")
    return run_into_folder(model, sequence, case / "out", replace(options, **changed), **arguments)


def _fresh(seeds: Path, case: Path) -> dict[str, bytes]:
    """Puts a drive and its interrupted run into the folder, and returns the files of the run without interruption."""
    whole = _prepared(seeds, case)
    shutil.copytree(seeds / SEEDS, case, dirs_exist_ok=True)
    return whole


@cache
def _prepared(seeds: Path, case: Path) -> dict[str, bytes]:
    rig = CameraRig(
        tuple(make_camera(name, yaw, 64, 36) for name, yaw in zip(CAMERAS, (0, 180), strict=True)),
        default_ego_from_bev(),
    )
    drive = MemoryDrive(FRAMES, rig)
    with NativeWriter(case / "drive", with_ego_motion=True) as writer:
        for place in range(FRAMES):
            writer.write(drive.load(place))
    model = _models()["same"]
    _run(model, case)
    whole = _contents(case)
    shutil.copytree(case, seeds / "whole")
    for name in ("out", "out-bev"):
        shutil.rmtree(case / name)
    _run(model, case, should_stop=iter([*[False] * (STOP_AFTER - 1), True]).__next__)
    shutil.copytree(case, seeds / SEEDS)
    shutil.rmtree(case)
    case.mkdir()
    return whole


@cache
def _models() -> dict[str, Model]:
    networks = {"same": small_model(cameras=CAMERAS, heads=("detection", "segmentation"))}
    for name, changes in {"other weights": {}, "other configuration": {"name": "other"}}.items():
        networks[name] = small_model(cameras=CAMERAS, heads=("detection", "segmentation"), **changes)
    with torch.no_grad():
        next(networks["other weights"].parameters()).view(-1)[0] += 1e-6
    return {name: Model(network, tracker=TRACKER) for name, network in networks.items()}


def _contents(case: Path) -> dict[str, bytes]:
    """The files whose bytes do not depend on the time that a run took."""
    paths = [path for folder in ("out", "out-bev") for path in (case / folder).rglob("*")]
    left = ("recording.rrd", "summary.json")
    return {
        f"{path.relative_to(case)}": path.read_bytes()
        for path in paths
        if path.is_file() and path.name not in left and ".bevcli" not in path.parts
    }


def _frames(case: Path) -> list[int]:
    """Indices of the frames that both predictions.json and the recording hold."""
    predicted = [frame.stamp.index for frame in read_boxes(case / "out/predictions.json").frames]
    recorded = [frame.index for frame in RecordingReader(case / "out/recording.rrd").frames()]
    return predicted if predicted == recorded else []


def _changed_document(text: bytes, random: Random) -> bytes:
    kind = random.choice(("value", "value", "value", "drop", "copy", "nest"))
    return changed_tree(text, kind, random.randrange(HUGE), random.randrange(HUGE))


def _changed_tensor(tensor: torch.Tensor, random: Random) -> torch.Tensor:
    kind = random.choice(("shape", "type", "cut", "nan", "huge", "more"))
    if kind == "shape":
        return tensor.reshape(-1)
    if kind == "type":
        return tensor.to(random.choice((torch.float64, torch.int8, torch.bool, torch.float16, torch.int64)))
    if kind == "cut":
        return tensor.reshape(-1)[: random.randrange(tensor.numel() + 1)]
    if kind == "more":
        return torch.stack([tensor] * 3)
    value = float("nan") if kind == "nan" and tensor.is_floating_point() else torch.iinfo(torch.uint8).max
    return torch.full_like(tensor, value if tensor.dtype is not torch.int8 else 1)
