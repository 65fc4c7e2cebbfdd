"""The native sequence folder: one drive with calibration, images or videos, ego-motion and ground truth.

folder: FolderSequence, the folder as a Sequence.
frames_table: frames.csv. unlisted_frames and timing: folders without it, from file names, videos and timing.toml.
ego_motion_file: ego_motion.csv. ground_truth: ground_truth.json and ground_truth_map/.
csv_table: strict CSV reading.
writer: NativeWriter, which writes frames as a native folder.
"""
