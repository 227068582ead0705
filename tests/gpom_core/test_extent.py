"""The extent of a map is where the map is, not where one lost robot said that it was."""

import numpy as np
import pytest

from gpom_core.extent import in_main_places
from gpom_core.mapper import Mapper
from tests.service.rooms import scan_at


def boxes(*places: tuple[float, float]) -> list[tuple[float, float, float, float]]:
    return [(x, y, x + 2.0, y + 2.0) for x, y in places]


@pytest.mark.parametrize(
    ("places", "weights", "expected"),
    [
        ([], [], []),
        ([(1e7, -1e7)], [1], [True]),
        ([(0.0, 0.0), (50.0, 0.0), (1e7, 0.0)], [500, 500, 9], [True, True, False]),
        ([(0.0, 0.0), (1e7, 0.0)], [500, 5], [True, False]),
        ([(0.0, 0.0), (1e4, 0.0)], [500, 50], [True, True]),
        ([(-1.0, -1.0), (99.0, 99.0), (150.0, 150.0)], [1000, 1, 1], [True, True, True]),
        ([(0.0, 0.0), (-1e4, 0.0), (1e4, 0.0)], [1, 1, 1], [True, True, True]),
    ],
)
def test_specks_far_away_are_left_out(places, weights, expected) -> None:
    assert in_main_places(boxes(*places), weights).tolist() == expected


def test_order_does_not_matter() -> None:
    random = np.random.default_rng(3)
    places = [(x * 120.0, y * 120.0) for x, y in random.integers(-20, 20, (200, 2))]
    weights = random.integers(1, 50, 200).tolist()
    order = random.permutation(200)
    main = in_main_places(boxes(*places), weights)
    again = in_main_places(boxes(*(places[i] for i in order)), [weights[i] for i in order])
    assert again.tolist() == main[order].tolist()
    assert 0 < main.sum() < 200


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
    assert len(after.main_members) < len(after.members)
