"""The entity paths of a recording. Writer, reader and blueprint share them.

`world` is the sequence's world frame, moved so that the first frame's ego position is its origin (the viewer computes
in float32). `bev` is a flat image of the bev frame in metres: x to the right, -y down. `map` holds latitudes and
longitudes, where the drive states its place on Earth. Lines on the ground are directly below `world` and `bev`, by
their kind (`line_kinds`), such as "bev/map_lines".
"""

import rerun as rr

from bevcli.registry import entries

WORLD = "world"
EGO = "world/ego"
VEHICLE = "world/ego/vehicle"
RANGE_RINGS = "world/ego/range_rings"
BEV_ON_GROUND = "world/ego/bev_map"
SEGMENTATION_ON_GROUND = "world/ego/segmentation"
SPEED = "world/ego/speed"
PILLARS = "world/ego/pillars"
PROBES = "world/ego/probes"
TRAJECTORY = "world/trajectory"
BOXES = "world/boxes"
VELOCITY = "world/boxes/velocity"
FALSE_BOXES = "world/boxes/false"
DUPLICATES = "world/boxes/duplicate"
TRACKS = "world/tracks"
GROUND_TRUTH = "world/ground_truth"
MISSED = "world/ground_truth/missed"

BEV = "bev"
BEV_FEATURES = "bev/features"
BEV_SEGMENTATION = "bev/segmentation"
BEV_HISTORY = "bev/history"
BEV_RINGS = "bev/range_rings"
BEV_VEHICLE = "bev/vehicle"
BEV_BOXES = "bev/boxes"
BEV_VELOCITY = "bev/boxes/velocity"
BEV_FALSE = "bev/boxes/false"
BEV_DUPLICATES = "bev/boxes/duplicate"
BEV_TRACKS = "bev/tracks"
BEV_GROUND_TRUTH = "bev/ground_truth"
BEV_MISSED = "bev/ground_truth/missed"
BEV_PROBES = "bev/probes"

MAP = "map"
MAP_EGO = "map/ego"
MAP_ROUTE = "map/route"
MAP_BOXES = "map/boxes"

STAGE_CURVES = "curves/time_per_stage"
BOX_CURVES = "curves/boxes_per_class"
SPEED_CURVE = "curves/speed"
LEGEND = "legend"
EVENTS = "events"
RUN = "run"
FUTURES = "futures"  # a kind of lines on the ground

FRAME_TIMELINE = "frame"
TIME_TIMELINE = "time"


def camera(name: str) -> str:
    """The entity of a camera: its pose and its pinhole; image and overlays are below it."""
    return f"world/cameras/{name}"


def image(name: str) -> str:
    """The entity of a camera's image."""
    return f"{camera(name)}/picture"


def track(class_name: str, identity: str) -> str:
    """The entity of a track, such as "world/tracks/car_12"."""
    return f"{TRACKS}/{rr.escape_entity_path_part(f'{class_name}_{identity}')}"


def class_mesh(class_name: str) -> str:
    """The entity of the mesh in all boxes of a class, such as "world/boxes/mesh/car"."""
    return f"{BOXES}/mesh/{rr.escape_entity_path_part(class_name)}"


def overlay(name: str, kind: str) -> str:
    """The entity of an image overlay. kind: "boxes", "boxes/labels", "ground_truth", "pillars", "probes",
    or a kind of lines on the ground.
    """
    return f"{camera(name)}/{kind}"


def line_kinds() -> tuple[str, ...]:
    """The last parts of the entities of lines on the ground, such as "map_lines"."""
    return (*entries("bevcli.results"), FUTURES)
