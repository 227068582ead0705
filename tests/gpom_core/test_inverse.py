"""The inverse: right, symmetric, and honest about matrices that have none."""

import mpmath
import numpy as np
import pytest

from gpom_core.inverse import (
    LARGEST_SWEPT,
    addresses_for,
    inverse_spd,
    padded,
    solve_and_pack,
    unpacked,
)


def positive_definite(n: int, seed: int = 0) -> np.ndarray:
    a = np.random.default_rng(seed).normal(size=(n, n))
    return a @ a.T + 0.1 * n * np.eye(n)


SIZES = [1, 2, 7, 8, 9, 64, 301, LARGEST_SWEPT, LARGEST_SWEPT + 1]  # swept, then LAPACK's


@pytest.mark.parametrize("n", SIZES)
def test_the_inverse_and_the_log_determinant_are_those_of_numpy(n: int) -> None:
    k = positive_definite(n)
    inverse = k.copy()
    log_determinant = inverse_spd(inverse, addresses_for(len(k)))
    np.testing.assert_allclose(inverse, np.linalg.inv(k), atol=1e-10)
    np.testing.assert_allclose(log_determinant, np.linalg.slogdet(k)[1], rtol=1e-12)
    assert np.array_equal(inverse, inverse.T)


@pytest.mark.parametrize("n", SIZES)
def test_a_system_is_solved_and_its_inverse_packed(n: int) -> None:
    k, y = positive_definite(n), np.random.default_rng(n).normal(size=n)
    a = np.full((padded(n), padded(n)), np.nan)
    a[:n, :n] = np.triu(k) + np.tril(np.full_like(k, np.nan), -1)
    x, packed = np.empty(n), np.empty(n * (n + 1) // 2)
    log_determinant = solve_and_pack(a, y, addresses_for(n), x, packed)
    inverse = unpacked(packed, n)
    assert np.array_equal(inverse, inverse.T)
    np.testing.assert_allclose(inverse, np.linalg.inv(k), atol=1e-10)
    np.testing.assert_allclose(x, np.linalg.solve(k, y), atol=1e-10)
    np.testing.assert_allclose(log_determinant, np.linalg.slogdet(k)[1], rtol=1e-12)


def crowded(n: int, noise: float) -> np.ndarray:
    """Covariance of n places of which many are the same or nearly so."""
    rng = np.random.default_rng(1)
    place = np.repeat(rng.uniform(0.0, 2.0, (n // 4, 2)), 4, axis=0)
    place[::2] += 1e-4 * rng.normal(size=(n // 2, 2))
    return np.exp(-0.5 * ((place[:, None] - place) ** 2).sum(axis=2)) + noise * np.eye(n)


@pytest.mark.parametrize("noise", [1e-3, 1e-5, 1e-8])
def test_an_ill_conditioned_matrix_is_inverted_as_well_as_its_condition_allows(
    noise: float,
) -> None:
    k = crowded(28, noise)
    with mpmath.workdps(50):
        exact = mpmath.matrix(k.tolist()) ** -1
        log_determinant = float(mpmath.log(mpmath.det(mpmath.matrix(k.tolist()))))
    expected = np.array(exact.tolist(), np.float64)
    inverse = k.copy()
    got = inverse_spd(inverse, addresses_for(len(k)))
    error = abs(inverse - expected).max() / abs(expected).max()
    assert error < 0.5 * np.finfo(float).eps * np.linalg.cond(k)
    assert abs(got - log_determinant) < 1e-15 * len(k) * np.linalg.cond(k)


def test_only_the_upper_triangle_is_read() -> None:
    k = positive_definite(9)
    half = np.triu(k) + np.tril(np.full_like(k, np.nan), -1)
    inverse_spd(half, addresses_for(len(half)))
    np.testing.assert_allclose(half, np.linalg.inv(k), atol=1e-10)


@pytest.mark.parametrize(
    "k",
    [
        np.array([[1.0, 2.0], [2.0, 1.0]]),
        np.zeros((3, 3)),
        -np.eye(2),
        np.full((2, 2), np.nan),
        np.diag([1.0, np.nan, 1.0]),
    ],
    ids=["indefinite", "zero", "negative", "NaN", "NaN on the diagonal"],
)
def test_a_matrix_that_is_not_positive_definite_has_no_log_determinant(k: np.ndarray) -> None:
    assert np.isnan(inverse_spd(k.copy(), addresses_for(len(k))))


@pytest.mark.parametrize("n", [20, LARGEST_SWEPT + 1])
def test_the_last_pivot_counts(n: int) -> None:
    k = np.eye(n)
    k[-1, 0] = k[0, -1] = 1.5
    assert np.isnan(inverse_spd(k, addresses_for(len(k))))


def test_an_infinite_matrix_has_no_finite_log_determinant() -> None:
    assert not np.isfinite(inverse_spd(np.diag([1.0, np.inf]), addresses_for(2)))
