import numpy as np
import pytest

from gpom_core.mapper import Mapper
from gpom_core.snapshot import Snapshot
from service import piecewise
from service.errors import StoppingError
from tests.service.rooms import scan_at


@pytest.fixture(scope="module")
def snapshot() -> Snapshot:
    mapper = Mapper()
    mapper.update(scan_at())
    return mapper.train()


def _go_on() -> None:
    pass


def _same(one, other) -> None:
    for name in ("occupancy", "mean", "variance", "known"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), atol=1e-12)


@pytest.mark.parametrize("count", [0, 1, 6, 7, 8, 20])
def test_pieces_say_what_the_whole_says(snapshot, monkeypatch, count) -> None:
    monkeypatch.setattr(piecewise, "PIECE_POINTS", 7)
    points = np.random.default_rng(count).uniform(-4.0, 4.0, (count, 2))
    _same(piecewise.query(snapshot, points, "bcm", _go_on), snapshot.query(points))


@pytest.mark.parametrize(
    ("bbox", "resolution_m"),
    [((-1, -2, 2, 2), 0.5), ((0.1, 0.2, 1.15, 0.9), 0.1), ((0, 0, 0.1, 3), 0.3)],
)
def test_rasters_are_those_of_the_core(snapshot, monkeypatch, bbox, resolution_m) -> None:
    monkeypatch.setattr(piecewise, "PIECE_POINTS", 7)
    whole = snapshot.grid(bbox, resolution_m)
    pieces = piecewise.grid(snapshot, bbox, resolution_m, "bcm", _go_on)
    assert pieces.occupancy.shape == whole.occupancy.shape
    _same(pieces, whole)


def test_giving_up_between_pieces(snapshot) -> None:
    def stop() -> None:
        raise StoppingError("now")

    with pytest.raises(StoppingError):
        piecewise.query(snapshot, np.zeros((1, 2)), "bcm", stop)
