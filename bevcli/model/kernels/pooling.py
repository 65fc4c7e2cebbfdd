"""A compiled loop for the max-pooling of a backbone's stem; PyTorch's takes six times as long in bfloat16."""

from bevcli.jit import njit


@njit(nogil=True)
def max_of_windows(values, out, begin, end):  # type: ignore[no-untyped-def]
    """Writes rows begin to end - 1 of the maxima of 3 x 3 windows at every second place, or 0 where they are negative.

    values: (B, H, W, C) signed integers. out: (B, H', W', C), H' and W' half of H and W, rounded up; its rows are those
    of all B images, one after another.
    """
    _, height, width, channels = values.shape
    rows, columns = out.shape[1:3]
    for row in range(begin, end):
        image, y = row // rows, 2 * (row % rows)
        for column in range(columns):
            x, found = 2 * column, out[image, y // 2, column]
            for c in range(channels):
                found[c] = 0
            for v in range(max(y - 1, 0), min(y + 2, height)):
                for u in range(max(x - 1, 0), min(x + 2, width)):
                    read = values[image, v, u]
                    for c in range(channels):
                        found[c] = max(found[c], read[c])
