"""Logs of the Argoverse 2 sensor dataset.

format: the format and its own options. classes: its class names. feather: its tables. rig: cameras and poses.
sequence: Argoverse2Sequence, one log as a Sequence.
"""
