"""The training as a whole: it learns, repeats itself, survives a kill and refuses what it cannot train on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from painted_drives import CONFIG, PaintedDrives

from bevcli.checkpoints import load_weights
from bevcli.cli.train import choose_drives, parse_seeds, prepare_folder
from bevcli.config import TRAINING, load_config, load_table
from bevcli.errors import BevcliError, ConfigError, InputError, OutputError, WeightsError
from bevcli.model.bevformer import BEVFormer
from bevcli.training.augmentation import AugmentationConfig
from bevcli.training.checkpoint import save_checkpoint
from bevcli.training.clips import ClipConfig
from bevcli.training.dense_loss import DenseLossConfig
from bevcli.training.drives import RenderedDrives
from bevcli.training.image_loss import ImageLossConfig
from bevcli.training.optimizer import OptimizerConfig, make_optimizer, set_rate
from bevcli.training.trainer import Trainer, TrainingConfig, TrainingJob, _in_turn

SHORT = TrainingConfig(
    steps=5, held_out=0, evaluate_every=4, checkpoint_every=2, clips=ClipConfig(frames=2, batch=2, short_share=0.0)
)
# Dropout on, so that chance in the model is tested too.
NOISY = replace(CONFIG, encoder=replace(CONFIG.encoder, dropout=0.2))


class Killed(Exception):
    pass


def trainer(out: Path, seed: int = 0, resume: bool = False, settings: TrainingConfig = SHORT) -> Trainer:
    out.mkdir(exist_ok=True)
    torch.manual_seed(seed)
    drives = PaintedDrives(2)
    job = TrainingJob(BEVFormer(NOISY), settings, drives, drives, out, torch.device("cpu"), seed)
    return Trainer(job, resume=resume)


def assert_same_weights(one: Trainer, other: Trainer, *, same: bool = True) -> None:
    pairs = zip(one.job.model.state_dict().values(), other.job.model.state_dict().values(), strict=True)
    assert all(torch.equal(a, b) for a, b in pairs) == same


def run_and_kill(killed: Trainer, *, after: int) -> None:
    def kill() -> None:
        if killed.done == after:
            raise Killed

    with pytest.raises(Killed):
        killed.run(kill)


def test_a_killed_and_resumed_training_equals_an_uninterrupted_one(tmp_path: Path) -> None:
    whole = trainer(tmp_path / "whole")
    whole.run()
    run_and_kill(trainer(tmp_path / "killed"), after=3)  # a step after the last checkpoint
    resumed = trainer(tmp_path / "killed", resume=True)
    assert resumed.done == 2
    resumed.run()
    assert_same_weights(whole, resumed)
    for file in ("loss.csv", "validation.csv"):
        assert (tmp_path / "whole" / file).read_text() == (tmp_path / "killed" / file).read_text()
    assert len((tmp_path / "whole" / "loss.csv").read_text().splitlines()) == 1 + 5


def test_a_seed_reproduces_and_another_one_differs(tmp_path: Path) -> None:
    settings = replace(SHORT, steps=2)
    runs = [trainer(tmp_path / str(i), seed, settings=settings) for i, seed in enumerate((3, 3, 4))]
    for one in runs:
        one.run()
    assert_same_weights(runs[0], runs[1])
    assert_same_weights(runs[0], runs[2], same=False)


def test_the_number_of_loaders_changes_nothing(tmp_path: Path) -> None:
    one, three = (
        trainer(tmp_path / str(loaders), settings=replace(SHORT, steps=2, loaders=loaders)) for loaders in (1, 3)
    )
    one.run()
    three.run()
    assert_same_weights(one, three)


def test_batches_in_turn_give_a_frame_each_after_another() -> None:
    clips = [iter("abc"), iter("de"), iter("fgh")]
    assert "".join(_in_turn(clips)) == "adfbegch"


def test_all_that_helps_to_learn_survives_a_kill_too(tmp_path: Path) -> None:
    """Every frame learned from, batches in turn, groups of queries, the dense and the image loss."""
    settings = replace(
        SHORT, steps=3, evaluate_every=3, checkpoint_every=1, clips=ClipConfig(2, 2, 0.0, "all", in_turn=2),
        dense_loss=DenseLossConfig(1.0), picture_loss=ImageLossConfig(1.0),
    )  # fmt: skip

    def helped(out: Path, resume: bool = False) -> Trainer:
        out.mkdir(exist_ok=True)
        torch.manual_seed(0)
        config = replace(NOISY, decoder=replace(NOISY.decoder, training_groups=2))
        drives = PaintedDrives(2, told=True)
        job = TrainingJob(BEVFormer(config), settings, drives, drives, out, torch.device("cpu"))
        return Trainer(job, resume=resume)

    whole = helped(tmp_path / "whole")
    assert [len(batch.steps) for batch in whole._load(0)] == [2, 2]
    whole.run()
    assert [name for name, parameter in whole.learning.named_parameters() if parameter.grad is None] == []
    run_and_kill(helped(tmp_path / "killed"), after=1)
    resumed = helped(tmp_path / "killed", resume=True)
    assert resumed.done == 1
    resumed.run()
    assert_same_weights(whole, resumed)


def test_every_parameter_receives_a_gradient(tmp_path: Path) -> None:
    one = trainer(tmp_path, settings=replace(SHORT, steps=1))
    one.run()
    without = [name for name, parameter in one.job.model.named_parameters() if parameter.grad is None]
    assert without == []


def test_what_a_training_leaves_can_be_run(tmp_path: Path) -> None:
    one = trainer(tmp_path, settings=replace(SHORT, steps=1, weights_dtype="float16"))
    one.run()
    model = BEVFormer(NOISY)
    load_weights(tmp_path / "weights.safetensors", model)
    expected = one.job.model.backbone.conv1.weight
    torch.testing.assert_close(model.backbone.conv1.weight, expected, atol=1e-3, rtol=1e-3)
    assert (tmp_path / "curves.png").stat().st_size > 1000


def test_a_kill_while_writing_leaves_the_checkpoint_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = BEVFormer(CONFIG)
    optimizer = make_optimizer(model, model.backbone, OptimizerConfig())
    save_checkpoint(tmp_path / "checkpoint.pt", 7, model, optimizer)
    before = (tmp_path / "checkpoint.pt").read_bytes()

    def die(contents: object, path: Path) -> None:
        path.write_bytes(b"half")
        raise Killed

    monkeypatch.setattr(torch, "save", die)
    with pytest.raises(Killed):
        save_checkpoint(tmp_path / "checkpoint.pt", 8, model, optimizer)
    assert (tmp_path / "checkpoint.pt").read_bytes() == before


def test_resuming_from_nothing_or_from_another_model_is_refused(tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match="no checkpoint to resume from"):
        trainer(tmp_path, resume=True)
    other = BEVFormer(replace(CONFIG, channels=16))
    save_checkpoint(tmp_path / "checkpoint.pt", 1, other, make_optimizer(other, other.backbone, OptimizerConfig()))
    with pytest.raises(WeightsError, match="is no checkpoint of this model"):
        trainer(tmp_path, resume=True)


def test_a_loss_that_is_no_number_stops_the_training(tmp_path: Path) -> None:
    one = trainer(tmp_path)
    with torch.no_grad():
        one.job.model.detection_head.box_branches[0][0].weight.fill_(float("nan"))
    with pytest.raises(BevcliError, match="step 1: the loss is nan"):
        one.run()


def test_the_rate_warms_up_and_falls_by_a_cosine() -> None:
    config = OptimizerConfig(learning_rate=1.0, warm_up_steps=10, warm_up_start=0.5, final_share=0.0)
    assert config.share(0, 100) == pytest.approx(0.5)
    assert config.share(50, 100) == pytest.approx(0.5)
    assert config.share(99, 100) < 0.001
    assert config.share(10, 100) == max(config.share(step, 100) for step in range(100))
    model = BEVFormer(CONFIG)
    optimizer = make_optimizer(model, model.backbone, replace(config, backbone_share=0.1))
    set_rate(optimizer, 0.3)
    assert [group["lr"] for group in optimizer.param_groups] == pytest.approx([0.3, 0.03])


def test_the_training_table_is_read_and_the_model_does_not_mind_it(tmp_path: Path) -> None:
    tiny = Path(__file__).parents[2].joinpath("bevcli", "configs", "tiny.toml").read_text()
    file = tmp_path / "mine.toml"
    file.write_text(f"{tiny}\n[training]\nsteps = 12\n[training.clips]\nframes = 4\n")
    assert load_config(file) == load_config("tiny")
    assert load_table(file, TRAINING, TrainingConfig) == TrainingConfig(steps=12, clips=ClipConfig(frames=4))
    assert load_table("tiny", TRAINING, TrainingConfig) == TrainingConfig()
    file.write_text(f"{tiny}\n[training]\nstep = 12\n")
    with pytest.raises(ConfigError, match=r'unknown key "training.step"; did you mean "steps"'):
        load_table(file, TRAINING, TrainingConfig)


def test_drives_are_asked_for_held_out_and_kept_apart(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="give --data DIR"):
        choose_drives([], None, tmp_path, CONFIG, 1)
    with pytest.raises(InputError, match="give --data DIR"):
        choose_drives([tmp_path], "0:2", tmp_path, CONFIG, 1)
    with pytest.raises(InputError, match="2 drives are too few with 2 of them held out"):
        choose_drives([], "0:2", tmp_path, CONFIG, 2)
    assert [len(part) for part in choose_drives([], "0:5", tmp_path, CONFIG, 2)] == [3, 2]
    assert [len(part) for part in choose_drives([], "0:5", tmp_path, CONFIG, 0)] == [5, 5]
    assert parse_seeds("3,9") == [3, 9]


def test_seeds_kept_for_evaluation_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="seeds from 1000000 on are kept for evaluation"):
        choose_drives([], "1,1000000", tmp_path, CONFIG, 1)


def test_a_training_is_not_overwritten(tmp_path: Path) -> None:
    prepare_folder(tmp_path / "new", resume=False)
    (tmp_path / "new" / "checkpoint.pt").write_bytes(b"")
    prepare_folder(tmp_path / "new", resume=True)
    with pytest.raises(OutputError, match="say --resume"):
        prepare_folder(tmp_path / "new", resume=False)


@pytest.mark.slow
def test_four_clips_are_learned_by_heart(tmp_path: Path) -> None:
    settings = TrainingConfig(
        steps=350,
        held_out=0,
        evaluate_every=350,
        clips=ClipConfig(frames=2, batch=4, short_share=0.0),
        augmentation=AugmentationConfig(0, 0),
        optimizer=OptimizerConfig(learning_rate=1e-3, backbone_share=1.0, warm_up_steps=50),
    )
    drives = PaintedDrives(4)
    torch.manual_seed(0)
    Trainer(TrainingJob(BEVFormer(CONFIG), settings, drives, drives, tmp_path, torch.device("cpu"))).run()
    header, last = (tmp_path / "validation.csv").read_text().splitlines()
    scores = dict(zip(header.split(","), map(float, last.split(",")), strict=True))
    assert scores["mAP"] > 0.9
    assert scores["IoU drivable_road"] > 0.6  # 0.75 is the best that cells of 2.7 m can do


@pytest.mark.slow
def test_a_rendered_drive_is_rendered_once_and_taught(tmp_path: Path) -> None:
    config = replace(CONFIG, image=replace(CONFIG.image, size=(64, 36)))
    drives = RenderedDrives([4, 5], tmp_path, config)
    assert len(drives.open(1).stamps) == 20
    assert [path.name for path in tmp_path.glob("64x36/*")] == ["000005"]
    frame = drives.open(1).load(0)
    assert frame.images["CAM_FRONT"].pixels_bgr.shape == (36, 64, 3)
    assert len(frame.ground_truth) > 0
    assert frame.ground_truth_map.x_range_m == (-16, 16)
