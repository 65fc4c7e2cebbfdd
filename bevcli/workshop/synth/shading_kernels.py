"""The numba kernels of shading: `shade_pixels`, `retouch_pixels` and the functions that they call.

They are in one file because numba's cache on disk is invalidated only when the file of the called function changes.
Positions are in the world frame in metres, colours are linear RGB.
"""

# mypy: disable-error-code="no-untyped-def"
# The kernels have no type hints: numba takes the types from the first call.

import numpy as np

from bevcli.jit import njit
from bevcli.workshop.synth.mesh import Material

LIGHT_LIMIT = 1.6  # the brightest light in the display table
ROUGH_TEXEL_M = 0.25  # texel size of the ground's roughness
KINDS = (Material.GROUND, Material.FACADE, Material.GLASS, Material.PAINT, Material.GLOW, Material.LEAVES)
GROUND, FACADE, GLASS, PAINT, GLOW, LEAVES = map(int, KINDS)


@njit(nogil=True, error_model="numpy")
def shade_pixels(buffer, surfaces, ground, shadows, weather, view, table, needed, image):
    """Colour the pixels of `image` (H, W, 3) uint8 BGR, in place.

    buffer: triangles and inverse depths of `VisibilityBuffer`.
    surfaces: normals, albedo, material, facade, facades of `TriangleSoup`, pattern of `WorldSnapshot`.
    ground: texels, offsets, roughness, x and y of the origin, texel size and size of `GroundTexture`.
    shadows: heights, x and y of the origin, texel size and shear of `ShadowMap`, softness in metres.
    weather: light (7, 3) with rows sun, sky, bounce, zenith, horizon, haze, cloud; to_sun; clouds; haze_m; lamps.
    view: world ray from pixel (3, 3), camera position (3,), angle of a pixel in radians.
    table: sRGB bytes of light from 0 to LIGHT_LIMIT.
    needed: (H, W) 0 for the pixels that stay as they are.
    """
    triangles, inverse_depth = buffer
    normals, albedo, material, facade, facades, pattern = surfaces
    light, to_sun, clouds, haze_m, lamps = weather
    ray_from_image, eye, pixel_angle = view
    sun, sky, bounce, haze = light[0], light[1], light[2], light[5]
    a = np.empty(3)  # first the albedo, then the colour
    mirror = np.empty(3)
    table_scale = (table.shape[0] - 1) / LIGHT_LIMIT
    height, width = triangles.shape
    for v in range(height):
        for u in range(width):
            if not needed[v, u]:
                continue
            rx, ry, rz, length = pixel_ray(ray_from_image, u, v)
            t = triangles[v, u]
            surface = GROUND
            nx, ny, nz = 0.0, 0.0, 1.0
            if t >= 0:
                z = 1.0 / inverse_depth[v, u]
                surface = material[t]
                nx, ny, nz = normals[t, 0], normals[t, 1], normals[t, 2]
            elif rz < -1e-4 * length:
                z = -eye[2] / rz
            else:
                _sky(rx / length, ry / length, rz / length, light, to_sun, clouds, a)
                _put(image, v, u, a, table, table_scale)
                continue
            px, py, pz = eye[0] + z * rx, eye[1] + z * ry, eye[2] + z * rz
            footprint, far = z * pixel_angle, z * length / haze_m
            grain = 0.0
            if surface == GROUND:
                along = footprint * length / max(-rz, 0.02 * length)
                grain = _ground(ground, px, py, footprint, along, rx, ry, a)
            elif surface == FACADE:
                if _facade(facades[facade[t]], px, py, pz, footprint, lamps, a):
                    surface = GLASS
            else:
                a[0], a[1], a[2] = albedo[t, 0], albedo[t, 1], albedo[t, 2]
            if pattern[0] > 0 and surface != GROUND:
                grain = _pattern(pattern, ground[2], px, py, pz, footprint)
            if surface == GLOW:
                for c in range(3):
                    a[c] *= 0.35 + 0.65 * lamps
            else:
                lit = _sunlit(shadows, to_sun, px, py, pz, nx, ny, nz)
                up = 0.5 + 0.5 * nz
                near_ground = 1.0
                if t >= 0 and nz < 0.5:  # walls get less light from the sky near the ground
                    near_ground = min(1.0, 0.62 + 0.2 * pz)
                for c in range(3):
                    a[c] *= sun[c] * lit + near_ground * (sky[c] * up + bounce[c] * (1.0 - up))
                    a[c] *= 1.0 + grain
                if surface == GLASS or surface == PAINT:  # noqa: SIM109  (faster in numba)
                    x, y, z = rx / length, ry / length, rz / length
                    _reflect(x, y, z, nx, ny, nz, surface, light, to_sun, clouds, lit > 0.02, mirror, a)
            _veil(a, haze, far)
            _put(image, v, u, a, table, table_scale)


