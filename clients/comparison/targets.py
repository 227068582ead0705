"""What the map has set out to reach against the counting grid, and whether it did."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction

from clients.comparison.study import Round

MAP, GRID, TUNED_GRID = "gpom bcm", "counting grid", "counting grid tuned"
ALL, THIRD, TENTH = Fraction(1), Fraction(1, 3), Fraction(1, 10)
NLL_RATIO_MOST = {ALL: 0.85, THIRD: 0.75, TENTH: 0.65}
ECE_MOST = {ALL: 0.02, TENTH: 0.04}


@dataclass(frozen=True, slots=True)
class Verdict:
    """One promise on one log.

    Attributes:
        limit: the highest value that keeps the promise.
        against_tuned: the same value against the grid with tuned weights, None without meaning.
    """

    log: str
    share: Fraction
    what: str
    value: float
    limit: float
    against_tuned: float | None = None

    @property
    def met(self) -> bool:
        """Whether the promise is kept."""
        return self.value <= self.limit


def verdicts(rounds: Sequence[Round]) -> list[Verdict]:
    """Judge every promise that the rounds allow to judge."""
    by_log: dict[str, dict[Fraction, Round]] = {}
    for one in rounds:
        by_log.setdefault(one.log, {})[one.share] = one
    return [v for log, shares in by_log.items() for v in _of_log(log, shares)]


def _of_log(log: str, shares: dict[Fraction, Round]) -> Iterable[Verdict]:
    for share, one in shares.items():
        nll, auc, ece = (_value(one, MAP, name) for name in ("nll", "auc", "ece"))
        ratio, tuned_ratio = (nll / _value(one, grid, "nll") for grid in (GRID, TUNED_GRID))
        if share in NLL_RATIO_MOST:
            limit = NLL_RATIO_MOST[share]
            yield Verdict(log, share, "NLL over the grid's", ratio, limit, tuned_ratio)
        short, tuned_short = (_value(one, grid, "auc") - auc for grid in (GRID, TUNED_GRID))
        yield Verdict(log, share, "AUC short of the grid's", short, 0.0, tuned_short)
        if share in ECE_MOST:
            yield Verdict(log, share, "ECE", ece, ECE_MOST[share])
    if ALL in shares and THIRD in shares:
        nll = _value(shares[THIRD], MAP, "nll")
        ratio, tuned = (nll / _value(shares[ALL], grid, "nll") for grid in (GRID, TUNED_GRID))
        yield Verdict(log, THIRD, "NLL over the grid's of all scans", ratio, 1.0, tuned)


def _value(one: Round, method: str, name: str) -> float:
    return one.of(method).scores[name].mean
