"""Meshes of everything in the city, each built from a few primitives.

mesh, triangles        meshes with colours and materials; meshes placed in the world
paint                  colours
cars, trucks, trailers, buses, machines, cycles, people, roadworks
                       the ten annotated classes
street_furniture       objects without annotations: trees, lamps, signs, signals
catalog                all of them by class, with sizes and colours to draw from
"""
