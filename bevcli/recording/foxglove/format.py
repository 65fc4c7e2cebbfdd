"""MCAP files as a format that drives are written in."""

from bevcli.sequences.output import OutputFormat

OUTPUT = OutputFormat("an MCAP file", "bevcli.recording.foxglove.writer:McapWriter", takes_boxes=True)
