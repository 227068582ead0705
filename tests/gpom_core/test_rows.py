"""Rows of evidence: found again whatever they are called, and on one list each."""

import numpy as np
import pytest

from gpom_core.jit import compiled
from gpom_core.rows import (
    COORDINATE_LIMIT,
    NONE,
    Rows,
    attach,
    cell_key,
    detach,
    find,
    find_or_add,
    new_rows,
    with_room,
)


@compiled
def add_all(rows: Rows, cells: np.ndarray) -> int:
    added = 0
    for i in range(len(cells)):
        key = cell_key(int(cells[i, 0]), int(cells[i, 1]), int(cells[i, 2]))
        _, new = find_or_add(rows.slots, rows.keys, rows.size, key, int(cells[i, 3]))
        added += new
    return added


@compiled
def find_all(rows: Rows, cells: np.ndarray) -> np.ndarray:
    out = np.empty(len(cells), np.int64)
    for i in range(len(cells)):
        key = cell_key(int(cells[i, 0]), int(cells[i, 1]), int(cells[i, 2]))
        out[i] = find(rows.slots, rows.keys, key, int(cells[i, 3]))
    return out


def random_cells(n: int, seed: int) -> np.ndarray:
    """(n, 4) distinct kind, x, y and second key, near the origin and at the ends of the lattice."""
    rng = np.random.default_rng(seed)
    xy = rng.integers(-30, 30, (n, 2)) + rng.choice((0, COORDINATE_LIMIT - 40), (n, 2))
    xy *= rng.choice((-1, 1), (n, 2))
    cells = np.column_stack([rng.integers(0, 2, n), xy, rng.integers(0, 3, n)])
    return rng.permutation(np.unique(cells, axis=0))


def test_every_key_is_found_again_after_the_table_has_grown() -> None:
    cells = random_cells(3000, seed=0)
    rows = new_rows(8)
    for part in np.array_split(cells, 40):
        rows = with_room(rows, len(part))
        assert add_all(rows, part) == len(part)
    assert rows.size[0] == len(cells)
    assert find_all(rows, cells).tolist() == list(range(len(cells)))


def test_a_known_key_is_not_added_again() -> None:
    cells = random_cells(500, seed=1)
    rows = with_room(new_rows(8), 1000)
    assert add_all(rows, cells) == len(cells)
    assert add_all(rows, cells[::-1].copy()) == 0


def test_keys_that_were_never_added_are_not_found() -> None:
    cells = random_cells(600, seed=2)
    rows = with_room(new_rows(8), 1000)
    add_all(rows, cells[:300])
    assert (find_all(rows, cells[300:]) == NONE).all()


def test_growing_keeps_what_is_known_of_each_row() -> None:
    rows = new_rows(8)
    add_all(rows, random_cells(8, seed=3)[:6])
    rows.count[:6] = np.arange(6)
    rows.geometry[:6] = np.arange(24).reshape(6, 2, 2)
    grown = with_room(rows, 100)
    assert len(grown.keys) >= 106
    for name in ("keys", "count", "geometry", "owner"):
        assert np.array_equal(getattr(grown, name)[:6], getattr(rows, name)[:6])
    assert with_room(grown, 1) is grown


@pytest.mark.parametrize("seed", range(3))
def test_lists_hold_what_was_attached_and_not_detached(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows, head, length = new_rows(64), np.full(5, NONE, np.int32), np.zeros(5, np.int32)
    owners: dict[int, int] = {}
    for _ in range(600):
        row, owner = int(rng.integers(50)), int(rng.integers(5))
        if row in owners:
            detach(rows.owner, rows.before, rows.after, head, length, row)
            del owners[row]
            assert rows.owner[row] == NONE
        else:
            attach(rows.owner, rows.before, rows.after, head, length, row, owner)
            owners[row] = owner
    for owner in range(5):
        mine, row = set(), int(head[owner])
        while row != NONE:
            mine.add(row)
            row = int(rows.after[row])
        assert mine == {r for r, o in owners.items() if o == owner}
        assert length[owner] == len(mine)
