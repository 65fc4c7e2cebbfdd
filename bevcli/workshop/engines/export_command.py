"""`bevcli export-onnx`: one step of a model as an ONNX file."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

from bevcli.cli.bridge import Part, model_option
from bevcli.inference.options import ModelOptions
from bevcli.printing import say
from bevcli.workshop.engines.options import FileOptions, OnnxOptions

PANEL = "Deploy"


def export_onnx(
    model: Annotated[
        str | None,
        model_option(
            "tiny, small, base, demo, v2-t1-base, v2-t1, v2-t2, v2-t8, or a FILE.toml. Default: the model that WEIGHTS "
            "fit, else demo.",
        ),
    ] = None,
    *,
    model_options: Annotated[ModelOptions, Part(only=("weights", "untrained"))],
    file: FileOptions,
    options: OnnxOptions,
) -> None:
    """Write one step of a model as an ONNX file of standard operators, without plugins.

    The number of cameras is fixed, the batch is one; calibrations are inputs. What the model remembers is an input and
    an output: the BEV map, or with v2 models image features. The file's metadata documents every input and output.
    docs/deploy.md shows how to run it. Needs pip install 'bevcli[onnx]'.
    """
    from bevcli.errors import BevcliError
    from bevcli.inference.load import load_model
    from bevcli.sequences.files.calibration_file import read_calibration
    from bevcli.sequences.open import open_sequence
    from bevcli.workshop.engines.differences import check_exported, difference_lines
    from bevcli.workshop.engines.export_onnx import export_onnx as write_onnx

    loaded = load_model(model, options=replace(model_options, device="cpu"))
    loaded.require_parts("bevcli export-onnx")
    if options.rig is not None:
        if options.cameras is not None:
            raise BevcliError("`rig` states the number of cameras: leave `cameras` out")
        rig = read_calibration(options.rig)
        loaded, options = loaded.for_rig(rig), replace(options, cameras=len(rig.cameras))
    target = file.target(Path(f"{loaded.name}.onnx"))
    drive = None if options.check is None else open_sequence(options.check, rate_hz=loaded.config.rate_hz)
    write_onnx(
        loaded.network,
        target,
        options,
        contents=loaded.contents(),
        untrained=loaded.untrained,
        bundled=loaded.bundled,
    )
    say(f"{target}: {target.stat().st_size / 1e6:.1f} MB")
    if drive is not None:
        say("\n".join(difference_lines(list(check_exported(target, loaded, drive)))))
