"""The shapes that observations have, and what is no shape."""

from enum import IntEnum
from math import inf
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpom_core.jit import compiled

_Floats = NDArray[np.float64]


class Kind(IntEnum):
    """What an observation's shape is."""

    POINT = 0
    SEGMENT = 1
    BOX = 2


_BOX: Final = int(Kind.BOX)
_POINT: Final = int(Kind.POINT)
_LONGEST: Final = 1e4  # length scales; quadrature takes two nodes for each

_NOT_FINITE, _UNKNOWN_KIND, _CORNERS, _NOT_A_POINT, _TOO_LONG = range(1, 6)
_FAULTS: Final = {
    _NOT_FINITE: "geometry must be finite",
    _UNKNOWN_KIND: "kinds must be values of Kind: 0 point, 1 segment, 2 box",
    _CORNERS: "a box must have its low corner first: geometry[i, 0] <= geometry[i, 1]",
    _NOT_A_POINT: "a point must be given twice: geometry[i, 0] == geometry[i, 1]",
    _TOO_LONG: f"no shape may be longer than {_LONGEST:g} length scales; cut it into parts",
}


def checked(
    kinds: ArrayLike, geometry: ArrayLike, length_scale: ArrayLike
) -> tuple[NDArray[np.uint8], _Floats, _Floats]:
    """Arguments as the compiled functions need them; the length scale inverted, (d,)."""
    as_typed = typed(kinds, geometry, length_scale)
    refuse(fault_of(*as_typed))
    return as_typed


def refuse(fault: int) -> None:
    """Raise the ValueError of a fault that is not 0."""
    if fault:
        raise ValueError(_FAULTS[fault])


def typed(
    kinds: ArrayLike, geometry: ArrayLike, length_scale: ArrayLike
) -> tuple[NDArray[np.uint8], _Floats, _Floats]:
    """As `checked`, without a look at the numbers in kinds and geometry."""
    shapes = np.ascontiguousarray(geometry, dtype=np.float64)
    if shapes.ndim != 3 or shapes.shape[1] != 2 or shapes.shape[2] == 0:
        raise ValueError(f"geometry must have shape (n, 2, d) with d >= 1, got {shapes.shape}")
    n, _, d = shapes.shape
    raw_kinds = np.asarray(kinds)
    if raw_kinds.shape != (n,):
        raise ValueError(f"kinds must have shape ({n},) as geometry has, got {raw_kinds.shape}")
    checked_kinds = np.ascontiguousarray(raw_kinds, dtype=np.uint8)
    if raw_kinds.dtype != np.uint8 and not np.array_equal(checked_kinds, raw_kinds):
        raise ValueError(_FAULTS[_UNKNOWN_KIND])
    scales = np.asarray(length_scale, dtype=np.float64)
    if scales.shape not in ((), (d,)):
        raise ValueError(f"length_scale must be one number or ({d},), got shape {scales.shape}")
    each = scales.tolist() if scales.ndim else [float(scales)] * d
    for x in each:
        if not 0.0 < x < inf:
            raise ValueError(f"length_scale must be finite and positive, got {each}")
    return checked_kinds, shapes, np.array([1.0 / x for x in each])


@compiled
def fault_of(kinds: NDArray[np.uint8], geometry: _Floats, inverse_length_scale: _Floats) -> int:
    """Which of `_FAULTS` the arguments have, 0 for none."""
    n, _, d = geometry.shape
    for i in range(n):
        if kinds[i] > _BOX:
            return _UNKNOWN_KIND
        for axis in range(d):
            span = geometry[i, 1, axis] - geometry[i, 0, axis]
            if not np.isfinite(span):
                return _NOT_FINITE
            if kinds[i] == _BOX and span < 0.0:
                return _CORNERS
            if kinds[i] == _POINT and span != 0.0:
                return _NOT_A_POINT
            if abs(span) * inverse_length_scale[axis] > _LONGEST:
                return _TOO_LONG
    return 0
