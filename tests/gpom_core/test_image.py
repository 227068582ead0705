"""A mapper that is dumped and loaded goes on as if nothing had happened."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from gpom_core.config import MapConfig
from gpom_core.image import InvalidImageError, dump, load
from gpom_core.mapper import Mapper
from tests.service.rooms import scan_at

CONFIG = MapConfig()
GRID = ((-4.0, -4.0, 4.0, 4.0), 0.1)


def drive(mapper: Mapper, first: int, last: int, *, train_every: int = 5) -> None:
    for i in range(first, last):
        mapper.update(scan_at(1.5 * np.cos(i / 3), 1.5 * np.sin(i / 3), seq=i + 1))
        if (i + 1) % train_every == 0:
            mapper.swap([job.run() for job in mapper.take_jobs(7)])


@pytest.fixture(scope="module")
def driven() -> Mapper:
    mapper = Mapper(CONFIG)
    drive(mapper, 0, 23)
    return mapper


def assert_same(one: Mapper, other: Mapper, tolerance: float = 1e-9) -> None:
    a, b = one.snapshot(), other.snapshot()
    assert (a.version, a.bounds) == (b.version, b.bounds)
    for name in ("occupancy", "mean", "variance"):
        expected = getattr(a.grid(*GRID), name)
        np.testing.assert_allclose(getattr(b.grid(*GRID), name), expected, rtol=0, atol=tolerance)
    assert one.dirty_ids() == other.dirty_ids()
    assert one.observation_count == other.observation_count
    assert one.expert_count == other.expert_count
    assert one.scan_count == other.scan_count


def test_answers_are_the_same_and_stay_so(driven):
    loaded = load(dump(driven), CONFIG)
    assert_same(driven, loaded)
    other = load(dump(driven), CONFIG)
    for mapper in (loaded, other):
        drive(mapper, 23, 41)
    assert_same(loaded, other)


def test_going_on_after_a_restart_is_going_on():
    straight, restarted = Mapper(CONFIG), Mapper(CONFIG)
    for mapper in (straight, restarted):
        drive(mapper, 0, 12)
    with ThreadPoolExecutor(2) as pool:
        restarted = load(dump(restarted), CONFIG, pool)
    for mapper in (straight, restarted):
        drive(mapper, 12, 40)
        mapper.train()
    assert_same(straight, restarted)


def test_what_is_in_training_is_dirty_in_the_image():
    mapper = Mapper(CONFIG)
    drive(mapper, 0, 3, train_every=100)
    expected = mapper.dirty_ids()
    mapper.take_jobs(3)
    expected |= {half for _, half in mapper.take_splits()}
    assert load(dump(mapper), CONFIG).dirty_ids() == expected


def test_an_empty_map_has_an_image():
    assert_same(Mapper(CONFIG), load(dump(Mapper(CONFIG)), CONFIG))


def test_images_do_not_share_memory_with_the_mapper(driven):
    image = dump(driven)
    before = {name: array.copy() for name, array in image.items()}
    mapper = load(image, CONFIG)
    drive(mapper, 23, 30)
    for name, array in image.items():
        np.testing.assert_array_equal(array, before[name])


def break_index(array):
    broken = array.copy()
    broken.flat[0] = 2**31 - 2 if array.dtype.itemsize > 1 else 200
    return broken


@pytest.mark.parametrize(
    "name",
    [
        "row_kind", "row_owner", "row_order", "tile_free", "tile_hit", "tile_first",
        "expert_cluster", "expert_start", "seen_kind",
    ],
)  # fmt: skip
def test_indices_that_point_outside_are_refused(driven, name):
    image = dump(driven)
    with pytest.raises(InvalidImageError):
        load({**image, name: break_index(image[name])}, CONFIG)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("row_geometry", np.nan),
        ("row_geometry", 1e12),
        ("row_count", -1.0),
        ("seen_geometry", 50.0),
        ("seen_noise", 0.0),
        ("expert_hyperparameters", 1e9),
        ("cluster_moments", np.inf),
    ],
)
def test_numbers_that_cannot_be_are_refused(driven, name, value):
    image = dump(driven)
    broken = image[name].copy()
    broken.flat[0] = value
    with pytest.raises(InvalidImageError):
        load({**image, name: broken}, CONFIG)


def test_shapes_names_and_versions_are_checked(driven):
    image = dump(driven)
    for broken in (
        {**image, "row_near": image["row_near"][:-1]},
        {**image, "row_near": image["row_near"].astype(np.float32)},
        {name: array for name, array in image.items() if name != "gone"},
        {**image, "more": np.zeros(1)},
        {**image, "version": np.array(99)},
    ):
        with pytest.raises(InvalidImageError):
            load(broken, CONFIG)
