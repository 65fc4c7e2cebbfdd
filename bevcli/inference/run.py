"""The loop over a sequence: `run` yields predictions."""

from collections.abc import Iterator, Mapping

from bevcli.frame import Frame, Prediction, Sequence
from bevcli.inference.commands import read_commands
from bevcli.inference.load import Model


def run(
    model: Model,
    sequence: Sequence,
    *,
    temporal: bool = True,
    track: bool = True,
    attention: bool = False,
    probes: tuple[tuple[float, float], ...] = (),
    cameras: Mapping[str, str] | None = None,
    command: str | None = None,
) -> Iterator[tuple[Frame, Prediction]]:
    """Runs a model over a sequence, frame by frame; the BEV map of a frame is the history of the next.

        for frame, prediction in bevcli.run(model, drive):
            print(frame.stamp.index, len(prediction.boxes))

    Frames are read and prepared in the background. Nothing is kept of a frame after it was yielded.

    Args:
        model: of `load_model`.
        sequence: of `open_sequence`.
        temporal: whether the previous BEV map is used.
        track: whether the boxes get identities over time: the columns `instances`, `track_scores` and `duplicates`.
            With history, those of a UniAD are the model's own.
        attention: whether `Prediction.attention` is filled in.
        probes: x, y in metres, bev frame: BEV cells whose sampling points `Prediction.attention` shows. They imply
            `attention`.
        cameras: camera of the rig -> camera of the model whose embedding it takes. Default: the camera of the same
            name, else the one with the nearest viewing direction.
        command: of the driver, which chooses one of the planned paths, such as "straight"; or a FILE.json.

    Raises:
        InputError: a frame cannot be read, a probe lies outside the BEV grid, a camera or a command is unknown, or the
            attention of an exported file is asked for.
    """
    model = model.in_engine(sequence.rig, sequence, parts="attention and probes" if attention or probes else "")
    asked = {"ask_attention": attention or bool(probes), "probes": tuple(probes)}
    runner = model.runner(track=track, temporal=temporal, commands=read_commands(command, model.config), **asked)
    steps = runner.run(sequence, range(len(sequence.stamps)), runner.preprocessor(cameras))
    return ((frame, prediction) for frame, prediction, _ in steps)
