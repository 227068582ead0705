"""Snapshots: indexed answers are those of the whole committee, and versions never change."""

import numpy as np
import pytest

from gpom_core.committee import OF_HITS, Fusion, fuse
from gpom_core.config import MapConfig
from gpom_core.errors import InvalidQueryError
from gpom_core.expert import Hyperparameters, train
from gpom_core.link import Link
from gpom_core.mapper import LENGTH_SCALE_RANGE, Mapper
from gpom_core.member import member_of, train_member
from gpom_core.observations import Observations
from gpom_core.shapes import Kind
from gpom_core.snapshot import Prediction, Snapshot, grid_shape
from tests.gpom_core.synthetic import look, posterior, tour, weighed


def mapped(scans: int = 10, **settings: object) -> Mapper:
    mapper = Mapper(MapConfig(**settings))  # type: ignore[arg-type]
    for scan in tour(scans):
        mapper.update(scan)
    mapper.train()
    return mapper


@pytest.fixture(scope="module")
def snapshot() -> Snapshot:
    return mapped().snapshot()


@pytest.fixture(scope="module")
def points() -> np.ndarray:
    """In the room, on its walls, and around it."""
    return np.random.default_rng(0).uniform((-5.0, -4.0), (5.0, 4.0), (400, 2))


def by_brute_force(
    snapshot: Snapshot, points: np.ndarray, fusion: Fusion
) -> tuple[np.ndarray, ...]:
    """Every expert at every point, with exact kernels."""
    opinions = [posterior(m.expert, points) for m in snapshot.members.values()]
    means, variances = (np.array(part) for part in zip(*opinions, strict=True))
    return fuse(means, variances, snapshot.prior_variance, fusion)


def probability(
    snapshot: Snapshot, mean: np.ndarray, variance: np.ndarray, points: np.ndarray
) -> np.ndarray:
    """By the link, what the evidence at the points weighs being added up one by one."""
    counts = sum(weighed(m.expert, points) for m in snapshot.members.values())
    left = variance / snapshot.prior_variance
    return snapshot.link.probability(mean, left, *np.log1p(counts))


@pytest.mark.parametrize("fusion", list(Fusion))
def test_the_index_changes_no_probability_by_a_thousandth(
    snapshot: Snapshot, points: np.ndarray, fusion: Fusion
) -> None:
    mean, variance = by_brute_force(snapshot, points, fusion)
    exact = probability(snapshot, mean, variance, points)
    got = snapshot.query(points, fusion.name.lower())
    assert abs(got.occupancy - exact).max() < 5e-4
    assert abs(got.mean - mean).max() < 5e-3
    np.testing.assert_allclose(got.variance, variance, rtol=2e-2)


@pytest.mark.parametrize(
    "settings",
    [
        {"free_evidence": "segments"},
        {"length_scale_m": 0.35, "signal_std": 1.4},
        {"coarse_levels": 0, "max_observations": 120},
    ],
    ids=["segments", "another kernel", "many small experts"],
)
def test_the_index_is_as_good_whatever_the_map_is_made_of(
    points: np.ndarray, settings: dict[str, object]
) -> None:
    snapshot = mapped(5, **settings).snapshot()
    mean, variance = by_brute_force(snapshot, points, Fusion.BCM)
    exact = probability(snapshot, mean, variance, points)
    assert abs(snapshot.query(points).occupancy - exact).max() < 1e-3


def test_a_long_length_scale_reaches_far() -> None:
    mapper = Mapper(MapConfig(length_scale_m=3.0))
    mapper.update(look(0.0, 0.0, walls=[((1.0, -0.1), (1.0, 0.1))], range_max=1.5, beams=30))
    snapshot = mapper.train()
    around = 11.0 * np.array([(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)])
    mean, variance = by_brute_force(snapshot, around, Fusion.BCM)
    got = snapshot.query(around)
    assert (got.variance < snapshot.prior_variance).all()
    np.testing.assert_allclose(got.variance, variance, atol=1e-3)
    np.testing.assert_allclose(got.mean, mean, atol=1e-3)


