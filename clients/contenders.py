"""Maps to be scored by the evaluation protocol: gpom in process, a running service, the grids."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from time import perf_counter

import numpy as np

from clients.map_client import MapClient
from clients.protocol import Bools, Floats, LabelledPoints, Predict, hit_ends, labelled_points
from gpom_core.baselines import (
    COUNTING_MODELS,
    RESOLUTIONS_M,
    CountingGrid,
    GridT,
    LogOddsGrid,
    OccupancyGrid,
    best_by_likelihood,
)
from gpom_core.calibration import Calibration
from gpom_core.config import MapConfig
from gpom_core.mapper import Mapper
from gpom_core.scan import Scan
from gpom_core.snapshot import Snapshot

# Every fifth training scan is set aside while a grid's cell size and weights are chosen.
_VALIDATION_STEP, _VALIDATION_PHASE = 5, 2
_VALIDATION_SEED = 1

Track = Callable[[Sequence[Scan], str], Iterable[Scan]]
"""Passes scans on while it shows progress under a title."""


@dataclass(frozen=True, slots=True)
class Contender:
    """A finished map.

    Attributes:
        name: of the method, in the report.
        predict: the map.
        facts: what building it cost and how large it is, ready for JSON.
    """

    name: str
    predict: Predict
    facts: Mapping[str, object] = field(default_factory=dict)


def untracked(scans: Sequence[Scan], _title: str) -> Iterable[Scan]:
    """Show no progress."""
    return scans


def gpom_map(
    training: Sequence[Scan],
    fusions: Sequence[str] = ("bcm",),
    *,
    config: MapConfig | None = None,
    track: Track = untracked,
    uncalibrated: bool = False,
) -> list[Contender]:
    """Build and train the map once, and enter it under each fusion rule.

    With `uncalibrated` also as it would be with the plain probit link, by the first rule.
    """
    config = config or MapConfig()
    _compile(training, config)
    mapper = Mapper(config)
    started = perf_counter()
    for scan in track(training, "building the map"):
        mapper.update(scan)
    built = perf_counter()
    snapshot = mapper.train()
    facts = {
        "build_s": _round_s(built - started),
        "training_s": _round_s(perf_counter() - built),
        "experts": mapper.expert_count,
        "observations": mapper.observation_count,
        "trained_observations": sum(len(m.expert.observations) for m in snapshot.members.values()),
        "memory_bytes": sum(member.size_bytes for member in snapshot.members.values()),
        "link": [round(weight, 3) for weight in snapshot.link.weights],
    }
    entered = [Contender(f"gpom {name}", _ask(snapshot, name), facts) for name in fusions]
    if uncalibrated:
        plain = Calibration()

        def predict(points: Floats) -> tuple[Floats, Bools]:
            answer = snapshot.query(points, fusions[0])
            return plain.probability(answer.mean, answer.variance), answer.known

        entered.append(Contender("gpom uncalibrated", predict, facts))
    return entered


def running_service(client: MapClient, fusions: Sequence[str] = ("bcm",)) -> list[Contender]:
    """Enter the map of a running service under each fusion rule; it must not hold held-out scans.

    Raises:
        MapServiceError: the service does not answer.
    """
    status = client.status()
    facts = {
        "url": client.url,
        "map_version": status.map_version,
        "scans_integrated": status.scans_integrated,
        "experts": status.experts,
        "dirty_experts": status.dirty_experts,
        "observations": status.observations,
    }

    def ask(fusion: str) -> Predict:
        def predict(points: Floats) -> tuple[Floats, Bools]:
            answer = client.query(points, fusion=fusion)
            return answer.occupancy, answer.known

        return predict

    return [Contender(f"service {name}", ask(name), facts) for name in fusions]


def grids(training: Sequence[Scan], track: Track = untracked) -> list[Contender]:
    """Enter both kinds of grid at every resolution, and the counting grid at its best.

    The best is the cell size and the weights with the best likelihood on every fifth training
    scan, read from grids of the other training scans.
    """
    contenders = []
    counting: dict[float, CountingGrid] = {}
    for resolution_m in RESOLUTIONS_M:
        count, log_odds = CountingGrid(resolution_m), LogOddsGrid(resolution_m)
        counting[resolution_m] = count
        for label, grid in (("counting grid", count), ("log-odds grid", log_odds)):
            title = f"{label} {resolution_m * 100:g} cm"
            seconds = fill(grid, track(training, title))
            facts: dict[str, object] = {"build_s": seconds, "resolution_m": resolution_m}
            contenders.append(Contender(title, grid.occupancy, facts))
    chosen = _best_counting(*set_aside(training))[1]
    best = counting[chosen.resolution_m].with_model(chosen.model)
    return [*contenders, _entered("counting grid tuned", best)]


def chosen_grids(training: Sequence[Scan]) -> list[Contender]:
    """Enter each kind of grid once, chosen by likelihood on every fifth training scan.

    The counting grid with its usual weights and with tuned ones, and the log-odds grid.
    """
    rest, points = set_aside(training)
    usual, tuned = _best_counting(rest, points)
    log_odds = _best([LogOddsGrid(r) for r in RESOLUTIONS_M], rest, points)
    whole: dict[str, CountingGrid | LogOddsGrid] = {
        "counting grid": CountingGrid(usual.resolution_m),
        "counting grid tuned": CountingGrid(tuned.resolution_m, tuned.model),
        "log-odds grid": LogOddsGrid(log_odds.resolution_m),
    }
    return [_entered(name, grid, {"build_s": fill(grid, training)}) for name, grid in whole.items()]


def log_odds_grids(training: Sequence[Scan]) -> list[Contender]:
    """Enter the log-odds grid once for each size of cells."""
    contenders = []
    for resolution_m in RESOLUTIONS_M:
        grid = LogOddsGrid(resolution_m)
        facts = {"build_s": fill(grid, training)}
        contenders.append(_entered(f"log-odds grid {resolution_m * 100:g} cm", grid, facts))
    return contenders


def _entered(
    name: str, grid: CountingGrid | LogOddsGrid, facts: Mapping[str, object] | None = None
) -> Contender:
    about = {
        "resolution_m": grid.resolution_m,
        **asdict(grid.model),
        "memory_bytes": grid.size_bytes,
        **(facts or {}),
    }
    return Contender(name, grid.occupancy, about)


def _best_counting(
    rest: Sequence[Scan], points: LabelledPoints
) -> tuple[CountingGrid, CountingGrid]:
    """The counting grid of the best cell size, with its usual weights and with the best ones."""
    candidates = [CountingGrid(resolution_m) for resolution_m in RESOLUTIONS_M]
    usual = _best(candidates, rest, points)
    if not has_both(points):
        return usual, usual
    read = (grid.with_model(model) for grid in candidates for model in COUNTING_MODELS)
    return usual, best_by_likelihood(read, points.points, points.occupied)


def _best(candidates: Sequence[GridT], rest: Sequence[Scan], points: LabelledPoints) -> GridT:
    """Fill the candidates and choose by likelihood; the middle one if there is no telling."""
    if not has_both(points):
        return candidates[len(candidates) // 2]
    for grid in candidates:
        fill(grid, rest)
    return best_by_likelihood(candidates, points.points, points.occupied)


def set_aside(training: Sequence[Scan]) -> tuple[list[Scan], LabelledPoints]:
    """Divide training scans to choose settings: most of them, and points of every fifth."""
    aside = [s for i, s in enumerate(training) if i % _VALIDATION_STEP == _VALIDATION_PHASE]
    rest = [s for i, s in enumerate(training) if i % _VALIDATION_STEP != _VALIDATION_PHASE]
    return rest, labelled_points(aside, _VALIDATION_SEED, keep=None)


def has_both(points: LabelledPoints) -> bool:
    """Whether there are hits and free points among them."""
    return bool(points.occupied.any() and not points.occupied.all())


def fill(grid: OccupancyGrid, scans: Iterable[Scan]) -> float:
    """Add scans to a grid; how long that took, s."""
    started = perf_counter()
    for scan in scans:
        grid.add(np.array(scan.pose[:2]), hit_ends(scan))
    return _round_s(perf_counter() - started)


def _round_s(seconds: float) -> float:
    return round(seconds, 4)


def _ask(snapshot: Snapshot, fusion: str) -> Predict:
    def predict(points: Floats) -> tuple[Floats, Bools]:
        answer = snapshot.query(points, fusion)
        return answer.occupancy, answer.known

    return predict


def _compile(training: Sequence[Scan], config: MapConfig) -> None:
    """Run everything once on the first scan, so that no figure contains compilation."""
    mapper = Mapper(config)
    for scan in training[:1]:
        mapper.update(scan)
        mapper.train().query(np.array([scan.pose[:2]]))
