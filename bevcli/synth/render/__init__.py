"""The rasteriser and its shading."""
