"""The command `gpom simulate`."""

import heapq
import time
from collections.abc import Iterator
from math import ceil
from operator import attrgetter
from typing import Annotated

import typer
from rich.console import Console

from clients.building import furnished_building
from clients.dispatch import Departure
from clients.fleet import FleetSettings, describe, losses, run_fleet
from clients.options import (
    DEFAULT_ENDPOINTS,
    DEFAULT_PREFIX,
    DEFAULT_WAIT_S,
    Connect,
    Prefix,
    Sensor,
    Wait,
)
from clients.replay import robot_names
from clients.sensor import RangeSensor
from clients.simulate import RobotSimulator

_LATE_S = 1.0


def simulate(  # noqa: PLR0913, PLR0917 - every option is an argument
    robots: Annotated[int, typer.Option(help="Number of robots.", min=1)] = 3,
    rate: Annotated[float, typer.Option(help="Scans per second and robot.", metavar="HZ")] = 10.0,
    beams: Annotated[int, typer.Option(help="Beams of a scan, around the robot.")] = 360,
    duration_s: Annotated[
        float | None,
        typer.Option(
            "--duration-s",
            "--duration",
            help="End after so long; default: go on until Ctrl-C.",
            min=0.0,
            metavar="SECONDS",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="Of furniture, tours and noise.", min=0)] = 0,
    robot: Annotated[str, typer.Option(help="They are NAME-1, NAME-2, …", metavar="NAME")] = "sim",
    speed_m_s: Annotated[float, typer.Option(help="Of driving.", metavar="M/S")] = 0.8,
    range_max_m: Annotated[float, typer.Option(help="Sight.", metavar="METRES")] = 12.0,
    noise_m: Annotated[
        float, typer.Option(help="Standard deviation of a range.", metavar="METRES")
    ] = 0.01,
    connect: Connect = DEFAULT_ENDPOINTS,
    prefix: Prefix = DEFAULT_PREFIX,
    sensor: Sensor = "laser",
    wait_s: Wait = DEFAULT_WAIT_S,
) -> None:
    """Drive simulated robots through a furnished building of 30 x 20 m, in real time."""
    scanner = RangeSensor(beams=beams, range_max_m=range_max_m, noise_std_m=noise_m)
    site = furnished_building(seed)
    start_ns = time.time_ns()
    fleet = [
        RobotSimulator(
            site,
            scanner,
            seed=seed,
            robot=index,
            rate_hz=rate,
            speed_m_s=speed_m_s,
            start_ns=start_ns,
        )
        for index in range(robots)
    ]
    names = robot_names(robot, robots)
    streams = [_departures(index, one, duration_s, rate) for index, one in enumerate(fleet)]
    total = None if duration_s is None else robots * ceil(duration_s * rate)
    report = run_fleet(
        names,
        heapq.merge(*streams, key=attrgetter("due_s")),
        total,
        FleetSettings(connect, prefix, sensor, wait_s),
        Console(stderr=True),
    )
    typer.echo(describe(report, names))
    if (lost := losses(report)) is not None:
        typer.echo(f"gpom: {lost}", err=True)
    elif report.most_late_s > _LATE_S:
        message = (
            f"gpom: this machine is too slow, scans came up to {report.most_late_s:.1f} s late; "
            "ask for fewer robots, beams or scans per second"
        )
        typer.echo(message, err=True)


def _departures(
    index: int, robot: RobotSimulator, duration_s: float | None, rate_hz: float
) -> Iterator[Departure]:
    for turn, scan in enumerate(robot.scans(duration_s)):
        yield Departure(turn / rate_hz, index, scan)