def test_walls_are_occupied_the_room_is_free_and_beyond_is_unknown(snapshot: Snapshot) -> None:
    answer = snapshot.query([(-3.03, 0.5), (1.02, 0.7), (-1.0, 0.0), (2.5, -1.5), (-8.0, 0.0)])
    assert (answer.occupancy[:2] > 0.9).all()
    assert (answer.occupancy[2:4] < 0.1).all()
    assert answer.known.tolist() == [True, True, True, True, False]


@pytest.mark.parametrize("distance", [20.0, 1e3, 1e7, 1e15, 1e300, 1.7e308])
def test_unknown_space_is_exactly_even_at_any_distance(snapshot: Snapshot, distance: float) -> None:
    around = distance * np.array([(1, 0), (0, 1), (-1, 0), (0, -1), (1, 1), (-1, 1), (1e-9, -1)])
    for fusion in ("bcm", "rbcm"):
        answer = snapshot.query(around, fusion)
        assert (answer.occupancy == 0.5).all()
        assert (answer.mean == 0.0).all()
        assert (answer.variance == snapshot.prior_variance).all()
        assert not answer.known.any()


def test_known_and_unknown_points_may_be_asked_together(
    snapshot: Snapshot, points: np.ndarray
) -> None:
    far = np.array([[1e300, 0.0], [0.0, -1e300]])
    mixed = snapshot.query(np.concatenate([far[:1], points, far[1:]]))
    assert np.array_equal(mixed.occupancy[1:-1], snapshot.query(points).occupancy)
    assert mixed.occupancy[[0, -1]].tolist() == [0.5, 0.5]


def test_points_asked_one_by_one_get_the_same_answers(
    snapshot: Snapshot, points: np.ndarray
) -> None:
    together = snapshot.query(points[:60])
    for i in range(60):
        alone = snapshot.query(points[i : i + 1])
        assert alone.occupancy[0] == together.occupancy[i]
        assert alone.variance[0] == together.variance[i]


def test_a_grid_is_asked_at_the_centres_of_its_cells(snapshot: Snapshot) -> None:
    grid = snapshot.grid((-1.0, 0.5, 0.6, 1.5), 0.25)
    assert grid.occupancy.shape == grid.variance.shape == grid.known.shape == (4, 7)
    for row, column in [(0, 0), (3, 0), (0, 6), (2, 3)]:
        at = [(-1.0 + (column + 0.5) * 0.25, 0.5 + (row + 0.5) * 0.25)]
        assert grid.occupancy[row, column] == snapshot.query(at).occupancy[0]


@pytest.mark.parametrize("bbox", [(0.0, 0.0, 0.3, 0.1), (1e6, 1e6, 1e6 + 0.3, 1e6 + 0.1)])
def test_rounding_adds_no_cells(bbox: tuple[float, float, float, float]) -> None:
    assert Snapshot().grid(bbox, 0.1).occupancy.shape == (1, 3)


@pytest.mark.parametrize(
    "wrong",
    [
        [1.0, 2.0],
        [[1.0, 2.0, 3.0]],
        [[[1.0, 2.0]]],
        5.0,
        "here",
        [["a", "b"]],
        None,
        [[1.0, 2.0], [3.0]],
        [[np.nan, 0.0]],
        [[0.0, np.inf]],
        [[0.0, -np.inf]],
        [[10**400, 0]],
        [[1j, 0]],
        {"x": 1},
    ],
    ids=repr,
)
def test_points_that_are_none_are_refused(snapshot: Snapshot, wrong: object) -> None:
    with pytest.raises(InvalidQueryError, match="points"):
        snapshot.query(wrong)  # type: ignore[arg-type]


def test_an_unknown_fusion_rule_is_refused(snapshot: Snapshot) -> None:
    with pytest.raises(InvalidQueryError, match="'average' is not known"):
        snapshot.query([[0.0, 0.0]], "average")


