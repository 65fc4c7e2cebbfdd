"""Pure math: rigid transforms, cameras, boxes, the BEV grid and ego-motion. NumPy float64, no files."""
