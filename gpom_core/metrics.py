"""How good is a map? Proper scores of occupancy probabilities against labels.

Labels are boolean, True for occupied. The area under the ROC curve only sees the order of the
probabilities, so it never stands alone: the likelihood beside it shows a map that is too sure.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpom_core.errors import InvalidQueryError

PROBABILITY_FLOOR = 1e-4
CALIBRATION_BINS = 15


@dataclass(frozen=True, slots=True)
class Scores:
    """Scores of one set of predictions.

    Attributes:
        auc: area under the ROC curve, 1 is perfect, 0.5 is chance.
        nll: mean negative log likelihood in nats, probabilities clipped to [1e-4, 1 - 1e-4].
        brier: mean squared error of the probability.
        ece: expected calibration error over 15 bins.
        share_unknown: share of the points that the map calls unknown.
        points: number of points scored.
    """

    auc: float
    nll: float
    brier: float
    ece: float
    share_unknown: float
    points: int

    def as_dict(self) -> dict[str, float | int]:
        """The scores by name, ready for JSON."""
        return asdict(self)


@dataclass(frozen=True, slots=True, eq=False)
class ReliabilityCurve:
    """What was predicted and what happened, per bin of equal width over [0, 1].

    Attributes:
        predicted: (bins,) mean probability in each bin, NaN where the bin is empty.
        observed: (bins,) share of occupied labels in each bin, NaN where the bin is empty.
        count: (bins,) number of points in each bin.
    """

    predicted: NDArray[np.float64]
    observed: NDArray[np.float64]
    count: NDArray[np.int64]

    def as_dict(self) -> Mapping[str, list[float | None] | list[int]]:
        """Lists ready for JSON; empty bins are None."""
        return {
            "predicted": [None if np.isnan(v) else float(v) for v in self.predicted],
            "observed": [None if np.isnan(v) else float(v) for v in self.observed],
            "count": [int(v) for v in self.count],
        }


def score(probability: ArrayLike, occupied: ArrayLike, known: ArrayLike | None = None) -> Scores:
    """All scores of one set of predictions.

    Args:
        probability: (N,) predicted probability of occupancy.
        occupied: (N,) boolean labels, of both kinds.
        known: (N,) which points the map calls known; None for all.

    Raises:
        InvalidQueryError: shapes differ, a probability is outside [0, 1], or one kind of label
            is missing.
    """
    p, y = _checked(probability, occupied)
    is_known = np.ones(p.shape, np.bool_) if known is None else np.asarray(known, np.bool_)
    if is_known.shape != p.shape:
        raise InvalidQueryError(f"known has shape {is_known.shape}, expected {p.shape}")
    return Scores(
        auc=roc_auc(p, y),
        nll=negative_log_likelihood(p, y),
        brier=brier(p, y),
        ece=expected_calibration_error(p, y),
        share_unknown=float(np.mean(~is_known)),
        points=int(p.size),
    )


def roc_auc(score: ArrayLike, occupied: ArrayLike) -> float:
    """Area under the ROC curve of any real-valued score, ties counting one half.

    Mann-Whitney U of the mid-ranks over the number of pairs (Hanley & McNeil 1982).

    Raises:
        InvalidQueryError: shapes differ, a score is not finite, or one kind of label is missing.
    """
    s, y = _paired(score, occupied)
    positives = int(np.count_nonzero(y))
    negatives = int(y.size) - positives
    if positives == 0 or negatives == 0:
        raise InvalidQueryError(
            f"AUC needs occupied and free labels, got {positives} occupied and {negatives} free; "
            "score more points"
        )
    _, tie, count = np.unique(s, return_inverse=True, return_counts=True)
    mid_rank = np.cumsum(count) - (count - 1) / 2.0
    rank_sum = float(np.sum(mid_rank[tie[y]]))
    return (rank_sum - positives * (positives + 1) / 2.0) / (positives * negatives)


def negative_log_likelihood(probability: ArrayLike, occupied: ArrayLike) -> float:
    """Mean of -log p(label) in nats, p clipped to [1e-4, 1 - 1e-4]."""
    p, y = _checked(probability, occupied)
    clipped = np.clip(p, PROBABILITY_FLOOR, 1.0 - PROBABILITY_FLOOR)
    return float(-np.mean(np.log(np.where(y, clipped, 1.0 - clipped))))


def brier(probability: ArrayLike, occupied: ArrayLike) -> float:
    """Mean squared difference of probability and label (Brier 1950)."""
    p, y = _checked(probability, occupied)
    return float(np.mean((p - y) ** 2))


def reliability_curve(
    probability: ArrayLike, occupied: ArrayLike, bins: int = CALIBRATION_BINS
) -> ReliabilityCurve:
    """Mean prediction and share of occupied labels per bin of equal width over [0, 1]."""
    p, y = _checked(probability, occupied)
    if bins < 1:
        raise InvalidQueryError(f"bins is {bins}, expected at least 1")
    index = np.minimum((p * bins).astype(np.int64), bins - 1)
    count = np.bincount(index, minlength=bins)
    # 0/0 marks an empty bin as NaN on purpose
    with np.errstate(invalid="ignore"):
        predicted = np.bincount(index, weights=p, minlength=bins) / count
        observed = np.bincount(index, weights=y, minlength=bins) / count
    return ReliabilityCurve(predicted=predicted, observed=observed, count=count)


def expected_calibration_error(
    probability: ArrayLike, occupied: ArrayLike, bins: int = CALIBRATION_BINS
) -> float:
    """Mean gap of prediction and frequency, each bin weighted by its points (Guo et al. 2017)."""
    curve = reliability_curve(probability, occupied, bins)
    filled = curve.count > 0
    gap = np.abs(curve.predicted[filled] - curve.observed[filled])
    return float(np.sum(gap * curve.count[filled]) / np.sum(curve.count))


def _paired(
    values: ArrayLike, occupied: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    v = np.asarray(values, np.float64)
    y = np.asarray(occupied)
    if v.ndim != 1 or v.shape != y.shape or v.size == 0:
        raise InvalidQueryError(
            f"predictions {v.shape} and labels {y.shape} must be two equal non-empty vectors"
        )
    if y.dtype != np.bool_:
        raise InvalidQueryError(f"labels are {y.dtype}, expected booleans (True = occupied)")
    if not np.all(np.isfinite(v)):
        raise InvalidQueryError("predictions hold NaN or infinity, expected finite numbers")
    return v, y


def _checked(
    probability: ArrayLike, occupied: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    p, y = _paired(probability, occupied)
    if p.min() < 0.0 or p.max() > 1.0:
        raise InvalidQueryError(
            f"probabilities span [{p.min():.6g}, {p.max():.6g}], expected within [0, 1]"
        )
    return p, y