@njit(nogil=True, error_model="numpy")
def pixel_ray(ray_from_image, u, v):
    """The world ray of a pixel, with depth 1: x, y, z and length."""
    rx = ray_from_image[0, 0] * u + ray_from_image[0, 1] * v + ray_from_image[0, 2]
    ry = ray_from_image[1, 0] * u + ray_from_image[1, 1] * v + ray_from_image[1, 2]
    rz = ray_from_image[2, 0] * u + ray_from_image[2, 1] * v + ray_from_image[2, 2]
    return rx, ry, rz, np.sqrt(rx * rx + ry * ry + rz * rz)


@njit(nogil=True, error_model="numpy")
def _sunlit(shadows, to_sun, x, y, z, nx, ny, nz):
    """Share of the sunlight, 0 to 1, that a surface with the normal (nx, ny, nz) gets at a point."""
    lit = nx * to_sun[0] + ny * to_sun[1] + nz * to_sun[2]
    if lit <= 0:
        return 0.0
    off = 0.02 + 1.6 * shadows[3] * (1.0 - lit)  # a point a little outside; otherwise surfaces shadow themselves
    return lit * (1.0 - _shadow(shadows, x + off * nx, y + off * ny, z + off * nz))


@njit(nogil=True, error_model="numpy")
def _veil(color, haze, far):
    """Mix the haze into a colour (3,). far: distance, in distances of the haze."""
    veil = 1.0 - 1.0 / (1.0 + far + 0.48 * far * far + 0.235 * far * far * far)  # about 1 - exp(-far)
    veil *= veil
    for c in range(3):
        color[c] += (haze[c] - color[c]) * veil


@njit(nogil=True, error_model="numpy")
def _put(image, v, u, color, table, scale):
    """Write a colour (3,) to a pixel. scale: entries of the table for each unit of light."""
    for c in range(3):
        level = int(color[c] * scale)
        image[v, u, 2 - c] = table[min(max(level, 0), table.shape[0] - 1)]


@njit(nogil=True, error_model="numpy")
def _sky(x, y, z, light, to_sun, clouds, out):
    """Light of the sky from the unit vector (x, y, z) into out (3,): gradient, clouds, glow around the sun."""
    zenith, horizon, cloud = light[3], light[4], light[6]
    up = max(z, 0.0)
    mix = 1.0 - (1.0 - up) * (1.0 - up) * (1.0 - up)
    spread = 90.0 / (up + 0.18)
    cover = _repeated(clouds, x * spread, y * spread)
    cover *= min(1.0, up * 5.0) * 0.85
    toward = max(x * to_sun[0] + y * to_sun[1] + z * to_sun[2], 0.0)
    toward2 = toward * toward
    toward8 = toward2 * toward2 * toward2 * toward2
    glow = 0.18 * toward8 + 0.8 * toward8**24
    for c in range(3):
        base = horizon[c] + (zenith[c] - horizon[c]) * mix
        out[c] = base + (cloud[c] - base) * cover + glow * light[0, c]


@njit(nogil=True, error_model="numpy")
def _repeated(texture, u, v):
    """Linear interpolation of a texture (S, S), S a power of 2, that repeats in both directions, at column u, row v."""
    size = texture.shape[0]
    iu, iv = int(np.floor(u)), int(np.floor(v))
    wu, wv = u - iu, v - iv
    i0, i1, j0, j1 = iu & (size - 1), (iu + 1) & (size - 1), iv & (size - 1), (iv + 1) & (size - 1)
    low, high = texture[j0, i0] * (1 - wu) + texture[j0, i1] * wu, texture[j1, i0] * (1 - wu) + texture[j1, i1] * wu
    return low * (1 - wv) + high * wv


