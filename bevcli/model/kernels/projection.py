"""A compiled loop for the pillars that a camera sees, with the arithmetic of `pillar_projection.project_pillars`."""

import numpy as np

from bevcli.jit import njit


@njit(nogil=True, error_model="numpy")
def find_hits(images_from_bev, points, has_image, image_size, min_depth, cells, reference_points, counts, begin, end):  # type: ignore[no-untyped-def]
    """Writes the cells that cameras begin to end - 1 see, and the points of their pillars, in the order of the cells.

    images_from_bev: (G, 4, 4) float32. points: (Y·X, Z, 3) float32. has_image: (G,) bool. image_size: (2,) float32
    height, width. cells: (G, Y·X) int64. reference_points: (G, Y·X, Z, 2) float32. counts: (G,) int64, of the hits.
    """
    zero, one, height, width = np.float32(0), np.float32(1), image_size[0], image_size[1]
    for camera in range(begin, end):
        matrix, count = images_from_bev[camera], 0
        for cell in range(len(points) if has_image[camera] else 0):
            is_seen = False
            for point in range(points.shape[1]):
                x, y, z = points[cell, point, 0], points[cell, point, 1], points[cell, point, 2]
                u = matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z + matrix[0, 3]
                v = matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z + matrix[1, 3]
                depth = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z + matrix[2, 3]
                divisor = max(depth, min_depth)
                column, row = u / divisor / width, v / divisor / height
                reference_points[camera, count, point, 0], reference_points[camera, count, point, 1] = column, row
                inside = (column > zero) & (column < one) & (row > zero) & (row < one)
                is_seen |= inside & (depth > min_depth)
            if is_seen:
                cells[camera, count] = cell
                count += 1
        counts[camera] = count
