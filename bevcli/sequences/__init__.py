"""Readers and writers of drives. Every input becomes a `bevcli.frame.Sequence`.

open: `open_sequence`, the way in. options: the options that every format has. format: `Format`, and a path's format.
native, nuscenes, ros, argoverse2, dgp, t4: one folder a format. `format` in it states the format and its own options.
files: single files that several formats share (boxes, BEV maps, calibration).
selection: a part of a sequence as a sequence: scene, frame range, frame rate.
images, video: decoding the images of a frame. tracks: velocities of annotated objects.

To add a format, in this package or in another one:

1. A subclass of `bevcli.frame.Sequence` that is made from a path, `SequenceOptions` and the format's own options.
2. A dataclass of its own options: `@options("Input")` and a subclass of `FormatOptions`, or of `RigOptions` if files
   may replace its calibration and ego-motion.
3. A `Format` that names both, and that recognises a path by the names of its files.
4. An entry point in pyproject.toml: the group `bevcli.sequences`, any name, and "module:attribute" of the `Format`.

The scene, the frame range, the frame rate and `ground_truth=False` are the work of `open_sequence`.
"""
