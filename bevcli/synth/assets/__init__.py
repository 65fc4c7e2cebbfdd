"""Meshes of everything that stands or moves in the city."""
