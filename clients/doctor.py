"""The command `gpom doctor`: what a running fleet lacks."""

import json
from contextlib import ExitStack
from dataclasses import asdict
from typing import Annotated, Literal

import typer
import zenoh
from rich.console import Console

from clients.children import stop_on_signal
from clients.errors import DeliveryError
from clients.examination import Examination, StreamReport
from clients.link import SessionSettings, open_session
from clients.listener import Listener, ListenerSettings, named
from clients.options import DEFAULT_ENDPOINTS, DEFAULT_PREFIX, Connect, Domain, Prefix, Transports
from gpom_core.ros.keys import Transport
from gpom_core.ros.messages import frame_name

_ASK_S = 2.0


def doctor(
    seconds: Annotated[float, typer.Option(help="Listen so long.", min=0.1)] = 5.0,
    transport: Transports = None,
    domain: Domain = 0,
    map_frame: Annotated[str, typer.Option(help="Frame to place scans in.")] = "map",
    pose_from: Annotated[
        Literal["tf", "odometry", "pose"], typer.Option(help="As in the settings of the service.")
    ] = "tf",
    connect: Connect = DEFAULT_ENDPOINTS,
    prefix: Prefix = DEFAULT_PREFIX,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Listen to the fleet for a few seconds and say what is missing.

    Which robots send scans, how often, in which frames, with which gaps and clocks, and whether
    their transforms place them in the map. Ends with 1 when something is wrong.
    """
    ways = named(transport)
    examination = Examination(frame_name(map_frame), pose_from)
    with ExitStack() as stack:
        stop = stack.enter_context(stop_on_signal())
        session = stack.enter_context(open_session(SessionSettings(connect)))
        listener = Listener(session, ListenerSettings(ways, domain, prefix))
        stack.callback(listener.close)
        with Console(stderr=True).status(f"listening for {seconds:g} s …"):
            for heard in listener.messages(seconds, stop):
                examination.hear(heard)
        reports = examination.report(listener.announced)
        problems = [
            *(f"{what} ({count} times)" for what, count in examination.troubles.items()),
            *_of_the_whole(session, prefix, domain, ways, reports),
        ]
    if as_json:
        streams = [asdict(report) for report in reports]
        typer.echo(json.dumps({"streams": streams, "problems": problems}, indent=2))
    else:
        typer.echo("\n".join([*map(_line, reports), *problems]) or "all is well")
    count = len(problems) + sum(len(report.problems) for report in reports)
    if count:
        raise DeliveryError(f"{count} thing{'s' if count > 1 else ''} to look at")


def _of_the_whole(
    session: zenoh.Session,
    prefix: str,
    domain: int,
    ways: list[Transport],
    reports: list[StreamReport],
) -> list[str]:
    problems = []
    token = f"{prefix}/_map/alive"
    if not any(reply.ok for reply in session.liveliness().get(token, timeout=_ASK_S)):
        problems.append(
            f"no map service is alive under the prefix {prefix}: is `gpom serve` running, and "
            "connected to this router?"
        )
    if not reports:
        problems.append(
            f"nobody publishes laser scans, neither over {' nor over '.join(ways)} (ROS domain "
            f"{domain}) nor as scans of gpom under {prefix}: are the robots connected to this "
            "router, and is their ROS_DOMAIN_ID the same?"
        )
    return problems


def _line(report: StreamReport) -> str:
    lost = "" if report.lost is None else f", {report.lost} lost"
    where = f" in {report.frame}, {report.placed:.0%} placed" if report.frame else ""
    head = (
        f"{report.topic} ({report.way}): {report.scans} scans, {report.rate_hz:.1f} Hz, "
        f"{report.beams} beams{where}{lost}, age {report.age_s:+.2f} s"
    )
    problems = (f"  ! {problem}" for problem in report.problems)
    return "\n".join([head, *problems, *(f"  - {note}" for note in report.notes)])
