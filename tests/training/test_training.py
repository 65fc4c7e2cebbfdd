"""The training as a whole: it converges, is reproducible, resumes after a kill and rejects invalid input."""

import os
import shutil
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import pytest
import torch
from command_line import full_disk
from matplotlib.figure import Figure
from painted_drives import CONFIG, PaintedDrives
from safetensors.torch import load_file

from bevcli.checkpoints import load_weights
from bevcli.cli.stop_signals import StopSignals
from bevcli.config import TRAINING, load_config, load_table
from bevcli.errors import BevcliError, ConfigError, InputError, OutputError, WeightsError
from bevcli.model.bevformer import BEVFormer
from bevcli.workshop.synth import DriveOptions, parse_seeds
from bevcli.workshop.synth.drives import FIRST_HELD_OUT_SEED, RenderedDrives, scored_drives, training_drives
from bevcli.workshop.training import TrainOptions
from bevcli.workshop.training.augmentation import AugmentationConfig, RandomisationConfig
from bevcli.workshop.training.frame_losses import PerspectiveLossConfig
from bevcli.workshop.training.job import OptimizerConfig, TrainingConfig, TrainingJob, check_folder, prepare_training
from bevcli.workshop.training.losses import DenseLossConfig
from bevcli.workshop.training.samples import ClipConfig
from bevcli.workshop.training.trainer import (
    Trainer,
    load_checkpoint,
    make_optimizer,
    save_checkpoint,
)
from bevcli.workshop.training.validation import LearningCurve, draw_learning_curves

SHORT = TrainingConfig(
    steps=5, held_out=0, evaluate_every=4, checkpoint_every=2, clips=ClipConfig(frames=2, batch=2, short_share=0.0)
)
TWO_STEPS = replace(SHORT, steps=2)
# With dropout, so that randomness in the model is tested too.
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
    next(progress for progress in killed.run() if progress.loss is None and progress.done == after)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Trainer:
    """An uninterrupted training."""
    whole = trainer(tmp_path_factory.mktemp("training"))
    list(whole.run())
    return whole


@pytest.fixture(scope="module")
def two_steps(tmp_path_factory: pytest.TempPathFactory) -> Trainer:
    """An uninterrupted training of two steps with one loader."""
    one = trainer(tmp_path_factory.mktemp("two-steps"), settings=TWO_STEPS)
    list(one.run())
    return one


@pytest.mark.slow
def test_a_stopped_and_killed_training_resumes_as_if_uninterrupted(whole: Trainer, tmp_path: Path) -> None:
    stopped = trainer(tmp_path / "part")
    run_and_kill(stopped, after=1)
    stopped.save_checkpoint()  # the next regular one is after step 2
    killed = trainer(tmp_path / "part", resume=True)
    assert killed.done == 1
    run_and_kill(killed, after=3)  # a step after the last checkpoint
    resumed = trainer(tmp_path / "part", resume=True)
    assert resumed.done == 2
    list(resumed.run())
    assert_same_weights(whole, resumed)
    for file in ("loss.csv", "validation.csv"):
        assert (whole.job.out / file).read_text() == (tmp_path / "part" / file).read_text()
    assert len((whole.job.out / "loss.csv").read_text().splitlines()) == 1 + 5
    assert cv2.imread(str(whole.job.out / "curves.png")).std() > 10


