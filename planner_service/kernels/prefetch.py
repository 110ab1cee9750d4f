"""Ask for a cell's memory before it is needed. It changes no result; uncompiled it does nothing."""

from __future__ import annotations

from llvmlite import ir
from numba import config, types
from numba.extending import intrinsic

_READ, _KEEP, _DATA = 0, 3, 1
"""As llvm.prefetch has them: for reading; to stay in all caches; data, not instructions."""


def _nothing(array, index):
    pass


@intrinsic
def _llvm_prefetch(typing, array, index):
    def generate(context, builder, signature, arguments):
        number = ir.IntType(32)
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        address = builder.bitcast(builder.gep(data, [arguments[1]]), ir.IntType(8).as_pointer())
        kind = ir.FunctionType(ir.VoidType(), [address.type, number, number, number])
        function = builder.module.declare_intrinsic("llvm.prefetch", [address.type], kind)
        builder.call(function, [address, number(_READ), number(_KEEP), number(_DATA)])
        return context.get_dummy_value()

    return types.void(array, index), generate


prefetch = _nothing if config.DISABLE_JIT else _llvm_prefetch
"""prefetch(array, index): `index` is not read, and may lie anywhere."""
