"""Reads files that may be broken or hostile: every file is read and parsed here, within limits.

files: bytes and text of regular files. documents: JSON, TOML and YAML. images: JPEG and PNG.
pickles: a pickle without running anything in it. pth: the tensors of a PyTorch file.
"""
