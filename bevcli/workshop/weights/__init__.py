"""`bevcli weights`: lists and downloads weights, inspects and converts files, names the classes of other ones."""
