"""nuScenes datasets, read without the official devkit (which needs an old NumPy).

sequence: NuScenesSequence, the dataset as a Sequence, and TableSequence, for formats with the same tables.
index: the contents of tables as arrays, dialects, splits and frames. tables: reads and caches them.
"""