@njit(nogil=True, error_model="numpy")
def _reflect(x, y, z, nx, ny, nz, kind, light, to_sun, clouds, sunlit, mirror, color):
    """Mix the reflection in glass or paint into `color` (3,): the sky, or a dark street below the horizon.

    x, y, z: direction of view. nx, ny, nz: surface normal. sunlit: whether to add the highlight of the sun.
    mirror: (3,) working memory.
    """
    facing = -(x * nx + y * ny + z * nz)
    mx, my, mz = x + 2 * facing * nx, y + 2 * facing * ny, z + 2 * facing * nz
    grazing = 1.0 - min(max(facing, 0.0), 1.0)
    fresnel = grazing * grazing * grazing * grazing * grazing
    if mz > 0:
        if kind == GLASS:
            _sky(mx, my, mz, light, to_sun, clouds, mirror)
        else:
            for c in range(3):
                mirror[c] = light[4, c] + (light[3, c] - light[4, c]) * mz
        fade = min(1.0, mz * 4.0)
        for c in range(3):
            mirror[c] = mirror[c] * fade + 0.22 * light[4, c] * (1 - fade)
    else:
        for c in range(3):
            mirror[c] = 0.22 * light[4, c]
    share = 0.16 + 0.7 * fresnel if kind == GLASS else 0.035 + 0.5 * fresnel
    for c in range(3):
        color[c] += (mirror[c] - color[c]) * share
    if sunlit:
        toward = max(mx * to_sun[0] + my * to_sun[1] + mz * to_sun[2], 0.0)
        shine = toward**40 * (0.5 if kind == GLASS else 0.3)
        for c in range(3):
            color[c] += shine * light[0, c]


@njit(nogil=True, error_model="numpy")
def _shadow(shadows, x, y, z):
    """Fraction of the sunlight, 0 to 1, that is blocked at a point."""
    heights, origin_x, origin_y, texel, shear_x, shear_y, softness = shadows
    x, y = x + shear_x * z, y + shear_y * z
    size = heights.shape[0]
    bias = z + 0.03 + texel * 0.5
    fu, fv = (x - origin_x) / texel - 0.5, (y - origin_y) / texel - 0.5
    if fu < 3 or fv < 3 or fu > size - 5 or fv > size - 5:
        return 0.0
    if softness > 0.5:  # overcast: a wide, weak shadow under and beside objects
        step = softness / texel * 0.35
        blocked = 0.0
        for j in range(-2, 3):
            for i in range(-2, 3):
                row = min(max(int(fv + j * step), 0), size - 1)
                column = min(max(int(fu + i * step), 0), size - 1)
                blocked += 1.0 if heights[row, column] > bias else 0.0
        return blocked / 25.0
    iu, iv = int(fu), int(fv)
    wu, wv = fu - iu, fv - iv
    b00 = 1.0 if heights[iv, iu] > bias else 0.0
    b01 = 1.0 if heights[iv, iu + 1] > bias else 0.0
    b10 = 1.0 if heights[iv + 1, iu] > bias else 0.0
    b11 = 1.0 if heights[iv + 1, iu + 1] > bias else 0.0
    return (b00 * (1 - wu) + b01 * wu) * (1 - wv) + (b10 * (1 - wu) + b11 * wu) * wv


@njit(nogil=True, error_model="numpy")
def _ground(ground, x, y, across, along, rx, ry, out):
    """Albedo of the ground at (x, y) into out (3,). Returns the roughness, a relative brightness around 0.

    across: size of the pixel on the ground, metres. along: its size in the direction (rx, ry), where up to three
    samples are averaged.
    """
    texels, offsets, rough, origin_x, origin_y, texel_m, size = ground
    flat = np.sqrt(rx * rx + ry * ry) + 1e-9
    samples = min(max(int(0.6 * along / across), 1), 3)
    width = max(across, along / samples * 0.5)
    level = 0
    span = texel_m * 1.4
    while width > span and level < offsets.shape[0] - 1:
        level += 1
        span *= 2
    n = size >> level
    scale = 1.0 / (texel_m * (1 << level))
    out[0] = out[1] = out[2] = 0.0
    step_x, step_y = along / samples * rx / flat * scale, along / samples * ry / flat * scale
    start_x = (x - origin_x) * scale - 0.5 - 0.5 * (samples - 1) * step_x
    start_y = (y - origin_y) * scale - 0.5 - 0.5 * (samples - 1) * step_y
    for i in range(samples):
        u = min(max(start_x + i * step_x, 0.0), n - 1.001)
        v = min(max(start_y + i * step_y, 0.0), n - 1.001)
        iu, iv = int(u), int(v)
        wu, wv = u - iu, v - iv
        w00, w01, w10, w11 = (1 - wu) * (1 - wv), wu * (1 - wv), (1 - wu) * wv, wu * wv
        at = offsets[level] + iv * n + iu
        under = at + n
        for c in range(3):
            root = texels[at, c] * w00 + texels[at + 1, c] * w01 + texels[under, c] * w10 + texels[under + 1, c] * w11
            out[c] += root * root
    for c in range(3):
        out[c] *= 1.0 / (65025.0 * samples)
    grain = _repeated(rough, x / ROUGH_TEXEL_M, y / ROUGH_TEXEL_M)
    if width < 0.05:
        fine = _hash(int(np.floor(x * 45)), int(np.floor(y * 45))) % 256 / 255.0 - 0.5
        grain += 0.22 * fine * min(1.0, (0.05 - width) / 0.035)
    return grain


