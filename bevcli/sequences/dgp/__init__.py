"""Scenes in the DGP format of Toyota Research Institute, as DDAD is published.

format: the format. records: members of the JSON files, and calibrations. samples: images and point clouds by time.
sequence: DgpSequence, one scene as a Sequence, and its ground truth.
"""
