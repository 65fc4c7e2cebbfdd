"""BEVFormer in plain PyTorch, one block of the paper a file."""
