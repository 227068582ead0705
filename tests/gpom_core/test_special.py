import mpmath as mp
import numpy as np
import pytest
from numba import njit
from numpy.typing import NDArray

from gpom_core.special import erf, exp_neg

TINY = [5e-324, 1e-310, 2.3e-308, 1e-200, 1e-20]


@njit(error_model="numpy", fastmath={"contract"})
def erf_of(x, out):
    for i in range(x.size):
        out[i] = erf(x[i])


@njit(error_model="numpy", fastmath={"contract"})
def exp_of(x, out):
    for i in range(x.size):
        out[i] = exp_neg(x[i])


def mapped(function, x: NDArray[np.float64]) -> NDArray[np.float64]:
    out = np.empty_like(x)
    function(x, out)
    return out


def test_exp_neg_is_within_its_stated_error() -> None:
    dense = -np.geomspace(1e-9, 800.0, 4000)
    ties = -np.log(2.0) * (np.arange(1, 40) + 0.5)
    x = np.concatenate([dense, ties, np.nextafter(ties, 0.0), -np.array(TINY), [0.0, -0.0]])
    true = np.array([float(mp.exp(mp.mpf(v))) for v in x.tolist()])
    assert np.abs(mapped(exp_of, x) - true).max() < 1e-12


def test_exp_neg_keeps_its_relative_error_until_it_underflows_to_zero() -> None:
    x = -np.linspace(0.0, 707.9, 3000)
    true = np.array([float(mp.exp(mp.mpf(v))) for v in x.tolist()])
    assert (np.abs(mapped(exp_of, x) - true) / true).max() < 1e-11
    below = np.array([-708.1, -745.2, -1e4, -1.7976931348623157e308, -np.inf])
    assert mapped(exp_of, below).tolist() == [0.0] * 5


def test_erf_is_within_its_stated_error() -> None:
    x = np.concatenate([np.linspace(-8.0, 8.0, 8001), TINY, [0.0, 30.0, 1e300, np.inf]])
    x = np.concatenate([x, -x])
    true = np.array([float(mp.erf(v)) for v in x.tolist()])
    assert np.abs(mapped(erf_of, x) - true).max() < 1e-11


def test_erf_is_odd_to_the_last_bit() -> None:
    x = np.concatenate([np.linspace(0.0, 7.0, 1001), TINY, [np.inf]])
    assert np.array_equal(mapped(erf_of, -x), -mapped(erf_of, x))


@pytest.mark.parametrize("function", [exp_of, erf_of])
def test_nan_stays_nan(function) -> None:
    assert np.isnan(mapped(function, np.array([np.nan] * 9))).all()


@pytest.mark.parametrize("function", [exp_of, erf_of])
def test_loops_are_vectorised(function) -> None:
    mapped(function, np.zeros(1))
    (code,) = function.inspect_llvm().values()
    assert " x double>" in code
