"""The kernels of the rasteriser: triangles into a visibility buffer, and into a shadow map."""

# mypy: disable-error-code="no-untyped-def"
# numba takes the arguments' types from the first call.

from __future__ import annotations

import numpy as np
from numba import njit

NEAR_M = 0.1  # triangles are cut where they come nearer to the camera's plane


@njit(cache=True, nogil=True)
def rasterise_runs(corners, normals, runs, run_objects, run_spheres, camera_from_world, pinhole, eye,
                    triangles, inverse_depth, stamps, unoccluded):  # fmt: skip
    """Draw runs of triangles, each hidden run as a whole left out; see `rasteriser.rasterise`."""
    height, width = triangles.shape
    slope_x = max(pinhole[2], width - pinhole[2]) / pinhole[0] + abs(pinhole[1] / pinhole[0])
    slope_y = max(pinhole[4], height - pinhole[4]) / pinhole[3]
    reach_x, reach_y = np.sqrt(1 + slope_x**2), np.sqrt(1 + slope_y**2)
    p = np.empty((3, 3))
    cut = np.empty((4, 3))
    center = np.empty(3)
    for run in range(runs.shape[0]):
        radius = run_spheres[run, 3]
        for axis in range(3):
            row = camera_from_world[axis]
            center[axis] = (
                row[0] * run_spheres[run, 0] + row[1] * run_spheres[run, 1] + row[2] * run_spheres[run, 2] + row[3]
            )
        if center[2] + radius < NEAR_M:
            continue
        if abs(center[0]) > slope_x * center[2] + radius * reach_x:
            continue
        if abs(center[1]) > slope_y * center[2] + radius * reach_y:
            continue
        if center[2] - radius > NEAR_M and _is_hidden(center, radius, pinhole, inverse_depth):
            continue  # it shows nothing, so that its unoccluded pixels need not be counted either
        owner = run_objects[run]
        for t in range(runs[run, 0], runs[run, 1]):
            facing = (
                normals[t, 0] * (corners[t, 0, 0] - eye[0])
                + normals[t, 1] * (corners[t, 0, 1] - eye[1])
                + normals[t, 2] * (corners[t, 0, 2] - eye[2])
            )
            if facing > 1e-3:  # seen from behind
                continue
            for i in range(3):
                for axis in range(3):
                    row = camera_from_world[axis]
                    p[i, axis] = (
                        row[0] * corners[t, i, 0] + row[1] * corners[t, i, 1] + row[2] * corners[t, i, 2] + row[3]
                    )
            if p[0, 2] < NEAR_M and p[1, 2] < NEAR_M and p[2, 2] < NEAR_M:
                continue
            _draw_triangle(p, cut, t, owner, pinhole, triangles, inverse_depth, stamps, unoccluded)


@njit(cache=True, nogil=True, error_model="numpy")
def _is_hidden(center, radius, pinhole, inverse_depth):
    """Whether everything that the sphere's image may cover is nearer than the sphere already."""
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


@njit(cache=True, nogil=True)
def _draw_triangle(p, cut, t, owner, pinhole, triangles, inverse_depth, stamps, unoccluded):
    """One triangle p (3, 3) in the camera frame, cut at the near plane where it must be."""
    if p[0, 2] >= NEAR_M and p[1, 2] >= NEAR_M and p[2, 2] >= NEAR_M:
        _fill(p, p, 0, 1, 2, pinhole, t, owner, triangles, inverse_depth, stamps, unoccluded)
        return
    count = 0
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
        _fill(p, cut, 0, i, i + 1, pinhole, t, owner, triangles, inverse_depth, stamps, unoccluded)


@njit(cache=True, nogil=True, error_model="numpy")
def _fill(p, q, a, b, c, pinhole, t, owner, triangles, inverse_depth, stamps, unoccluded):
    """Scan the rows of the image that points a, b, c of q span; each edge bounds the columns of a row.

    p: (3, 3) the whole triangle in the camera frame. 1 / z is affine over the image, so its plane gives it exactly.
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
    if distance >= -1e-12 or area == 0.0:  # seen from behind or edge-on
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
            if owner >= 0 and stamps[v, u] != owner:
                stamps[v, u] = owner
                unoccluded[owner] += 1
            if nearness > inverse_depth[v, u]:
                inverse_depth[v, u] = nearness
                triangles[v, u] = t


@njit(cache=True, nogil=True, inline="always")
def _narrow(low, high, slope, needed, origin):
    """The part of [low, high] where slope * (u - origin) >= needed."""
    if slope > 0:
        return max(low, origin + needed / slope), high
    if slope < 0:
        return low, min(high, origin + needed / slope)
    if needed > 0:
        return 1.0, 0.0
    return low, high


@njit(cache=True, nogil=True)
def rasterise_heights(corners, shear_x, shear_y, origin_x, origin_y, scale, heights):
    """Draw triangles that face the light into a map of heights; see `rasteriser.heights_from_sun`."""
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
        if area <= 0:  # for a closed mesh the side towards the sun is enough
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
