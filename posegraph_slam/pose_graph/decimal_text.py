"""Decimal numbers to doubles, correctly rounded, fast: the algorithm of Eisel and Lemire (Lemire 2021) in numba.

A number w 10^q with a 64-bit w is multiplied by a 128-bit approximation of 5^q; the product decides the rounding but in
cases that are left to the caller, who parses them slowly. Numbers of more than 19 digits are taken when the first 19
digits and their successor round alike.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import numpy.typing as npt

from posegraph_slam.arrays import IntArray
from posegraph_slam.jit import kernel

UIntArray = npt.NDArray[np.uint64]
Bytes = npt.NDArray[np.uint8]

LEAST_POWER, LARGEST_POWER = -342, 308
ZERO, ONE, THREE = np.uint64(0), np.uint64(1), np.uint64(3)
TEN, S32, LOW32 = np.uint64(10), np.uint64(32), np.uint64(0xFFFFFFFF)
ALL, PRECISION = np.uint64(0xFFFFFFFFFFFFFFFF), np.uint64(0x1FF)
HIDDEN, S9, S52, S63 = np.uint64(1 << 52), np.uint64(9), np.uint64(52), np.uint64(63)
DIGITS = 19
SPACE, TAB, LINE, RETURN = 32, 9, 10, 13
PLUS, MINUS, POINT, DIGIT0, DIGIT9, SMALL_E, LARGE_E, HASH = 43, 45, 46, 48, 57, 101, 69, 35
OK, ODD = 0, 1
"""States of a parse: done, or something that is left to the slow path."""


@cache
def powers_of_five() -> tuple[UIntArray, UIntArray]:
    """Return the upper and lower 64 bits of 5^q, scaled to 128 bits, for q from -342 to 308."""
    values = []
    for q in range(LEAST_POWER, LARGEST_POWER + 1):
        power = 5 ** abs(q)
        if q >= 0:
            shift = power.bit_length() - 128
            value = power >> shift if shift > 0 else power << -shift
        else:
            z = (power - 1).bit_length()
            value = 2 ** (z + 127 if q >= -27 else 2 * z + 128) // power + 1
            value >>= max(value.bit_length() - 128, 0)
        values.append(value)
    upper = np.array([v >> 64 for v in values], dtype=np.uint64)
    return upper, np.array([v & (2**64 - 1) for v in values], dtype=np.uint64)


@kernel
def _product(a: np.uint64, b: np.uint64) -> tuple[np.uint64, np.uint64]:
    """Return the upper and lower half of a b."""
    a1, a0, b1, b0 = a >> S32, a & LOW32, b >> S32, b & LOW32
    low, mid, other = a0 * b0, a1 * b0, a0 * b1
    carry = (low >> S32) + (mid & LOW32) + (other & LOW32)
    return a1 * b1 + (mid >> S32) + (other >> S32) + (carry >> S32), (carry << S32) | (low & LOW32)


@kernel
def _bits(w: np.uint64, q: int, upper5: UIntArray, lower5: UIntArray) -> tuple[int, np.uint64]:
    """Return state and bits of the double nearest to w 10^q."""
    if w == ZERO:
        return OK, ZERO
    if q < LEAST_POWER or q > LARGEST_POWER:
        return ODD, ZERO
    zeros = 0
    while w >> S63 == ZERO:
        w = w << ONE
        zeros += 1
    index = q - LEAST_POWER
    high, low = _product(w, upper5[index])
    if high & PRECISION == PRECISION:
        extra, _ = _product(w, lower5[index])
        low = low + extra
        if low < extra:
            high = high + ONE
        if low == ALL and (q < -27 or q > 55):
            return ODD, ZERO
    top = high >> S63
    shift = top + S9
    mantissa = high >> shift
    power = ((217706 * q) >> 16) + 63 + np.int64(top) - zeros + 1023
    if power <= 0:
        return ODD, ZERO
    if low <= ONE and q >= -4 and q <= 23 and mantissa & THREE == ONE and mantissa << shift == high:
        mantissa = mantissa & (ALL ^ ONE)
    mantissa = (mantissa + (mantissa & ONE)) >> ONE
    if mantissa >= HIDDEN << ONE:
        mantissa = HIDDEN
        power += 1
    if power >= 2047:
        return ODD, ZERO
    return OK, (mantissa & (HIDDEN - ONE)) | (np.uint64(power) << S52)


@kernel
def _number(data: Bytes, at: int, upper5: UIntArray, lower5: UIntArray) -> tuple[int, int, np.uint64]:
    """Parse the number at `at`; return state, the place behind it, and its bits."""
    size, negative = len(data), False
    if at < size and (data[at] == MINUS or data[at] == PLUS):
        negative = data[at] == MINUS
        at += 1
    w, digits, dropped, seen, scale, behind, more = ZERO, 0, 0, 0, 0, False, False
    while at < size:
        byte = data[at]
        if byte >= DIGIT0 and byte <= DIGIT9:
            seen += 1
            if digits < DIGITS:
                w = w * TEN + np.uint64(byte - DIGIT0)
                if w != ZERO:
                    digits += 1
                if behind:
                    scale -= 1
            else:
                dropped += 1
                more = more or byte != DIGIT0
                if not behind:
                    scale += 1
        elif byte == POINT and not behind:
            behind = True
        else:
            break
        at += 1
    if seen == 0:
        return ODD, at, ZERO
    if at < size and (data[at] == SMALL_E or data[at] == LARGE_E):
        at += 1
        below = at < size and data[at] == MINUS
        if at < size and (data[at] == MINUS or data[at] == PLUS):
            at += 1
        exponent, first = 0, at
        while at < size and data[at] >= DIGIT0 and data[at] <= DIGIT9 and at - first < 5:
            exponent = exponent * 10 + int(data[at]) - DIGIT0
            at += 1
        if at == first:
            return ODD, at, ZERO
        scale += -exponent if below else exponent
    if at < size and data[at] > SPACE:
        return ODD, at, ZERO
    state, bits = _bits(w, scale, upper5, lower5)
    if more and state == OK:
        state, above = _bits(w + ONE, scale, upper5, lower5)
        if above != bits:
            state = ODD
    return state, at, bits | (ONE << S63) if negative else bits


@kernel
def _blank(byte: int) -> bool:
    return byte in (SPACE, TAB, RETURN)


@kernel
def _tag_at(data: Bytes, at: int, tags: Bytes, tag_start: IntArray) -> int:
    """Return which tag stands at a place, -1 for none."""
    for tag in range(len(tag_start) - 1):
        length = tag_start[tag + 1] - tag_start[tag]
        if at + length > len(data) or (at + length < len(data) and data[at + length] > SPACE):
            continue
        same = True
        for k in range(length):
            if data[at + k] != tags[tag_start[tag] + k]:
                same = False
                break
        if same:
            return tag
    return -1


@kernel
def count_tags(data: Bytes, tags: Bytes, tag_start: IntArray) -> tuple[int, IntArray]:
    """Return the number of lines that cannot be told, and how many lines (T,) begin with each tag."""
    counts, odd, at, size = np.zeros(len(tag_start) - 1, np.int64), 0, 0, len(data)
    while at < size:
        while at < size and _blank(data[at]):
            at += 1
        if at < size and data[at] != LINE and data[at] != HASH:
            tag = _tag_at(data, at, tags, tag_start)
            if tag < 0:
                odd += 1
            else:
                counts[tag] += 1
        while at < size and data[at] != LINE:
            at += 1
        at += 1
    return odd, counts


@kernel
def parse_lines(data: Bytes, tags: Bytes, tag_start: IntArray, id_counts: IntArray, real_counts: IntArray,
                id_start: IntArray, real_start: IntArray, line_start: IntArray, upper5: UIntArray, lower5: UIntArray,
                ids: IntArray, reals: UIntArray, lines: IntArray) -> bool:  # fmt: skip
    """Fill ids, bits of reals and line numbers of all records, those of a tag from its start on; False if odd."""
    filled, at, size, line = np.zeros(len(id_counts), np.int64), 0, len(data), 0
    while at < size:
        line += 1
        while at < size and _blank(data[at]):
            at += 1
        if at < size and data[at] != LINE and data[at] != HASH:
            tag = _tag_at(data, at, tags, tag_start)
            at += tag_start[tag + 1] - tag_start[tag]
            row = filled[tag]
            filled[tag] += 1
            lines[line_start[tag] + row] = line
            for k in range(id_counts[tag]):
                while at < size and _blank(data[at]):
                    at += 1
                first, value = at, 0
                while at < size and data[at] >= DIGIT0 and data[at] <= DIGIT9:
                    value = value * 10 + int(data[at]) - DIGIT0
                    at += 1
                if at == first or at - first > 18 or (at < size and data[at] > SPACE):
                    return False
                ids[id_start[tag] + row * id_counts[tag] + k] = value
            for k in range(real_counts[tag]):
                while at < size and _blank(data[at]):
                    at += 1
                state, at, bits = _number(data, at, upper5, lower5)
                if state != OK:
                    return False
                reals[real_start[tag] + row * real_counts[tag] + k] = bits
            while at < size and _blank(data[at]):
                at += 1
            if at < size and data[at] != LINE:
                return False
        while at < size and data[at] != LINE:
            at += 1
        at += 1
    return True
