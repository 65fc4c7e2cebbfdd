"""Skies and textures for material.py, of @pmndrs/assets (panoramas of Poly Haven) and of TORCS (photographs)."""

import base64
import io
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from bevcli.workshop.synth.shading_kernels import TEXTURE_MEAN, TEXTURE_SIZE

Array = NDArray[np.float32]

HEIGHT, WIDTH = 512, 2048  # of a sky
PIXELS_PER_DEG = WIDTH / 360
BRIGHTNESS = {  # of the middle of each panorama, before its lights are compressed
    "city": 0.7, "dawn": 0.5, "forest": 0.3, "park": 0.5, "sky": 0.4, "sunrise": 0.5, "sunset": 0.6, "venice": 0.55,
}  # fmt: skip
WITHOUT_HORIZON = 430  # rows of a panorama that show hardly more than the sky
COLLAGES = 16
FACADES_AND_TREES = ((26, 17), (8, 70), (40, 10), (14, 36))  # of the collages, in turn
FACADE_MEAN = 188  # sRGB of the grey that a facade's texture multiplies
COLORFULNESS = 0.35  # of the textures that multiply a colour of the street
TREES = """dirt/dirt-2/tree10_n.png dirt/dirt-2/tree13_n.png dirt/dirt-2/tree15_n.png road/brondehach/tree2_n.png
road/corkscrew/treeSC2_n.png road/corkscrew/treeSC_n.png road/corkscrew/tree_n.png road/e-track-2/tree11_n.png
road/e-track-2/tree7_n.png road/e-track-2/tree9_n.png road/e-track-3/tree12_n.png road/forza/treetd_n.png
road/wheel-1/tree2_n.png road/wheel-1/tree5_n.png road/wheel-1/tree6_n.png road/wheel-2/tree_n.png"""
TEXTURES = {  # KIND: files below tracks
    "facade": """dirt/dirt-2/pitfacade2.png road/e-track-2/block4f.png road/e-track-2/block4s.png
        road/e-track-2/block5f.png road/e-track-2/block5s.png road/e-track-2/house17facade.png
        road/e-track-2/house20facade.png road/e-track-2/house21w1.png road/e-track-2/house21w2.png
        road/e-track-2/house22facade.png road/e-track-2/house23facade.png road/e-track-2/house24facade.png
        road/e-track-2/house25facade.png road/e-track-2/house26elev.png road/e-track-2/house28facade.png
        road/e-track-2/house32facade.png road/e-track-2/house33facade.png road/e-track-2/house33side.png
        road/e-track-2/house34facade.png road/e-track-2/house35facade.png road/e-track-2/house36facade.png
        road/street-1/tr-building8.rgb road/wheel-1/garage5.png""",
    "wall": """dirt/dirt-2/roof11.png dirt/dirt-2/silo1-w.png dirt/dirt-3/pit-walls.png dirt/dirt-3/tank.png
        oval/michigan/wall4.rgb road/alpine-2/concwall2.png road/alpine-2/rockwall.png road/brondehach/PALAZB03.png
        road/brondehach/PALAZB08.png road/brondehach/wall.png road/e-track-2/concrete-wall1.png
        road/e-track-2/house26facade.png road/e-track-2/house31facade.png road/e-track-2/rock-wall-e2.png
        road/e-track-6/wall2.png road/wheel-2/swall2.png""",
    "asphalt": """road/e-track-2/asphalt-sl-e2.png road/g-track-1/asphalt-bw-g1-sidel_n.rgb
        road/ole-road-1/concrete-patch.png road/ole-road-1/cracked-asphalt.png road/g-track-3/road3.rgb
        road/ruudskogen/sand01.png road/alpine-2/concwall2.png""",
    "pavement": """oval/michigan/border-dirt.rgb road/brondehach/tr-road1.png road/e-track-2/bordertile.png
        road/wheel-2/sand.png road/e-track-6/grass3.png road/alpine-2/rockwall.png""",
    "leaf": TREES,
}


