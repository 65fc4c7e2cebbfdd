"""BEVFormerV2 (Yang et al. 2022)."""
