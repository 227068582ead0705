"""Silent beams follow the returning beam that the segment-segment kernel finds most like them."""

import numpy as np
import pytest

from gpom_core.kernels import gram
from gpom_core.shapes import Kind
from gpom_core.similarity import NEIGHBOURS, most_similar

SCALE_M = 0.2


def beams_of(ranges: np.ndarray, turn_rad: float = 2.0 * np.pi) -> np.ndarray:
    angle = 0.3 + turn_rad / len(ranges) * np.arange(len(ranges))
    return np.asarray(ranges)[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])


def similarities(beams: np.ndarray) -> np.ndarray:
    shapes = np.stack([np.zeros_like(beams), beams], axis=1)
    return gram(np.full(len(beams), Kind.SEGMENT, np.uint8), shapes, SCALE_M)


def candidates(returned: np.ndarray, i: int) -> np.ndarray:
    """The returning beams next to beam i on the ring."""
    back = np.flatnonzero(returned)
    middle = np.searchsorted(back, i)
    return back[np.arange(middle - NEIGHBOURS, middle + NEIGHBOURS) % len(back)]


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("turn_rad", [np.pi, 2.0 * np.pi])
def test_the_most_similar_neighbour_is_that_of_the_gram_matrix(seed: int, turn_rad: float) -> None:
    rng = np.random.default_rng(seed)
    returned = rng.random(60) < 0.6
    beams = beams_of(np.where(returned, rng.uniform(0.5, 6.0, 60), 8.0), turn_rad)
    k = similarities(beams)
    got = most_similar(beams, returned, SCALE_M)
    assert got[returned].tolist() == np.flatnonzero(returned).tolist()
    for i in np.flatnonzero(~returned):
        near = candidates(returned, int(i))
        assert got[i] in near
        assert k[i, got[i]] == pytest.approx(k[i, near].max(), rel=1e-6)


def test_of_beams_equally_long_the_neighbours_are_the_most_similar_of_all() -> None:
    returned = np.random.default_rng(7).random(48) < 0.5
    beams = beams_of(np.where(returned, 3.0, 8.0))
    k = similarities(beams)
    got = most_similar(beams, returned, SCALE_M)
    for i in np.flatnonzero(~returned):
        assert k[i, got[i]] == pytest.approx(k[i, returned].max(), rel=1e-6)


def test_the_last_beam_of_a_full_turn_is_next_to_the_first() -> None:
    returned = np.ones(360, bool)
    returned[:3] = False
    returned[350] = False
    got = most_similar(beams_of(np.full(360, 4.0)), returned, SCALE_M)
    assert got[0] == 359
    assert got[2] == 3


@pytest.mark.parametrize("count", [1, 2, 5])
def test_a_few_returning_beams_are_enough(count: int) -> None:
    returned = np.zeros(20, bool)
    returned[:count] = True
    got = most_similar(beams_of(np.full(20, 2.0)), returned, SCALE_M)
    assert set(got.tolist()) == set(range(count))
    assert got[19] == 0
    assert got[count] == count - 1
