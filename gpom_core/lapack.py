"""LAPACK from compiled code, without the interpreter lock and cacheable.

scipy's Python wrappers hold the lock while LAPACK runs (measured: two threads take twice as long),
and numba's own `cholesky` cannot invert from the factor. Addresses come from scipy's cython_lapack
and are passed as arguments, so that the compiled callers can still be cached; they are looked up
when they are first needed, for scipy takes as long to load as a tenth of a service's start.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import get_cython_function_address, intrinsic
from numpy.typing import NDArray

from gpom_core.jit import compiled

_LOWER = ord("L")


@cache
def addresses() -> NDArray[np.int64]:
    """Where the factor and the inverse from it are, (2,)."""
    names = ("dpotrf", "dpotri")
    found = [get_cython_function_address("scipy.linalg.cython_lapack", name) for name in names]
    return np.array(found, np.int64)


@intrinsic
def _call5(typing_context: Any, address: Any, a: Any, b: Any, c: Any, d: Any, e: Any) -> Any:
    """Call a C function of five pointers that returns nothing."""
    signature = types.void(*([types.int64] * 6))

    def generate(context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        word = ir.IntType(64)
        kind = ir.FunctionType(ir.VoidType(), [word] * 5)
        function = builder.inttoptr(args[0], kind.as_pointer())
        builder.call(function, args[1:])
        return context.get_dummy_value()

    return signature, generate


@compiled
def inverse_by_lapack(k: Any, addresses: Any) -> float:
    """Replace a symmetric positive definite matrix (n, n) by its inverse.

    Args:
        k: C-ordered float64, only its upper triangle is read.
        addresses: those of `addresses`.

    Returns:
        The log determinant, or NaN when `k` is not positive definite.
    """
    n = len(k)
    uplo = np.array([_LOWER], np.uint8)  # C order: the upper triangle is LAPACK's lower one
    size = np.array([n], np.int32)
    info = np.zeros(1, np.int32)
    pointers = (uplo.ctypes.data, size.ctypes.data, k.ctypes.data, info.ctypes.data)
    _call5(addresses[0], pointers[0], pointers[1], pointers[2], pointers[1], pointers[3])
    if info[0] != 0:
        return np.nan
    log_determinant = 0.0
    for i in range(n):
        log_determinant += 2.0 * np.log(k[i, i])
    _call5(addresses[1], pointers[0], pointers[1], pointers[2], pointers[1], pointers[3])
    for i in range(n):
        for j in range(i):
            k[i, j] = k[j, i]
    # Reading the arrays here keeps them alive while LAPACK holds their addresses.
    sound = info[0] == 0 and size[0] == n and uplo[0] == _LOWER
    return log_determinant if sound else np.nan
