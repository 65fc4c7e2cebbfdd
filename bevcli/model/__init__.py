"""BEVFormer, BEVFormerV2 and UniAD in plain PyTorch, one block of the papers a file."""
