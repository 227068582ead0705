"""The field: near the exact answers, kept where nothing changed, bounded in memory."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import gpom_core.field
from gpom_core.committee import Fusion
from gpom_core.config import MapConfig
from gpom_core.errors import InvalidQueryError
from gpom_core.mapper import Mapper
from gpom_core.snapshot import Snapshot
from tests.gpom_core.synthetic import look, tour


@pytest.fixture(autouse=True)
def _fill_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gpom_core.field, "FILL_AFTER", 1)


@pytest.fixture
def mapper() -> Mapper:
    mapper = Mapper(MapConfig())
    for scan in tour(8):
        mapper.update(scan)
    mapper.train()
    return mapper


@pytest.fixture
def snapshot(mapper: Mapper) -> Snapshot:
    return mapper.snapshot()


@pytest.fixture(scope="module")
def points() -> np.ndarray:
    return np.random.default_rng(0).uniform((-5.0, -4.0), (5.0, 4.0), (3000, 2))


def nodes(snapshot: Snapshot) -> dict[int, np.ndarray]:
    """Address and nodes of every tile that is filled."""
    return {
        values.ctypes.data: values
        for sector in snapshot.sectors.values()
        for values in sector.pages[Fusion.BCM].nodes.values()
    }


@pytest.mark.parametrize("fusion", ["bcm", "rbcm", "poe"])
def test_the_field_is_near_the_exact_answer(
    snapshot: Snapshot, points: np.ndarray, fusion: str
) -> None:
    exact, field = snapshot.query(points, fusion), snapshot.query(points, fusion, "field")
    error = abs(field.occupancy - exact.occupancy)
    # With `poe` the map is so sure of itself that any error of its sums shows.
    assert np.quantile(error, 0.99) < (0.05 if fusion == "poe" else 0.01)
    assert error.max() < (0.5 if fusion == "poe" else 0.06)
    assert np.mean(field.known != exact.known) < 0.01


def test_what_is_asked_again_is_not_computed_again(snapshot: Snapshot, points: np.ndarray) -> None:
    first = snapshot.query(points, method="field")
    before = nodes(snapshot).keys()
    again = snapshot.query(points, method="field")
    assert nodes(snapshot).keys() == before
    assert np.array_equal(first.variance, again.variance)


def test_a_tile_is_filled_when_it_was_asked_for_often(
    snapshot: Snapshot, points: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gpom_core.field, "FILL_AFTER", 50)
    exact = snapshot.query(points)
    first = snapshot.query(points, method="field")  # some ten in each tile
    assert not nodes(snapshot)
    assert np.array_equal(first.variance, exact.variance)
    for _ in range(10):
        snapshot.query(points, method="field")
    assert nodes(snapshot)


def test_a_raster_may_be_read_from_the_field(snapshot: Snapshot) -> None:
    box = (-2.0, -1.5, 2.0, 1.5)
    exact, field = snapshot.grid(box, 0.1), snapshot.grid(box, 0.1, method="field")
    assert field.occupancy.shape == exact.occupancy.shape
    assert abs(field.occupancy - exact.occupancy).max() < 0.06


def test_unknown_space_is_exactly_even(snapshot: Snapshot) -> None:
    far = np.array([(1e300, 0.0), (-1e300, -1e300), (500.0, 500.0), (0.0, -60.0)])
    answer = snapshot.query(far, method="field")
    assert (answer.occupancy == 0.5).all()
    assert (answer.variance == snapshot.prior_variance).all()
    assert Snapshot().query(far, method="field").occupancy.tolist() == [0.5] * 4


def test_a_swap_forgets_what_its_experts_reach_and_nothing_else(
    mapper: Mapper, points: np.ndarray
) -> None:
    old = mapper.snapshot()
    old.query(points, method="field")
    kept = nodes(old)
    mapper.update(look(2.6, 0.0, walls=[((2.8, -0.2), (2.8, 0.2))], range_max=0.5))
    new = mapper.swap([job.run() for job in mapper.take_jobs(1000)])
    carried = nodes(new)
    assert 0 < len(carried) < len(kept)
    assert carried.keys() <= kept.keys()
    # What was carried is what a map without any history would compute.
    fresh = Snapshot(version=new.version, prior_variance=new.prior_variance, link=new.link).swapped(
        new.members.values()
    )
    a, b = new.query(points, method="field"), fresh.query(points, method="field")
    assert np.array_equal(a.variance, b.variance)
    assert np.array_equal(a.mean, b.mean)
    # And the old version still answers as it did.
    assert old.query(points, method="field").variance.shape == (len(points),)
    assert (
        abs(old.query(points, method="field").occupancy - old.query(points).occupancy).max() < 0.1
    )


def test_memory_is_bounded(
    snapshot: Snapshot, points: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = snapshot.query(points, method="field")
    full_bytes = snapshot.field().size_bytes  # type: ignore[union-attr]
    monkeypatch.setattr(gpom_core.field, "BYTES_MAX", full_bytes // 3)
    small = Snapshot(prior_variance=snapshot.prior_variance, link=snapshot.link).swapped(
        snapshot.members.values()
    )
    for _ in range(2):
        answer = small.query(points, method="field")
        assert np.array_equal(answer.variance, whole.variance)
        assert 0 < small.field().size_bytes <= full_bytes // 3  # type: ignore[union-attr]


def test_many_threads_may_fill_it_at_once(snapshot: Snapshot, points: np.ndarray) -> None:
    alone = Snapshot(prior_variance=snapshot.prior_variance, link=snapshot.link).swapped(
        snapshot.members.values()
    )
    expected = alone.query(points, method="field")
    with ThreadPoolExecutor(4) as pool:
        answers = list(pool.map(lambda _: snapshot.query(points, method="field"), range(8)))
    assert all(np.array_equal(answer.variance, expected.variance) for answer in answers)


def test_an_unknown_method_is_refused(snapshot: Snapshot) -> None:
    with pytest.raises(InvalidQueryError, match="'guess' is not known"):
        snapshot.query([[0.0, 0.0]], method="guess")
