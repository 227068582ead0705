"""The inverse from LAPACK: right, symmetric, and honest about matrices that have none."""

import numpy as np
import pytest

from gpom_core.lapack import ADDRESSES, inverse_spd


def positive_definite(n: int, seed: int = 0) -> np.ndarray:
    a = np.random.default_rng(seed).normal(size=(n, n))
    return a @ a.T + 0.1 * n * np.eye(n)


@pytest.mark.parametrize("n", [1, 2, 7, 64, 301])
def test_the_inverse_and_the_log_determinant_are_those_of_numpy(n: int) -> None:
    k = positive_definite(n)
    inverse = k.copy()
    log_determinant = inverse_spd(inverse, ADDRESSES)
    np.testing.assert_allclose(inverse, np.linalg.inv(k), atol=1e-10)
    np.testing.assert_allclose(log_determinant, np.linalg.slogdet(k)[1], rtol=1e-12)
    assert np.array_equal(inverse, inverse.T)


def test_only_the_upper_triangle_is_read() -> None:
    k = positive_definite(9)
    half = np.triu(k) + np.tril(np.full_like(k, np.nan), -1)
    inverse_spd(half, ADDRESSES)
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
    assert np.isnan(inverse_spd(k.copy(), ADDRESSES))


def test_an_infinite_matrix_has_no_finite_log_determinant() -> None:
    assert not np.isfinite(inverse_spd(np.diag([1.0, np.inf]), ADDRESSES))
