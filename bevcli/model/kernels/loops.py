"""Compiled loops: bilinear sampling, weighted sums of samples, which they do not store, softmax, max-pooling.

The functions take arrays and no Python objects. Several threads may run one on disjoint ranges of queries or rows.
The compiled code is cached on disk (in NUMBA_CACHE_DIR, next to this file, or in the user's cache folder).

The sums of bilinear samples stay in vector registers. The compiler cannot know that the sums and the values do not
overlap in memory, so that a loop over channels would load and store the sums for every sample. Hence the LLVM code:
6,000 hits of 8 heads, 8 samples and 32 channels take 8 ms, and 47 ms by such a loop of numba (Intel Xeon, one thread).
"""

from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from bevcli.jit import njit

BFLOAT16_BITS = 16


@njit(nogil=True, inline="always")
def sum_samples(values, first, step, cells, shares, begin, end, out, first_sum, depth):  # type: ignore[no-untyped-def]
    """Writes the weighted sums of `depth` successive channels to out[first_sum], out[first_sum + 1] and so on.

    values: (N,) float32, or bfloat16 bits as uint16. first: index of the first channel in cell 0. step: from a cell to
    the next. cells (int32), shares: (4, T), the corners of all samples and their weights; samples begin to end - 1 are
    summed. out: (M,) float32, or bfloat16 bits as uint16.
    """
    if depth % 32 == 0:
        for c in range(0, depth, 32):
            _sum_channels(32, values, first + c, step, cells, shares, begin, end, out, first_sum + c)
    elif depth % 16 == 0:
        for c in range(0, depth, 16):
            _sum_channels(16, values, first + c, step, cells, shares, begin, end, out, first_sum + c)
    elif depth % 8 == 0:
        for c in range(0, depth, 8):
            _sum_channels(8, values, first + c, step, cells, shares, begin, end, out, first_sum + c)
    else:
        for c in range(depth):
            _sum_channels(1, values, first + c, step, cells, shares, begin, end, out, first_sum + c)


