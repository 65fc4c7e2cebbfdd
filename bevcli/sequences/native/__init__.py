"""The native sequence folder: one drive with calibration, images or videos, ego-motion and ground truth.

folder: FolderSequence, the folder as a Sequence, with ground_truth.json and ground_truth_map/.
tables: frames.csv and ego_motion.csv. unlisted_frames: folders without frames.csv, from file names, videos and
timing.toml.
writer: NativeWriter, which writes frames as a native folder.
"""
