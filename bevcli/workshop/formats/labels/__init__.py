"""Ground truth in the formats of labelling tools, one file each, registered under `bevcli.label_formats`."""
