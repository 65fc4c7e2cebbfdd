"""The formats that boxes are exported in, one file each, registered under `bevcli.box_formats`."""