def torcs(package: Path, out: Path) -> None:
    """Textures, and skies with houses and trees at the horizon. They use the skies that are in OUT already."""
    tracks = package / "usr/share/games/torcs/tracks"
    (out / "skies").mkdir(parents=True, exist_ok=True)
    (out / "textures").mkdir(exist_ok=True)
    for kind, files in TEXTURES.items():
        for file in files.split():
            name = f"{kind}-{Path(file).parent.name}-{Path(file).stem}.png"
            write(out / "textures" / name, texture(kind, rgba(tracks / file)))
    skies = [out / "skies" / f"{name}.png" for name in BRIGHTNESS if name != "forest"]
    skies = [cv2.imread(path)[:WITHOUT_HORIZON, :, ::-1] for path in skies if path.exists()]
    facades = [rgba(tracks / file) for file in TEXTURES["facade"].split()]
    trees = [trimmed(rgba(tracks / file)) for file in TREES.split()]
    for index in range(COLLAGES if skies else 0):
        sky = cv2.resize(skies[index % len(skies)], (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
        write(out / "skies" / f"collage{index:02d}.png", collage(sky, facades, trees, index))


def panoramas(package: Path, out: Path) -> None:
    """Skies of high dynamic range, which are EXR files in texts of JavaScript. Raises ImportError without OpenEXR."""
    import OpenEXR

    (out / "skies").mkdir(parents=True, exist_ok=True)
    for name, brightness in BRIGHTNESS.items():
        text = (package / f"package/hdri/{name}.exr.js").read_text()
        exr = package / f"{name}.exr"
        exr.write_bytes(base64.b64decode(text.split("base64,")[1].split("'")[0]))
        with OpenEXR.File(str(exr)) as file:
            channels = file.channels()
            pixels = channels["RGB"].pixels if "RGB" in channels else np.stack([channels[c].pixels for c in "RGB"], -1)
        write(out / "skies" / f"{name}.png", sharpened(displayed(pixels[:128, :, :3].astype(np.float32), brightness)))


def displayed(light: Array, brightness: float) -> Array:
    """An image (HEIGHT, WIDTH, 3), 0 to 255, of linear RGB; the sun, whose colours compression has lost, is white."""
    x = light * brightness / np.nanmedian(light)
    low, high = x.min(-1, keepdims=True), x.max(-1, keepdims=True)
    has_colors = np.isfinite(high - low) & (low > -1) & ((high < 1) | (low > 0.01 * high))
    x = np.where(has_colors, x, 500).clip(0, 500)
    x = x * (1 + x / 9) / (1 + 0.55 * x)
    srgb = x.clip(0, 1).astype(np.float32) ** (1 / 2.2) * 255
    around = np.pad(srgb, ((0, 0), (8, 8), (0, 0)), "wrap")
    scale = WIDTH // srgb.shape[1]
    wide = cv2.resize(around, (WIDTH + 16 * scale, HEIGHT), interpolation=cv2.INTER_CUBIC)
    return wide[:, 8 * scale : -8 * scale]


def sharpened(image: Array) -> Array:
    """With sharper edges and a little grain, where an image was enlarged."""
    grain = np.random.default_rng(1).normal(0, 2.5, (*image.shape[:2], 1))
    return image + 0.8 * (image - cv2.GaussianBlur(image, (0, 0), 3)) + grain


def collage(sky: NDArray[np.uint8], facades: list[Array], trees: list[Array], index: int) -> Array:
    """A sky with houses and trees at the horizon; those far away are hazy."""
    draw = np.random.default_rng(index)
    image = np.roll(sky, draw.integers(WIDTH), axis=1).astype(np.float32)
    haze, light = image[-60:].mean((0, 1)), draw.uniform(0.7, 1.15)
    facade_count, tree_count = FACADES_AND_TREES[index % len(FACADES_AND_TREES)]
    for cutouts, count, nearest_m, lowest_m, highest_m in (
        (facades, facade_count, 60, 7, 22),
        (trees, tree_count, 35, 5, 14),
    ):
        for _ in range(count):
            cutout = cutouts[draw.integers(len(cutouts))][:, :: draw.choice([-1, 1])].astype(np.float32)
            distance_m = np.exp(draw.uniform(np.log(nearest_m), np.log(220)))
            height = np.degrees(np.arctan(draw.uniform(lowest_m, highest_m) / distance_m)) * PIXELS_PER_DEG
            width = height * cutout.shape[1] / cutout.shape[0]
            clear = 1 - distance_m / 500
            color = cutout[..., :3] * clear * light * draw.uniform(0.7, 1.05) + haze * (1 - clear)
            paste(image, color, cutout[..., 3:] / 255, int(draw.integers(WIDTH)), int(width) + 2, int(height) + 2)
    return sharpened(cv2.GaussianBlur(image, (0, 0), 0.5))


def paste(image: Array, color: Array, alpha: Array, column: int, width: int, height: int) -> None:
    """Draw a cut-out whose foot is at the horizon, from this column on; the image is closed."""
    small = cv2.resize(np.concatenate([color * alpha, alpha], axis=-1), (width, height), interpolation=cv2.INTER_AREA)
    small = small[-HEIGHT:]
    columns = (np.arange(width) + column) % WIDTH
    image[-len(small) :, columns] = image[-len(small) :, columns] * (1 - small[..., 3:]) + small[..., :3]


def texture(kind: str, image: NDArray[np.uint8]) -> Array:
    """The ratios of an image to its mean, times TEXTURE_MEAN. A facade keeps its aspect, others are square."""
    color = image[..., :3].astype(np.float32)
    height, width = color.shape[:2]
    if kind == "facade":
        color = color[: round(0.95 * height)]  # the pavement before it
        size = round(TEXTURE_SIZE * width / len(color)), TEXTURE_SIZE
        return cv2.resize(color, size, interpolation=cv2.INTER_AREA) / FACADE_MEAN * TEXTURE_MEAN
    if kind == "leaf":  # the middle of the crown of a tree, with dark gaps
        crown = trimmed(image).astype(np.float32)
        crown = crown[: round(0.75 * len(crown))]
        height, width = crown.shape[:2]
        color = crown[..., :3] * (0.2 + 0.8 * crown[..., 3:] / 255)
    if kind in ("leaf", "asphalt"):  # without the crown's ends, or the borders of the road
        side = min(height, width) // 2
        color = color[(height - side) // 2 :, (width - side) // 2 :][:side, :side]
        color = np.concatenate([color, color[::-1]])
        color = np.concatenate([color, color[:, ::-1]], axis=1)  # repeats without seams
    mean = color.mean((0, 1))
    grey = color.mean(-1, keepdims=True)
    tint = color / grey.clip(1) / (mean / mean.mean()) - 1
    color = cv2.resize(grey * (1 + COLORFULNESS * tint), (TEXTURE_SIZE, TEXTURE_SIZE), interpolation=cv2.INTER_AREA)
    return color / color.mean((0, 1)).clip(8) * TEXTURE_MEAN


def trimmed(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Without transparent borders."""
    rows, columns = (np.flatnonzero((image[..., 3] > 127).any(axis)) for axis in (1, 0))
    return image[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]


def rgba(path: Path) -> NDArray[np.uint8]:
    """(H, W, 4)."""
    return np.asarray(Image.open(io.BytesIO(path.read_bytes())).convert("RGBA"))


def write(path: Path, image: Array) -> None:
    """Write RGB, 0 to 255."""
    cv2.imwrite(path, np.rint(image).clip(0, 255).astype(np.uint8)[..., ::-1])
