"""The rendered world: drives through a procedural city, with images from any rig and exact ground truth.

assets/    meshes of vehicles, people and street furniture
world/     the city of one seed: streets, buildings, traffic, people, weather
render/    images and ground truth maps: rasteriser, shading, ground texture, shadows
rig        the default cameras
drive      a drive, rendered frame by frame in memory
export     a drive as a sequence folder; `render`, the function behind `bevcli render`

Each part imports only from those above it.
"""
