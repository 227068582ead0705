"""Laws of the integral kernels, for any shapes."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from gpom_core.kernels import cross, gram, prior_variance_of
from gpom_core.shapes import Kind

Shapes = tuple[NDArray[np.uint8], NDArray[np.float64]]

coordinates = st.floats(-12.0, 12.0) | st.sampled_from([0.0, 0.25, 1.0])
lengths = st.sampled_from([0.0, 1e-12, 1e-8, 1e-4, 0.1, 0.45, 0.5, 1.0]) | st.floats(0.0, 20.0)
scales = st.floats(0.2, 5.0)
angles = st.floats(-np.pi, np.pi)


@st.composite
def shapes(draw: st.DrawFn, dimensions=(1, 2, 3), kinds=tuple(Kind), most: int = 8) -> Shapes:
    d = draw(st.sampled_from(dimensions))
    drawn = draw(st.lists(st.sampled_from(kinds), min_size=1, max_size=most))
    rows = []
    for kind in drawn:
        start = np.array(draw(st.lists(coordinates, min_size=d, max_size=d)))
        span = np.array(draw(st.lists(lengths, min_size=d, max_size=d)))
        if kind == Kind.SEGMENT:
            span *= np.array(draw(st.lists(st.sampled_from([-1.0, 1.0]), min_size=d, max_size=d)))
        rows.append(np.stack([start, start if kind == Kind.POINT else start + span]))
    return np.array(drawn, np.uint8), np.stack(rows)


@given(shapes(), scales)
def test_gram_is_symmetric_bounded_and_positive_semidefinite(drawn: Shapes, scale: float) -> None:
    k = gram(*drawn, scale)
    assert np.array_equal(k, k.T)
    assert np.linalg.eigvalsh(k).min() > -1e-9 * len(k)
    deviation = np.sqrt(np.diag(k))
    assert (np.abs(k) <= deviation[:, None] * deviation + 1e-9).all()


@given(shapes(), scales)
def test_prior_variance_is_the_diagonal_of_the_gram(drawn: Shapes, scale: float) -> None:
    assert np.allclose(
        prior_variance_of(*drawn, scale), np.diag(gram(*drawn, scale)), rtol=0.0, atol=2e-10
    )


@given(shapes(), st.randoms(use_true_random=False), scales)
def test_order_of_shapes_does_not_matter(drawn: Shapes, random, scale: float) -> None:
    kinds, geometry = drawn
    order = list(range(len(kinds)))
    random.shuffle(order)
    got = gram(kinds[order], geometry[order], scale)
    assert np.allclose(got, gram(*drawn, scale)[np.ix_(order, order)], rtol=0.0, atol=3e-10)


@given(shapes(), scales)
def test_a_segment_has_no_direction(drawn: Shapes, scale: float) -> None:
    kinds, geometry = drawn
    turned = geometry.copy()
    segments = kinds == Kind.SEGMENT
    turned[segments] = geometry[segments][:, ::-1]
    assert np.allclose(gram(kinds, turned, scale), gram(*drawn, scale), rtol=0.0, atol=3e-10)


@given(shapes(), st.floats(-100.0, 100.0), scales)
def test_moving_everything_changes_nothing(drawn: Shapes, by: float, scale: float) -> None:
    kinds, geometry = drawn
    assert np.allclose(gram(kinds, geometry + by, scale), gram(*drawn, scale), rtol=0.0, atol=1e-9)


@given(shapes((2,), (Kind.POINT, Kind.SEGMENT)), angles, scales)
def test_turning_points_and_segments_changes_nothing(
    drawn: Shapes, angle: float, scale: float
) -> None:
    kinds, geometry = drawn
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    turned = geometry @ turn.T
    turned[kinds == Kind.POINT, 1] = turned[kinds == Kind.POINT, 0]
    assert np.allclose(gram(kinds, turned, scale), gram(*drawn, scale), rtol=0.0, atol=1e-9)


@given(shapes(), st.sampled_from([0.0, 1e-300, 1e-14, 1e-10, 1e-8]))
def test_shapes_shrunk_to_points_are_points(drawn: Shapes, size: float) -> None:
    kinds, geometry = drawn
    shrunk = geometry.copy()
    shrunk[:, 1] = shrunk[:, 0] + size * np.sign(geometry[:, 1] - geometry[:, 0])
    points = np.repeat(geometry[:, :1], 2, axis=1)
    true = gram(np.zeros_like(kinds), points, 1.0)
    assert np.allclose(gram(kinds, shrunk, 1.0), true, rtol=0.0, atol=10.0 * size + 1e-10)
    at_origin = np.zeros((1, geometry.shape[2]))
    assert np.allclose(
        cross(kinds, shrunk, at_origin, 1.0),
        cross(np.zeros_like(kinds), points, at_origin, 1.0),
        rtol=0.0,
        atol=10.0 * size + 1e-10,
    )


@given(shapes((1,)), scales)
def test_on_a_line_a_box_is_a_segment(drawn: Shapes, scale: float) -> None:
    kinds, geometry = drawn
    as_boxes = np.where(kinds == Kind.SEGMENT, Kind.BOX, kinds)
    ordered = np.sort(geometry, axis=1)
    assert np.allclose(gram(as_boxes, ordered, scale), gram(*drawn, scale), rtol=0.0, atol=3e-10)


@given(shapes(most=3), st.integers(2, 4))
def test_a_shape_is_the_mean_of_its_parts(drawn: Shapes, parts: int) -> None:
    kinds, geometry = drawn
    points = np.array([np.zeros(geometry.shape[2]), np.ones(geometry.shape[2])])
    whole = cross(kinds, geometry, points, 1.0)
    span = geometry[:, 1] - geometry[:, 0]
    # boxes are cut across the first axis, segments along themselves
    along = np.where((kinds == Kind.BOX)[:, None], np.eye(1, span.shape[1])[0] * span, span)
    total = np.zeros_like(whole)
    for part in range(parts):
        cut = geometry.copy()
        cut[:, 0] += along * part / parts
        cut[:, 1] = cut[:, 0] + span - along * (1.0 - 1.0 / parts)
        cut[kinds == Kind.BOX, 1] = np.maximum(cut, cut[:, :1])[kinds == Kind.BOX, 1]
        total += cross(kinds, cut, points, 1.0) / parts
    assert np.allclose(total, whole, rtol=0.0, atol=3e-10)
