"""Reads files that may be broken or hostile: every file is read and parsed here, within limits.

files: regular files, images, other programs. documents: JSON, TOML, YAML, XML and CSV.
pth: tensors in PyTorch and safetensors files, without running anything in them.
"""
