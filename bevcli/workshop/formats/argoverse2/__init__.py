"""Logs of the Argoverse 2 sensor dataset.

format: the format and its own options. sequence: its tables, and Argoverse2Sequence, one log as a Sequence.
"""
