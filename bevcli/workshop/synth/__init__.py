"""The rendered world: drives through a procedural city, with images from any rig and exact ground truth.

assets/    meshes of vehicles, people and street furniture, each built from a few primitives
world/     the city of one seed: streets, buildings, traffic, people, weather
render/    images and ground truth maps: rasteriser, shading, ground texture, shadows
rig        the cameras: the default ones, those of a file, or drawn at random
drive      a drive, rendered frame by frame in memory
export     a drive as a sequence folder; `render`, the function behind `bevcli render`
drives     the drives of a training, a validation or a stress test: folders, or rendered from seeds

Each part imports only from those above it.
"""
