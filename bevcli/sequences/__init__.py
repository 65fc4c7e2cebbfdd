"""Readers: every kind of input becomes a Sequence of Frames."""
