"""From the committee's sums to probability in the online map: the link, and how it is fitted."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.special import expit, log_expit

from gpom_core.link import DEFAULT_WEIGHTS, Link, fit

positive = st.floats(0.0, 20.0)
number = st.floats(-20.0, 20.0)
counts = st.floats(0.0, 12.0)  # log(1 + weight)
links = st.builds(Link, st.tuples(positive, positive, positive, positive, number, number))


def log_odds(
    mean: float, u: float, hits: float, passes: float, weights: tuple[float, ...]
) -> float:
    """The formula of the docstring, term by term."""
    a, b, c, d, e, f = weights
    w, k = 1.0 - u, 0.2
    cubed = (mean + k * w) ** 3 - (k * w) ** 3
    return a * mean + b * cubed + c * hits - d * passes + w * (e + f * u)


@given(links, st.floats(-1.5, 1.5), st.floats(1e-6, 1.0), counts, counts)
def test_it_is_the_formula(link: Link, mean: float, u: float, hits: float, passes: float) -> None:
    got = link.probability(*(np.array([value]) for value in (mean, u, hits, passes)))
    assert got[0] == pytest.approx(expit(log_odds(mean, u, hits, passes, link.weights)), abs=1e-9)


@given(links)
def test_knowing_nothing_is_even(link: Link) -> None:
    left = np.array([1.0, 1.0 + 1e-12, 1e9])  # rounding may leave more than the prior
    assert link.probability(np.zeros(3), left, np.zeros(3), np.zeros(3)).tolist() == [0.5] * 3


@given(links, st.floats(1e-6, 1.0), counts)
def test_more_mean_or_hits_is_never_less_probability_and_more_passes_never_more(
    link: Link, u: float, other: float
) -> None:
    mean, count = np.linspace(-2.0, 2.0, 101), np.linspace(0.0, 12.0, 101)
    left, same = np.full(101, u), np.full(101, other)
    assert (np.diff(link.probability(mean, left, same, same)) >= 0.0).all()
    assert (np.diff(link.probability(same / 12.0, left, count, same)) >= 0.0).all()
    assert (np.diff(link.probability(same / 12.0, left, same, count)) <= 0.0).all()


def test_probabilities_stay_within_their_range() -> None:
    mean = np.array([-1e6, 0.0, 1.0, 1e6])
    p = Link().probability(mean, np.full(4, 1e-300), np.zeros(4), np.full(4, 700.0))
    assert ((p >= 0.0) & (p <= 1.0)).all()


Drawn = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def drawn(weights: tuple[float, ...], n: int) -> Drawn:
    """What is said and what happens in a world where these weights are the truth."""
    rng = np.random.default_rng(0)
    mean, u = rng.uniform(-1.1, 1.1, n), rng.beta(0.5, 1.0, n).clip(1e-4)
    hits, passes = (2.0 * np.maximum(s * mean, 0.0) + rng.uniform(0.0, 3.0, n) for s in (1.0, -1.0))
    truth = Link(weights).probability(mean, u, hits, passes)
    return mean, u, hits, passes, rng.random(n) < truth


def test_the_truth_is_found_again() -> None:
    truth = (2.0, 1.5, 0.5, 0.8, 0.8, 2.0)
    found = fit(*drawn(truth, 100_000))
    assert found.weights == pytest.approx(truth, abs=0.35)
    assert not found.differs(Link(truth), 0.02)


@pytest.mark.parametrize(
    "truth",
    [
        (2.0, 1.5, 0.5, 0.8, 0.8, 2.0),
        (4.0, 0.3, -1.0, 0.2, 0.0, 6.0),
        (-3.0, -1.0, 0.5, -1.0, 9.0, -9.0),
    ],
)
def test_it_is_the_best_by_another_way_of_looking(truth: tuple[float, ...]) -> None:
    """L-BFGS-B on the loss as the docstrings say it; the best may lie on any of the bounds."""
    rng = np.random.default_rng(1)
    mean, u = rng.uniform(-1.1, 1.1, 3000), rng.beta(0.5, 1.0, 3000).clip(1e-4)
    said = (mean, u, rng.uniform(0.0, 3.0, 3000), rng.uniform(0.0, 3.0, 3000))
    occupied = rng.random(3000) < expit(log_odds(*said, truth))  # type: ignore[arg-type]
    spread = np.array([0.91, 1.04, 2.19, 1.66, 0.25, 0.07])
    pull = np.array([1.0, 8.0, 8.0, 8.0, 8.0, 8.0])
    parts = [log_odds(*said, tuple(one)) for one in np.eye(6)]  # type: ignore[arg-type]
    terms = np.column_stack(parts) / spread

    def loss(theta: np.ndarray) -> float:
        score = np.where(occupied, 1.0, -1.0) * (terms @ theta)
        return -log_expit(score).sum() + pull @ (theta - DEFAULT_WEIGHTS * spread) ** 2

    bounds = [(0.0, None)] * 4 + [(None, None)] * 2
    best = minimize(loss, DEFAULT_WEIGHTS * spread, bounds=bounds, options={"ftol": 1e-15})
    found = np.array(fit(*said, occupied).weights) * spread
    assert loss(found) <= best.fun + 1e-9
    np.testing.assert_allclose(found, best.x, atol=1e-3)


def test_no_evidence_is_the_default_and_a_little_changes_little() -> None:
    empty = np.empty(0)
    assert fit(empty, empty, empty, empty, empty.astype(bool)) == Link()
    few = fit(*drawn((9.0, 0.0, 0.0, 0.0, 0.0, 0.0), 5))
    assert not few.differs(Link(), 0.2)


@pytest.mark.parametrize("contradicted", [False, True])
def test_evidence_of_one_kind_cannot_run_away(contradicted: bool) -> None:
    mean = np.repeat([1.0, 0.9, -1.0, -1.1], 500)
    count = np.maximum(mean, 0.0)
    occupied = (mean > 0.0) ^ contradicted
    found = fit(mean, np.full(2000, 0.01), count, 1.0 - count, occupied)
    assert np.isfinite(found.weights).all()
    assert min(found.weights[:4]) >= 0.0


def test_links_that_say_the_same_do_not_differ() -> None:
    near = (DEFAULT_WEIGHTS[0] + 0.001, *DEFAULT_WEIGHTS[1:])
    assert not Link(near).differs(Link(), 0.003)
    assert Link((DEFAULT_WEIGHTS[0] + 1.0, *DEFAULT_WEIGHTS[1:])).differs(Link(), 0.003)


@pytest.mark.parametrize("changed", [2, 3])
def test_links_that_weigh_counts_otherwise_differ(changed: int) -> None:
    weights = [w + (0.1 if i == changed else 0.0) for i, w in enumerate(DEFAULT_WEIGHTS)]
    assert Link(tuple(weights)).differs(Link(), 0.003)


@pytest.mark.parametrize(
    "weights",
    [(1.0,), (1.0, 1.0, 1.0, -0.1, 0.0, 0.0), (np.nan, 0, 0, 0, 0, 0), (1.0, 0, 0, 0, np.inf, 0)],
)
def test_weights_that_make_no_link_are_refused(weights: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="six numbers"):
        Link(weights)
