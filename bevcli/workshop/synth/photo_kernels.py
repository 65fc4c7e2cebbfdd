"""The numba kernels of `material`: photographic skies and textures over shaded images.

Images hold display values (sRGB bytes); a texture is a factor on them. Positions are in the world frame in metres.
"""

# mypy: disable-error-code="no-untyped-def"
# The kernels have no type hints: numba takes the types from the first call.

import numpy as np

from bevcli.jit import njit
from bevcli.workshop.synth.mesh import Material
from bevcli.workshop.synth.shading_kernels import pixel_ray

GROUND, GLASS, GLOW, LEAVES = (int(m) for m in (Material.GROUND, Material.GLASS, Material.GLOW, Material.LEAVES))
TEXTURE_SIZE, TEXTURE_MEAN = 256, 85  # pixels of a side; the value that leaves the brightness as it is
TO_DISPLAY = 1 / 2.2  # exponent that turns a factor on the light into one on display values


@njit(nogil=True, error_model="numpy")
def retouch_pixels(buffer, surfaces, view, haze_m, sky, textures, coats, ground, contact, needed, image):
    """Draw the photographic sky into `image` (H, W, 3) uint8 BGR, and textures, reflections and shadows over it.

    buffer: triangles and inverse depths of `VisibilityBuffer`.
    surfaces: normals and material of `TriangleSoup`.
    view: world ray from pixel (3, 3), camera position (3,), angle of a pixel in radians.
    sky: panorama (h, w, 3), empty for none; display value of each of its values (256, 3); turn; mirrored; gloss.
    textures: texels and offsets of `Textures`.
    coats: mesh (S,) of the first S triangles, rows (M, 8) of `Coats`.
    ground: (8,) of `PhotoLooks`.
    contact: darkness (S, S) uint8, x and y of the origin, cell size, strength.
    needed: (H, W) 0 for the pixels that stay as they are.
    """
    triangles, inverse_depth = buffer
    normals, material = surfaces
    ray_from_image, eye, pixel_angle = view
    factor, color = np.empty(3), np.empty(3)
    has_sky = sky[0].shape[0] > 0
    height, width = triangles.shape
    for v in range(height):
        for u in range(width):
            if not needed[v, u]:
                continue
            rx, ry, rz, length = pixel_ray(ray_from_image, u, v)
            t = triangles[v, u]
            if t < 0 and rz >= -1e-4 * length:
                if has_sky:
                    _sky(sky, rx / length, ry / length, rz / length, color)
                    _mix(image, v, u, color, 1.0)
                continue
            z = 1.0 / inverse_depth[v, u] if t >= 0 else -eye[2] / rz
            x, y, height_m = eye[0] + z * rx, eye[1] + z * ry, eye[2] + z * rz
            clear = np.exp(-0.7 * z * length / haze_m)
            footprint = z * pixel_angle
            factor[:] = 1.0
            if t < 0 or material[t] == GROUND:
                slant = min(max(0.5 * length / max(-rz, 0.05 * length), 1.0), 4.0)
                _ground(textures, ground, 0 if t < 0 else 3, x, y, footprint * slant, clear, color, factor)
                _darken(contact, x, y, factor)
            elif material[t] == GLASS:
                if has_sky:
                    _reflect(sky, rx / length, ry / length, rz / length, normals[t], clear, color, image, v, u)
            elif t < coats[0].shape[0] and material[t] != GLOW:
                row, is_leaf = coats[1][coats[0][t]], material[t] == LEAVES
                _coat(textures, row, is_leaf, normals[t], x, y, height_m, footprint, clear, color, factor)
            _multiply(image, v, u, factor)


@njit(nogil=True)
def _mix(image, v, u, color, share):
    """Mix a display colour (3,) RGB into a pixel."""
    for c in range(3):
        image[v, u, 2 - c] = np.uint8(image[v, u, 2 - c] * (1.0 - share) + color[c] * share)


@njit(nogil=True, error_model="numpy")
def _multiply(image, v, u, factor):
    """Multiply a pixel by factors (3,) RGB; towards white it saturates smoothly."""
    for c in range(3):
        old = float(image[v, u, 2 - c])
        new = old * factor[c]
        if factor[c] > 1.0:
            left = max(255.0 - old, 1.0)
            new = old + left * (1.0 - np.exp((old - new) / left))
        image[v, u, 2 - c] = np.uint8(min(max(new, 0.0), 255.0))


@njit(nogil=True, error_model="numpy")
def _sky(sky, x, y, z, out):
    """Display colour of the panorama in the direction of a unit vector into out (3,) RGB."""
    panorama, shown, turn, mirrored, _ = sky
    rows, columns = panorama.shape[0], panorama.shape[1]
    row = np.arccos(min(max(z, -1.0), 1.0)) / (np.pi / 2) * rows - 0.5
    row = min(max(row, 0.0), rows - 1.001)
    around = (np.arctan2(y, x) + turn) / (2 * np.pi)
    around = around if mirrored else -around
    column = (around - np.floor(around)) * columns - 0.5
    i, j = int(np.floor(column)), int(row)
    wu, wv = column - i, row - j
    left, right = (i + columns) % columns, (i + 1) % columns
    for c in range(3):
        low = panorama[j, left, c] * (1 - wu) + panorama[j, right, c] * wu
        high = panorama[j + 1, left, c] * (1 - wu) + panorama[j + 1, right, c] * wu
        out[c] = shown[int(low * (1 - wv) + high * wv + 0.5), c]


