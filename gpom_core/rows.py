"""The merged evidence of the whole map: one row per place, in growing arrays with a hash index.

A row is an observation that many beams may have made: its key says where (one lattice cell, or a
pair of cells for a segment), its count how often. Rows know their cluster, and every cluster
threads its rows on a doubly linked list, so that moving a row costs O(1).
Everything here is compiled and holds no lock: one thread owns the evidence.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import carray
from numpy.typing import NDArray

from gpom_core.jit import compiled, inlined
from gpom_core.pointers import pointer

NONE = -1
POINT, SEGMENT, BOX = 0, 1, 2  # as shapes.Kind; plain numbers are what compiled code takes
COORDINATE_BITS = 29  # of a cell index; two of them and the kind fill an int64 key
COORDINATE_LIMIT = 2 ** (COORDINATE_BITS - 1) - 4096


class Rows(NamedTuple):
    """Struct of arrays; `size[0]` rows are in use.

    Attributes:
        slots: (h,) hash table of row numbers, h a power of two; free areas are found by tile.
        keys: (r, 2) lattice keys; the second is 0 except for segments.
        kind: (r,) kind of observation.
        geometry: (r, 2, 2) metres in the map frame, see `gpom_core.kernels`.
        count: (r,) how many observations were merged; its weight in training is capped.
        learned: (r,) the count that its expert was last trained with.
        crossed: (r,) cells that were crossed of a free area that stands for a whole tile; else 0.
        near: (r,) distance to the nearest hit, metres; inf beyond `near_surface_m`.
        owner: (r,) cluster number.
        before, after: (r,) neighbours on the owner's list.
        size: (1,) rows in use.
    """

    slots: NDArray[np.int32]
    keys: NDArray[np.int64]
    kind: NDArray[np.uint8]
    geometry: NDArray[np.float64]
    count: NDArray[np.float64]  # type: ignore[assignment] # nobody counts values of this tuple
    learned: NDArray[np.float64]
    crossed: NDArray[np.uint8]
    near: NDArray[np.float64]
    owner: NDArray[np.int32]
    before: NDArray[np.int32]
    after: NDArray[np.int32]
    size: NDArray[np.int64]


def new_rows(capacity: int = 4096) -> Rows:
    """Empty rows with room for `capacity`."""
    return Rows(
        slots=np.full(table_size(capacity), NONE, np.int32),
        keys=np.zeros((capacity, 2), np.int64),
        kind=np.zeros(capacity, np.uint8),
        geometry=np.zeros((capacity, 2, 2)),
        count=np.zeros(capacity),
        learned=np.zeros(capacity),
        crossed=np.zeros(capacity, np.uint8),
        near=np.zeros(capacity),
        owner=np.full(capacity, NONE, np.int32),
        before=np.full(capacity, NONE, np.int32),
        after=np.full(capacity, NONE, np.int32),
        size=np.zeros(1, np.int64),
    )


@compiled
def rows_at(handle: NDArray[np.int64]) -> Rows:
    """The rows behind a handle, see `gpom_core.handles`."""
    capacity = handle[1, 1]
    return Rows(
        carray(pointer(handle[0, 0]), handle[0, 1], np.int32),
        carray(pointer(handle[1, 0]), (capacity, 2), np.int64),
        carray(pointer(handle[2, 0]), capacity, np.uint8),
        carray(pointer(handle[3, 0]), (capacity, 2, 2), np.float64),
        carray(pointer(handle[4, 0]), capacity, np.float64),
        carray(pointer(handle[5, 0]), capacity, np.float64),
        carray(pointer(handle[6, 0]), capacity, np.uint8),
        carray(pointer(handle[7, 0]), capacity, np.float64),
        carray(pointer(handle[8, 0]), capacity, np.int32),
        carray(pointer(handle[9, 0]), capacity, np.int32),
        carray(pointer(handle[10, 0]), capacity, np.int32),
        carray(pointer(handle[11, 0]), 1, np.int64),
    )


def table_size(capacity: int) -> int:
    """Slots of a hash table that is at most half full."""
    return 1 << int(np.ceil(np.log2(max(capacity, 8) * 2)))


def with_room(rows: Rows, extra: int) -> Rows:
    """`rows`, or a grown copy with room for `extra` more."""
    used, capacity = int(rows.size[0]), len(rows.keys)
    if used + extra <= capacity:
        return rows
    grown = new_rows(max(2 * capacity, used + extra))
    for name in rows._fields:
        if name not in ("slots", "size"):
            getattr(grown, name)[:used] = getattr(rows, name)[:used]
    grown.size[0] = used
    _index(grown, used)
    return grown


@compiled
def _index(rows: Rows, used: int) -> None:
    for i in range(used):
        if rows.kind[i] != BOX:
            slot = _slot(rows.slots, rows.keys, rows.keys[i, 0], rows.keys[i, 1])
            rows.slots[slot] = i


@compiled
def add_unindexed(rows: Rows, key: int) -> int:
    """A new row that only its tile will find. The caller has made room."""
    row = int(rows.size[0])
    rows.size[0] = row + 1
    rows.keys[row, 0] = key
    rows.keys[row, 1] = 0
    return row


@inlined
def cell_key(kind: int, ix: int, iy: int) -> int:
    """Key of lattice cell (ix, iy), |index| < COORDINATE_LIMIT."""
    offset = 1 << (COORDINATE_BITS - 1)
    return (kind << (2 * COORDINATE_BITS)) | ((ix + offset) << COORDINATE_BITS) | (iy + offset)


@inlined
def _slot(slots: Any, keys: Any, a: int, b: int) -> int:
    """Slot of key (a, b), or the free slot where it belongs. Linear probing."""
    mask = len(slots) - 1
    mixed = np.uint64(a) * np.uint64(0x9E3779B97F4A7C15) ^ np.uint64(b) * np.uint64(
        0xC2B2AE3D27D4EB4F
    )
    mixed ^= mixed >> np.uint64(29)
    slot = np.int64(mixed & np.uint64(mask))
    while True:
        entry = slots[slot]
        if entry == NONE or (keys[entry, 0] == a and keys[entry, 1] == b):
            return int(slot)
        slot = (slot + 1) & mask


@inlined
def find(slots: Any, keys: Any, a: int, b: int) -> int:
    """Entry with key (a, b), or NONE."""
    return int(slots[_slot(slots, keys, a, b)])


@inlined
def find_or_add(slots: Any, keys: Any, size: Any, a: int, b: int) -> tuple[int, bool]:
    """Entry with key (a, b) and whether it is new. The caller has made room."""
    slot = _slot(slots, keys, a, b)
    entry = slots[slot]
    if entry != NONE:
        return entry, False
    entry = size[0]
    size[0] = entry + 1
    slots[slot] = entry
    keys[entry, 0] = a
    keys[entry, 1] = b
    return entry, True


@inlined
def attach(
    owner: Any, before: Any, after: Any, head: Any, length: Any, row: int, home: int
) -> None:
    """Put a row that has no owner on the list of `home`.

    Takes the arrays of `Rows` and `Clusters`, not the tuples: see `jit.inlined`.
    """
    owner[row] = home
    before[row] = NONE
    after[row] = head[home]
    if head[home] != NONE:
        before[head[home]] = row
    head[home] = row
    length[home] += 1


@inlined
def detach(owner: Any, before: Any, after: Any, head: Any, length: Any, row: int) -> None:
    """Take a row off its owner's list."""
    home, previous, following = owner[row], before[row], after[row]
    if previous == NONE:
        head[home] = following
    else:
        after[previous] = following
    if following != NONE:
        before[following] = previous
    owner[row] = NONE
    length[home] -= 1


@compiled
def relink(rows: Rows, head: Any, length: Any, order: NDArray[np.int64]) -> None:
    """Make the lists of owners anew: `order` (n,) has the rows of each owner as its list shall."""
    owner, before, after = rows.owner, rows.before, rows.after
    for i in range(len(order) - 1, -1, -1):
        row = order[i]
        attach(owner, before, after, head, length, row, owner[row])
