"""nuScenes datasets, read without the official devkit (which needs an old NumPy).

sequence: NuScenesSequence, the dataset as a Sequence, and TableSequence, for formats with the same tables; rig, poses
and CAN bus data of one scene.
choice: version, split, scenes and frames of a dataset root.
index: the contents of tables as arrays, and dialects. build makes it of json_tables; cache keeps it on disk.
writer: NuScenesWriter, a drive as a nuScenes root.
"""
