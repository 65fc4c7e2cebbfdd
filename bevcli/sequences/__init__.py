"""Readers and writers of drives. Every input becomes a `bevcli.frame.Sequence`.

open: `open_sequence`, the way in, with the list of input formats. A new format gets a package and an entry there.
native: the native sequence folder, with images or videos.
nuscenes: a nuScenes dataset root.
files: single files that several formats share (boxes, BEV maps, calibration).
selection: a part of a sequence as a sequence: scene, frame range, frame rate.
images, video: decoding the images of a frame.
"""
