"""The command `gpom replay`."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from clients.errors import DeliveryError
from clients.fleet import FleetSettings, describe, losses, run_fleet
from clients.logs import LogReader, NoReturns, ReadOptions, open_log
from clients.options import (
    DEFAULT_ENDPOINTS,
    DEFAULT_PREFIX,
    DEFAULT_WAIT_S,
    Connect,
    MapFrame,
    Prefix,
    Sensor,
    Topic,
    Wait,
)
from clients.replay import Pace, cut, robot_names, schedule


def replay(  # noqa: PLR0913, PLR0917 - every option is an argument
    file: Annotated[
        Path, typer.Argument(help="CARMEN log, or ROS bag (ROS 1, sqlite3, MCAP).", metavar="FILE")
    ],
    robot: Annotated[str, typer.Option(help="Name of the robot.", metavar="NAME")],
    robots: Annotated[
        int,
        typer.Option(
            help="Cut the log into so many trajectories and publish them at the same time, as "
            "NAME-1, NAME-2, …",
            min=1,
        ),
    ] = 1,
    rate: Annotated[
        float | None, typer.Option(help="Scans per second and robot.", metavar="HZ")
    ] = None,
    speed: Annotated[
        float | None, typer.Option(help="As recorded, so many times faster.", metavar="X")
    ] = None,
    skip_held_out: Annotated[
        bool,
        typer.Option(
            "--skip-held-out",
            help="Leave out scans 5, 15, 25 …, on which `gpom evaluate` scores the map.",
        ),
    ] = False,
    range_cap_m: Annotated[
        float | None, typer.Option(help="Longer ranges count as no-returns.", metavar="METRES")
    ] = None,
    no_return: Annotated[
        NoReturns,
        typer.Option(
            help="What a beam without an echo means: nothing (ignore; indoors most are failures) "
            "or free space up to the range limit.",
        ),
    ] = NoReturns.IGNORE,
    topic: Topic = None,
    map_frame: MapFrame = None,
    connect: Connect = DEFAULT_ENDPOINTS,
    prefix: Prefix = DEFAULT_PREFIX,
    sensor: Sensor = "laser",
    wait_s: Wait = DEFAULT_WAIT_S,
) -> None:
    """Publish a recorded log to the map, as if robots were driving now.

    Without --rate or --speed it goes as fast as the map service takes the scans; none is left
    out. Ends with 1 when scans may have been lost on the way.
    """
    errors = Console(stderr=True)
    pace = Pace(rate, speed)
    names = robot_names(robot, robots)
    with errors.status(f"reading {file.name} …"):
        log = open_log(file, ReadOptions(no_return, range_cap_m, None, topic, map_frame))
        trajectories = cut(list(log), robots, skip_held_out=skip_held_out)
        departures = schedule(trajectories, pace)
    for note in log.describe().notes:
        errors.print(note, highlight=False)
    _warn_of_skipped_lines(log, errors)
    settings = FleetSettings(connect, prefix, sensor, wait_s)
    report = run_fleet(names, departures, len(departures), settings, errors)
    held_out = len(log) - len(departures)
    left_out = f"; {held_out} held out" if skip_held_out else ""
    typer.echo(f"{file.name}: {describe(report, names)}{left_out}")
    if (lost := losses(report)) is not None:
        raise DeliveryError(f"{lost}; replay the log again")


def _warn_of_skipped_lines(log: LogReader, errors: Console) -> None:
    skipped = log.describe().skipped
    if skipped:
        count = sum(skipped.values())
        reasons = ", ".join(f"{number} {reason}" for reason, number in sorted(skipped.items()))
        errors.print(
            f"left out {count} of {len(log) + count} scans that cannot be read: {reasons}",
            highlight=False,
        )
