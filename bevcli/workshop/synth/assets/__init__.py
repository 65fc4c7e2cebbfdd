"""Meshes of everything in the city.

Cycles are with the people, construction vehicles with the roadworks; `catalog` has all annotated objects by class.
"""
