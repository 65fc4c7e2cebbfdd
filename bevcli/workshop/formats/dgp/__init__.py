"""Scenes in the DGP format of Toyota Research Institute, as DDAD is published.

format: the format. records: the JSON files: images and point clouds by time, and calibrations.
sequence: DgpSequence, one scene as a Sequence, and its ground truth.
"""
