"""Who follows the advice of a refusal is not refused again."""

import re
from random import Random

import pytest

from gpom_core.errors import InvalidQueryError
from gpom_core.snapshot import grid_shape
from service.errors import PayloadTooLargeError
from service.http.grids import check_size


def advice(box, resolution_m: float, cells_max: int) -> str:
    """The resolution that a refusal tells."""
    with pytest.raises(PayloadTooLargeError) as refused:
        check_size(box, resolution_m, cells_max)
    found = re.search(r"resolution from ([\d.e-]+) m", str(refused.value))
    assert found is not None, refused.value
    return found.group(1)


def sizes(count: int):
    """Boxes of all sizes and forms, near and far, and what is allowed of them."""
    draw = Random(5)
    for _ in range(count):
        width_m, height_m = (10.0 ** draw.uniform(-2.0, 5.0) for _ in range(2))
        x_m, y_m = (draw.uniform(-1.0, 1.0) * 10.0 ** draw.uniform(-2.0, 6.0) for _ in range(2))
        cells_max = int(10.0 ** draw.uniform(0.0, 7.0))
        box = (x_m, y_m, x_m + width_m, y_m + height_m)
        yield box, (width_m * height_m / cells_max) ** 0.5 / draw.uniform(2.0, 50.0), cells_max


def test_the_resolution_that_is_told_is_allowed_and_hardly_coarser_than_it_must_be() -> None:
    for box, resolution_m, cells_max in sizes(500):
        told = advice(box, resolution_m, cells_max)
        check_size(box, float(told), cells_max)
        rows, columns = grid_shape(box, float(told) * 0.989)
        assert rows * columns > cells_max, (box, cells_max, told)


@pytest.mark.parametrize(
    ("box", "resolution_m", "cells_max", "expected"),
    [
        ((0.0, 0.0, 100.0, 100.0), 0.5, 10_000, "1"),
        ((0.0, 0.0, 101.0, 101.0), 0.5, 10_000, "1.01"),
        ((0.0, 0.0, 1000.0, 0.001), 0.5, 100, "10"),  # one row, however coarse
        ((0.0, 0.0, 7.0, 3.0), 0.5, 1, "7"),
        ((0.0, 0.0, 99_999.0, 99_999.0), 10.0, 1, "1e05"),  # 1e+05 would be "1e 05" in a URL
        ((0.0, 0.0, 1e-9, 1e-9), 1e-11, 100, "1e-10"),
        ((-1e150, 0.0, 1e150, 1e160), 1e159, 4, "2.5e159"),
        ((0.0, 0.0, 1e-320, 1e-320), 5e-324, 4_000_000, "2.22e-308"),
    ],
)
def test_what_is_told(box, resolution_m: float, cells_max: int, expected: str) -> None:
    told = advice(box, resolution_m, cells_max)
    assert told == expected
    check_size(box, float(told), cells_max)


def test_more_than_any_raster_may_have_is_not_told() -> None:
    box, many = (0.0, 0.0, 1e5, 1e5), 10**12
    with pytest.raises(InvalidQueryError, match="more than 200000000"):
        check_size(box, 0.1, many)
