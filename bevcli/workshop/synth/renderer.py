"""The image of one camera: rasterise and shade the world, and count the pixels of each object.

The z-buffer rasteriser finds the triangle that each pixel sees, its depth, and the height up to which the sun is
blocked. The triangles of an object follow each other, so the pixels that it would cover without occlusion are counted
in the same pass. Then each pixel is shaded once, in linear RGB (deferred shading, `shading_kernels`). All surfaces are
diffuse; glass and paint also reflect the sky. The ground has no triangles: a pixel that sees none and looks down sees
the plane z = 0. The image of a camera with distortion is resampled from pinhole images (`rig.lens_parts`).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import Array, inverse
from bevcli.jit import njit
from bevcli.workshop.synth.ground import GroundTexture
from bevcli.workshop.synth.material import PhotoView
from bevcli.workshop.synth.mesh import TriangleSoup
from bevcli.workshop.synth.rig import LensPart
from bevcli.workshop.synth.scenery import Weather
from bevcli.workshop.synth.shading_kernels import LIGHT_LIMIT, shade_pixels

# mypy: disable-error-code="no-untyped-def"
# The kernels have no type hints: numba takes the types from the first call.


@dataclass(frozen=True)
class VisibilityBuffer:
    """Nearest triangle and depth of each pixel of an image."""

    triangles: NDArray[np.int32]  # (H, W) index of the nearest triangle; -1 for none
    inverse_depth: NDArray[np.float32]  # (H, W) 1 / depth, 1/metres; 0 for none
    unoccluded: NDArray[np.int64]  # (O,) pixels of each object without occlusion; may be too small for a hidden one


def rasterise(soup: TriangleSoup, camera: Camera, camera_from_world: Array, object_count: int) -> VisibilityBuffer:
    """Rasterise triangles into one image. Back faces are not drawn; the camera's distortion is not applied.

    camera_from_world: (4, 4). object_count: O; the objects in the soup are 0 to O - 1.
    """
    shape = (camera.height, camera.width)
    triangles = np.full(shape, -1, np.int32)
    inverse_depth = np.zeros(shape, np.float32)
    last_objects = np.full(shape, -1, np.int32)
    unoccluded = np.zeros(object_count, np.int64)
    k = camera.intrinsics
    pinhole = np.array([k[0, 0], k[0, 1], k[0, 2], k[1, 1], k[1, 2]])
    rasterise_meshes(
        (soup.corners, soup.normals),
        (soup.mesh_ranges, soup.mesh_objects, soup.mesh_spheres),
        np.ascontiguousarray(camera_from_world[:3]), pinhole, inverse(camera_from_world)[:3, 3].copy(),
        triangles, inverse_depth, last_objects, unoccluded,
    )  # fmt: skip
    return VisibilityBuffer(triangles, inverse_depth, unoccluded)


NEAR_M = 0.1  # depth of the near plane, at which triangles are clipped


@njit(nogil=True)
def rasterise_meshes(world, meshes, camera_from_world, pinhole, eye,
                     triangles, inverse_depth, last_objects, unoccluded):  # fmt: skip
    """Draw meshes; those that are hidden or out of view are skipped as a whole.

    world: corners (T, 3, 3) and normals (T, 3) of the triangles, world frame, metres.
    meshes: triangle ranges (M, 2), objects (M,) and bounding spheres (M, 4) of the meshes, as in `TriangleSoup`.
    camera_from_world: (3, 4). pinhole: (5,) fx, skew, cx, fy, cy. eye: (3,) camera position, world, metres.
    Written: triangles (H, W) int32, inverse_depth (H, W) float32, unoccluded (O,) int64 as in `VisibilityBuffer`, and
    last_objects (H, W) int32, the last object drawn at each pixel, hidden or not.
    """
    corners, normals = world
    mesh_ranges, mesh_objects, mesh_spheres = meshes
    height, width = triangles.shape
    slope_x = max(pinhole[2], width - pinhole[2]) / pinhole[0] + abs(pinhole[1] / pinhole[0])
    slope_y = max(pinhole[4], height - pinhole[4]) / pinhole[3]
    reach_x, reach_y = np.sqrt(1 + slope_x**2), np.sqrt(1 + slope_y**2)
    p = np.empty((3, 3))
    cut = np.empty((4, 3))
    center = np.empty(3)
    for mesh in range(mesh_ranges.shape[0]):
        radius = mesh_spheres[mesh, 3]
        _transform(camera_from_world, mesh_spheres[mesh], center)
        if center[2] + radius < NEAR_M:
            continue
        if abs(center[0]) > slope_x * center[2] + radius * reach_x:
            continue
        if abs(center[1]) > slope_y * center[2] + radius * reach_y:
            continue
        if center[2] - radius > NEAR_M and _is_hidden(center, radius, pinhole, inverse_depth):
            continue  # hidden as a whole, so its unoccluded pixels are not counted
        owner = mesh_objects[mesh]
        for t in range(mesh_ranges[mesh, 0], mesh_ranges[mesh, 1]):
            facing = (
                normals[t, 0] * (corners[t, 0, 0] - eye[0])
                + normals[t, 1] * (corners[t, 0, 1] - eye[1])
                + normals[t, 2] * (corners[t, 0, 2] - eye[2])
            )
            if facing > 1e-3:  # a back face
                continue
            for i in range(3):
                _transform(camera_from_world, corners[t, i], p[i])
            if p[0, 2] < NEAR_M and p[1, 2] < NEAR_M and p[2, 2] < NEAR_M:
                continue
            _draw_triangle(p, cut, t, owner, pinhole, triangles, inverse_depth, last_objects, unoccluded)


@njit(nogil=True)
def _transform(matrix, point, out):
    """Write a point (3 or more,) transformed by a matrix (3, 4) to `out` (3,)."""
    for axis in range(3):
        row = matrix[axis]
        out[axis] = row[0] * point[0] + row[1] * point[1] + row[2] * point[2] + row[3]


@njit(nogil=True, error_model="numpy")
def _is_hidden(center, radius, pinhole, inverse_depth):
    """True where all pixels that a sphere (camera frame, metres) may cover already see something nearer."""
    near, far = center[2] - radius, center[2] + radius
    left, right = center[0] - radius, center[0] + radius
    above, below = center[1] - radius, center[1] + radius
    low_y, high_y = min(above / near, above / far), max(below / near, below / far)
    low_x, high_x = min(left / near, left / far), max(right / near, right / far)
    skew_low, skew_high = min(pinhole[1] * low_y, pinhole[1] * high_y), max(pinhole[1] * low_y, pinhole[1] * high_y)
    u0 = max(int(np.floor(pinhole[0] * low_x + skew_low + pinhole[2])), 0)
    u1 = min(int(np.ceil(pinhole[0] * high_x + skew_high + pinhole[2])), inverse_depth.shape[1] - 1)
    v0 = max(int(np.floor(pinhole[3] * low_y + pinhole[4])), 0)
    v1 = min(int(np.ceil(pinhole[3] * high_y + pinhole[4])), inverse_depth.shape[0] - 1)
    nearest = 1.0 / near
    for v in range(v0, v1 + 1):
        for u in range(u0, u1 + 1):
            if inverse_depth[v, u] < nearest:
                return False
    return True


@njit(nogil=True)
def _draw_triangle(p, cut, t, owner, pinhole, triangles, inverse_depth, last_objects, unoccluded):
    """Draw triangle number t, with corners p (3, 3) in the camera frame, clipped at the near plane.

    cut: (4, 3) working memory. owner: the triangle's object, -1 for none.
    """
    q, count = p, 3
    if p[0, 2] < NEAR_M or p[1, 2] < NEAR_M or p[2, 2] < NEAR_M:
        q, count = cut, 0
        for i in range(3):  # Sutherland-Hodgman against the near plane
            j = (i + 1) % 3
            if p[i, 2] >= NEAR_M:
                for axis in range(3):
                    cut[count, axis] = p[i, axis]
                count += 1
            if (p[i, 2] >= NEAR_M) != (p[j, 2] >= NEAR_M):
                w = (NEAR_M - p[i, 2]) / (p[j, 2] - p[i, 2])
                for axis in range(3):
                    cut[count, axis] = p[i, axis] + w * (p[j, axis] - p[i, axis])
                count += 1
    for i in range(1, count - 1):
        _fill(p, q, 0, i, i + 1, pinhole, t, owner, triangles, inverse_depth, last_objects, unoccluded)


@njit(nogil=True, error_model="numpy")
def _fill(p, q, a, b, c, pinhole, t, owner, triangles, inverse_depth, last_objects, unoccluded):
    """Fill the triangle of rows a, b, c of q, row by row; its edges bound the columns of each row.

    q: (3 or 4, 3) corners after clipping, camera frame, metres. p: (3, 3) corners of the whole triangle. 1 / z is an
    affine function of the pixel, so the plane of p gives it exactly.
    """
    fx, skew, cx, fy, cy = pinhole[0], pinhole[1], pinhole[2], pinhole[3], pinhole[4]
    height, width = triangles.shape
    u0, v0 = (fx * q[a, 0] + skew * q[a, 1]) / q[a, 2] + cx, fy * q[a, 1] / q[a, 2] + cy
    u1, v1 = (fx * q[b, 0] + skew * q[b, 1]) / q[b, 2] + cx, fy * q[b, 1] / q[b, 2] + cy
    u2, v2 = (fx * q[c, 0] + skew * q[c, 1]) / q[c, 2] + cx, fy * q[c, 1] / q[c, 2] + cy
    top = int(np.ceil(max(min(v0, v1, v2), 0.0)))
    bottom = int(np.floor(min(max(v0, v1, v2), height - 1.0)))
    left_most, right_most = max(min(u0, u1, u2), 0.0), min(max(u0, u1, u2), width - 1.0)
    if top > bottom or np.ceil(left_most) > np.floor(right_most):
        return
    ax, ay, az = p[1, 0] - p[0, 0], p[1, 1] - p[0, 1], p[1, 2] - p[0, 2]
    bx, by, bz = p[2, 0] - p[0, 0], p[2, 1] - p[0, 1], p[2, 2] - p[0, 2]
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    distance = nx * p[0, 0] + ny * p[0, 1] + nz * p[0, 2]
    area = (u1 - u0) * (v2 - v0) - (u2 - u0) * (v1 - v0)
    if distance >= -1e-12 or area == 0.0:  # a back face, or seen edge-on
        return
    gu = nx / fx / distance
    gv = (ny - nx * skew / fx) / fy / distance
    g0 = nz / distance - gu * cx - gv * cy
    sign = 1.0 if area > 0 else -1.0
    e0u, e0v = -(v1 - v0) * sign, (u1 - u0) * sign
    e1u, e1v = -(v2 - v1) * sign, (u2 - u1) * sign
    e2u, e2v = -(v0 - v2) * sign, (u0 - u2) * sign
    for v in range(top, bottom + 1):
        low, high = left_most, right_most
        low, high = _narrow(low, high, e0u, -e0v * (v - v0), u0)
        low, high = _narrow(low, high, e1u, -e1v * (v - v1), u1)
        low, high = _narrow(low, high, e2u, -e2v * (v - v2), u2)
        if low > high:
            continue
        base = gv * v + g0
        for u in range(int(np.ceil(low)), int(np.floor(high)) + 1):
            nearness = np.float32(gu * u + base)
            if owner >= 0 and last_objects[v, u] != owner:
                last_objects[v, u] = owner
                unoccluded[owner] += 1
            if nearness > inverse_depth[v, u]:
                inverse_depth[v, u] = nearness
                triangles[v, u] = t


@njit(nogil=True, error_model="numpy")
def _narrow(low, high, slope, needed, origin):
    """The part of the interval [low, high] where slope * (u - origin) >= needed."""
    if slope > 0:
        return max(low, origin + needed / slope), high
    if slope < 0:
        return low, min(high, origin + needed / slope)
    if needed > 0:
        return 1.0, 0.0
    return low, high


@njit(nogil=True)
def rasterise_heights(corners, shear_x, shear_y, origin_x, origin_y, scale, heights):
    """Draw triangles (T, 3, 3) that face the sun into the heights (S, S) of a `ShadowMap`. scale: texels per metre."""
    size = heights.shape[0]
    q = np.empty((3, 3))
    for t in range(corners.shape[0]):
        for i in range(3):
            z = corners[t, i, 2]
            q[i, 0] = (corners[t, i, 0] + shear_x * z - origin_x) * scale - 0.5
            q[i, 1] = (corners[t, i, 1] + shear_y * z - origin_y) * scale - 0.5
            q[i, 2] = z
        low_u, high_u = min(q[0, 0], q[1, 0], q[2, 0]), max(q[0, 0], q[1, 0], q[2, 0])
        low_v, high_v = min(q[0, 1], q[1, 1], q[2, 1]), max(q[0, 1], q[1, 1], q[2, 1])
        if high_u < 0 or high_v < 0 or low_u > size - 1 or low_v > size - 1:
            continue
        area = (q[1, 0] - q[0, 0]) * (q[2, 1] - q[0, 1]) - (q[2, 0] - q[0, 0]) * (q[1, 1] - q[0, 1])
        if area <= 0:  # faces away from the sun: the side that faces it casts the whole shadow of a closed mesh
            continue
        du = ((q[1, 2] - q[0, 2]) * (q[2, 1] - q[0, 1]) - (q[2, 2] - q[0, 2]) * (q[1, 1] - q[0, 1])) / area
        dv = ((q[2, 2] - q[0, 2]) * (q[1, 0] - q[0, 0]) - (q[1, 2] - q[0, 2]) * (q[2, 0] - q[0, 0])) / area
        for v in range(int(np.ceil(max(low_v, 0.0))), int(np.floor(min(high_v, size - 1.0))) + 1):
            low, high = max(low_u, 0.0), min(high_u, size - 1.0)
            for i in range(3):
                j = (i + 1) % 3
                low, high = _narrow(low, high, -(q[j, 1] - q[i, 1]), -(q[j, 0] - q[i, 0]) * (v - q[i, 1]), q[i, 0])
            base = q[0, 2] + dv * (v - q[0, 1]) - du * q[0, 0]
            for u in range(int(np.ceil(low)), int(np.floor(high)) + 1):
                heights[v, u] = max(heights[v, u], np.float32(base + du * u))


@dataclass(frozen=True)
class ShadowMap:
    """Heights of shadow over a square of the ground, in the world frame.

    A point (x, y, z) is in shadow where the height at (x, y) + z * shear exceeds z.
    """

    heights: NDArray[np.float32]  # (S, S) metres, rows along y; -1 where nothing blocks the sun
    origin: tuple[float, float]  # x and y of the first texel's corner, metres
    texel_m: float  # size of a texel, metres
    shear: tuple[float, float]  # distance in x and y that a shadow moves for each metre of height

    @staticmethod
    def of(
        corners: NDArray[np.float32], to_sun: ArrayLike, center: ArrayLike, extent_m: float, texel_m: float
    ) -> "ShadowMap":
        """The shadows of triangles on a square of `extent_m` metres around a world point.

        corners: (T, 3, 3) world, metres. to_sun: (3,) unit vector. center: (2,) metres; it is rounded to whole texels,
        so that the edges of shadows stay in place while the vehicle moves.
        """
        sun = np.asarray(to_sun, dtype=np.float64)
        shear = (float(-sun[0] / sun[2]), float(-sun[1] / sun[2]))
        size = round(extent_m / texel_m)
        low = np.asarray(center, dtype=np.float64) - extent_m / 2
        origin = (float(np.floor(low[0] / texel_m) * texel_m), float(np.floor(low[1] / texel_m) * texel_m))
        empty = ShadowMap(np.full((size, size), -1.0, np.float32), origin, texel_m, shear)
        return empty.with_shadows_of([corners])

    def with_shadows_of(self, parts: Iterable[NDArray[np.float32]]) -> "ShadowMap":
        """A copy of the map with the shadows of more triangles. parts: arrays (T, 3, 3), world, metres."""
        heights = self.heights.copy()
        for corners in parts:
            rasterise_heights(corners, *self.shear, *self.origin, 1.0 / self.texel_m, heights)
        return replace(self, heights=heights)


@dataclass(frozen=True)
class WorldSnapshot:
    """The world at one time, as the renderer needs it."""

    soup: TriangleSoup  # all triangles around the vehicle
    object_count: int  # O; the annotated objects in the soup are 0 to O - 1
    ground: GroundTexture
    shadows: ShadowMap
    weather: Weather  # light, sky and haze
    pattern: tuple[float, float, float] = (0.0, 1.0, 0.0)  # strength, waves per metre, hardness; not on the ground
    photo: PhotoView | None = None  # photographs over the shaded images


@dataclass(frozen=True)
class RenderedView:
    """The image of one camera, with its ground truth."""

    pixels_bgr: NDArray[np.uint8]  # (H, W, 3) uint8
    objects: NDArray[np.int32]  # (H, W) index of the object that each pixel sees; -1 for none
    visible: NDArray[np.int64]  # (O,) number of pixels that show each object
    unoccluded: NDArray[np.int64]  # (O,) number of pixels that would show each object without occlusion


def render_view(
    snapshot: WorldSnapshot,
    camera: Camera,
    world_from_ego: Array,
    supersampling: int = 1,
    needed: NDArray[np.uint8] | None = None,
) -> RenderedView:
    """Render the image of a camera.

    world_from_ego: (4, 4) at the time of the image. supersampling: samples per pixel along each axis; the image is
    their mean, `visible` and `unoccluded` count whole pixels. The camera's distortion is ignored.
    needed: (H, W) 0 for pixels that may stay black. Default: all are coloured.
    """
    soup = snapshot.soup
    shift = np.array([[1.0, 0, (supersampling - 1) / 2], [0, 1.0, (supersampling - 1) / 2], [0, 0, 1.0]])
    fine = camera.scaled(supersampling)
    fine = replace(fine, intrinsics=shift @ fine.intrinsics)  # each pixel is divided into equal parts
    world_from_camera = world_from_ego @ camera.ego_from_camera
    buffer = rasterise(soup, fine, inverse(world_from_camera), snapshot.object_count)
    wanted = np.ones((camera.height, camera.width), np.uint8) if needed is None else needed
    wanted = wanted.repeat(supersampling, axis=0).repeat(supersampling, axis=1)
    image = shade(snapshot, buffer, fine, world_from_camera, wanted)
    owners = np.repeat(soup.mesh_objects, soup.mesh_ranges[:, 1] - soup.mesh_ranges[:, 0])
    objects = np.append(owners, -1).astype(np.int32)[buffer.triangles]  # triangle -1 is the last entry
    area = supersampling**2
    visible = np.bincount(objects[objects >= 0], minlength=snapshot.object_count)
    if supersampling > 1:
        image = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA).astype(np.uint8)
        objects = np.ascontiguousarray(objects[::supersampling, ::supersampling])
    return RenderedView(image, objects, visible // area, -(-buffer.unoccluded // area))


def render_through_lens(
    snapshot: WorldSnapshot, parts: Sequence[LensPart], world_from_ego: Array, supersampling: int = 1
) -> RenderedView:
    """Render the image of a camera with distortion, as `render_view` does.

    parts: its `lens_parts`. Their images are resampled: linearly for colours, by the nearest pixel for objects. The
    ratio of visible to unoccluded pixels of each object is that of the parts. What no part gives is black.
    """
    views = [render_view(snapshot, part.pinhole, world_from_ego, supersampling, part.needed) for part in parts]
    shape = parts[0].columns.shape
    image, seen = np.zeros((*shape, 3), np.uint8), np.full(shape, -1, np.float32)  # OpenCV resamples no int32
    for view, part in zip(views, parts, strict=True):
        at = (part.columns, part.rows)
        cv2.remap(view.pixels_bgr, *at, cv2.INTER_LINEAR, image, cv2.BORDER_TRANSPARENT)
        cv2.remap(view.objects.astype(np.float32), *at, cv2.INTER_NEAREST, seen, cv2.BORDER_TRANSPARENT)
    objects = seen.astype(np.int32)
    seen_flat = np.sum([view.visible for view in views], axis=0)
    unoccluded_flat = np.sum([view.unoccluded for view in views], axis=0)
    visible = np.bincount(objects[objects >= 0], minlength=len(seen_flat))
    share = np.minimum(seen_flat / np.maximum(unoccluded_flat, 1), 1.0)
    unoccluded = np.where(visible > 0, np.ceil(visible / np.maximum(share, 1e-6)), unoccluded_flat)
    return RenderedView(image, objects, visible, unoccluded.astype(np.int64))


TABLE_SIZE = 4096


def shade(
    snapshot: WorldSnapshot,
    buffer: VisibilityBuffer,
    camera: Camera,
    world_from_camera: Array,
    needed: NDArray[np.uint8],
) -> NDArray[np.uint8]:
    """Colour a visibility buffer. Returns (H, W, 3) uint8 BGR.

    camera: the buffer's camera; its distortion is ignored. world_from_camera: (4, 4). needed: as in `render_view`.
    """
    soup, ground, shadows, w = snapshot.soup, snapshot.ground, snapshot.shadows, snapshot.weather
    ray_from_image = world_from_camera[:3, :3] @ np.linalg.inv(camera.intrinsics)
    image = np.zeros((*buffer.triangles.shape, 3), np.uint8)
    seen = (buffer.triangles, buffer.inverse_depth)
    view = (ray_from_image, np.ascontiguousarray(world_from_camera[:3, 3]), 1.0 / camera.intrinsics[0, 0])
    shade_pixels(
        seen,
        (soup.normals, soup.albedo, soup.material, soup.facade, soup.facades, snapshot.pattern),
        (ground.texels, ground.offsets, ground.rough, *ground.origin, ground.texel_m, ground.size),
        (shadows.heights, *shadows.origin, shadows.texel_m, *shadows.shear, w.kind.shadow_softness_m),
        (w.light, w.to_sun, w.clouds, w.kind.haze_m, w.kind.lamps),
        view,
        _display_table(),
        needed,
        image,
    )
    if snapshot.photo is not None:
        snapshot.photo.retouch(seen, soup, view, _display_table(), needed, image)
    return image


@lru_cache(maxsize=1)
def _display_table() -> NDArray[np.uint8]:
    """(TABLE_SIZE,) sRGB bytes of linear light from 0 to LIGHT_LIMIT. Light above 0.7 is compressed smoothly."""
    light = np.linspace(0, LIGHT_LIMIT, TABLE_SIZE)
    shoulder = 0.7
    rolled = shoulder + (1 - shoulder) * (1 - np.exp(-(light - shoulder) / (1 - shoulder)))
    mapped = np.where(light < shoulder, light, rolled)
    encoded = np.where(mapped <= 0.0031308, 12.92 * mapped, 1.055 * mapped ** (1 / 2.4) - 0.055)
    return np.clip(np.round(encoded * 255), 0, 255).astype(np.uint8)
