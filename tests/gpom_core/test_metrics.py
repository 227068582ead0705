"""Scores against scikit-learn, and their laws."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn import metrics as reference

from gpom_core.errors import InvalidQueryError
from gpom_core.metrics import (
    brier,
    expected_calibration_error,
    negative_log_likelihood,
    reliability_curve,
    roc_auc,
    score,
)


@st.composite
def predictions(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray]:
    """Probabilities, often tied, with labels of both kinds."""
    n = draw(st.integers(2, 60))
    grain = draw(st.sampled_from([2, 5, 1000]))
    p = draw(st.lists(st.integers(0, grain), min_size=n, max_size=n))
    y = draw(st.lists(st.booleans(), min_size=n, max_size=n))
    y[0], y[1] = True, False
    return np.array(p) / grain, np.array(y)


@given(predictions())
def test_scores_equal_scikit_learn(case: tuple[np.ndarray, np.ndarray]) -> None:
    p, y = case
    clipped = np.clip(p, 1e-4, 1 - 1e-4)
    assert roc_auc(p, y) == pytest.approx(reference.roc_auc_score(y, p), abs=1e-12)
    assert negative_log_likelihood(p, y) == pytest.approx(reference.log_loss(y, clipped))
    assert brier(p, y) == pytest.approx(reference.brier_score_loss(y, p))


@given(predictions())
def test_auc_sees_only_the_order_and_turns_round_with_the_labels(
    case: tuple[np.ndarray, np.ndarray],
) -> None:
    p, y = case
    assert roc_auc(5.0 * p - 2.0, y) == roc_auc(p, y)
    assert roc_auc(p, ~y) == pytest.approx(1.0 - roc_auc(p, y), abs=1e-12)


@given(predictions())
def test_calibration_error_is_a_bounded_gap(case: tuple[np.ndarray, np.ndarray]) -> None:
    p, y = case
    ece = expected_calibration_error(p, y)
    assert 0.0 <= ece <= 1.0
    # one bin leaves only the overall bias
    assert expected_calibration_error(p, y, bins=1) == pytest.approx(abs(p.mean() - y.mean()))


def test_calibration_error_by_hand() -> None:
    p = np.array([0.02, 0.02, 0.52, 0.52, 1.0])
    y = np.array([False, True, True, True, True])
    expected = (2 * abs(0.02 - 0.5) + 2 * abs(0.52 - 1.0) + 0.0) / 5
    assert expected_calibration_error(p, y) == pytest.approx(expected)


def test_probabilities_drawn_from_their_labels_are_calibrated() -> None:
    rng = np.random.default_rng(1)
    p = rng.random(200_000)
    y = rng.random(p.size) < p
    curve = reliability_curve(p, y)
    assert expected_calibration_error(p, y) < 0.01
    assert np.allclose(curve.predicted, curve.observed, atol=0.02)
    assert curve.count.sum() == p.size


def test_empty_bins_are_none_in_json() -> None:
    curve = reliability_curve(np.array([0.0, 1.0]), np.array([False, True]), bins=3).as_dict()
    assert curve == {
        "predicted": [0.0, None, 1.0],
        "observed": [0.0, None, 1.0],
        "count": [1, 0, 1],
    }


def test_likelihood_is_clipped() -> None:
    certain_and_wrong = negative_log_likelihood(np.array([0.0]), np.array([True]))
    assert certain_and_wrong == pytest.approx(-np.log(1e-4))


def test_score_bundles_everything() -> None:
    p, y = np.array([0.1, 0.5, 0.9, 0.5]), np.array([False, False, True, True])
    result = score(p, y, known=np.array([True, False, True, False]))
    assert result.as_dict() == {
        "auc": roc_auc(p, y),
        "nll": negative_log_likelihood(p, y),
        "brier": brier(p, y),
        "ece": expected_calibration_error(p, y),
        "share_unknown": 0.5,
        "points": 4,
    }
    assert score(p, y).share_unknown == 0.0


@pytest.mark.parametrize(
    ("p", "y", "message"),
    [
        ([0.1, 0.2], [True], "equal"),
        ([], [], "non-empty"),
        ([0.1, 0.2], [1, 0], "booleans"),
        ([0.1, np.nan], [True, False], "finite"),
        ([0.1, 1.1], [True, False], r"within \[0, 1\]"),
        ([0.1, 0.2], [True, True], "2 occupied and 0 free"),
    ],
)
def test_nonsense_is_refused(p: list[float], y: list[bool], message: str) -> None:
    with pytest.raises(InvalidQueryError, match=message):
        score(np.array(p), np.array(y))


def test_known_must_fit_and_bins_must_exist() -> None:
    p, y = np.array([0.1, 0.9]), np.array([False, True])
    with pytest.raises(InvalidQueryError, match="known"):
        score(p, y, known=np.array([True]))
    with pytest.raises(InvalidQueryError, match="bins"):
        reliability_curve(p, y, bins=0)