@pytest.mark.parametrize(
    ("bbox", "resolution_m"),
    [
        ((0.0, 0.0, 0.0, 1.0), 0.1),
        ((0.0, 2.0, 1.0, 1.0), 0.1),
        ((0.0, 0.0, np.nan, 1.0), 0.1),
        ((0.0, 0.0, np.inf, 1.0), 0.1),
        ((0.0, 0.0, 1.0), 0.1),
        ((0.0, 0.0, 1.0, 1.0), 0.0),
        ((0.0, 0.0, 1.0, 1.0), -0.1),
        ((0.0, 0.0, 1.0, 1.0), np.nan),
        ((0.0, 0.0, 1e6, 1e6), 0.1),
        ((-1e308, 0.0, 1e308, 1.0), 1e-3),
        (None, 0.1),
        (("0", "0", "1", "1"), 0.1),
        ((0.0, 0.0, 1.0, 1.0), "0.1"),
        ((0.0, 0.0, 1.0, 10**400), 0.1),
    ],
)
def test_a_raster_that_is_none_is_refused(
    snapshot: Snapshot, bbox: tuple[float, ...], resolution_m: float
) -> None:
    with pytest.raises(InvalidQueryError, match=r"bbox|resolution|cells"):
        snapshot.grid(bbox, resolution_m)  # type: ignore[arg-type]


@pytest.mark.parametrize("fusion", [rule.name.lower() for rule in Fusion])
def test_the_empty_map_knows_nothing(fusion: str) -> None:
    empty = Mapper(MapConfig(signal_std=2.0)).snapshot()
    answer = empty.query([[0.0, 0.0], [1e300, 1.0]], fusion)
    assert answer.occupancy.tolist() == [0.5, 0.5]
    assert answer.variance.tolist() == [4.0, 4.0]
    assert not answer.known.any()
    assert empty.bounds is None
    assert empty.changed_bounds is None
    assert empty.experts() == []
    assert empty.version == 0


def test_no_points_get_no_answers(snapshot: Snapshot) -> None:
    for nothing in ([], np.empty((0, 2))):
        assert snapshot.query(nothing).occupancy.shape == (0,)


def test_bounds_enclose_the_evidence(snapshot: Snapshot) -> None:
    assert snapshot.bounds is not None
    xmin, ymin, xmax, ymax = snapshot.bounds
    assert -3.3 < xmin < -3.0
    assert -2.3 < ymin < -2.0
    assert 5.0 < xmax < 11.0  # through the door, as far as the scanner sees
    assert 2.0 < ymax < 10.0


def test_experts_are_listed_with_their_evidence(snapshot: Snapshot) -> None:
    experts = snapshot.experts()
    assert [e.cluster_id for e in experts] == sorted(snapshot.members)
    for e in experts:
        assert e.observations >= e.hits >= 0
        low, high = (factor * MapConfig().length_scale_m for factor in LENGTH_SCALE_RANGE)
        assert low <= e.length_scale_m <= high
        assert np.isfinite(e.line).all()
    assert sum(e.hits for e in experts) > 100


def test_shards_of_a_committee_are_a_committee(snapshot: Snapshot, points: np.ndarray) -> None:
    members = list(snapshot.members.values())
    empty = snapshot.emptied()
    shards = [empty.swapped(members[i::3]) for i in range(3)]
    for fusion in (Fusion.BCM, Fusion.RBCM):
        together = np.sum([shard.sums(points, fusion) for shard in shards], axis=0)
        whole = snapshot.sums(points, fusion)
        assert (whole.max(axis=0) > 1.0).all()
        np.testing.assert_allclose(together, whole, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0), (1, 2, 0)])
