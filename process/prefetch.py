"""Ask the processor to fetch a pixel's cache line from memory before it is needed."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import cgutils as untyped
from numba.core import types
from numba.extending import intrinsic

cgutils: Any = untyped

#: Arguments of LLVM's llvm.prefetch: to be read, kept in every cache, data.
_HOW = (0, 3, 1)


def _typed(_context: Any, array: Any, _row: Any, _column: Any) -> Any:
    """The type and the code of :func:`prefetch` for the types of its arguments."""

    def code(target: Any, builder: Any, signature: Any, values: Any) -> Any:
        data, row, column = values
        pixels = target.make_array(signature.args[0])(target, builder, data)
        steps = cgutils.unpack_tuple(builder, pixels.strides)
        offset = builder.add(builder.mul(row, steps[0]), builder.mul(column, steps[1]))
        byte, word = ir.IntType(8).as_pointer(), ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [byte, word, word, word])
        asked = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0i8")
        place = builder.gep(builder.bitcast(pixels.data, byte), [offset])
        builder.call(asked, [place, *(ir.Constant(word, n) for n in _HOW)])
        return target.get_dummy_value()

    return types.void(array, types.intp, types.intp), code


#: ``prefetch(frame, row, column)`` in a kernel, of a frame (H, W): changes nothing but when it arrives.
prefetch: Any = intrinsic(_typed)
