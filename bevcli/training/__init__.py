"""Losses, clips and the loop that train a BEVFormer, without any framework."""
