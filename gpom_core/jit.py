"""The one way gpom_core compiles its hot loops."""

from collections.abc import Callable
from typing import Final, TypeVar, cast

from numba import njit

_Function = TypeVar("_Function", bound=Callable[..., object])

_OPTIONS: Final = {
    "nogil": True,
    "cache": True,
    "error_model": "numpy",
    "fastmath": {"contract"},
}


def compiled(function: _Function) -> _Function:
    """Compile `function` with numba on first call: no interpreter lock held, cached on disk.

    Division by zero follows IEEE 754, and products may be fused with sums (never reordered), so
    the stated error bounds hold. The disk cache of a caller does not notice changes in another
    file's callee: clear ``__pycache__`` after editing shared compiled code.
    """
    return cast("_Function", njit(**_OPTIONS)(function))


def inlined(function: _Function) -> _Function:
    """As `compiled`, and always inlined into compiled callers, so that their loops vectorise."""
    return cast("_Function", njit(forceinline=True, **_OPTIONS)(function))
