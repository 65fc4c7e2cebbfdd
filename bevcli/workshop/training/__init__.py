"""Training of a BEVFormer: data, losses, the loop and the validation, in plain PyTorch.

In the order of a training step:

    augmentation           changes of the images and of the calibration
    targets                the ground truth boxes and masks of frames
    samples                clips of drives (`bevcli.workshop.synth.drives`) as network inputs, in batches made ahead
    losses                 Hungarian matching, focal, L1 and dice loss of boxes, masks and BEV cells
    frame_losses           all losses of a frame by name, also of BEVFormerV2's detector and against a teacher
    trainer                the loop: passes through clips, updates, checkpoints, weights; `train` and `validate`
    job                    the [training] table of a model file, and the model, drives and processes of a training
    warm_start             weights of another model, or of a backbone for ImageNet, to start from
    model_file             a new model file for a data set
    validation             checks of drives, scores of a model over several drives, and learning curves
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

from bevcli.inference import complete_model
from bevcli.options import option, options, parse_pairs
from bevcli.workshop.scores import MAX_RANGE_HELP

Log = Literal["tensorboard"]
Preset = Literal["quick", "photographs", "demo", "tiny", "base"]


@options()
class TrainOptions:
    """The output, the start and the length of a training. Default of steps and held_out: the [training] table."""

    out: Path | None = option(
        default=None,
        help="Folder for weights, checkpoint, learning curves and rendered drives. Default: runs/train-MODEL.",
    )
    resume: bool = option(default=False, help="Resume from the checkpoint in the output folder.")
    weights: Path | None = option(
        reads="path or name",
        default=None,
        help="Start from these weights (fine-tuning) instead of random ones: a file, or a model's name. The model may "
        "have other classes, cameras and BEV cells; a table lists what is loaded.",
        metavar="FILE|NAME",
        complete=complete_model,
    )
    backbone_weights: Path | None = option(
        reads="path or name",
        default=None,
        help="Start the image backbone from these weights, such as those for ImageNet of torchvision, timm or "
        "efficientnet-lite-pytorch: a .pth, a .safetensors, or a model's name. All of the backbone must be in it.",
        metavar="FILE|NAME",
        complete=complete_model,
    )
    steps: int | None = option(default=None, help="Number of steps. Default: as in the training table.", minimum=1)
    held_out: int | None = option(
        default=None,
        help="Hold out the last N drives for evaluation; 0 evaluates on the training drives. Default: as in the "
        "training table.",
        metavar="N",
        minimum=0,
    )
    changes: Mapping[str, str] = option(
        default_factory=dict,
        help="Change a setting of the training table, such as optimizer.learning_rate=1e-4. Repeatable.",
        flag="--set",
        metavar="KEY=VALUE",
        parse=lambda texts: parse_pairs(texts, "KEY=VALUE, such as clips.batch=2"),
        repeatable=True,
    )
    log: Log | None = option(
        default=None,
        help="Write the learning curves for TensorBoard too, into the folder tensorboard of the output folder.",
    )
    seed: int = option(default=0, help="Random seed.", minimum=0)


@options("Model")
class ModelFileOptions:
    """A new model file for a data set."""

    init: Path | None = option(
        default=None,
        help="Do not train: write a model file for the drives, with their classes, cameras, frame rate, image size and "
        "BEV range, and with the time and memory of a training on this machine.",
        metavar="FILE.toml",
    )
    preset: Preset | None = option(
        default=None,
        help="The model that the file of --init starts from. quick, the default, is the demo model on smaller images, "
        "for a CPU; photographs is the model for real images.",
    )


@options()
class ValidationOptions:
    """The rig and the scores of a validation."""

    rig: str | None = option(
        reads="path or name",
        complete=lambda incomplete: ["random"],
        default=None,
        help="Cameras of the rendered drives: a calibration.json, scaled to the model's image size, or a random rig "
        "for each drive, from training.rigs of the model. Default: six cameras like nuScenes.",
        metavar="FILE|random",
    )
    max_range: float | None = option(
        default=None,
        help=MAX_RANGE_HELP,
        metavar="METRES",
    )
    tracking: bool = option(default=False, help="Also run the tracker and score its tracks: AMOTA, identity switches.")
    each: bool = option(default=False, help="Also score each drive alone, with the mean and the lowest mAP.")
    odometry: bool = option(
        default=False, help="Run with the motion that `bevcli odometry` measures of each drive, not with stated poses."
    )
    reference: Path | None = option(
        reads="path",
        default=None,
        help="Where no drive has ground truth: a drive on which the weights are known to work. Its agreement is "
        "printed beside that of each drive.",
        metavar="DIR",
    )
