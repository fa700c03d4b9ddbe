"""One tile of a matrix product held in vector registers: what the kernels of the Cholesky factorisation spend time in.

LLVM's loop vectoriser, as numba runs it, keeps no tile of the target in registers: it loads and stores the target for
every few rows of the factor, and tests all arrays for overlap first, which small fronts do not pay back. So the tile is
given to LLVM as vector operations, which it translates for any processor. Multiply and subtract stay apart (no fused
operation), so that results do not depend on the processor. Factorisations take 0.3 to 0.5 of the time of plain loops.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic
from numba.np.arrayobj import make_array

TILE = 4
"""Rows of a tile, and columns of the narrow one: every target must be stored in multiples of it."""
INDEX, LANE = ir.IntType(64), ir.IntType(32)
ALIGNED = 8
"""Vectors begin at any double."""


def _make_tile(lanes: int) -> Callable[..., None]:
    """Make the intrinsic for tiles of `TILE` rows of one vector of `lanes` columns; LLVM splits what is too wide."""

    @intrinsic  # type: ignore[untyped-decorator]
    def subtract_tile(_context: Any, target: Any, t: Any, target_stride: Any, source: Any, a: Any, b: Any,
                      source_stride: Any, depth: Any) -> Any:  # fmt: skip
        signature = types.void(target, t, target_stride, source, a, b, source_stride, depth)
        vector = ir.VectorType(ir.DoubleType(), lanes)
        return signature, lambda context, builder, signature, values: _emit(context, builder, signature, values, vector)

    return subtract_tile  # type: ignore[no-any-return]


def _emit(context: Any, builder: Any, signature: Any, values: Any, vector: Any) -> Any:
    """Write the code: load the tile, subtract one outer product per row of the source, store the tile."""
    _, t, target_stride, _, a, b, source_stride, depth = values
    target = make_array(signature.args[0])(context, builder, values[0]).data
    source = make_array(signature.args[3])(context, builder, values[3]).data
    places = [_vector_at(builder, target, builder.add(t, builder.mul(target_stride, INDEX(row))), vector)
              for row in range(TILE)]  # fmt: skip
    tile = [cgutils.alloca_once_value(builder, builder.load(place, align=ALIGNED)) for place in places]
    left, right = cgutils.alloca_once_value(builder, a), cgutils.alloca_once_value(builder, b)
    with cgutils.for_range(builder, depth):
        from_left, from_right = builder.load(left), builder.load(right)
        columns = builder.load(_vector_at(builder, source, from_right, vector), align=ALIGNED)
        for row, cell in enumerate(tile):
            scale = _repeated(builder, source, builder.add(from_left, INDEX(row)), vector)
            builder.store(builder.fsub(builder.load(cell), builder.fmul(scale, columns)), cell)
        builder.store(builder.add(from_left, source_stride), left)
        builder.store(builder.add(from_right, source_stride), right)
    for place, cell in zip(places, tile, strict=True):
        builder.store(builder.load(cell), place, align=ALIGNED)
    return context.get_dummy_value()


def _vector_at(builder: Any, data: Any, index: Any, vector: Any) -> Any:
    return builder.bitcast(builder.gep(data, [index]), vector.as_pointer())


def _repeated(builder: Any, data: Any, index: Any, vector: Any) -> Any:
    """Load one number into all lanes."""
    value = builder.load(builder.gep(data, [index]))
    nothing = ir.Constant(vector, ir.Undefined)
    lanes = ir.Constant(ir.VectorType(LANE, vector.count), [0] * vector.count)
    return builder.shuffle_vector(builder.insert_element(nothing, value, LANE(0)), nothing, lanes)


subtract_tile = _make_tile(TILE)
"""Do T -= A^T B on a tile T of 4 rows and 4 columns, A and B (depth, 4) with rows `source_stride` apart.

Arguments: target (flat), t, target_stride, source (flat), a, b, source_stride, depth; t, a and b are where T, A and B
begin, all integers of 64 bits.
"""
subtract_wide_tile = _make_tile(2 * TILE)
"""The same on 4 rows and 8 columns."""
