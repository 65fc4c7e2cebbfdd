"""`bevcli convert`: writes any input as a native sequence folder."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from bevcli.cli.input_options import (
    CalibrationOption,
    ClassMapOption,
    EgoMotionOption,
    ExtrinsicsOption,
    GroundTruthOption,
    IntrinsicsOption,
    SceneOption,
    SplitOption,
    StrictOption,
    SweepsOption,
    TopicOption,
    TopicsOption,
    VersionOption,
    parse_class_map,
    parse_topics,
)


def convert(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="INPUT",
            help="Sequence folder (images or videos), nuScenes root, .mcap file or rosbag2 folder.",
        ),
    ],
    out: Annotated[Path, typer.Argument(metavar="OUT_SEQUENCE", help="The native sequence folder to write.")],
    strict: StrictOption = False,
    scene: SceneOption = None,
    version: VersionOption = None,
    split: SplitOption = None,
    sweeps: SweepsOption = False,
    intrinsics: IntrinsicsOption = None,
    extrinsics: ExtrinsicsOption = None,
    calibration: CalibrationOption = None,
    ego_motion: EgoMotionOption = None,
    topic: TopicOption = None,
    topics: TopicsOption = None,
    ground_truth: GroundTruthOption = True,
    class_map: ClassMapOption = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite an existing sequence in OUT_SEQUENCE.")] = False,
) -> None:
    """Write any input as a native sequence folder.

    Image files are copied byte for byte; images of a video become PNG. Ego-motion and ground truth are kept.
    """
    from bevcli.cli.progress import Progress
    from bevcli.errors import OutputError
    from bevcli.frame import facts_of
    from bevcli.sequences.native.writer import NativeWriter
    from bevcli.sequences.open import open_sequence

    if out.resolve() == source.resolve() or out.resolve() in source.resolve().parents:
        raise OutputError(f"{out}: contains the input: choose another folder")
    sequence = open_sequence(
        source,
        ego_motion="optional",
        strict=strict,
        scene=scene,
        version=version,
        split=split,
        sweeps=sweeps,
        intrinsics=intrinsics,
        extrinsics=extrinsics,
        calibration=calibration,
        ego_motion_file=ego_motion,
        topics=parse_topics(topic),
        topics_file=topics,
        ground_truth=ground_truth,
        class_map=parse_class_map(class_map),
    )
    for note in sequence.notes:
        typer.echo(f"note: {note}", err=True)
    count = len(sequence.stamps)
    gaps = 0
    with (
        NativeWriter(out, with_ego_motion=sequence.has_ego_motion, force=force, facts=facts_of(sequence)) as writer,
        Progress(count, "frames") as progress,
    ):
        for place in range(count):
            frame = sequence.load(place)
            for camera, reason in frame.dropped.items():
                progress.message(f"warning: frame {frame.stamp.index}: camera {camera}: {reason}")
            gaps += len(frame.dropped)
            writer.write(frame)
            progress.advance()
    missing = f", {gaps} images missing" if gaps else ""
    typer.echo(f"{out}: {count} frames, {len(frame.rig.cameras)} cameras{missing}")
