"""Who is built from which scans, and how well each knows the points that nobody has seen."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from time import perf_counter

import numpy as np

from clients.comparison.peers import peers
from clients.comparison.places import places
from clients.contenders import Contender, chosen_grids, gpom_map, log_odds_grids
from clients.protocol import (
    Bools,
    Floats,
    LabelledPoints,
    held_out_points,
    split,
    thin,
)
from gpom_core.config import MapConfig
from gpom_core.errors import ConfigurationError
from gpom_core.metrics import (
    ReliabilityCurve,
    brier,
    expected_calibration_error,
    negative_log_likelihood,
    reliability_curve,
    roc_auc,
    score,
)
from gpom_core.scan import Scan

SCORES = ("auc", "nll", "brier", "ece", "share_unknown")
FEWEST = 50  # points of a place in a draw, on average; fewer say nothing


@dataclass(frozen=True, slots=True)
class Spread:
    """Mean and standard deviation over draws of the test points."""

    mean: float
    std: float


@dataclass(frozen=True, slots=True)
class There:
    """One method at the test points of one place, of all draws together.

    Attributes:
        points: per draw, on average.
        occupied: share of them. predicted: their mean probability.
        auc: None where all are occupied, or none.
    """

    points: float
    occupied: float
    predicted: float
    auc: float | None
    nll: float
    brier: float
    ece: float
    share_unknown: float


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """One method on one log from one share of its training scans.

    Attributes:
        scores: by name, at all test points.
        there: by place, where there are FEWEST points or more.
        reliability: at the points of all draws.
        facts: what building cost.
    """

    method: str
    scores: Mapping[str, Spread]
    there: Mapping[str, There]
    reliability: ReliabilityCurve
    facts: Mapping[str, object]


@dataclass(frozen=True, slots=True, eq=False)
class Round:
    """All methods on one log from one share of its training scans."""

    log: str
    share: Fraction
    training_scans: int
    draws: int
    results: tuple[Result, ...]

    def of(self, method: str) -> Result:
        """The result of one method."""
        return next(result for result in self.results if result.method == method)


def play(
    log: str,
    scans: Sequence[Scan],
    share: Fraction,
    draws: int,
    *,
    config: MapConfig | None = None,
    with_peers: bool = True,
) -> Round:
    """Build every method from a share of the training scans and score it on held-out points.

    Args:
        scans: all scans of the log, in order. draws: of the test points, seeds 0, 1, 2 …

    Raises:
        ConfigurationError: no draw, or the log has too few scans or hits.
    """
    if draws < 1:
        raise ConfigurationError(f"draws is {draws}; expected one or more")
    tests = [held_out_points(scans, seed, log=log) for seed in range(draws)]
    training = thin(split(scans)[0], share)
    points = np.concatenate([test.points for test in tests])
    where = {
        place: mask
        for place, mask in places(points, training).items()
        if mask.sum() >= FEWEST * draws
    }
    contenders = gpom_map(training, config=config, uncalibrated=True)
    contenders += chosen_grids(training)
    if with_peers:
        resolution = next(c for c in contenders if c.name == "log-odds grid").facts["resolution_m"]
        contenders += log_odds_grids(training)
        contenders += peers(training, float(str(resolution)))
    return Round(
        log=log,
        share=share,
        training_scans=len(training),
        draws=draws,
        results=tuple(_scored(contender, points, tests, where) for contender in contenders),
    )


def _scored(
    contender: Contender,
    points: Floats,
    tests: Sequence[LabelledPoints],
    where: Mapping[str, Bools],
) -> Result:
    started = perf_counter()
    probability, known = contender.predict(points)
    query_us = 1e6 * (perf_counter() - started) / len(points)
    occupied = np.concatenate([test.occupied for test in tests])
    parts = list(
        zip(
            np.split(probability, len(tests)), np.split(occupied, len(tests)),
            np.split(known, len(tests)), strict=True,
        )
    )  # fmt: skip
    return Result(
        method=contender.name,
        scores=_spread(parts),
        there={
            place: _at_place(probability[mask], occupied[mask], known[mask], len(tests))
            for place, mask in where.items()
        },
        reliability=reliability_curve(probability, occupied),
        facts={**contender.facts, "query_us": round(query_us, 2)},
    )


def _spread(parts: Sequence[tuple[Floats, Bools, Bools]]) -> dict[str, Spread]:
    scores = [score(p, y, k).as_dict() for p, y, k in parts]
    return {
        name: Spread(
            float(np.mean([s[name] for s in scores])), float(np.std([s[name] for s in scores]))
        )
        for name in SCORES
    }


def _at_place(probability: Floats, occupied: Bools, known: Bools, draws: int) -> There:
    mixed = occupied.any() and not occupied.all()
    return There(
        points=len(occupied) / draws,
        occupied=float(occupied.mean()),
        predicted=float(probability.mean()),
        auc=roc_auc(probability, occupied) if mixed else None,
        nll=negative_log_likelihood(probability, occupied),
        brier=brier(probability, occupied),
        ece=expected_calibration_error(probability, occupied),
        share_unknown=float(1.0 - known.mean()),
    )
