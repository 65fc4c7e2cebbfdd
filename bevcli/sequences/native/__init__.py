"""The native sequence folder: one drive with calibration, images or videos, ego-motion and ground truth.

folder: FolderSequence, the folder as a Sequence, also without frames.csv. tables: frames.csv and ego_motion.csv.
"""
