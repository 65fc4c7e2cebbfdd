"""The model of a configuration."""

from __future__ import annotations

from bevcli.model.bevformer import BEVFormer, BEVFormerConfig
from bevcli.model.bevformer_v2 import BEVFormerV2, BEVFormerV2Config
from bevcli.model.uniad import UniAD, UniADConfig


def build_model(config: BEVFormerConfig) -> BEVFormer | BEVFormerV2 | UniAD:
    """The model of a configuration, with random weights."""
    if isinstance(config, UniADConfig):
        return UniAD(config)
    return BEVFormerV2(config) if isinstance(config, BEVFormerV2Config) else BEVFormer(config)
