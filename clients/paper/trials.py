"""One seed of the experiment: all methods, all fusion rules, scored and timed."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf
from time import process_time

import numpy as np

from clients.paper.experiment import Experiment, make_experiment
from clients.paper.methods import (
    SEGMENT_M,
    GridMethod,
    Map,
    Method,
    MixtureMap,
    paper_methods,
)
from clients.paper.regions import Cells, cells_of
from gpom_core.committee import Fusion

_REPEATS = 10  # the fastest counts: the machine may be busy
_PATIENCE_S = 2.0

Progress = Callable[[str], None]


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """What one seed gave.

    Attributes:
        maps: by the name of the method.
        results: by the name of the map: costs, facts and scores per region, ready for JSON. The
            mixtures appear under every fusion rule, and without a suffix under bcm.
    """

    experiment: Experiment
    cells: Cells
    maps: dict[str, Map]
    results: dict[str, dict[str, object]]


def run_trial(seed: int, methods: Sequence[Method], resolution_m: float, say: Progress) -> Trial:
    """Fit and score every method on one seed's scans."""
    experiment = make_experiment(seed)
    cells = cells_of(experiment, resolution_m)
    trial = Trial(experiment, cells, {}, {})
    for method in methods:
        say(f"seed {seed}: {method.name}")
        fitted = method.fit(experiment.scans)
        trial.maps[method.name] = fitted
        trial.results[method.name] = _result(fitted, cells)
        if isinstance(fitted, MixtureMap) and fitted.facts["clusters"] > 1:
            for fusion in Fusion:
                fused = fitted.fused_by(fusion)
                scores = cells.scores(fused.occupancy(cells.points))
                trial.results[fused.name] = {"scores": scores}
    return trial


def methods_of(seed: int, *, first: bool) -> list[Method]:
    """All methods; the single process on cut beams only once, since it takes the longest."""
    return [
        GridMethod(),
        *paper_methods(seed),
        *paper_methods(seed, with_single=first, segment_m=SEGMENT_M),
    ]


def warm_up() -> None:
    """Compile every loop, so that no method pays for it in its times."""
    scans = make_experiment(0).scans[::6]
    points = np.zeros((4, 2))
    for segment_m in (inf, 4.0):
        for method in paper_methods(0, segment_m=segment_m):
            fitted = method.fit(scans)
            for fusion in Fusion:
                fitted.fused_by(fusion).occupancy(points)


def _result(fitted: Map, cells: Cells) -> dict[str, object]:
    seconds: list[float] = []
    while len(seconds) < _REPEATS and sum(seconds) < _PATIENCE_S:
        started = process_time()
        occupancy = fitted.occupancy(cells.points)
        seconds.append(process_time() - started)
    return {
        **fitted.costs,
        "inference_s": min(seconds),
        "inference_us_per_point": 1e6 * min(seconds) / len(cells.points),
        **fitted.facts,
        "scores": cells.scores(occupancy),
    }