@njit(nogil=True, error_model="numpy")
def _pattern(pattern, texture, x, y, z, footprint):
    """Relative brightness around 0 of the pattern at a point. footprint: size of the pixel, metres; it fades out."""
    strength, waves, hardness = pattern
    scale = waves * 4.0  # texels of `roughness` per metre
    value = 4.0 * _repeated(texture, (x + 0.61 * z) * scale, (y - 0.73 * z) * scale)
    if hardness > 0:
        value = 0.5 if value > 0 else -0.5
    return strength * min(max(value, -1.0), 1.0) * min(1.0, 0.5 / (waves * footprint))


@njit(nogil=True, error_model="numpy")
def _facade(row, x, y, z, footprint, lamps, out):
    """Albedo of a wall at a point into out (3,). Returns whether the point is glass.

    row: (16,) of `TriangleSoup.facades`. footprint: size of the pixel on the wall, metres; finer details fade out.
    lamps: brightness of lit windows.
    """
    u = (x - row[0]) * row[2] + (y - row[1]) * row[3]
    height, length = row[4], row[5]
    floor_m, pitch, window_w, window_h, shop_m, brick = row[6], row[7], row[8], row[9], row[10], row[11]
    coded = int(row[12])
    band, seed = coded % 2 == 1, coded // 2
    out[0], out[1], out[2] = row[13], row[14], row[15]
    if z > height - 0.7:  # cornice
        shade = 0.8 if z > height - 0.2 or z < height - 0.6 else 1.12
        for c in range(3):
            out[c] *= shade
        return False
    if z < shop_m and shop_m < 1.0:  # a plinth of stone
        out[0], out[1], out[2] = 0.5 * out[0] + 0.08, 0.5 * out[1] + 0.08, 0.5 * out[2] + 0.08
        return False
    if z < shop_m:
        return _shop(u, z, length, shop_m, seed, out)
    floors = np.floor((height - 0.9 - shop_m) / floor_m)
    storey = np.floor((z - shop_m) / floor_m)
    columns = max(1.0, np.floor((length - 0.8) / pitch))
    margin = (length - columns * pitch) / 2
    column = np.floor((u - margin) / pitch)
    inside = 0 <= column < columns and storey < floors
    wu = u - margin - column * pitch - pitch / 2
    wv = z - shop_m - storey * floor_m - floor_m * 0.52
    if brick > 0:
        _bricks(u, z, footprint, brick, out)
    if not inside:
        return False
    if band:
        glass = abs(wv) < window_h / 2
        frame = abs(wu) > pitch / 2 - 0.06
    else:
        glass = abs(wu) < window_w / 2 and abs(wv) < window_h / 2
        frame = abs(wu) < 0.035 or abs(wu) > window_w / 2 - 0.07 or abs(wv) > window_h / 2 - 0.07
        if abs(wu) < window_w / 2 + 0.12 and -window_h / 2 - 0.16 < wv < -window_h / 2:  # sill
            for c in range(3):
                out[c] = out[c] * 0.5 + 0.34
            return False
        if abs(wu) < window_w / 2 + 0.05 and window_h / 2 < wv < window_h / 2 + 0.18:  # lintel
            for c in range(3):
                out[c] *= 0.72
            return False
    if not glass:
        return False
    if frame and footprint < 0.12:
        out[0], out[1], out[2] = 0.5, 0.5, 0.48
        return False
    _pane(seed, int(column), int(storey), wv / window_h, lamps, out)
    return True


@njit(nogil=True)
def _bricks(u, z, footprint, brick, out):
    """Multiply out (3,) by a brick pattern at u along the wall and height z.

    footprint: size of the pixel, metres; coarse pixels get no pattern. brick: contrast, 0 to 1.
    """
    strength = brick * min(1.0, max(0.0, (0.09 - footprint) / 0.06))
    if strength <= 0:
        return
    course = int(np.floor(z / 0.09))
    shifted = u / 0.26 + 0.5 * (course % 2)
    along = int(np.floor(shifted))
    tone = (_hash(along, course) % 64) / 64.0 - 0.5
    joint = z / 0.09 - course < 0.16 or shifted - along < 0.06
    factor = 1.0 + strength * (0.35 * tone + (0.35 if joint else 0.0))
    for c in range(3):
        out[c] *= factor


