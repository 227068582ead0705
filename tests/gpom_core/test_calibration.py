"""From mean and variance to probability: the link, and how it is fitted."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import minimize
from scipy.stats import norm

from gpom_core.calibration import _PULL, DEFAULT_SLOPE, Calibration, fit


def drawn(slope: float, offset: float, n: int = 40_000) -> tuple[np.ndarray, ...]:
    """Means, variances and outcomes of a world where this slope and offset are the truth."""
    rng = np.random.default_rng(0)
    mean, variance = rng.normal(0.0, 1.0, n), rng.uniform(0.01, 0.8, n)
    latent = rng.normal(mean, np.sqrt(variance))
    return mean, variance, rng.random(n) < norm.cdf(slope * latent + offset)


def test_the_probability_is_the_average_over_the_latent_function() -> None:
    link, mean, variance = Calibration(2.5, -0.3), 0.4, 0.7

    def integrand(f: float) -> float:
        density = norm.pdf(f, mean, np.sqrt(variance))
        return float(norm.cdf(link.slope * f + link.offset) * density)

    expected, _ = quad(integrand, -8.0, 8.0)
    got = link.probability(np.array([mean]), np.array([variance]))
    np.testing.assert_allclose(got, [expected], rtol=1e-8)


@pytest.mark.parametrize("slope", [0.1, 1.0, 30.0])
def test_knowing_nothing_is_even_whatever_the_slope(slope: float) -> None:
    assert (
        Calibration(slope).probability(np.zeros(3), np.array([1e-9, 1.0, 1e9])).tolist()
        == [0.5] * 3
    )


def test_probabilities_keep_their_shape_and_stay_within_their_range() -> None:
    mean = np.array([[-1e6, 0.0], [1.0, 1e6]])
    p = Calibration(50.0).probability(mean, np.full((2, 2), 1e-12))
    assert p.shape == (2, 2)
    assert (p >= 0.0).all()
    assert (p <= 1.0).all()
    assert (np.diff(p.ravel()) >= 0.0).all()


def test_the_truth_is_found_again() -> None:
    found = fit(*drawn(DEFAULT_SLOPE, 0.0))
    assert found.slope == pytest.approx(DEFAULT_SLOPE, rel=0.05)
    assert found.offset == pytest.approx(0.0, abs=0.05)


@pytest.mark.parametrize("with_offset", [True, False])
@pytest.mark.parametrize("start", [None, Calibration(0.3, 1.0), Calibration(20.0, -2.0)])
def test_the_fit_is_the_best_there_is_wherever_it_starts(
    with_offset: bool, start: Calibration | None
) -> None:
    mean, variance, occupied = drawn(1.5, 0.4, 500)

    def loss(theta: np.ndarray) -> float:
        slope, offset = np.exp(theta[0]), theta[1] if with_offset else 0.0
        score = (slope * mean + offset) / np.sqrt(1.0 + slope**2 * variance)
        pull = (theta[0] - np.log(DEFAULT_SLOPE)) ** 2 + offset**2
        return float(-norm.logcdf(np.where(occupied, score, -score)).mean() + _PULL * pull)

    best = minimize(
        loss, np.zeros(2), method="Nelder-Mead", options={"xatol": 1e-6, "fatol": 1e-12}
    )
    found = fit(mean, variance, occupied, with_offset=with_offset, start=start)
    assert found.slope == pytest.approx(np.exp(best.x[0]), rel=1e-3)
    assert found.offset == pytest.approx(best.x[1] if with_offset else 0.0, abs=1e-3)


def test_weights_count_as_repetitions() -> None:
    mean, variance, occupied = (part[:300] for part in drawn(2.0, 0.1))
    times = np.random.default_rng(1).integers(1, 5, 300)
    weighted = fit(mean, variance, occupied, times.astype(float))
    repeated = fit(*(np.repeat(part, times) for part in (mean, variance, occupied)))
    assert weighted.slope == pytest.approx(repeated.slope, rel=1e-4)
    assert weighted.offset == pytest.approx(repeated.offset, abs=1e-4)


@pytest.mark.parametrize("contradicted", [False, True])
def test_evidence_of_one_kind_cannot_run_away(contradicted: bool) -> None:
    mean = np.array([1.0, 0.9, -1.0, -1.1])
    found = fit(mean, np.full(4, 0.01), (mean > 0.0) ^ contradicted)
    assert 0.05 <= found.slope <= 50.0
    assert np.isfinite(found.offset)


def test_without_evidence_nothing_is_fitted() -> None:
    empty = np.empty(0)
    assert fit(empty, empty, empty.astype(bool)) == Calibration()
