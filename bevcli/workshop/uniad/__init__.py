"""UniAD's first stage (Hu et al. 2023)."""