@njit(nogil=True, error_model="numpy")
def _reflect(sky, x, y, z, normal, clear, color, image, v, u):
    """Mix the reflection of the sky in glass into a pixel. x, y, z: direction of view. color: working memory."""
    facing = -(x * normal[0] + y * normal[1] + z * normal[2])
    up = z + 2 * facing * normal[2]
    if up > 0.0:
        _sky(sky, x + 2 * facing * normal[0], y + 2 * facing * normal[1], up, color)
        share = sky[4] * (1.0 - 0.6 * min(max(facing, 0.0), 1.0)) * min(1.0, up * 20.0) * clear
        _mix(image, v, u, color, share)


@njit(nogil=True, error_model="numpy")
def _texture(textures, index, u, v, footprint, out):
    """Factors of a texture at u, v into out (3,). u, v and the footprint of the pixel are in widths of the texture."""
    texels, offsets = textures
    level, span = 0, footprint * TEXTURE_SIZE
    while span > 1.3 and level < offsets.shape[0] - 1:
        span *= 0.5
        level += 1
    n = TEXTURE_SIZE >> level
    fu, fv = (u - np.floor(u)) * n - 0.5, (v - np.floor(v)) * n - 0.5
    iu, iv = int(np.floor(fu)), int(np.floor(fv))
    wu, wv = fu - iu, fv - iv
    left, right = iu & (n - 1), (iu + 1) & (n - 1)
    first, second = offsets[level] + (iv & (n - 1)) * n, offsets[level] + ((iv + 1) & (n - 1)) * n
    for c in range(3):
        low = texels[index, first + left, c] * (1 - wu) + texels[index, first + right, c] * wu
        high = texels[index, second + left, c] * (1 - wu) + texels[index, second + right, c] * wu
        out[c] = (low * (1 - wv) + high * wv) * (1.0 / TEXTURE_MEAN)


@njit(nogil=True)
def _apply(factor, color, strength):
    """Multiply factor (3,) by the factors of a texture, color (3,), weakened or strengthened."""
    for c in range(3):
        factor[c] *= max(1.0 + strength * (color[c] - 1.0), 0.06)


@njit(nogil=True, error_model="numpy")
def _ground(textures, ground, base, x, y, footprint, clear, color, factor):
    """Multiply factor (3,) by the texture of the ground at (x, y), and by large patches of brightness.

    base: where the numbers of the surface stand in `ground`. color: working memory.
    """
    index, tile, strength = int(ground[base]), ground[base + 1], ground[base + 2] * clear
    if index >= 0 and strength > 0.02:
        _texture(textures, index, x / tile, y / tile, footprint / tile, color)
        _apply(factor, color, strength)
    index, tile = int(ground[6]), ground[7]
    if index >= 0:
        _texture(textures, index, (x + 0.37 * y) / tile, (y - 0.37 * x) / tile, footprint / tile, color)
        color[0] = color[2] = color[1]
        _apply(factor, color, 0.7 * ground[2] * clear)


@njit(nogil=True, error_model="numpy")
def _coat(textures, row, is_leaf, normal, x, y, z, footprint, clear, color, factor):
    """Multiply factor (3,) by the texture of a wall or of leaves at a point. row: of `Coats`. color: working memory."""
    index, width, height, strength = int(row[0]), row[1], row[2], row[3] * clear
    if is_leaf:
        index, width, height, strength = int(row[6]), row[7], row[7], 0.95 * clear
    if index < 0 or strength < 0.02:
        return
    nx, ny = normal[0], normal[1]
    if abs(normal[2]) >= (0.8 if is_leaf else 0.5):  # from above
        a, b = x, y
    elif is_leaf:  # one plane for many faces, so that there are no seams between them
        a, b = (y, -z) if abs(nx) > abs(ny) else (x + 0.4, -z)
    else:
        a, b = (y * nx - x * ny) / np.sqrt(nx * nx + ny * ny), -z
    _texture(textures, index, a / width + row[4], b / height + row[5], footprint / min(width, height), color)
    _apply(factor, color, strength)


@njit(nogil=True, error_model="numpy")
def _darken(contact, x, y, factor):
    """Multiply factor (3,) by the shadow under objects at (x, y)."""
    darkness, origin_x, origin_y, cell, strength = contact
    i, j = int(np.floor((x - origin_x) / cell)), int(np.floor((y - origin_y) / cell))
    if 0 <= i < darkness.shape[1] and 0 <= j < darkness.shape[0] and darkness[j, i] > 0:
        shade = (1.0 - darkness[j, i] * (1.0 / 255.0) * strength) ** TO_DISPLAY
        for c in range(3):
            factor[c] *= shade
