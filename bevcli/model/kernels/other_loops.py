"""Compiled loops that inference on a CPU does not need: gradients of sampling, and the hits of pillars for a GPU.

See `bevcli.model.kernels.loops` for what the functions take.
"""

import numpy as np

from bevcli.jit import njit


@njit(nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
def sample_maps_backward(  # type: ignore[no-untyped-def]
    values, level_shapes, locations, weights, starts, out_gradient,
    values_gradient, locations_gradient, weights_gradient, begin, end,
) -> None:  # fmt: skip
    """The gradients of `loops.sample_maps`, for units begin to end - 1; a unit is map * heads + head.

    Threads get ranges of units, not of queries, because no two units write to the same element. All arrays are
    float32, and each gradient has the shape of what it belongs to; values_gradient is added to. starts: (G + 1,) int64,
    index of each map's first query.
    """
    heads, levels, points = weights.shape[1:]
    depth = values.shape[3]
    nothing = np.zeros(depth, dtype=np.float32)
    unused = np.empty(depth, dtype=np.float32)
    one, half = np.float32(1), np.float32(0.5)
    for unit in range(begin, end):
        group, head = unit // heads, unit % heads
        tokens, tokens_gradient = values[group], values_gradient[group]
        for query in range(starts[group], starts[group + 1]):
            above = out_gradient[query, head]
            start = 0
            for level in range(levels):
                height, width = level_shapes[level]
                for point in range(points):
                    locations_gradient[query, head, level, point, :] = 0
                    weights_gradient[query, head, level, point] = 0
                    x = locations[query, head, level, point, 0] * np.float32(width) - half
                    y = locations[query, head, level, point, 1] * np.float32(height) - half
                    if not (x > -1 and x < width and y > -1 and y < height):
                        continue
                    left, top = np.int64(np.floor(x)), np.int64(np.floor(y))
                    right_share, bottom_share = x - np.float32(left), y - np.float32(top)
                    left_share, top_share = one - right_share, one - bottom_share
                    first = start + top * width + left
                    at_left, at_right, at_top, at_bottom = left >= 0, left + 1 < width, top >= 0, top + 1 < height
                    # Outside the map zeros are read, and what is written is not used.
                    a = tokens[first, head] if at_top and at_left else nothing
                    b = tokens[first + 1, head] if at_top and at_right else nothing
                    c = tokens[first + width, head] if at_bottom and at_left else nothing
                    d = tokens[first + width + 1, head] if at_bottom and at_right else nothing
                    to_a = tokens_gradient[first, head] if at_top and at_left else unused
                    to_b = tokens_gradient[first + 1, head] if at_top and at_right else unused
                    to_c = tokens_gradient[first + width, head] if at_bottom and at_left else unused
                    to_d = tokens_gradient[first + width + 1, head] if at_bottom and at_right else unused
                    weight = weights[query, head, level, point]
                    share_a, share_b = top_share * left_share, top_share * right_share
                    share_c, share_d = bottom_share * left_share, bottom_share * right_share
                    sum_a = sum_b = sum_c = sum_d = np.float32(0)
                    for channel in range(depth):
                        arriving = above[channel]
                        sum_a += arriving * a[channel]
                        sum_b += arriving * b[channel]
                        sum_c += arriving * c[channel]
                        sum_d += arriving * d[channel]
                    for channel in range(depth):
                        arriving = weight * above[channel]
                        to_a[channel] += arriving * share_a
                        to_b[channel] += arriving * share_b
                        to_c[channel] += arriving * share_c
                        to_d[channel] += arriving * share_d
                    weights_gradient[query, head, level, point] = (
                        share_a * sum_a + share_b * sum_b + share_c * sum_c + share_d * sum_d
                    )
                    along_x = top_share * (sum_b - sum_a) + bottom_share * (sum_d - sum_c)
                    along_y = left_share * (sum_c - sum_a) + right_share * (sum_d - sum_b)
                    locations_gradient[query, head, level, point, 0] = weight * along_x * np.float32(width)
                    locations_gradient[query, head, level, point, 1] = weight * along_y * np.float32(height)
                start += height * width


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