def test_the_counts_of_a_place_are_those_of_the_evidence_at_it(order: tuple[int, ...]) -> None:
    """Hits within a sixth of a length scale, free areas that the place is in, by their weight."""
    near, far = 0.0, 3.0
    kinds = np.array([Kind.POINT, Kind.POINT, Kind.BOX], np.uint8)
    geometry = np.array([[[near, 0.0]] * 2, [[far, 0.0]] * 2, [[-2.0, 1.0], [2.0, 5.0]]])
    noise = np.array([0.5, 0.25, 0.1])
    signal_std, scale = 1.5, 0.2
    targets, turned = np.array([1.0, 1.0, -1.0]), list(order)
    seen = Observations(kinds[turned], geometry[turned], targets[turned], noise[turned], np.ones(3))
    expert = train(seen, Hyperparameters(scale, signal_std))
    snapshot = Snapshot(prior_variance=signal_std**2).swapped(
        [member_of(0, 1, expert, geometry[0])]
    )
    at = np.array([[0.0, 0.0], [0.02, 0.03], [0.3, 0.0], [far, 0.0], [0.0, 3.0], [0.0, 5.0]])
    hits, passes = snapshot.sums(at)[:, OF_HITS:].T
    narrow = scale / np.sqrt(32.0)
    close = np.exp(-0.5 * (0.02**2 + 0.03**2) / narrow**2)
    weight = signal_std**2 / noise
    expected = [weight[0], close * weight[0], 0.0, weight[1], 0.0, 0.0]
    assert hits == pytest.approx(expected, rel=1e-6, abs=1e-9)
    assert passes[4:] == pytest.approx([weight[2], 0.5 * weight[2]], rel=1e-6)
    assert passes[3] == pytest.approx(0.0, abs=1e-5)


def test_evidence_without_noise_is_counted_as_a_number() -> None:
    """However little noise an expert is given, what it says is finite, and so is what it counts."""
    geometry = np.array([[[0.0, 0.0]] * 2, [[0.3, 0.0], [0.4, 0.1]]])
    kinds = np.array([Kind.POINT, Kind.BOX], np.uint8)
    seen = Observations(kinds, geometry, np.array([1.0, -1.0]), np.full(2, 1e-320), np.ones(2))
    member = train_member(0, 1, seen, Hyperparameters(0.2, 1.0), geometry[0])
    answer = Snapshot().swapped([member]).query([[0.0, 0.0], [0.35, 0.05], [9.0, 9.0]])
    assert np.isfinite(answer.occupancy).all()
    assert answer.occupancy[0] > answer.occupancy[1]


@pytest.mark.parametrize(
    "geometry",
    [np.zeros((4, 2, 3)), np.zeros((4, 2, 4))[:, :, ::2], np.zeros((4, 2, 2), np.float32)],
    ids=["in space", "with gaps", "of half the bytes"],
)
def test_evidence_that_queries_could_not_read_is_refused(geometry: np.ndarray) -> None:
    kinds = np.full(4, Kind.POINT, np.uint8)
    seen = Observations(kinds, geometry, np.ones(4), np.ones(4), np.ones(4))
    with pytest.raises(ValueError, match=r"contiguous|uint8"):
        train_member(0, 1, seen, Hyperparameters(0.2, 1.0), np.zeros((2, 2)))


def test_the_counts_of_a_whole_beam_are_those_along_it() -> None:
    geometry = np.array([[[0.0, 0.0], [6.0, 8.0]]])
    seen = Observations(
        np.array([Kind.SEGMENT], np.uint8), geometry, np.array([-1.0]), np.array([0.5]), np.ones(1)
    )
    snapshot = Snapshot().swapped(
        [member_of(0, 1, train(seen, Hyperparameters(0.2, 1.0)), geometry[0])]
    )
    hits, passes = snapshot.sums(np.array([[3.0, 4.0], [0.0, 0.0], [4.0, -3.0]]))[:, OF_HITS:].T
    assert hits.tolist() == [0.0] * 3
    assert passes == pytest.approx([2.0, 1.0, 0.0], abs=1e-6)


