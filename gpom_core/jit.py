"""The one way gpom_core compiles its hot loops."""

from collections.abc import Callable
from typing import TypeVar, cast

from numba import njit

_Function = TypeVar("_Function", bound=Callable[..., object])


def compiled(function: _Function) -> _Function:
    """Compile `function` with numba on first call: no interpreter lock held, cached on disk.

    Division by zero follows IEEE 754, and products may be fused with sums (never reordered), so
    the stated error bounds hold. The disk cache of a caller does not notice changes in another
    file's callee: clear ``__pycache__`` after editing shared compiled code.
    """
    decorate = njit(nogil=True, cache=True, error_model="numpy", fastmath={"contract"})
    return cast("_Function", decorate(function))


def inlined(function: _Function) -> _Function:
    """As `compiled`, and copied into its callers.

    Calls that pass many arrays pay for counting references to each, which in the innermost loop
    over cells costs more than the work.
    """
    decorate = njit(
        nogil=True, cache=True, error_model="numpy", fastmath={"contract"}, inline="always"
    )
    return cast("_Function", decorate(function))


def vectorised(function: _Function) -> _Function:
    """As `compiled`, and merged into its callers by the compiler whatever its size.

    For scalar functions inside loops: one that stays a call stops the loop from being vectorised.
    """
    decorate = njit(
        nogil=True, cache=True, error_model="numpy", fastmath={"contract"}, forceinline=True
    )
    return cast("_Function", decorate(function))
