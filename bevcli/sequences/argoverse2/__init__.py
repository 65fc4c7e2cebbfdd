"""Logs of the Argoverse 2 sensor dataset.

format: the format and its own options. feather: its tables. sequence: Argoverse2Sequence, one log as a Sequence.
"""
