"""Sums of bilinear samples in vector registers, for compiled loops.

The compiler cannot know that the sums and the values do not overlap in memory, so that a loop over channels would load
and store the sums for every sample. Here they stay in registers.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from bevcli.jit import njit

BFLOAT16_BITS = 16


@njit(nogil=True, inline="always")
def sum_samples(values, corners, shares, out, place, depth):  # type: ignore[no-untyped-def]
    """Writes the weighted sums of `depth` successive channels to out[place], out[place + 1] and so on.

    values: (N,) float32, or bfloat16 bits as uint16. corners: (T, 4) int64, where the first channel of a sample's
    corners lies in values. shares: (T, 4) float32, their weights. out: (M,) float32.
    """
    if depth % 32 == 0:
        for channel in range(0, depth, 32):
            _sum_channels(32, values, channel, corners, shares, out, place + channel)
    elif depth % 16 == 0:
        for channel in range(0, depth, 16):
            _sum_channels(16, values, channel, corners, shares, out, place + channel)
    elif depth % 8 == 0:
        for channel in range(0, depth, 8):
            _sum_channels(8, values, channel, corners, shares, out, place + channel)
    else:
        for channel in range(depth):
            _sum_channels(1, values, channel, corners, shares, out, place + channel)


@intrinsic(prefer_literal=True)
def _sum_channels(typing, width, values, channel, corners, shares, out, place):  # type: ignore[no-untyped-def]
    """The sums of `width` channels from `channel` on; arguments as for `sum_samples`. The width is a constant."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = [
            context.make_array(kind)(context, builder, argument) if isinstance(kind, types.Array) else argument
            for kind, argument in zip(signature.args, arguments, strict=True)
        ]
        _, value_array, first, corner_array, share_array, out_array, target = data
        lanes, halves = signature.args[0].literal_value, signature.args[1].dtype == types.uint16
        floats, words = ir.VectorType(ir.FloatType(), lanes), ir.VectorType(ir.IntType(32), lanes)
        stored = ir.VectorType(ir.IntType(16), lanes) if halves else floats
        undefined, everywhere = ir.Constant(floats, ir.Undefined), ir.Constant(words, None)

        total = cgutils.alloca_once_value(builder, ir.Constant(floats, None))  # becomes a register
        start = builder.gep(value_array.data, [first])
        corner_count = builder.mul(builder.extract_value(corner_array.shape, 0), first.type(4))
        with cgutils.for_range(builder, corner_count) as loop:
            corner = builder.load(builder.gep(corner_array.data, [loop.index]))
            pointer = builder.bitcast(builder.gep(start, [corner]), stored.as_pointer())
            read = builder.load(pointer, align=2 if halves else 4)
            if halves:
                shift = ir.Constant(words, [BFLOAT16_BITS] * lanes)
                read = builder.bitcast(builder.shl(builder.zext(read, words), shift), floats)
            share = builder.load(builder.gep(share_array.data, [loop.index]))
            share = builder.insert_element(undefined, share, ir.IntType(32)(0))
            product = builder.fmul(read, builder.shuffle_vector(share, undefined, everywhere), flags=("contract",))
            builder.store(builder.fadd(builder.load(total), product, flags=("contract",)), total)
        pointer = builder.bitcast(builder.gep(out_array.data, [target]), floats.as_pointer())
        builder.store(builder.load(total), pointer, align=4)
        return context.get_dummy_value()

    return types.void(width, values, channel, corners, shares, out, place), generate
