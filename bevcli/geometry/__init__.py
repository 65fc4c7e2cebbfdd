"""Pure geometry in NumPy float64. No files are read here."""
