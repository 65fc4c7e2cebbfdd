"""Readers and writers of drives. Every input becomes a `bevcli.frame.Sequence`.

open: `open_sequence`, the way in. options: the options that every format has. format: `Format`, and a path's format.
native, nuscenes, ros, argoverse2, dgp, t4: one folder a format. `format` in it states the format and its own options.
files: single files that several formats share (boxes, BEV maps, calibration).
selection: a part of a sequence as a sequence: scene, frame range, frame rate.
images, video: decoding the images of a frame. tracks: velocities of annotated objects.

docs/extend.md shows how to add a format, in this package or in another one. The scene, the frame range, the frame rate
and `ground_truth=False` are the work of `open_sequence`.
"""
