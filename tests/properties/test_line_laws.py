"""Laws of line tracking, for any hits in any order."""

import numpy as np
from hypothesis import example, given
from hypothesis import strategies as st

from gpom_core.lines import GAP_IN_BEAMS, principal_axis, track_lines

TOLERANCE_M, GAP_M = 0.1, 0.3


@st.composite
def hits(draw: st.DrawFn) -> np.ndarray:
    """Polylines with noise, and stray points, (n, 2)."""
    parts = []
    for _ in range(draw(st.integers(0, 4))):
        ends = np.array(draw(st.tuples(*[st.floats(-4.0, 4.0)] * 4))).reshape(2, 2)
        parts.append(np.linspace(*ends, draw(st.integers(1, 40))))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    xy = np.concatenate([np.empty((0, 2)), *parts])
    return xy + rng.normal(scale=draw(st.sampled_from([0.0, 0.02, 0.2])), size=xy.shape)


def starts_of(xy: np.ndarray, spacing_m: float = 0.02) -> np.ndarray:
    return track_lines(xy, np.full(len(xy), spacing_m), TOLERANCE_M, GAP_M)


@given(hits())
def test_runs_divide_the_hits_without_gaps_between_neighbours(xy) -> None:
    starts = starts_of(xy)
    assert starts.shape == (len(xy) + 1,)
    used = starts[starts < len(xy)]
    assert (np.diff(used) > 0).all()
    assert (starts[len(used) :] == len(xy)).all()
    if len(xy):
        assert starts[0] == 0
    for run in np.split(xy, used[1:]):
        steps = np.linalg.norm(np.diff(run, axis=0), axis=1)
        assert (steps <= max(GAP_M, GAP_IN_BEAMS * 0.02) + 1e-12).all()


@given(hits(), st.floats(-np.pi, np.pi), st.floats(-1e4, 1e4), st.floats(-1e4, 1e4))
def test_runs_move_with_the_room(xy, turn: float, dx: float, dy: float) -> None:
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    starts, moved = starts_of(xy), starts_of(xy @ rotation.T + np.array([dx, dy]))
    if not np.array_equal(starts, moved):  # only where rounding decides: a hair changes it here too
        hairs = np.random.default_rng(0).normal(scale=1e-10, size=(20, *xy.shape))
        assert any(not np.array_equal(starts_of(xy + hair), starts) for hair in hairs)


@given(hits())
@example(np.array([[2.4619215e-160, 0.0], [0.0, 0.0]]))
def test_the_axis_is_where_the_hits_spread_most(xy) -> None:
    if len(xy) == 0:
        return
    m = np.array(
        [len(xy), *xy.sum(0), (xy[:, 0] ** 2).sum(), xy.prod(1).sum(), (xy[:, 1] ** 2).sum()]
    )
    cx, cy, tx, ty, along, across = principal_axis(m)
    np.testing.assert_allclose(np.hypot(tx, ty), 1.0)
    spread = xy - np.array([cx, cy])
    np.testing.assert_allclose((spread @ [tx, ty]).var(), along, atol=1e-9)
    np.testing.assert_allclose((spread @ [-ty, tx]).var(), across, atol=1e-9)
    assert along >= across >= 0.0
