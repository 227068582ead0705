"""The command `gpom evaluate`: how good is the map of a log, beside the best grids?"""

import json
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from time import perf_counter
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import track as track_on_console

from clients.contenders import Contender, Track, gpom_map, grids, running_service, untracked
from clients.map_client import MapClient
from clients.options import MapFrame, Topic
from clients.protocol import (
    LabelledPoints,
    evaluate,
    far_from_beams,
    held_out_points,
    parse_share,
    read_scans,
    split,
    thin,
)
from gpom_core.committee import Fusion
from gpom_core.scan import Scan

__all__ = ["Trial", "evaluate", "evaluate_command", "held_out_points", "prepare", "report", "thin"]


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """What the contenders build from and what they are asked.

    Attributes:
        log: name of the log, for the report.
        share: of the training scans that build the map.
        seed: of the test points.
        training: scans that build the map, already thinned.
        held_out: number of scans kept off the map.
        test: labelled points of the held-out scans.
        far: those of them that are far from every training beam; None when not asked for.
        far_m: how far that is; 0 when not asked for.
    """

    log: str
    share: Fraction
    seed: int
    training: list[Scan]
    held_out: int
    test: LabelledPoints
    far: LabelledPoints | None = None
    far_m: float = 0.0


def prepare(
    log: str, scans: Sequence[Scan], share: Fraction, seed: int, far_m: float | None = None
) -> Trial:
    """Divide the scans of a log by the protocol.

    Args:
        log: name for the report.
        scans: all scans of the log, in order, as `read_scans` gives them.
        share: of the training scans that build the map.
        seed: of the test points.
        far_m: also score the points farther than this from every training beam.

    Raises:
        ConfigurationError: the log has too few scans or hits, or a value is out of range.
    """
    training, held_out = split(scans)
    training = thin(training, share)
    test = held_out_points(scans, seed, log=log)
    far = None
    if far_m is not None:
        far = test.where(far_from_beams(test.points, training, far_m))
    return Trial(log, share, seed, training, len(held_out), test, far, far_m or 0.0)


def report(trial: Trial, contenders: Sequence[Contender]) -> dict[str, object]:
    """Ask every contender and give what `gpom evaluate` prints."""
    summary: dict[str, object] = {
        "log": trial.log,
        "share": str(trial.share),
        "seed": trial.seed,
        "training_scans": len(trial.training),
        "held_out_scans": trial.held_out,
        "points": len(trial.test),
        "occupied_points": int(trial.test.occupied.sum()),
    }
    if trial.far is not None:
        summary |= {"far_m": trial.far_m, "far_points": len(trial.far)}
    return summary | {"methods": {c.name: _scored(trial, c) for c in contenders}}


def evaluate_command(  # noqa: PLR0913, PLR0917 - every option is an argument
    file: Annotated[Path, typer.Argument(help="CARMEN log, or ROS bag (ROS 1, sqlite3, MCAP).")],
    share: Annotated[str, typer.Option(help="Share of the training scans: 1, 1/3, 1/10 …")] = "1",
    seed: Annotated[int, typer.Option(min=0, help="Draw of the test points.")] = 0,
    url: Annotated[
        str | None,
        typer.Option(help="Score the map of this running service instead of building one."),
    ] = None,
    baselines: Annotated[bool, typer.Option("--baselines", help="Score the grids too.")] = False,
    fusion: Annotated[
        list[str] | None, typer.Option(help="bcm, rbcm or poe; may be repeated.  [default: bcm]")
    ] = None,
    far_m: Annotated[
        float | None,
        typer.Option(help="Also score the points farther than this from every training beam."),
    ] = None,
    topic: Topic = None,
    map_frame: MapFrame = None,
) -> None:
    """Build a map from most scans of a log, score it on the others, print JSON.

    Scans 5, 15, 25 … are held out. A service scored by --url must not have seen them either: fill
    it with gpom replay FILE --skip-held-out --range-cap-m 20.
    """
    # what was asked is refused before the work, not after
    part = parse_share(share)
    fusions = list(dict.fromkeys(fusion or ["bcm"]))
    for name in fusions:
        Fusion.named(name)
    trial = prepare(file.name, read_scans(file, topic, map_frame), part, seed, far_m)
    console = Console(stderr=True)
    track = _on_console(console)
    with ExitStack() as stack:
        if url is None:
            contenders = gpom_map(trial.training, fusions, track=track)
        else:
            contenders = running_service(stack.enter_context(MapClient(url)), fusions)
            _warn_of_other_scans(trial, contenders[0].facts["scans_integrated"], console)
        if baselines:
            contenders += grids(trial.training, track)
        typer.echo(json.dumps(report(trial, contenders), indent=2))


def _warn_of_other_scans(trial: Trial, in_service: object, console: Console) -> None:
    if in_service != len(trial.training):
        console.print(
            f"the service holds {in_service} scans and share {trial.share} of the training scans "
            f"is {len(trial.training)}: its figures are of the map it holds, not of that share",
            highlight=False,
            soft_wrap=True,
        )


def _scored(trial: Trial, contender: Contender) -> dict[str, object]:
    started = perf_counter()
    scores = evaluate(contender.predict, trial.test.points, trial.test.occupied)
    query_s = perf_counter() - started
    result = {**contender.facts, "query_s": round(query_s, 4), **scores.as_dict()}
    if trial.far is not None:
        far = trial.far
        # without both kinds of label there is nothing to compare
        mixed = bool(far.occupied.any()) and not bool(far.occupied.all())
        result["far"] = (
            evaluate(contender.predict, far.points, far.occupied).as_dict() if mixed else None
        )
    return result


def _on_console(console: Console) -> Track:
    if not console.is_terminal:
        return untracked

    def track(scans: Sequence[Scan], title: str) -> Iterable[Scan]:
        return track_on_console(scans, description=title, console=console)

    return track
