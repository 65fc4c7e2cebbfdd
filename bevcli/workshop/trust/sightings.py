"""Boxes held against what the witness sees: projected boxes and seen ones of each image, and which are partners."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from bevcli.frame import Frame
from bevcli.geometry.boxes import BOX_EDGES, Boxes2D, Boxes3D
from bevcli.geometry.cameras import Camera
from bevcli.geometry.object_classes import ObjectClass
from bevcli.geometry.transforms import Array, apply, inverse

GROUPS = ("vehicles", "people", "cycles")
OF_COCO = {"car": 0, "truck": 0, "bus": 0, "person": 1, "bicycle": 2, "motorcycle": 2}
_OF_KIND = {"vehicle": 0, "pedestrian": 1, "cycle": 2}  # of the attributes of a class of objects
PARTNER = 0.3  # overlap from which on two boxes explain each other
APART_M = np.array([0.5, 1, 2, 4])  # as `bevcli eval` matches boxes
SURE, POSSIBLE = 0.4, 0.2  # scores of the witness: of an object, and of one that may confirm a box
LEAST_PX = 16.0  # height of an object in an image
EDGE_PX = 2.0  # a seen box that ends this near the edge of the image may go on outside
IN_VIEW = 0.7  # share of a projected box that lies in the image
HIDDEN, NEARER_M = 0.5, 1.0  # share of a projected box that one covers which is nearer by this
RIDER = 0.2  # overlap of a person and a cycle from which on the person rides it
DOUBLE = 0.6  # overlap of two seen boxes of a group, such as a car and a truck, that are one object
POINTS = np.linspace(0, 1, 5)  # of an edge of a box, which a lens bends

Seen = Mapping[str, Boxes2D]  # camera -> the boxes that the witness sees in its image
Sightings = NDArray[np.void]  # (N,) of SIGHTING: projected boxes of a model, and boxes that the witness sees
SIGHTING = np.dtype(
    [
        ("camera", np.object_),  # name
        ("is_seen", np.bool_),  # by the witness; else it is projected
        ("corners", np.float64, 4),  # x0, y0, x1, y1 in the image, pixels
        ("group", np.int64),  # index into GROUPS
        # to the ego frame's origin, on flat ground for what is seen; metres, inf above the horizon
        ("distance", np.float64),
        ("counted", np.bool_),  # held against the other side: whole in the image, large enough, and not hidden
        ("overlap", np.float64),  # intersection over union with the partner; 0 without one
        ("fit", np.float64),  # to the partner, 0 to 1, see `_fits`; of what is seen, times the partner's score
        ("partner", np.float64, 4),  # corners of a projected box's partner; zeros without one
    ]
)
NOTHING: Sightings = np.zeros(0, SIGHTING)


def groups_of(boxes: Boxes3D, classes: Mapping[str, ObjectClass]) -> NDArray[np.int64]:
    """(N,) indices into GROUPS; -1 for a class that the witness does not know."""
    kinds = {name: each.attributes[0].partition(".")[0] for name, each in classes.items()}
    return np.array([_OF_KIND.get(kinds.get(name, ""), -1) for name in boxes.classes.tolist()], dtype=int)


def projected(boxes: Boxes3D, camera_from_boxes: Array, camera: Camera) -> Array:
    """(N, 4) the rectangles around boxes in the image, not cut at its edges; NaN for what is partly behind the camera.

    camera_from_boxes: (4, 4), metres.
    """
    edges = boxes.corners()[:, np.array(BOX_EDGES)]  # (N, 12, 2, 3)
    points = edges[:, :, :1] * (1 - POINTS[:, None]) + edges[:, :, 1:] * POINTS[:, None]
    pixels, _ = camera.project(apply(camera_from_boxes, points.reshape(len(boxes), len(BOX_EDGES) * len(POINTS), 3)))
    return np.concatenate([pixels.min(axis=1), pixels.max(axis=1)], axis=1)


def overlaps(a: Array, b: Array) -> Array:
    """(N, M) intersection over union of rectangles (N, 4) and (M, 4); 0 where one is NaN."""
    shared, own = intersections(a, b), [areas(each) for each in (a, b)]
    return np.nan_to_num(shared / np.maximum(own[0][:, None] + own[1] - shared, 1e-9))


def intersections(a: Array, b: Array) -> Array:
    """(N, M) areas that rectangles (N, 4) and (M, 4) share."""
    size = np.minimum(a[:, None, 2:], b[:, 2:]) - np.maximum(a[:, None, :2], b[:, :2])
    return np.asarray(np.maximum(size, 0).prod(axis=-1))


def areas(corners: Array) -> Array:
    """(N,) areas of rectangles."""
    return np.asarray(np.maximum(corners[:, 2:] - corners[:, :2], 0).prod(axis=1))


def unexplained(
    frame: Frame, boxes: Boxes3D, seen: Seen, classes: Mapping[str, ObjectClass]
) -> dict[str, NDArray[np.bool_]]:
    """Camera -> (N,) of the boxes in its image, whether the witness is sure of it, and no projected box explains it.

    Arguments are those of `sightings`.
    """
    groups, lonely = groups_of(boxes, classes), {}
    for name, in_image in seen.items():
        pose = frame.world_from_ego_at[name].matrix @ frame.rig[name].ego_from_camera
        kinds = np.array([OF_COCO.get(kind, -1) for kind in in_image.classes.tolist()], dtype=int)
        overlap = overlaps(projected(boxes, inverse(pose), frame.rig[name]), in_image.corners)
        best = (overlap * (groups[:, None] == kinds)).max(axis=0, initial=0)
        lonely[name] = (kinds >= 0) & (in_image.scores >= SURE) & (best < PARTNER)
    return lonely


def sightings(frame: Frame, boxes: Boxes3D, seen: Seen, classes: Mapping[str, ObjectClass]) -> Sightings:
    """What is projected, and what is seen, in all images of a frame.

    boxes: those that are shown, world frame. seen: of the witness. classes: of the boxes, by name.
    """
    groups = groups_of(boxes, classes)
    boxes, groups = boxes[groups >= 0], groups[groups >= 0]
    cameras = [camera for camera in frame.rig.cameras if camera.name in seen]
    return np.concatenate([NOTHING, *(_of_camera(frame, one, boxes, groups, seen[one.name]) for one in cameras)])


def _of_camera(frame: Frame, camera: Camera, boxes: Boxes3D, groups: NDArray[np.int64], seen: Boxes2D) -> Sightings:
    pose, size = frame.world_from_ego_at[camera.name].matrix, np.array([camera.width, camera.height])
    whole = projected(boxes, inverse(pose @ camera.ego_from_camera), camera)
    inside = np.clip(whole, -0.5, np.tile(size, 2) - 0.5)
    kept = areas(inside) > 0  # False for NaN
    boxes, groups, whole, inside = boxes[kept], groups[kept], whole[kept], inside[kept]
    distances = np.linalg.norm(boxes.centers - pose[:3, 3], axis=1)
    covered = intersections(inside, inside) / areas(inside)[:, None] * (distances[:, None] > distances + NEARER_M)
    is_counted = (inside[:, 3] - inside[:, 1] >= LEAST_PX) & (areas(inside) >= IN_VIEW * areas(whole))
    is_counted &= covered.max(axis=1, initial=0) < HIDDEN
    scores = np.ones(len(boxes)) if boxes.scores is None else boxes.scores

    known = np.array([name in OF_COCO for name in seen.classes.tolist()], dtype=bool) & (seen.scores >= POSSIBLE)
    kinds = np.array([OF_COCO[name] for name in seen.classes[known].tolist()], dtype=int)
    double = overlaps(seen.corners[known], seen.corners[known]) * (kinds[:, None] == kinds) > DOUBLE
    single = ~np.triu(double, 1).any(axis=0)  # the better one of two, as they come by falling score
    corners, certainties, kinds = seen.corners[known][single], seen.scores[known][single], kinds[single]
    is_whole = np.concatenate([corners[:, :2] > EDGE_PX, corners[:, 2:] < size - 1 - EDGE_PX], axis=1).all(axis=1)
    rides = (kinds == 1) & (overlaps(corners, corners[kinds == 2]).max(axis=1, initial=0) > RIDER)
    is_sure = (certainties >= SURE) & is_whole & (corners[:, 3] - corners[:, 1] >= LEAST_PX) & ~rides

    table = overlaps(inside, corners) * (groups[:, None] == kinds)
    fits = _fits(table, boxes, (inside, corners), pose @ camera.ego_from_camera, camera)
    rows, columns = linear_sum_assignment(fits, maximize=True)
    is_pair = table[rows, columns] > 0
    rows, columns = rows[is_pair], columns[is_pair]
    ground = np.linalg.norm(_feet(camera, camera.ego_from_camera, corners, np.zeros(1)), axis=1)
    found = np.zeros(len(inside) + len(corners), SIGHTING)
    found["camera"], found["is_seen"] = camera.name, np.arange(len(found)) >= len(inside)
    found["corners"], found["group"] = np.concatenate([inside, corners]), np.concatenate([groups, kinds])
    found["distance"], found["counted"] = np.concatenate([distances, ground]), np.concatenate([is_counted, is_sure])
    ours, theirs = np.split(found, [len(inside)])  # views
    fit = fits[rows, columns]
    ours["overlap"][rows] = theirs["overlap"][columns] = table[rows, columns]
    ours["fit"][rows], theirs["fit"][columns] = fit, fit * scores[rows]
    ours["partner"][rows] = corners[columns]
    return found


def _fits(
    overlap: Array, boxes: Boxes3D, sides: tuple[Array, Array], world_from_camera: Array, camera: Camera
) -> Array:
    """(N, M) how well projected and seen rectangles fit, 0 to 1; 0 without overlap.

    Mean of the overlap (N, M) and of the share of APART_M within which their feet stand from each other, on the plane
    below the box. boxes: N, world frame. sides: (N, 4) and (M, 4).
    """
    floor = boxes.centers[:, 2] - boxes.sizes_lwh[:, 2] / 2
    own, seen = (_feet(camera, world_from_camera, corners, floor[:, None]) for corners in sides)
    with np.errstate(invalid="ignore"):
        off_m = np.linalg.norm(own.diagonal().T[:, None] - seen, axis=2)
    return np.asarray((overlap + (off_m[..., None] < APART_M).mean(axis=-1)) / 2 * (overlap > 0))


def _feet(camera: Camera, frame_from_camera: Array, corners: Array, floor: Array) -> Array:
    """(..., N, 2) where the middles of the lower edges of rectangles (N, 4) stand on a plane; inf where they do not.

    floor: (..., 1) height of the plane in the frame.
    """
    pixels = np.stack([corners[:, [0, 2]].mean(axis=1), corners[:, 3]], axis=1)
    rays, origin = camera.rays(pixels) @ frame_from_camera[:3, :3].T, frame_from_camera[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        steps = (floor - origin[2]) / rays[:, 2]
        places = origin[:2] + rays[:, :2] * np.where(steps > 0, steps, np.inf)[..., None]
    return np.nan_to_num(places, nan=np.inf, posinf=np.inf, neginf=-np.inf)
