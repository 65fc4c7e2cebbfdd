"""BEVFormer and BEVFormerV2 in plain PyTorch, one block of the papers a file."""
