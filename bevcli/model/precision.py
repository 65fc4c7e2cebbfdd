"""The precisions of the image features: backbone, neck, image tokens and their values."""

from typing import Literal

Precision = Literal["fp32", "bf16", "fp16"]
"""Of a model in PyTorch."""
AnyPrecision = Literal["fp32", "bf16", "fp16", "int8"]
"""Of a model in any engine: only other engines have INT8."""
