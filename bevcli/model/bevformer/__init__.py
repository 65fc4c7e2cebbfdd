"""BEVFormer (Li et al. 2022)."""
