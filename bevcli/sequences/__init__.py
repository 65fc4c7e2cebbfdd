"""Readers of drives. Every input becomes a `bevcli.frame.Drive`.

open: `open_sequence`, the way in, which selects a scene, a frame range and a frame rate, and leaves out ground truth.
options: the options that every format has. format: `Format`, and a path's format. docs/extend.md shows how to add one.
native: the sequence folder. images: decoding the images of a frame.
files: single files that several formats share (boxes, BEV maps, calibration).
"""
