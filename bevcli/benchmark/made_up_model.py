"""A model with made-up weights of which every part has something to say, so that differences can show."""

from __future__ import annotations

import math

import torch
from torch import nn

from bevcli.model.bevformer import BEVFormer, BEVFormerConfig

SEED = 0
RESIDUAL_GAIN = 0.25  # of the backbone's blocks, which start as identities
USUAL_DEVIATION = 57.0  # of images, grey levels; images that are not divided by it enter larger


def made_up_model(config: BEVFormerConfig) -> BEVFormer:
    """The same weights at every call: fresh ones, with small random numbers where training starts from zero."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(SEED)
        model = BEVFormer(config).eval()
        with torch.no_grad():
            for name, parameter in model.named_parameters():
                if name.endswith("bn3.weight"):
                    nn.init.constant_(parameter, RESIDUAL_GAIN)
                elif parameter.ndim > 1 and not parameter.any():
                    nn.init.normal_(parameter, std=0.5 / math.sqrt(parameter[0].numel()))
            model.backbone.conv1.weight *= sum(config.image.std) / 3 / USUAL_DEVIATION
    return model
