"""The rendered world: procedural drives with images from any rig and exact ground truth."""
