"""The rendered world: drives through a procedural city, with images from any rig and exact ground truth.

meshes     `mesh` (primitives), `road_users`, `catalog` (what stands still; all annotated objects by class)
world      `city` (streets, blocks, routes), `looks`, `ground`, `traffic`, `simulation` (all actors), `scenery`
images     `rig` (cameras and lenses), `shading_kernels`, `photo_kernels`, `material` (a user's photographs), `renderer`
drives     `body` (pitch and roll), `drive` (one drive; `render`), `drives` (of a training, a validation, a stress test)

Each module imports only from those before it.
"""
