"""Box formats of other programs, written by `bevcli export`."""