def test_the_order_in_which_experts_came_does_not_matter(
    snapshot: Snapshot, points: np.ndarray
) -> None:
    members = list(snapshot.members.values())
    empty = snapshot.emptied()
    one_by_one = empty
    for member in members[::-1]:
        one_by_one = one_by_one.swapped([member])
    assert same(one_by_one.query(points), snapshot.query(points))


def test_a_committee_without_an_expert_is_one_that_never_had_it(
    snapshot: Snapshot, points: np.ndarray
) -> None:
    *others, gone = sorted(snapshot.members.values(), key=lambda m: len(m.expert.observations))
    without = snapshot.swapped([], [gone.cluster_id])
    never = snapshot.emptied().swapped(others)
    assert gone.cluster_id not in without.members
    assert same(without.query(points), never.query(points))
    assert not same(without.query(points), snapshot.query(points))


def test_a_version_answers_the_same_whatever_comes_after(points: np.ndarray) -> None:
    mapper = mapped(3)
    old = mapper.snapshot()
    version, before, experts = old.version, old.query(points), old.experts()
    for i in range(4):
        mapper.update(look(0.5 - 0.3 * i, 0.2 * i, walls=[((-1.0, 1.43), (2.0, 1.44))]))
        mapper.train()
    assert same(old.query(points), before)
    assert old.version == version
    assert old.experts() == experts
    assert mapper.snapshot().version > version
    assert not same(mapper.snapshot().query(points), before)


def test_what_is_outside_the_changed_area_answers_as_before(points: np.ndarray) -> None:
    mapper = mapped(6)
    old = mapper.snapshot()
    mapper.update(look(2.6, 0.0, walls=[((2.8, -0.2), (2.8, 0.2))], range_max=0.5))
    new = old.swapped([job.run() for job in mapper.take_jobs(1000)])
    assert new.changed_bounds is not None
    xmin, ymin, xmax, ymax = new.changed_bounds
    x, y = points.T
    outside = (x < xmin) | (x > xmax) | (y < ymin) | (y > ymax)
    assert 0 < np.count_nonzero(outside) < len(points)
    a, b = old.query(points), new.query(points)
    assert np.array_equal(a.variance[outside], b.variance[outside])
    assert not np.array_equal(a.variance, b.variance)


def test_where_nothing_reaches_all_is_unknown(snapshot: Snapshot, points: np.ndarray) -> None:
    assert snapshot.reach is not None
    xmin, ymin, xmax, ymax = snapshot.reach
    x, y = points.T
    outside = (x < xmin) | (x > xmax) | (y < ymin) | (y > ymax)
    assert 0 < np.count_nonzero(outside) < len(points)
    assert (snapshot.query(points[outside]).variance == snapshot.prior_variance).all()


def test_a_new_calibration_changes_probabilities_and_nothing_else(
    snapshot: Snapshot, points: np.ndarray
) -> None:
    other = snapshot.with_link(Link((1.0, 0.0, 0.0, 0.0, 0.0, 0.0)))
    a, b = snapshot.query(points), other.query(points)
    assert np.array_equal(a.mean, b.mean)
    assert np.array_equal(a.variance, b.variance)
    assert not np.array_equal(a.occupancy, b.occupancy)
    assert other.changed_bounds == snapshot.reach


@pytest.mark.parametrize("x", [0.0, 1e6, -9e6, 1e7])
@pytest.mark.parametrize("resolution_m", [0.05, 0.1, 0.3])
def test_a_raster_has_the_cells_it_was_made_of_wherever_it_is(
    x: float, resolution_m: float
) -> None:
    for cells in range(1, 200):
        first = np.floor(x / resolution_m)
        edges = (first * resolution_m, (first + cells) * resolution_m)
        assert grid_shape((edges[0], 0.0, edges[1], 1.0), resolution_m)[1] == cells


def same(a: Prediction, b: Prediction) -> bool:
    return all(
        np.array_equal(getattr(a, name), getattr(b, name))
        for name in ("occupancy", "mean", "variance", "known")
    )
