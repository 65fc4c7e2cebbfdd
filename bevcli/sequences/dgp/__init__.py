"""Scenes in the DGP format of Toyota Research Institute, as DDAD is published.

format: the format. classes: its class names. records: members of the JSON files, and calibrations.
samples: images and point clouds by time. boxes: the ground truth. sequence: DgpSequence, one scene as a Sequence.
"""
