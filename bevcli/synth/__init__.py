"""The rendered world: procedural drives with pictures from any rig and exact ground truth."""
