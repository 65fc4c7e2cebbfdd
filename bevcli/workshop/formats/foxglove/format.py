"""MCAP files as a format that drives are written in."""

from bevcli.workshop.formats.output import OutputFormat

OUTPUT = OutputFormat("an MCAP file", "bevcli.workshop.formats.foxglove.writer:McapWriter", takes_boxes=True)
