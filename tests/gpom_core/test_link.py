"""From mean and variance to probability in the online map: the link, and how it is fitted."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.special import expit, log_expit

from gpom_core.link import DEFAULT_WEIGHTS, Link, fit

positive = st.floats(0.0, 20.0)
number = st.floats(-20.0, 20.0)
links = st.builds(Link, st.tuples(positive, positive, positive, number, number))


def log_odds(mean: float, u: float, weights: tuple[float, ...]) -> float:
    """The formula of the docstring, term by term."""
    a, b, c, d, e = weights
    w, k = 1.0 - u, 0.2
    cubed = (mean + k * w) ** 3 - (k * w) ** 3
    return mean * (a + b * np.log(1.0 / u)) + c * cubed + w * (d + e * u)


@given(links, st.floats(-1.5, 1.5), st.floats(1e-6, 1.0), st.floats(0.1, 4.0))
def test_it_is_the_formula(link: Link, mean: float, u: float, prior: float) -> None:
    got = link.probability(np.array([mean]), np.array([u * prior]), prior)
    assert got[0] == pytest.approx(expit(log_odds(mean, u, link.weights)), abs=1e-9)


@given(links)
def test_knowing_nothing_is_even(link: Link) -> None:
    variance = np.array([2.0, 2.0 + 1e-12, 1e9])  # rounding may leave more than the prior
    assert link.probability(np.zeros(3), variance, 2.0).tolist() == [0.5] * 3


@given(links, st.floats(1e-6, 1.0))
def test_more_mean_is_never_less_probability(link: Link, u: float) -> None:
    mean = np.linspace(-2.0, 2.0, 101)
    p = link.probability(mean, np.full(101, u), 1.0)
    assert (np.diff(p) >= 0.0).all()


def test_probabilities_keep_their_shape_and_stay_within_their_range() -> None:
    mean = np.array([[-1e6, 0.0], [1.0, 1e6]])
    p = Link().probability(mean, np.full((2, 2), 1e-300), 1.0)
    assert p.shape == (2, 2)
    assert ((p >= 0.0) & (p <= 1.0)).all()


def drawn(weights: tuple[float, ...], n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means, shares of the variance and outcomes of a world where these weights are the truth."""
    rng = np.random.default_rng(0)
    mean, u = rng.uniform(-1.1, 1.1, n), rng.beta(0.5, 1.0, n).clip(1e-4)
    truth = Link(weights).probability(mean, u, 1.0)
    return mean, u, rng.random(n) < truth


def test_the_truth_is_found_again() -> None:
    truth = (2.0, 0.5, 1.5, 0.8, 2.0)
    found = fit(*drawn(truth, 100_000))
    assert found.weights == pytest.approx(truth, abs=0.35)
    assert not found.differs(Link(truth), 0.02)


@pytest.mark.parametrize(
    "truth",
    [(2.0, 0.5, 1.5, 0.8, 2.0), (4.0, -1.0, 0.3, 0.0, 6.0), (-3.0, 0.0, -1.0, 9.0, -9.0)],
)
def test_it_is_the_best_by_another_way_of_looking(truth: tuple[float, ...]) -> None:
    """L-BFGS-B on the loss as the docstrings say it; the best may lie on any of the bounds."""
    rng = np.random.default_rng(1)
    mean, u = rng.uniform(-1.1, 1.1, 3000), rng.beta(0.5, 1.0, 3000).clip(1e-4)
    occupied = rng.random(3000) < expit(log_odds(mean, u, truth))
    spread = np.array([0.87, 2.84, 1.01, 0.31, 0.08])
    terms = np.column_stack([log_odds(mean, u, tuple(one)) for one in np.eye(5)]) / spread

    def loss(theta: np.ndarray) -> float:
        score = np.where(occupied, 1.0, -1.0) * (terms @ theta)
        return -log_expit(score).sum() + 10.0 * ((theta - DEFAULT_WEIGHTS * spread) ** 2).sum()

    bounds = [(0.0, None)] * 3 + [(None, None)] * 2
    best = minimize(loss, DEFAULT_WEIGHTS * spread, bounds=bounds, options={"ftol": 1e-15})
    found = np.array(fit(mean, u, occupied).weights) * spread
    assert loss(found) <= best.fun + 1e-9
    np.testing.assert_allclose(found, best.x, atol=1e-3)


def test_no_evidence_is_the_default_and_a_little_changes_little() -> None:
    empty = np.empty(0)
    assert fit(empty, empty, empty.astype(bool)) == Link()
    few = fit(*drawn((9.0, 0.0, 0.0, 0.0, 0.0), 5))
    assert not few.differs(Link(), 0.2)


@pytest.mark.parametrize("contradicted", [False, True])
def test_evidence_of_one_kind_cannot_run_away(contradicted: bool) -> None:
    mean = np.repeat([1.0, 0.9, -1.0, -1.1], 500)
    found = fit(mean, np.full(2000, 0.01), (mean > 0.0) ^ contradicted)
    assert np.isfinite(found.weights).all()
    assert min(found.weights[:3]) >= 0.0


def test_links_that_say_the_same_do_not_differ() -> None:
    near = (DEFAULT_WEIGHTS[0] + 0.001, *DEFAULT_WEIGHTS[1:])
    assert not Link(near).differs(Link(), 0.003)
    assert Link((DEFAULT_WEIGHTS[0] + 1.0, *DEFAULT_WEIGHTS[1:])).differs(Link(), 0.003)


@pytest.mark.parametrize(
    "weights",
    [(1.0,), (1.0, 1.0, -0.1, 0.0, 0.0), (np.nan, 0.0, 0.0, 0.0, 0.0), (1.0, 0, 0, np.inf, 0)],
)
def test_weights_that_make_no_link_are_refused(weights: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="five numbers"):
        Link(weights)
