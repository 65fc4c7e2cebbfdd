"""nuScenes datasets, read without the official devkit (which needs an old NumPy).

sequence: NuScenesSequence, the dataset as a Sequence.
choice: which version, split and scenes of a dataset root.
frames: keyframes, and the sweeps between them.
scene: rig, poses and CAN bus data of one scene.
index: the tables' contents as arrays. It is built by build, annotations and json_tables, and kept on disk by cache.
"""
