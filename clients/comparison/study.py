"""Who is built from which scans, and how well each knows the points that nobody has seen."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from time import perf_counter

import numpy as np

from clients.comparison.peers import peers
from clients.contenders import Contender, chosen_grids, gpom_map, log_odds_grids
from clients.protocol import (
    Bools,
    Floats,
    LabelledPoints,
    far_from_beams,
    labelled_points,
    split,
    thin,
)
from gpom_core.config import MapConfig
from gpom_core.errors import ConfigurationError
from gpom_core.metrics import ReliabilityCurve, reliability_curve, score
from gpom_core.scan import Scan

FAR_M = 0.5
SCORES = ("auc", "nll", "brier", "ece", "share_unknown")


@dataclass(frozen=True, slots=True)
class Spread:
    """Mean and standard deviation over draws of the test points."""

    mean: float
    std: float


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """One method on one log from one share of its training scans.

    Attributes:
        scores: by name, at all test points.
        far: the same at points farther than FAR_M from every training beam; None without enough.
        reliability: at the points of all draws.
        facts: what building cost.
    """

    method: str
    scores: Mapping[str, Spread]
    far: Mapping[str, Spread] | None
    reliability: ReliabilityCurve
    facts: Mapping[str, object]


@dataclass(frozen=True, slots=True, eq=False)
class Round:
    """All methods on one log from one share of its training scans.

    Attributes:
        far_points: mean number per draw.
    """

    log: str
    share: Fraction
    training_scans: int
    draws: int
    far_points: float
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
        ConfigurationError: the log has too few scans.
    """
    training, held_out = split(scans)
    training = thin(training, share)
    tests = [labelled_points(held_out, seed) for seed in range(draws)]
    if not tests or any(test.occupied.all() or not test.occupied.any() for test in tests):
        raise ConfigurationError(
            f"{log} has {len(held_out)} held-out scans, {draws} draws were asked for; expected one "
            "draw or more, of hits and passing beams: the log needs six scans or more"
        )
    points = np.concatenate([test.points for test in tests])
    far = np.split(far_from_beams(points, training, FAR_M), len(tests))
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
        far_points=float(np.mean([mask.sum() for mask in far])),
        results=tuple(_scored(contender, points, tests, far) for contender in contenders),
    )


def _scored(
    contender: Contender, points: Floats, tests: Sequence[LabelledPoints], far: Sequence[Bools]
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
    # A draw without both kinds of label has no AUC; such far points are too few to compare.
    far_parts = [(p[mask], y[mask], k[mask]) for (p, y, k), mask in zip(parts, far, strict=True)]
    mixed = all(y.any() and not y.all() for _, y, _ in far_parts)
    return Result(
        method=contender.name,
        scores=_spread(parts),
        far=_spread(far_parts) if mixed else None,
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
