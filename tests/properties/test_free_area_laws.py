"""Laws of merging free areas: nothing is lost, nothing overlaps, nothing is coarse at a surface."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gpom_core.observations import merge_areas
from gpom_core.rows import BOX, cell_key

CELL_M, RATIO, CAP = 0.1, 3.0, 50.0


@st.composite
def lattices(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cells (n, 2), their counts and how far the nearest hit is."""
    blocks = draw(
        st.lists(
            st.tuples(st.integers(-20, 20), st.integers(-20, 20), st.integers(1, 12)),
            min_size=1,
            max_size=4,
        )
    )
    cells = np.unique(
        np.concatenate(
            [
                np.stack(np.meshgrid(np.arange(x, x + e), np.arange(y, y + e)), -1).reshape(-1, 2)
                for x, y, e in blocks
            ]
        ),
        axis=0,
    )
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    cells = rng.permutation(cells[rng.random(len(cells)) >= draw(st.sampled_from([0.0, 0.02]))])
    count = rng.uniform(0.01, 2.0 * CAP, len(cells))
    hit = np.array(draw(st.tuples(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0))))
    near = np.hypot(*((cells + 0.5) * CELL_M - hit).T)
    near[near > 2.4] = np.inf
    return cells, count, near


@given(lattices(), st.integers(0, 4))
def test_merging_keeps_area_and_counts_and_is_fine_near_hits(lattice, levels: int) -> None:
    cells, count, near = lattice
    keys = np.array([cell_key(BOX, int(x), int(y)) for x, y in cells], np.int64)
    fine = np.zeros(len(keys), np.bool_)
    geometry, total, capped, _ = merge_areas(keys, count, near, fine, CELL_M, levels, RATIO, CAP)

    low = np.round(geometry[:, 0] / CELL_M).astype(int)
    edge = np.round((geometry[:, 1] - geometry[:, 0]) / CELL_M).astype(int)
    assert np.array_equal(edge[:, 0], edge[:, 1])
    assert set(edge[:, 0].tolist()) <= {2**level for level in range(levels + 1)}
    np.testing.assert_allclose(geometry, np.stack([low, low + edge], 1) * CELL_M, atol=1e-9)

    number = {(int(x), int(y)): i for i, (x, y) in enumerate(cells)}
    seen = []
    for box, (corner, size) in enumerate(zip(low, edge[:, 0], strict=True)):
        inside = [
            number.pop((corner[0] + dx, corner[1] + dy)) for dx in range(size) for dy in range(size)
        ]  # each cell is in one box only, and every box is full
        seen += inside
        np.testing.assert_allclose(total[box], count[inside].sum())
        np.testing.assert_allclose(capped[box], np.minimum(count[inside], CAP).sum())
        if size > 1:
            assert near[inside].min() > RATIO * CELL_M * size / 2
    assert not number
    assert len(seen) == len(cells)


@given(lattices(), st.integers(0, 4), st.randoms(use_true_random=False))
def test_merging_does_not_depend_on_the_order_of_cells(lattice, levels: int, random) -> None:
    cells, count, near = lattice
    keys = np.array([cell_key(BOX, int(x), int(y)) for x, y in cells], np.int64)
    order = list(range(len(cells)))
    random.shuffle(order)

    def areas(of: list[int]) -> dict[tuple[float, ...], float]:
        fine = np.zeros(len(of), np.bool_)
        geometry, total, *_ = merge_areas(
            keys[of], count[of], near[of], fine, CELL_M, levels, RATIO, CAP
        )
        return {tuple(g.ravel()): t for g, t in zip(np.round(geometry, 6), total, strict=True)}

    a, b = areas(order), areas(sorted(order))
    assert a.keys() == b.keys()
    for key, total in a.items():
        np.testing.assert_allclose(b[key], total)