@intrinsic(prefer_literal=True)
def _sum_channels(typing, width, values, first, step, cells, shares, begin, end, out, first_sum):  # type: ignore[no-untyped-def]
    """The sums of `width` channels from `first` on; arguments as for `sum_samples`. The width is a constant."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = [
            context.make_array(type_)(context, builder, argument) if isinstance(type_, types.Array) else argument
            for type_, argument in zip(signature.args, arguments, strict=True)
        ]
        _, value_array, start, cell_step, cell_array, share_array, first_sample, last_sample, out_array, target = data
        lanes, halves = signature.args[0].literal_value, signature.args[1].dtype == types.uint16
        rounds = signature.args[8].dtype == types.uint16
        floats, words = ir.VectorType(ir.FloatType(), lanes), ir.VectorType(ir.IntType(32), lanes)
        stored = ir.VectorType(ir.IntType(16), lanes) if halves else floats
        undefined, everywhere = ir.Constant(floats, ir.Undefined), ir.Constant(words, None)

        total = cgutils.alloca_once_value(builder, ir.Constant(floats, None))  # becomes a register
        origin = builder.gep(value_array.data, [start])
        samples = builder.extract_value(cell_array.shape, 1)
        with cgutils.for_range(builder, last_sample, start=first_sample) as loop:
            for corner in range(4):
                index = builder.add(loop.index, builder.mul(samples, samples.type(corner)))
                cell = builder.sext(builder.load(builder.gep(cell_array.data, [index])), ir.IntType(64))
                pointer = builder.bitcast(builder.gep(origin, [builder.mul(cell, cell_step)]), stored.as_pointer())
                read = builder.load(pointer, align=2 if halves else 4)
                if halves:
                    shift = ir.Constant(words, [BFLOAT16_BITS] * lanes)
                    read = builder.bitcast(builder.shl(builder.zext(read, words), shift), floats)
                share = builder.load(builder.gep(share_array.data, [index]))
                share = builder.insert_element(undefined, share, ir.IntType(32)(0))
                product = builder.fmul(read, builder.shuffle_vector(share, undefined, everywhere), flags=("contract",))
                builder.store(builder.fadd(builder.load(total), product, flags=("contract",)), total)
        result = builder.load(total)
        if rounds:  # to the nearest bfloat16
            half, shift = (ir.Constant(words, [number] * lanes) for number in (0x8000, BFLOAT16_BITS))
            bits = builder.lshr(builder.add(builder.bitcast(result, words), half), shift)
            result = builder.trunc(bits, ir.VectorType(ir.IntType(16), lanes))
        pointer = builder.bitcast(builder.gep(out_array.data, [target]), result.type.as_pointer())
        builder.store(result, pointer, align=2 if rounds else 4)
        return context.get_dummy_value()

    return types.void(width, values, first, step, cells, shares, begin, end, out, first_sum), generate


@njit(nogil=True, error_model="numpy", fastmath={"contract"}, inline="never")
def _find_corners(places, weights, maps, cells, shares):  # type: ignore[no-untyped-def]
    """Writes the four cells around each sample, and their weights, to cells and shares (4, T).

    places: (2, T) float32, x and y in cells, 0 at the centre of the first. weights: (T,) float32. maps: (3, T) float32,
    width, height and first cell. A neighbour outside the map has weight zero, and its index is replaced by one inside.

    Without branches and in float32, which holds all indices exactly, so that several samples are computed at once.
    """
    one, zero = np.float32(1), np.float32(0)
    for sample in range(len(weights)):
        width, height = maps[0, sample], maps[1, sample]
        x, y = places[0, sample], places[1, sample]
        # NaN counts as outside. A location outside gets weight zero, and the first cell is read for it.
        inside = (x > -one) & (x < width) & (y > -one) & (y < height)
        x, y = x if inside else zero, y if inside else zero
        weight = weights[sample] if inside else zero
        left, top = np.floor(x), np.floor(y)
        right, bottom = left + one, top + one
        right_share, bottom_share = x - left, y - top
        left_share, top_share = one - right_share, one - bottom_share
        left_share, left = (zero, zero) if left < zero else (left_share, left)
        top_share, top = (zero, zero) if top < zero else (top_share, top)
        right_share, right = (zero, width - one) if right >= width else (right_share, right)
        bottom_share, bottom = (zero, height - one) if bottom >= height else (bottom_share, bottom)
        upper, lower = maps[2, sample] + top * width, maps[2, sample] + bottom * width
        cells[0, sample], cells[1, sample] = np.int32(upper + left), np.int32(upper + right)
        cells[2, sample], cells[3, sample] = np.int32(lower + left), np.int32(lower + right)
        shares[0, sample] = weight * (top_share * left_share)
        shares[1, sample] = weight * (top_share * right_share)
        shares[2, sample] = weight * (bottom_share * left_share)
        shares[3, sample] = weight * (bottom_share * right_share)


@njit(nogil=True, error_model="numpy", fastmath={"contract"})
def sample_maps(values, level_shapes, locations, weights, map_of_query, out, begin, end) -> None:  # type: ignore[no-untyped-def]
    """Writes the weighted sums of queries begin to end - 1 to out (M, heads, D) float32.

    values: (G, S, heads, D) float32 or bfloat16 bits; S less than 2^24. level_shapes: (L, 2) int64 height, width.
    locations: (M, heads, L, P, 2) float32, x and y, 0 to 1. weights: (M, heads, L, P) float32.
    map_of_query: (M,) int64, which of the G maps a query samples. Values outside a map are zero.

    The corners of all samples of a query are computed before any is read, so that the reads overlap.
    """
    heads, levels, points = weights.shape[1:]
    flat_locations, flat_weights = locations.reshape(len(locations), -1, 2), weights.reshape(len(weights), -1)
    maps, samples, half = _maps_of_samples(level_shapes, heads, points), levels * points, np.float32(0.5)
    places, cells, shares = _room_for(heads * samples)
    for query in range(begin, end):
        for sample in range(heads * samples):
            places[0, sample] = flat_locations[query, sample, 0] * maps[0, sample] - half
            places[1, sample] = flat_locations[query, sample, 1] * maps[1, sample] - half
        _find_corners(places, flat_weights[query], maps, cells, shares)
        _sum_heads(values, map_of_query[query], cells, shares, samples, out, query)


@njit(nogil=True, error_model="numpy", fastmath={"contract"})
def sample_hits(values, level_shapes, points, offsets, logits, query, prediction, map_of_hit, out, begin, end) -> None:  # type: ignore[no-untyped-def]
    """As `sample_maps` for hits begin to end - 1, whose samples lie around reference points.

    points: (M, Z, 2) float32, x and y, 0 to 1; sample p lies around point p mod Z. offsets: (B·Q, heads, maps, L, P, 2)
    float32, in cells of a level. logits: (B·Q, heads, maps, L, P) float32; the weights are their softmax over levels
    and points. query, prediction (an index in the axis "maps"), map_of_hit: (M,) int64.
    """
    heads, predictions, levels, count = logits.shape[1:]
    samples, half, heights = levels * count, np.float32(0.5), points.shape[1]
    flat_offsets = offsets.reshape(len(offsets), heads, predictions, samples, 2)
    flat_logits = logits.reshape(len(logits), heads, predictions, samples)
    maps = _maps_of_samples(level_shapes, heads, count)
    places, cells, shares = _room_for(heads * samples)
    weights, powers = np.empty(heads * samples, np.float32), np.empty(heads * samples, np.int32)
    for hit in range(begin, end):
        for head in range(heads):
            moved = flat_offsets[query[hit], head, prediction[hit]]
            predicted = flat_logits[query[hit], head, prediction[hit]]
            for first in range(0, samples, heights):
                for height in range(heights):
                    read, sample = first + height, head * samples + first + height
                    x = points[hit, height, 0] + moved[read, 0] / maps[0, sample]
                    y = points[hit, height, 1] + moved[read, 1] / maps[1, sample]
                    places[0, sample] = x * maps[0, sample] - half
                    places[1, sample] = y * maps[1, sample] - half
                    weights[sample] = predicted[read]
        softmax_of_groups(weights, samples, powers)
        _find_corners(places, weights, maps, cells, shares)
        _sum_heads(values, map_of_hit[hit], cells, shares, samples, out, hit)


@njit(nogil=True)
def _room_for(samples):  # type: ignore[no-untyped-def]
    """Places (2, T), cells (4, T) and shares (4, T) of `_find_corners`."""
    return np.empty((2, samples), np.float32), np.empty((4, samples), np.int32), np.empty((4, samples), np.float32)


@njit(nogil=True)
def _maps_of_samples(level_shapes, heads, points):  # type: ignore[no-untyped-def]
    """(3, heads · L · P) float32: width, height and first cell of the level of each sample of a query."""
    maps = np.empty((3, heads * len(level_shapes) * points), np.float32)
    for sample in range(maps.shape[1]):
        level = sample // points % len(level_shapes)
        maps[0, sample], maps[1, sample] = level_shapes[level, 1], level_shapes[level, 0]
        maps[2, sample] = (level_shapes[:level, 0] * level_shapes[:level, 1]).sum()
    return maps


@njit(nogil=True, inline="always")
def _sum_heads(values, chosen_map, cells, shares, samples, out, query):  # type: ignore[no-untyped-def]
    """Writes the weighted sums of a query, whose samples (`samples` a head) have these corners, to out[query]."""
    heads, depth = values.shape[2:]
    flat, sums, step = values.reshape(-1), out.reshape(-1), heads * depth
    start = chosen_map * values.shape[1] * step
    for head in range(heads):
        channel, first = head * depth, head * samples
        first_sum = query * step + channel
        sum_samples(flat, start + channel, step, cells, shares, first, first + samples, sums, first_sum, depth)


@njit(nogil=True, error_model="numpy", fastmath={"contract"})
def sample_taps(x, offsets, mask, stride, first, out, begin, end) -> None:  # type: ignore[no-untyped-def]
    """Samples and masks the nine taps of output positions first + begin to first + end - 1.

    x: (B, H, W, C) float32 or bfloat16 bits. offsets: (B, H', W', 9, 2) float32, dy and dx in cells, taps row by row.
    mask: (B, H', W', 9) float32. Positions count through B, H', W'. out: (rows, 9, C) in the dtype of x; row `begin`
    takes position first + begin.
    """
    _, height, width, channels = x.shape
    _, out_height, out_width, taps = mask.shape
    flat, sums = x.reshape(-1), out.reshape(-1)
    maps = np.zeros((3, taps), np.float32)
    maps[0], maps[1] = width, height
    places, cells, shares = _room_for(taps)
    for row in range(begin, end):
        position = first + row
        image = position // (out_height * out_width)
        line = position // out_width % out_height
        column = position % out_width
        for tap in range(taps):
            places[0, tap] = np.float32(column * stride - 1 + tap % 3) + offsets[image, line, column, tap, 1]
            places[1, tap] = np.float32(line * stride - 1 + tap // 3) + offsets[image, line, column, tap, 0]
        _find_corners(places, mask[image, line, column], maps, cells, shares)
        start, target = image * height * width * channels, row * taps * channels
        for tap in range(taps):
            sum_samples(flat, start, channels, cells, shares, tap, tap + 1, sums, target + tap * channels, channels)


@njit(nogil=True)
def max_of_windows(values, out, begin, end):  # type: ignore[no-untyped-def]
    """Writes rows begin to end - 1 of the maxima of 3 x 3 windows at every second place, or 0 where they are negative.

    PyTorch's max-pooling takes six times as long in bfloat16.

    values: (B, H, W, C) signed integers. out: (B, H', W', C), H' and W' half of H and W, rounded up; its rows are those
    of all B images, one after another.
    """
    _, height, width, channels = values.shape
    rows, columns = out.shape[1:3]
    for row in range(begin, end):
        image, y = row // rows, 2 * (row % rows)
        for column in range(columns):
            x, largest = 2 * column, out[image, y // 2, column]
            for c in range(channels):
                largest[c] = 0
            for v in range(max(y - 1, 0), min(y + 2, height)):
                for u in range(max(x - 1, 0), min(x + 2, width)):
                    read = values[image, v, u]
                    for c in range(channels):
                        largest[c] = max(largest[c], read[c])


LOG2_E = np.float32(1.44269504)
# The logarithm of 2 as the sum of a number with few bits, whose products are exact, and a small one.
LN_2, LN_2_REST = np.float32(0.693359375), np.float32(-2.12194440e-4)
SMALLEST = np.float32(-87.0)  # its exponential is just a normal number
EXPONENT_BIAS, MANTISSA_BITS = np.int32(127), np.int32(23)


@njit(nogil=True, inline="always")
def softmax_of_groups(numbers, count, powers):  # type: ignore[no-untyped-def]
    """Replaces every `count` successive logits (K,) float32 by their softmax, in place. A group with NaN becomes NaN.

    powers: (K,) int32, room for intermediate results.
    """
    # The loops over a constant count need no branches. These are the counts of the published models.
    if count == 4:
        _softmax(numbers, 4, powers)
    elif count == 8:
        _softmax(numbers, 8, powers)
    elif count == 32:
        _softmax(numbers, 32, powers)
    else:
        _softmax(numbers, count, powers)


@njit(nogil=True, inline="always")
def _softmax(numbers, count, powers):  # type: ignore[no-untyped-def]
    """As `softmax_of_groups`."""
    _subtract_largest(numbers, count)
    _exponentials(numbers, powers)
    _divide_by_sums(numbers, count)


@njit(nogil=True, fastmath={"contract", "reassoc", "nsz"}, inline="always")
def _subtract_largest(numbers, count):  # type: ignore[no-untyped-def]
    """Subtracts from each group its largest number, in place."""
    for first in range(0, len(numbers), count):
        largest = numbers[first]
        for i in range(first + 1, first + count):
            largest = max(largest, numbers[i])
        for i in range(first, first + count):
            numbers[i] -= largest


@njit(nogil=True, fastmath={"contract"}, inline="never")
def _exponentials(numbers, powers):  # type: ignore[no-untyped-def]
    """Replaces numbers by their exponentials: a power of 2 times that of a small rest, by its Taylor series."""
    half, one = np.float32(0.5), np.float32(1)
    for i in range(len(numbers)):
        x = SMALLEST if numbers[i] < SMALLEST else numbers[i]  # NaN stays
        power = np.floor(x * LOG2_E + half)
        rest = x - power * LN_2 - power * LN_2_REST  # -0.35 to 0.35
        series = np.float32(1 / 5040)
        for divisor in (720.0, 120.0, 24.0, 6.0, 2.0):
            series = series * rest + np.float32(1 / divisor)
        numbers[i] = (series * rest + one) * rest + one
        powers[i] = (np.int32(power) + EXPONENT_BIAS) << MANTISSA_BITS
    factors = powers.view(np.float32)
    for i in range(len(numbers)):
        numbers[i] *= factors[i]


@njit(nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz"}, inline="always")
def _divide_by_sums(numbers, count):  # type: ignore[no-untyped-def]
    """Divides each group of numbers by its sum, in place."""
    for first in range(0, len(numbers), count):
        total = np.float32(0)
        for i in range(first, first + count):
            total += numbers[i]
        share = np.float32(1) / total
        for i in range(first, first + count):
            numbers[i] *= share
