"""Reads files that may be broken or hostile: every file is read and parsed here, within limits.

files: regular files, and decompression up to a limit. documents: JSON, TOML and YAML. images: JPEG and PNG.
pickles: a pickle without running anything in it. pth: tensors in PyTorch and safetensors files.
"""
