"""nuScenes datasets, read without the official devkit (which needs an old NumPy).

sequence: NuScenesSequence, the dataset as a Sequence, and TableSequence, for formats with the same tables.
dialect: the points in which tables differ from nuScenes'.
choice: version, split, scenes and frames of a dataset root.
scene: rig, poses and CAN bus data of one scene.
index: the tables' contents as arrays. It is built by build, annotations and json_tables, and kept on disk by cache.
"""
