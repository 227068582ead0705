import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

from gpom_core import kernels
from gpom_core.kernels import cross, gram, prior_variance_of
from gpom_core.shapes import Kind
from tests.gpom_core.integrals import simpson, to_30_digits

LENGTHS = [0.0, 1e-9, 1e-3, 0.3, 0.46, 1.0, 3.1, 7.7, 20.0]
SCALAR = {
    Kind.POINT: kernels.point_point,
    Kind.SEGMENT: kernels.point_segment,
    Kind.BOX: kernels.point_box,
}


def shape(kind: Kind, middle: NDArray[np.float64], span: NDArray[np.float64]) -> NDArray:
    if kind == Kind.POINT:
        return np.stack([middle, middle])
    if kind == Kind.BOX:
        span = np.abs(span)
    return np.stack([middle - span / 2, middle + span / 2])


def shapes(
    count: int, d: int, seed: int, reach: float = 4.0
) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Shapes of all kinds and lengths near the origin; some boxes are flat."""
    rng = np.random.default_rng(seed)
    kinds = rng.integers(0, len(Kind), count).astype(np.uint8)
    middle = rng.uniform(-reach / 2, reach / 2, (count, d))
    direction = rng.normal(size=(count, d))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    direction[rng.uniform(size=(count, d)) < 0.2] = 0.0
    span = direction * rng.choice(LENGTHS, count)[:, None]
    rows = [shape(Kind(k), m, s) for k, m, s in zip(kinds, middle, span, strict=True)]
    return kinds, np.stack(rows)


def assert_kernels_agree(got, true, prior_variance) -> None:
    allowed = 1e-9 * np.sqrt(prior_variance[:, None] * prior_variance)
    assert (np.abs(got - true) <= allowed).all()


@pytest.mark.parametrize("d", [1, 2, 3])
def test_gram_of_all_kinds_is_exact_to_1e_9_of_the_prior_variance(d: int) -> None:
    kinds, geometry = shapes(24, d, seed=d)
    true = np.empty((len(kinds), len(kinds)))
    for i, j in itertools.combinations_with_replacement(range(len(kinds)), 2):
        pair = [(Kind(kinds[k]), geometry[k]) for k in (i, j)]
        true[i, j] = true[j, i] = to_30_digits(*pair)
    assert_kernels_agree(gram(kinds, geometry, 1.0), true, np.diag(true))
    assert np.allclose(prior_variance_of(kinds, geometry, 1.0), np.diag(true), rtol=1e-9)


@pytest.mark.parametrize("lengths", [*itertools.combinations_with_replacement(LENGTHS[3:], 2)])
def test_segments_of_all_lengths_and_angles(lengths: tuple[float, float]) -> None:
    rng = np.random.default_rng(1)
    for angle in np.deg2rad([0.0, 1e-6, 20.0, 45.0, 90.0, 180.0]):
        direction = np.array([np.cos(angle), np.sin(angle)])
        offset = rng.uniform(-1.0, 1.0, 2) * (1.0 + np.array(lengths) / 2)
        first = shape(Kind.SEGMENT, np.zeros(2), np.array([lengths[0], 0.0]))
        second = shape(Kind.SEGMENT, offset, lengths[1] * direction)
        got = gram([Kind.SEGMENT] * 2, np.stack([first, second]), 1.0)
        true = to_30_digits((Kind.SEGMENT, first), (Kind.SEGMENT, second))
        assert abs(got[0, 1] - true) < 1e-9 * np.sqrt(got[0, 0] * got[1, 1])


@pytest.mark.parametrize("d", [1, 2, 3])
def test_cross_is_exact_to_1e_9(d: int) -> None:
    kinds, geometry = shapes(24, d, seed=10 + d)
    points = np.random.default_rng(d).uniform(-4.0, 4.0, (8, d))
    got = cross(kinds, geometry, points, 1.0)
    for (i, point), j in itertools.product(enumerate(points), range(len(kinds))):
        true = to_30_digits((Kind.POINT, np.stack([point, point])), (Kind(kinds[j]), geometry[j]))
        assert got[i, j] == pytest.approx(true, abs=5e-10)


def test_closed_forms_agree_with_simpson_over_both_segments() -> None:
    kinds, geometry = shapes(12, 2, seed=5)
    lines = np.flatnonzero(kinds != Kind.BOX)
    got = gram(kinds[lines], geometry[lines], 1.0)
    for a, b in itertools.product(range(lines.size), repeat=2):
        pair = [(Kind(kinds[k]), geometry[k]) for k in (lines[a], lines[b])]
        assert got[a, b] == pytest.approx(simpson(*pair), abs=2e-8)


@pytest.mark.parametrize("d", [1, 2, 3])
def test_cross_equals_the_gram_block_of_points(d: int) -> None:
    kinds, geometry = shapes(30, d, seed=20 + d)
    points = np.random.default_rng(d).uniform(-3.0, 3.0, (9, d))
    both_kinds = np.concatenate([kinds, np.zeros(9, np.uint8)])
    both = np.concatenate([geometry, np.stack([points, points], axis=1)])
    block = gram(both_kinds, both, 0.8)[30:, :30]
    assert np.allclose(cross(kinds, geometry, points, 0.8), block, rtol=0.0, atol=3e-10)


@pytest.mark.parametrize("d", [1, 2, 3])
def test_batched_equals_looped(d: int) -> None:
    kinds, geometry = shapes(30, d, seed=30 + d)
    points = np.random.default_rng(d).uniform(-3.0, 3.0, (7, d))
    scale = np.linspace(0.5, 0.9, d)
    looped = [
        [SCALAR[Kind(k)](row, p, 1.0 / scale) for k, row in zip(kinds, geometry, strict=True)]
        for p in points
    ]
    assert np.allclose(cross(kinds, geometry, points, scale), looped, rtol=0.0, atol=1e-12)
    one_by_one = np.vstack([cross(kinds, geometry, p[None], scale) for p in points])
    assert np.allclose(cross(kinds, geometry, points, scale), one_by_one, rtol=0.0, atol=1e-12)


def test_many_points_are_answered_as_few() -> None:
    kinds, geometry = shapes(10, 2, seed=3)
    points = np.random.default_rng(3).uniform(-3.0, 3.0, (1100, 2))
    got = cross(kinds, geometry, points, 1.0)
    for part in (slice(0, 5), slice(510, 515), slice(1095, 1100)):
        assert np.allclose(got[part], cross(kinds, geometry, points[part], 1.0), atol=1e-12)


def test_a_length_scale_per_axis_stretches_that_axis() -> None:
    kinds, geometry = shapes(20, 3, seed=7)
    scale = np.array([0.5, 2.0, 1.3])
    assert np.allclose(gram(kinds, geometry, scale), gram(kinds, geometry / scale, 1.0), atol=1e-12)


@pytest.mark.parametrize("kind", Kind)
@pytest.mark.parametrize("other", Kind)
def test_far_apart_is_nothing(kind: Kind, other: Kind) -> None:
    near = shape(kind, np.zeros(2), np.array([1.0, 0.5]))
    for middle in ([9.0, 0.0], [0.0, -9.0], [-7.0, 7.0], [1e3, 1e3], [1e9, 0.0]):
        far = shape(other, np.array(middle), np.array([0.7, 1.0]))
        value = gram([kind, other], np.stack([near, far]), 1.0)[0, 1]
        assert abs(value) < 1e-10
    assert value == 0.0


@pytest.mark.parametrize("distance", [1e2, 1e6, 1e12, 1e40, 1e160, 1e300])
def test_points_however_far_away_are_finite_and_nothing(distance: float) -> None:
    kinds = np.repeat(np.array(list(Kind), np.uint8), 2)
    spans = np.array([[0.0, 0.0], [0.0, 0.0], [0.1, 0.0], [3.0, 3.0], [0.1, 0.0], [3.0, 3.0]])
    geometry = np.stack([np.zeros((6, 2)), spans], axis=1)
    turn = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    points = distance * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    looped = [
        [SCALAR[Kind(k)](row, p, np.ones(2)) for k, row in zip(kinds, geometry, strict=True)]
        for p in points
    ]
    assert np.abs(cross(kinds, geometry, points, 1.0)).max() < 1e-10
    assert np.abs(looped).max() < 1e-10


def test_boxes_of_a_lattice_equal_boxes_that_share_no_side() -> None:
    rng = np.random.default_rng(2)
    corner = rng.integers(0, 6, (40, 2)) * 0.25
    lattice = np.stack([corner, corner + rng.choice([0.25, 0.5], (40, 1))], axis=1)
    kinds = np.full(40, Kind.BOX)
    apart = lattice + np.arange(40)[:, None, None] * 1e-13
    assert np.allclose(gram(kinds, lattice, 0.4), gram(kinds, apart, 0.4), atol=1e-11)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("most", list(Kind))
@pytest.mark.parametrize("in_order", [True, False])
def test_the_upper_triangle_is_that_of_the_gram_matrix(d: int, most: Kind, in_order: bool) -> None:
    kinds, geometry = shapes(61, d, seed=7)
    if most is not Kind.SEGMENT:  # points, boxes, or both
        chosen = kinds == Kind.BOX if most is Kind.BOX else kinds != Kind.SEGMENT
        kinds, geometry = kinds[chosen], geometry[chosen]
    if in_order:
        order = np.argsort(kinds, kind="stable")
        kinds, geometry = kinds[order], geometry[order]
    n = len(kinds)
    got = np.full((n + 3, n + 3), np.nan)
    assert kernels.gram_upper_into(kinds, geometry, np.full(d, 2.0), got) == 0
    upper = np.triu_indices(n)
    np.testing.assert_allclose(got[upper], gram(kinds, geometry, 0.5)[upper], atol=1e-14)


def test_no_shapes_and_no_points_are_fine() -> None:
    nothing = np.empty((0, 2, 2))
    kinds, geometry = shapes(4, 2, seed=1)
    assert gram([], nothing, 1.0).shape == (0, 0)
    assert prior_variance_of([], nothing, 1.0).shape == (0,)
    assert cross([], nothing, np.zeros((3, 2)), 1.0).shape == (3, 0)
    assert cross(kinds, geometry, np.empty((0, 2)), 1.0).shape == (0, 4)


BOX = [[[0.0, 0.0], [1.0, 1.0]]]


@pytest.mark.parametrize(
    ("kinds", "geometry", "scale", "message"),
    [
        ([2], [[0.0, 1.0]], 1.0, r"geometry must have shape \(n, 2, d\)"),
        ([2], [[[0.0], [1.0], [2.0]]], 1.0, r"geometry must have shape \(n, 2, d\)"),
        ([2], [[[0.0, 0.0], [np.nan, 1.0]]], 1.0, "geometry must be finite"),
        ([2, 2], BOX, 1.0, r"kinds must have shape \(1,\)"),
        ([3], BOX, 1.0, "values of Kind"),
        ([258], BOX, 1.0, "values of Kind"),
        ([2], [[[0.0, 2.0], [1.0, 1.0]]], 1.0, "low corner first"),
        ([0], BOX, 1.0, "a point must be given twice"),
        ([2], BOX, [1.0, 1.0, 1.0], r"one number or \(2,\)"),
        ([2], BOX, 0.0, "finite and positive"),
        ([2], BOX, 1e-5, "longer than 10000 length scales"),
        ([0.5], BOX, 1.0, "values of Kind"),
        ([2], BOX, [1.0, np.inf], "finite and positive"),
    ],
)
def test_what_does_not_fit_is_refused(kinds, geometry, scale, message) -> None:
    for call in (gram, prior_variance_of, lambda k, g, s: cross(k, g, [[0.0, 0.0]], s)):
        with pytest.raises(ValueError, match=message):
            call(kinds, geometry, scale)


@pytest.mark.parametrize(
    ("points", "message"),
    [([[0.0]], r"shape \(m, 2\)"), ([0.0, 0.0], r"shape \(m, 2\)"), ([[0.0, np.inf]], "finite")],
)
def test_points_that_do_not_fit_are_refused(points, message) -> None:
    with pytest.raises(ValueError, match=message):
        cross([2], BOX, points, 1.0)