@pytest.mark.parametrize(("number", "exit_code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_requests_a_stop(number: int, exit_code: int) -> None:
    before = signal.getsignal(number)
    with StopSignals("step") as signals:
        assert not signals.received()
        os.kill(os.getpid(), number)
        assert signals.received()
        assert signals.exit_code == exit_code
    assert signal.getsignal(number) is before


@pytest.mark.slow
def test_a_training_with_all_options_on_resumes_exactly_too(tmp_path: Path) -> None:
    """Updates on every frame, alternating batches, query groups, averaged weights, the dense and perspective loss, and
    randomised images, which are drawn anew by the seed."""
    settings = replace(
        SHORT, steps=3, evaluate_every=3, checkpoint_every=1, clips=ClipConfig(2, 2, 0.0, "all", in_turn=2),
        dense_loss=DenseLossConfig(1.0), perspective_loss=PerspectiveLossConfig(1.0),
        optimizer=replace(SHORT.optimizer, average=0.9),
        augmentation=AugmentationConfig(randomisation=RandomisationConfig(convolution=0.5, noise=0.5)),
    )  # fmt: skip

    def with_all_options(out: Path, resume: bool = False) -> Trainer:
        out.mkdir(exist_ok=True)
        torch.manual_seed(0)
        config = replace(NOISY, decoder=replace(NOISY.decoder, training_groups=2))
        drives = PaintedDrives(2, all_labelled=True)
        job = TrainingJob(BEVFormer(config), settings, drives, drives, out, torch.device("cpu"))
        return Trainer(job, resume=resume)

    whole = with_all_options(tmp_path / "whole")
    assert [len(whole.maker(0, place).inputs) for place in range(2)] == [2, 2]
    list(whole.run())
    assert parameters_without_gradient(whole) == []
    # These keys are part of the checkpoint format.
    keys = torch.load(tmp_path / "whole" / "checkpoint.pt", weights_only=True)["model"]
    assert {key.partition(".")[0] for key in keys} == {"model", "dense_reader", "perspective_head"}
    exported = load_file(tmp_path / "whole" / "weights.safetensors")
    assert exported.keys() == whole.job.model.state_dict().keys()
    key = "detection_head.class_branches.0.0.weight"  # what is released is the average, not the last weights
    assert key in exported
    assert not torch.equal(exported[key], whole.job.model.state_dict()[key])
    run_and_kill(with_all_options(tmp_path / "killed"), after=1)
    resumed = with_all_options(tmp_path / "killed", resume=True)
    assert resumed.done == 1
    list(resumed.run())
    again = load_file(tmp_path / "killed" / "weights.safetensors")
    assert all(torch.equal(again[name], exported[name]) for name in exported)
    assert_same_weights(whole, resumed)


def parameters_without_gradient(trained: Trainer) -> list[str]:
    """Names of the parameters whose last gradient is missing or zero throughout."""
    named = trained.trained.named_parameters()
    return [name for name, parameter in named if parameter.grad is None or not parameter.grad.any()]


def test_every_parameter_receives_a_gradient_that_is_not_zero(two_steps: Trainer) -> None:
    # Two steps: residual branches end in a batch norm that starts at zero, so that the first gives them no gradient.
    assert parameters_without_gradient(two_steps) == []


@pytest.mark.slow
def test_frozen_stages_keep_weights_and_statistics(tmp_path: Path) -> None:
    trained = trainer(tmp_path, settings=replace(SHORT, frozen_stages=1))
    before = {name: value.clone() for name, value in trained.job.model.backbone.state_dict().items()}
    list(trained.run())
    changed = {name for name, value in trained.job.model.backbone.state_dict().items() if not value.equal(before[name])}
    assert not [name for name in changed if name.startswith(("conv1", "bn1", "stages.0."))]
    assert {"stages.1.0.conv1.weight", "stages.1.0.bn1.running_mean"} <= changed


def test_a_training_leaves_only_weights_that_can_be_loaded(tmp_path: Path) -> None:
    """No hooks on the model, no changed random state of the process; the weights in half precision."""
    perspective = PerspectiveLossConfig(1.0)
    settings = replace(SHORT, steps=2, evaluate_every=1, perspective_loss=perspective, weights_dtype="float16")
    one, random_state = trainer(tmp_path, settings=settings), torch.get_rng_state()
    hooks = [
        sum(len(m._forward_hooks) + len(m._forward_pre_hooks) for m in one.job.model.modules())
        for progress in one.run()
        if progress.scores is not None
    ]
    assert hooks == [0, 0]
    assert torch.equal(torch.get_rng_state(), random_state)
    load_weights(tmp_path / "weights.safetensors", model := BEVFormer(NOISY))
    expected = one.job.model.backbone.conv1.weight
    torch.testing.assert_close(model.backbone.conv1.weight, expected, atol=1e-3, rtol=1e-3)


def test_validation_is_drawn_up_to_its_best_score(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[Figure] = []

    def keep(figure: Figure, path: Path, **_: object) -> None:
        path.touch()
        drawn.append(figure)

    monkeypatch.setattr(Figure, "savefig", keep)
    loss, validation = (LearningCurve(tmp_path / f"{name}.csv") for name in ("loss", "validation"))
    for step in range(3):
        loss.add(step, {"boxes": 1.0 / (step + 1)})
        validation.add(step, {"mAP": 0.01 * step})
    draw_learning_curves(loss, validation, tmp_path / "curves.png")
    low, high = drawn[0].axes[1].get_ylim()
    assert low == 0
    assert 0.02 < high < 0.03


def test_a_kill_or_a_full_disk_leaves_the_checkpoint_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = BEVFormer(CONFIG)
    optimizer = make_optimizer(model, model.backbone, OptimizerConfig())
    save_checkpoint(tmp_path / "checkpoint.pt", 7, model, optimizer)
    before = (tmp_path / "checkpoint.pt").read_bytes()
    message = r"/checkpoint\.pt: cannot be written \(is the disk full\?"
    with full_disk(10_000), pytest.raises(OutputError, match=message):
        save_checkpoint(tmp_path / "checkpoint.pt", 8, model, optimizer)

    def die(contents: object, path: Path) -> None:
        path.write_bytes(b"half")
        raise Killed

    monkeypatch.setattr(torch, "save", die)
    with pytest.raises(Killed):
        save_checkpoint(tmp_path / "checkpoint.pt", 8, model, optimizer)
    assert (tmp_path / "checkpoint.pt").read_bytes() == before


def test_resuming_from_nothing_or_from_another_model_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match="no checkpoint to resume from"):
        trainer(tmp_path, resume=True)
    other = BEVFormer(replace(CONFIG, channels=16))
    save_checkpoint(tmp_path / "checkpoint.pt", 1, other, make_optimizer(other, other.backbone, OptimizerConfig()))
    with pytest.raises(WeightsError, match="is not a checkpoint of this model"):
        trainer(tmp_path, resume=True)


DAMAGES: dict[str, Callable[[dict], object]] = {
    "negative step": lambda found: found.update(step=-6),
    "step is a text": lambda found: found.update(step="2"),
    "NaN in a weight": lambda found: found["model"]["weight"].fill_(torch.nan),
    "moments of another shape": lambda found: found["optimizer"]["state"][0].update(exp_avg=torch.zeros(3)),
    "NaN in a moment": lambda found: found["optimizer"]["state"][0]["exp_avg_sq"].fill_(torch.nan),
    "negative second moment": lambda found: found["optimizer"]["state"][0]["exp_avg_sq"].fill_(-1),
    "no moments": lambda found: found["optimizer"]["state"].update({0: {}}),
    "moments of nothing": lambda found: found["optimizer"]["state"].update({"a": {}}),
    "no settings": lambda found: found["optimizer"].pop("param_groups"),
}


@pytest.mark.parametrize("kind", list(DAMAGES))
def test_a_damaged_checkpoint_is_rejected_in_one_line(kind: str, tmp_path: Path) -> None:
    model = torch.nn.Linear(2, 2)
    optimizer = torch.optim.AdamW(model.parameters())
    model(torch.ones(2)).sum().backward()
    optimizer.step()
    path = tmp_path / "checkpoint.pt"
    save_checkpoint(path, 2, model, optimizer)
    assert load_checkpoint(path, model, optimizer) == 2
    contents = torch.load(path)
    DAMAGES[kind](contents)
    torch.save(contents, path)
    with pytest.raises(WeightsError, match=r"checkpoint\.pt: is not a checkpoint of this model: "):
        load_checkpoint(path, model, optimizer)


def test_half_a_row_of_a_full_disk_does_not_stop_a_training(two_steps: Trainer, tmp_path: Path) -> None:
    shutil.copy(two_steps.job.out / "checkpoint.pt", tmp_path)
    rows = (two_steps.job.out / "loss.csv").read_text()
    (tmp_path / "loss.csv").write_text(f"{rows}3,0.5,")
    resumed = trainer(tmp_path, resume=True, settings=TWO_STEPS)
    assert resumed.done == 2
    assert (tmp_path / "loss.csv").read_text() == rows
    (tmp_path / "loss.csv").unlink()
    (tmp_path / "loss.csv").symlink_to("/dev/full")
    with pytest.raises(OutputError, match=r"loss\.csv: cannot be written \(No space left"):
        resumed._loss_curve.add(3, {"loss": 1.0})
    (tmp_path / "giant.csv").write_text("step,loss\n1," + "9" * 200_000 + "\n")
    with pytest.raises(InputError, match=r"giant\.csv: .*start a new training"):
        LearningCurve(tmp_path / "giant.csv", 1, "training")


def test_one_folder_holds_one_training_at_a_time(tmp_path: Path) -> None:
    def prepare() -> TrainingJob:
        drives = DriveOptions(rendered=tuple(range(5)))
        return prepare_training("demo", torch.device("cpu"), drives, TrainOptions(tmp_path))

    with prepare().lock, pytest.raises(OutputError, match="is in use by another run"):
        prepare()
    prepare().lock.close()


def test_a_resumed_training_names_other_settings_and_too_few_steps(two_steps: Trainer, tmp_path: Path) -> None:
    job = replace(two_steps.job, out=tmp_path)
    assert job.changed_settings() == ()
    shutil.copy(two_steps.job.out / "checkpoint.pt", tmp_path)
    assert job.changed_settings() == ()
    optimizer = replace(job.config.optimizer, learning_rate=0.5)
    (note,) = replace(job, seed=7, config=replace(job.config, optimizer=optimizer)).changed_settings()
    assert "seed 7 (before 0)" in note
    assert "learning_rate 0.5 (before 0.0002)" in note
    with pytest.raises(InputError, match=r"has done 2 steps already \(expected at most `steps=1` \(`--steps 1`\)\)"):
        trainer(tmp_path, resume=True, settings=replace(SHORT, steps=1))


def test_a_nan_loss_stops_the_training(tmp_path: Path) -> None:
    one = trainer(tmp_path)
    with torch.no_grad():
        one.job.model.detection_head.box_branches[0][0].weight.fill_(float("nan"))
    with pytest.raises(BevcliError, match="step 1: the loss is nan"):
        list(one.run())


def test_the_learning_rate_warms_up_and_decays_by_a_cosine() -> None:
    config = OptimizerConfig(learning_rate=1.0, warm_up_steps=10, warm_up_start=0.5, final_share=0.0)
    assert config.learning_rate_at(0, 100) == pytest.approx(0.5)
    assert config.learning_rate_at(50, 100) == pytest.approx(0.5)
    assert config.learning_rate_at(99, 100) < 0.001
    assert config.learning_rate_at(10, 100) == max(config.learning_rate_at(step, 100) for step in range(100))
    model = BEVFormer(CONFIG)
    optimizer = make_optimizer(model, model.backbone, replace(config, backbone_share=0.1))
    assert [group["share"] for group in optimizer.param_groups] == [1.0, 0.1]


def test_the_training_table_is_read_apart_from_the_model_config(tmp_path: Path) -> None:
    tiny = Path(__file__).parents[2].joinpath("bevcli", "configs", "tiny.toml").read_text()
    file = tmp_path / "mine.toml"
    file.write_text(f"{tiny}\n[training]\nsteps = 12\n[training.clips]\nframes = 4\n")
    assert load_config(file) == load_config("tiny")
    assert load_table(file, TRAINING, TrainingConfig) == TrainingConfig(steps=12, clips=ClipConfig(frames=4))
    assert load_table("tiny", TRAINING, TrainingConfig) == TrainingConfig()
    file.write_text(f"{tiny}\n[training]\nstep = 12\n")
    with pytest.raises(ConfigError, match=r'unknown key "training.step"; did you mean "steps"'):
        load_table(file, TRAINING, TrainingConfig)


def test_drives_come_from_folders_or_from_seeds(tmp_path: Path) -> None:
    for folders, seeds in (((), None), ((tmp_path,), (0, 1))):
        with pytest.raises(InputError, match=r"give either `data` \(`--data DIR`\)"):
            scored_drives(DriveOptions(data=folders, rendered=seeds), CONFIG)
    assert len(scored_drives(DriveOptions(data=(tmp_path,)), CONFIG)) == 1
    assert len(scored_drives(DriveOptions(rendered=(3, 9)), CONFIG)) == 2


@pytest.mark.parametrize(
    ("held_out", "trained_on", "evaluated_on"), [(2, [0, 1, 2], [3, 4]), (0, [0, 1, 2, 3, 4], [0, 1, 2, 3, 4])]
)
def test_the_last_drives_are_held_out(
    held_out: int, trained_on: list[int], evaluated_on: list[int], tmp_path: Path
) -> None:
    folders = tuple(Path(f"{number}") for number in range(5))
    for data in (DriveOptions(data=folders), DriveOptions(rendered=tuple(range(5)))):
        parts = training_drives(data, held_out, tmp_path, CONFIG, None)
        assert [[int(folder.name) for folder in part.folders] for part in parts] == [trained_on, evaluated_on]


def test_seeds_are_a_range_or_a_list() -> None:
    assert parse_seeds("2:5") == (2, 3, 4)
    assert parse_seeds("3,9") == (3, 9)
    for wrong in ("", "a", "5:2", "-1", "1:2:3"):
        with pytest.raises(InputError, match=r"expected seeds as A:B \(B excluded\) or A,B,C"):
            parse_seeds(wrong)


def test_a_job_is_prepared_from_a_model_file_and_seeds(tmp_path: Path) -> None:
    cpu, out = torch.device("cpu"), tmp_path / "out"
    job = prepare_training("demo", cpu, DriveOptions(rendered=tuple(range(10))), TrainOptions(out, steps=3, seed=4))
    assert job.model.config == load_config("demo")
    assert job.config == replace(load_table("demo", TRAINING, TrainingConfig), steps=3)
    assert (len(job.drives), len(job.held_out)) == (6, 4)
    assert (job.seed, job.group.size, job.out.is_dir()) == (4, 1, True)
    with pytest.raises(InputError, match="seed 1000000 is reserved for evaluation"):
        prepare_training("demo", cpu, DriveOptions(rendered=(1, FIRST_HELD_OUT_SEED)), TrainOptions(out))


def test_a_training_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "checkpoint.pt").write_bytes(b"")
    check_folder(tmp_path, resume=True)
    with pytest.raises(OutputError, match=r"pass `resume=True` \(`--resume`\) to continue it"):
        check_folder(tmp_path, resume=False)


@pytest.mark.slow
def test_four_clips_can_be_overfitted(tmp_path: Path) -> None:
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
    list(Trainer(TrainingJob(BEVFormer(CONFIG), settings, drives, drives, tmp_path, torch.device("cpu"))).run())
    header, last = (tmp_path / "validation.csv").read_text().splitlines()
    scores = dict(zip(header.split(","), map(float, last.split(",")), strict=True))
    assert scores["mAP"] > 0.9
    assert scores["IoU drivable_road"] > 0.6  # cells of 2.7 m allow 0.75 at most


@pytest.mark.slow
def test_a_drive_is_rendered_once_in_the_size_of_the_model(tmp_path: Path) -> None:
    config = replace(CONFIG, image=replace(CONFIG.image, size=(64, 36)))
    drives = RenderedDrives([4, 5], tmp_path, config)
    assert len(drives.open(1).stamps) == 20
    assert [path.name for path in tmp_path.glob("64x36/*")] == ["000005"]
    frame = drives.open(1).load(0)
    assert frame.images["CAM_FRONT"].pixels_bgr.shape == (36, 64, 3)
    assert len(frame.ground_truth) > 0
    assert frame.ground_truth_map.x_range_m == (-16, 16)