@njit(nogil=True)
def _pane(seed, column, storey, up, lamps, out):
    """Albedo of a window into out (3,): a dark room, a curtain, or a lit room. up: -0.5 to 0.5 in the window."""
    chance = _hash(seed + column * 7919, storey * 104729 + seed) % 100
    out[0], out[1], out[2] = 0.035, 0.045, 0.055
    if chance < 26 and up > -0.5 + (chance % 5) * 0.2:  # curtain or blind
        out[0], out[1], out[2] = 0.32, 0.30, 0.26
    elif chance > 100 - 30 * (lamps - 0.4):
        out[0], out[1], out[2] = 1.5, 1.1, 0.6


@njit(nogil=True)
def _shop(u, z, length, shop_m, seed, out):
    """Albedo of a shop front into out (3,). Returns whether the point is glass. u: position along the wall, metres."""
    unit = 4.2
    count = max(1.0, np.floor(length / unit))
    width = length / count
    index = int(np.floor(u / width))
    wu = u - index * width
    kind = _hash(seed + 31 * index, seed) % 5
    if z > shop_m - 0.75:
        if z > shop_m - 0.68 and 0.25 < wu < width - 0.25:
            pick = _hash(index + 5, seed) % 6
            out[0] = 0.30 if pick in (0, 3) else 0.07
            out[1] = 0.20 if pick in (1, 3, 4) else 0.06
            out[2] = 0.22 if pick in (2, 4) else 0.07
        return False
    if wu < 0.25 or wu > width - 0.25 or (z < 0.45 and kind != 0):
        for c in range(3):
            out[c] *= 0.7
        return False
    if kind == 4:  # closed shutters
        stripe = z * 8 - np.floor(z * 8) < 0.15
        for c in range(3):
            out[c] = (0.16 if stripe else 0.24) + 0.02 * c
        return False
    if abs(wu - width / 2) < 0.05 or (kind == 0 and abs(wu - width * 0.7) < 0.04):
        out[0], out[1], out[2] = 0.08, 0.08, 0.09
        return False
    out[0], out[1], out[2] = 0.06, 0.065, 0.07
    if z < 1.3 and kind != 0:  # goods in the shop window
        tone = _hash(int(np.floor(u * 2.5)), seed + int(z * 3)) % 7
        out[0], out[1], out[2] = 0.05 + 0.03 * tone, 0.06 + 0.02 * (6 - tone), 0.10
    return True


@njit(nogil=True, error_model="numpy")
def _hash(a, b):
    h = (a * 73856093) ^ (b * 19349663)
    h = (h ^ (h >> 13)) * 1274126177
    return (h ^ (h >> 16)) & 0x7FFFFFFF


# Photographs (`material`) over shaded images: these hold display values (sRGB bytes); a texture is a factor on them.
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
                    _photo_sky(sky, rx / length, ry / length, rz / length, color)
                    _mix(image, v, u, color, 1.0)
                continue
            z = 1.0 / inverse_depth[v, u] if t >= 0 else -eye[2] / rz
            x, y, height_m = eye[0] + z * rx, eye[1] + z * ry, eye[2] + z * rz
            clear = np.exp(-0.7 * z * length / haze_m)
            footprint = z * pixel_angle
            factor[:] = 1.0
            if t < 0 or material[t] == GROUND:
                slant = min(max(0.5 * length / max(-rz, 0.05 * length), 1.0), 4.0)
                _photo_ground(textures, ground, 0 if t < 0 else 3, x, y, footprint * slant, clear, color, factor)
                _darken(contact, x, y, factor)
            elif material[t] == GLASS:
                if has_sky:
                    _photo_reflection(sky, rx / length, ry / length, rz / length, normals[t], clear, color, image, v, u)
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
def _photo_sky(sky, x, y, z, out):
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
def _photo_reflection(sky, x, y, z, normal, clear, color, image, v, u):
    """Mix the reflection of the sky in glass into a pixel. x, y, z: direction of view. color: working memory."""
    facing = -(x * normal[0] + y * normal[1] + z * normal[2])
    up = z + 2 * facing * normal[2]
    if up > 0.0:
        _photo_sky(sky, x + 2 * facing * normal[0], y + 2 * facing * normal[1], up, color)
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
def _photo_ground(textures, ground, base, x, y, footprint, clear, color, factor):
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
