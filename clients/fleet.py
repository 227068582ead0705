"""Several robots of one process on the way to the map: what `replay` and `simulate` share."""

from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from clients.children import stop_on_signal
from clients.dispatch import Departure, Report, await_map, dispatch
from clients.keys import StreamKeys
from clients.link import SessionSettings, open_session
from clients.publisher import ScanPublisher


@dataclass(frozen=True, slots=True)
class FleetSettings:
    """How the robots reach the map.

    Attributes:
        endpoints: zenoh routers.
        prefix: of the site's keys.
        sensor: of every robot.
        wait_s: for the map service, at the start and when it goes away.
    """

    endpoints: Sequence[str]
    prefix: str
    sensor: str
    wait_s: float


def run_fleet(
    names: Sequence[str],
    departures: Iterable[Departure],
    total: int | None,
    settings: FleetSettings,
    console: Console,
) -> Report:
    """Publish the scans of robots until they end or a signal comes, and show the progress.

    Raises:
        ConfigurationError: a name or endpoint is malformed.
        DeliveryError: the map service is not there, or goes away for good.
    """
    for name in names:
        StreamKeys(settings.prefix, name, settings.sensor)  # refuses bad names before connecting
    with ExitStack() as stack:
        stop = stack.enter_context(stop_on_signal())
        session = stack.enter_context(open_session(SessionSettings(settings.endpoints)))
        publishers = [
            stack.enter_context(
                ScanPublisher(name, settings.sensor, prefix=settings.prefix, session=session)
            )
            for name in names
        ]
        if not await_map(publishers, settings.wait_s, stop):
            return Report((0,) * len(names), 0.0, 0.0, 0, drained=True, stopped=True)
        bar = stack.enter_context(_progress(console))
        task = bar.add_task("publishing", total=total)
        return dispatch(
            departures,
            publishers,
            stop=stop,
            timeout_s=settings.wait_s,
            on_sent=lambda _: bar.advance(task),
        )


def describe(report: Report, names: Sequence[str]) -> str:
    """Say in a sentence what came of it."""
    scans = sum(report.sent)
    rate_hz = scans / report.elapsed_s if report.elapsed_s > 0.0 else 0.0
    robots = names[0] if len(names) == 1 else f"{len(names)} robots ({names[0]} … {names[-1]})"
    stopped = ", stopped by a signal" if report.stopped else ""
    return (
        f"published {scans} scans as {robots} in {report.elapsed_s:.1f} s "
        f"({rate_hz:.0f} a second){stopped}"
    )


def losses(report: Report) -> str | None:
    """Say why scans may be missing in the map; None when none can be."""
    if report.interruptions:
        return "the map service went away meanwhile, so scans may be missing in the map"
    if not report.drained:
        return "the map service has not acknowledged the last scans, so some may be missing in it"
    return None


def _progress(console: Console) -> Progress:
    return Progress(
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("scans"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )
