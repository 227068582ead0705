"""The command `gpom tune`: the few settings that matter, by cross-validation on training scans.

Held-out scans of the evaluation protocol are never read. Every trial builds maps from most of the
training scans and scores them on the others, on all logs and at all shares that are asked for, so
that one default has to hold where scans are many and where they are few.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from math import log
from pathlib import Path
from time import perf_counter
from typing import Annotated

import numpy as np
import typer
from pydantic import ValidationError
from rich.console import Console

from clients.map_settings import as_yaml, read_config
from clients.output import require_file, write
from clients.protocol import (
    LabelledPoints,
    labelled_points,
    lacking,
    parse_share,
    read_scans,
    split,
    thin,
)
from gpom_core.config import MapConfig
from gpom_core.errors import ConfigurationError
from gpom_core.mapper import Mapper
from gpom_core.metrics import negative_log_likelihood
from gpom_core.scan import Scan

TUNED = ("hit_noise_std", "free_noise_std", "length_scale_m", "cell_m", "hit_cell_m")
"""The settings that are searched, in this order."""

FIRST_FACTOR = 1.25
LAST_FACTOR = 1.03
_VALIDATION_POINTS = 5000
_SEED = 1


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """One map to build in every trial, and where it is asked.

    Attributes:
        training: scans that build it.
        test: labelled points of training scans that do not.
    """

    training: list[Scan]
    test: LabelledPoints


@dataclass(frozen=True, slots=True)
class Outcome:
    """What one configuration reached over all cases.

    Attributes:
        nll: mean over the cases of the negative log likelihood, nats per point.
        observations: that experts were trained on, over all cases.
        training_ms: of all experts, over all cases.
        points: that were asked, over all cases.
    """

    config: MapConfig
    nll: float
    observations: int
    training_ms: float
    points: int

    @property
    def gained(self) -> float:
        """Nats gained over knowing nothing (log 2 a point), of all points."""
        return (log(2.0) - self.nll) * self.points

    @property
    def per_observation(self) -> float:
        """Nats gained per observation that experts were trained on."""
        return self.gained / max(self.observations, 1)

    @property
    def per_ms(self) -> float:
        """Nats gained per millisecond of training."""
        return self.gained / max(self.training_ms, 1e-9)


def cases_of(
    scans: Sequence[Scan], folds: int, shares: Sequence[Fraction], log_name: str = "the log"
) -> list[Case]:
    """Cross-validation within the training scans of a log.

    Args:
        scans: all scans of a log, in order. folds: each fold is left out once.
        shares: of the scans of the other folds that build the map.
        log_name: for the errors.

    Raises:
        ConfigurationError: fewer folds than two, or a fold without hits and passing beams.
    """
    if folds < 2:
        raise ConfigurationError(f"folds is {folds}; expected at least 2")
    training, _ = split(scans)
    if len(training) < folds:
        raise ConfigurationError(
            f"{log_name} has {len(training)} training scans for {folds} folds; expected one or "
            "more in every fold: use fewer folds or a longer log"
        )
    cases = []
    for fold in range(folds):
        aside = training[fold::folds]
        rest = [scan for i, scan in enumerate(training) if i % folds != fold]
        test = labelled_points(aside, _SEED + fold, _VALIDATION_POINTS)
        if missing := lacking(test):
            raise ConfigurationError(
                f"the {len(aside)} training scans in fold {fold} of {folds} of {log_name} have "
                f"{missing}; expected hits and passing beams in every fold"
            )
        cases += [Case(thin(rest, share), test) for share in shares]
    return cases


def measure(config: MapConfig, cases: Sequence[Case]) -> Outcome:
    """Build the map of every case and score it."""
    nll, observations, seconds, points = [], 0, 0.0, 0
    for case in cases:
        mapper = Mapper(config)
        for scan in case.training:
            mapper.update(scan)
        started = perf_counter()
        snapshot = mapper.train()
        seconds += perf_counter() - started
        observations += sum(len(m.expert.observations) for m in snapshot.members.values())
        occupancy = snapshot.query(case.test.points).occupancy
        nll.append(negative_log_likelihood(occupancy, case.test.occupied))
        points += len(case.test)
    return Outcome(config, float(np.mean(nll)), observations, 1000.0 * seconds, points)


def search(
    start: MapConfig, measured: Callable[[MapConfig], Outcome], trials: int
) -> Iterator[tuple[str, Outcome, bool]]:
    """Coordinate search: each setting a step up and down, steps shrinking when none helps.

    Yields:
        what was changed, what came of it, and whether it is the best so far.
    """
    best = measured(start)
    yield "start", best, True
    done, factor, tried = 1, FIRST_FACTOR, {_key(start)}
    while factor > LAST_FACTOR:
        improved = False
        for name in TUNED:
            for step in (factor, 1.0 / factor):
                config = _changed(best.config, name, step)
                if config is None or _key(config) in tried:
                    continue
                if done >= trials:
                    return
                tried.add(_key(config))
                outcome, done = measured(config), done + 1
                better = outcome.nll < best.nll
                best, improved = (outcome, True) if better else (best, improved)
                yield f"{name} {getattr(config, name):g}", outcome, better
                if better:
                    break
        factor = factor if improved else factor**0.5


def tune(
    logs: Annotated[list[Path], typer.Argument(help="CARMEN logs, or ROS bags.")],
    folds: Annotated[int, typer.Option(min=2, help="Parts of the training scans.")] = 5,
    trials: Annotated[int, typer.Option(min=1, help="Configurations to try at most.")] = 40,
    shares: Annotated[
        str, typer.Option(help="Shares of the other folds that build maps.")
    ] = "1,1/10",
    config: Annotated[
        Path | None, typer.Option(help="YAML file of settings to start from.")
    ] = None,
    output: Annotated[
        Path | None, typer.Option(help="File for the best settings, as YAML.")
    ] = None,
) -> None:
    """Search the map's settings by cross-validation on training scans, print the best as YAML.

    Scans 5, 15, 25 … are never touched, so `gpom evaluate` and `gpom compare` stay honest. Each
    trial shows its likelihood, and the nats gained over knowing nothing per observation and per
    millisecond of training.
    """
    parts = [parse_share(text) for text in shares.split(",")]
    start = read_config(config)
    cases = [case for path in logs for case in cases_of(read_scans(path), folds, parts, str(path))]
    if output is not None:
        require_file(output)
    console = Console(stderr=True)
    console.print(f"{len(cases)} maps a trial")
    measure(start, [replace(cases[0], training=cases[0].training[:1])])  # compiles
    best = None
    for number, (what, outcome, better) in enumerate(
        search(start, lambda c: measure(c, cases), trials), 1
    ):
        best = outcome if better else best
        mark = "  best so far" if better else ""
        console.print(
            f"{number:3}  {what:24} {_line(outcome)}{mark}", highlight=False, soft_wrap=True
        )
    if best is None:
        raise ConfigurationError("no configuration was tried; expected at least one trial")
    text = f"# {_line(best)}\n" + as_yaml(best.config)
    typer.echo(text, nl=False)
    if output is not None:
        write(output, text.encode())


def _line(outcome: Outcome) -> str:
    return (
        f"nll {outcome.nll:.4f}  {outcome.observations} observations, "
        f"{outcome.per_observation:.3f} nats each  {outcome.training_ms:.0f} ms, "
        f"{outcome.per_ms:.1f} nats each"
    )


def _key(config: MapConfig) -> tuple[float, ...]:
    return tuple(getattr(config, name) for name in TUNED)


def _changed(config: MapConfig, name: str, step: float) -> MapConfig | None:
    values = {**config.model_dump(), name: float(f"{getattr(config, name) * step:.3g}")}
    try:
        return MapConfig(**values)
    except ValidationError:  # a step out of the allowed range
        return None
