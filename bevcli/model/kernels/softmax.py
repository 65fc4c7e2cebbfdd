"""The softmax of a few numbers inside the compiled loops of `bilinear`: the weights of deformable attention."""

import numpy as np

from bevcli.jit import njit

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
