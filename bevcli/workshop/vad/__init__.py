"""VAD (Jiang et al. 2023): BEVFormer's BEV map, lines of the map, forecasts of all objects, and a planned path."""
