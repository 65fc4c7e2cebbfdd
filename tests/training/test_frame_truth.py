"""Lines, futures and the driven path of a frame to train on, and a training of a VAD with them."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from memory_drive import make_rig
from painted_drives import CONFIG, PaintedDrive
from safetensors.torch import load_file

from bevcli.config import load_config
from bevcli.errors import InputError
from bevcli.frame import Drive, Frame, FrameStamp
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.ego_motion import GRAVITY, Kinematics
from bevcli.geometry.transforms import Pose, apply
from bevcli.workshop.formats.map_lines import MapLines
from bevcli.workshop.training.augmentation import AugmentationConfig
from bevcli.workshop.training.clip_steps import forward_clip
from bevcli.workshop.training.frame_losses import FrameLosses, LossConfigs
from bevcli.workshop.training.job import OptimizerConfig, TrainingConfig, TrainingJob, training_config
from bevcli.workshop.training.samples import Clip, ClipConfig, load_batch
from bevcli.workshop.training.trainer import Trainer
from bevcli.workshop.vad.heads import LineDecoderConfig, MotionConfig
from bevcli.workshop.vad.losses import frame_truth
from bevcli.workshop.vad.vad import VAD, VADConfig

VAD_CONFIG = VADConfig(
    **{field.name: getattr(CONFIG, field.name) for field in fields(CONFIG)} | {"heads": ("detection",)},
    line_decoder=LineDecoderConfig(
        lines=6, line_points=4, layers=2, attention_heads=4, feed_forward_width=64, dropout=0, max_lines=6
    ),
    motion=MotionConfig(modes=2, steps=3, attention_heads=4, feed_forward_width=64, dropout=0),
)
LINES = MapLines((np.array([[-3.0, -10], [-3, 10]]),), np.array(["divider"]))
RIG = make_rig({"CAM_FRONT": 0.0})


class MovingDrive(Drive):
    """Four frames half a second apart; the vehicle drives 4 m a frame to the north. Two cars start beside it.

    One drives along at the same speed, the other stands and is gone from the third frame on.
    """

    name, rig, has_ego_motion = "moving", RIG, True
    stamps = tuple(FrameStamp(index, "", 10**18 + index * 500_000_000) for index in range(4))

    def load(self, index: int) -> Frame:
        pose = Pose(np.array([0.0, 4.0 * index, 0]), np.array([0.5**0.5, 0, 0, 0.5**0.5]))
        count = 2 if index < 2 else 1
        centers = np.array([[3.0, 4.0 * index, 1], [5.0, 0.0, 1]])[:count]
        boxes = Boxes3D(
            centers, np.ones((count, 3)), np.zeros(count), np.zeros((count, 2)), np.array(["car"] * count),
            instances=np.array(["a", "b"])[:count],
        )  # fmt: skip
        still = Kinematics(np.array([0, 0, GRAVITY]), np.zeros(3), np.zeros(3))
        at = dict.fromkeys(RIG.names, pose)
        return Frame(self.stamps[index], RIG, {}, pose, at, still, ground_truth=boxes, ground_truth_results=(LINES,))


def test_futures_and_the_driven_path_are_in_the_bev_frame() -> None:
    drive = MovingDrive()
    truth = frame_truth(drive.load(0), drive, 0, VAD_CONFIG)
    np.testing.assert_allclose(truth.driven, [[0, 4], [0, 8], [0, 12]], atol=1e-9)
    assert truth.command == "straight"
    assert truth.boxes.futures is not None
    futures = truth.boxes.futures[:, 0] - np.pad(truth.boxes.centers[:, None, :2], ((0, 0), (0, 0), (1, 0)))
    np.testing.assert_allclose(futures[0], [[0.5, 0, 4], [1, 0, 8], [1.5, 0, 12]], atol=1e-9)
    np.testing.assert_allclose(futures[1, 0], [0.5, 0, 0], atol=1e-9)
    assert np.isnan(futures[1, 1:, 1:]).all()
    east = apply(RIG.ego_from_bev, (3.0, 0, 0))[1]  # the car 3 m to the east is on the right
    assert truth.boxes.centers[0, 0] == pytest.approx(-east)


def test_nothing_is_known_after_the_end_of_a_drive() -> None:
    drive = MovingDrive()
    truth = frame_truth(drive.load(2), drive, 2, VAD_CONFIG)
    assert np.isfinite(truth.driven).all(-1).tolist() == [True, False, False]
    truth = frame_truth(drive.load(3), drive, 3, VAD_CONFIG)
    assert (np.isfinite(truth.driven).any(), truth.command) == (False, "")


def test_missing_lines_and_identities_are_named() -> None:
    drive = MovingDrive()
    frame = drive.load(0)
    with pytest.raises(InputError, match=r"frame 0 of the drive has no true lines .* ground_truth_lines\.json"):
        frame_truth(replace(frame, ground_truth_results=()), drive, 0, VAD_CONFIG)
    nameless = replace(frame, ground_truth=replace(frame.ground_truth, instances=None))
    with pytest.raises(InputError, match='true boxes have no "instance"'):
        frame_truth(nameless, drive, 0, VAD_CONFIG)


class LinedDrive(PaintedDrive):
    """A painted drive whose boxes have identities, with a line."""

    def load(self, index: int) -> Frame:
        frame = super().load(index)
        assert frame.ground_truth is not None
        names = np.array([str(place) for place in range(len(frame.ground_truth))])
        return replace(frame, ground_truth=replace(frame.ground_truth, instances=names), ground_truth_results=(LINES,))


class LinedDrives:
    input_shapes = None
    drives = tuple(LinedDrive(seed, all_labelled=True) for seed in range(2))

    def __len__(self) -> int:
        return len(self.drives)

    def open(self, index: int) -> LinedDrive:
        return self.drives[index]


def test_losses_of_own_heads_join_those_of_boxes() -> None:
    torch.manual_seed(0)
    model, losses = VAD(VAD_CONFIG), {}
    clips = [Clip(0, (0,)), Clip(1, (0,))]
    batch = load_batch(LinedDrives(), clips, VAD_CONFIG, AugmentationConfig(0, 0), np.random.default_rng(0))
    for outputs in forward_clip(model, batch):
        losses = FrameLosses(model, LossConfigs())(batch.inputs[0], outputs, batch.targets[0])
    lines, path = ("line classes", "line points", "line directions"), ("boundaries", "collisions", "directions")
    assert [*losses] == ["classes", "boxes", *lines, "futures", "modes", "plan", *(f"plan {name}" for name in path)]
    assert all(losses[name] > 0 for name in ("line points", "futures", "plan"))


def test_the_small_vad_of_the_documents_can_be_trained() -> None:
    file = str(Path(__file__).parents[2] / "docs" / "small-vad.toml")
    assert MapLines in load_config(file).results
    load_config(file).check_training(training_config(file).clips.frames)


@pytest.mark.slow
def test_a_vad_learns_and_resumes_exactly(tmp_path: Path) -> None:
    settings = TrainingConfig(
        steps=12,
        held_out=0,
        evaluate_every=12,
        checkpoint_every=12,
        clips=ClipConfig(2, 2, 0.0, "all"),
        optimizer=OptimizerConfig(learning_rate=2e-3, warm_up_steps=0),
    )

    def training(out: Path, *, resume: bool = False) -> Trainer:
        out.mkdir(exist_ok=True)
        torch.manual_seed(0)
        drives = LinedDrives()
        return Trainer(TrainingJob(VAD(VAD_CONFIG), settings, drives, drives, out, torch.device("cpu")), resume=resume)

    whole = training(tmp_path / "whole")
    whole.run()
    names, *rows = (line.split(",") for line in (tmp_path / "whole" / "loss.csv").read_text().splitlines())
    curves = dict(zip(names, np.array(rows, dtype=float).T, strict=True))
    for name in ("loss", "line classes", "line points", "futures", "plan"):
        assert curves[name][-3:].mean() < 0.9 * curves[name][:3].mean(), (name, curves[name])
    moments = whole.optimizer.state  # the last frames of the drives alone have no futures
    assert [name for name, each in whole.job.model.named_parameters() if not moments[each]["exp_avg"].any()] == []
    stopped = training(tmp_path / "part")
    stopped.run(stop=lambda: stopped.done == 5)
    training(tmp_path / "part", resume=True).run()
    one, other = (load_file(tmp_path / name / "weights.safetensors") for name in ("whole", "part"))
    assert all(torch.equal(one[key], other[key]) for key in one)
