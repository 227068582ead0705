"""The extent of a map is where the map is, not where one lost robot said that it was."""

import numpy as np
import pytest

from gpom_core.extent import main_squares
from gpom_core.mapper import Mapper
from gpom_core.snapshot import union
from tests.service.rooms import scan_at


@pytest.mark.parametrize(
    ("weights", "expected"),
    [
        ({}, set()),
        ({(90_000, -90_000): 1}, {(90_000, -90_000)}),
        ({(0, 0): 1000, (90_000, 0): 9}, {(0, 0)}),
        ({(0, 0): 500, (1000, 0): 50}, {(0, 0), (1000, 0)}),
        ({(-1, -1): 1000, (0, 0): 1, (1, 1): 1}, {(-1, -1), (0, 0), (1, 1)}),
        ({(0, 0): 1000, (2, 0): 1}, {(0, 0)}),
        ({(0, 0): 1, (-100, 0): 1, (100, 0): 1}, {(0, 0), (-100, 0), (100, 0)}),
    ],
)
def test_specks_far_away_are_left_out(weights, expected) -> None:
    assert main_squares(weights) == expected


def test_order_does_not_matter() -> None:
    random = np.random.default_rng(3)
    weights = {(x, y): int(random.integers(1, 50)) for x, y in random.integers(-20, 20, (200, 2))}
    main = main_squares(weights)
    assert main_squares(dict(reversed(weights.items()))) == main
    assert 0 < len(main) < len(weights)


def test_the_extent_is_what_the_experts_cover_whatever_was_swapped() -> None:
    mapper = Mapper()
    rooms = [(9.0 * i, 120.0 * (i % 2)) for i in range(12)]
    for x, y in rooms:
        mapper.update(scan_at(x, y, room=(x, y)))
        mapper.train()
    snapshot = mapper.snapshot()
    numbers = sorted(snapshot.members)
    for gone in ([], numbers[::3], numbers[1::3], numbers[2::3]):
        snapshot = snapshot.swapped([], gone)
        members = list(snapshot.members.values())
        assert snapshot.bounds == snapshot.extent == union(member.bounds for member in members)
        assert snapshot.reach == snapshot.main_reach == union(member.reach for member in members)
        assert snapshot.main_count == len(snapshot.members) == len(members)
    assert snapshot.bounds is None


def test_one_scan_from_far_away_does_not_stretch_a_map() -> None:
    mapper = Mapper()
    rooms = [(8.0 * i, 8.0 * j) for i in range(12) for j in range(12)]
    for x, y in rooms:
        mapper.update(scan_at(x, y, room=(x, y)))
    before = mapper.train().extent
    assert before == mapper.snapshot().bounds
    mapper.update(scan_at(9e6, 9e6, room=(9e6, 9e6)))
    after = mapper.train()
    assert after.extent == before
    assert after.bounds[2] > 8.9e6
    assert after.query([[9e6 + 3.0, 9e6]]).known.tolist() == [True], "it is in the map all the same"
    assert 0 < after.main_count < len(after.members)
