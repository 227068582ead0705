"""Robots that drive through a simulated building and scan it; the same for the same seed."""

from collections.abc import Iterator
from itertools import count, islice
from math import isfinite

import numpy as np

from clients.building import Site
from clients.motion import Trajectory, drive, round_corners
from clients.sensor import RangeSensor
from gpom_core.errors import ConfigurationError
from gpom_core.scan import Scan

ROBOT_RADIUS_M = 0.3

_NANOSECONDS = 1e9


class RobotSimulator:
    """One robot on its tour through all rooms. Robots do not see each other.

    Args:
        site: where it drives.
        sensor: what it scans with, mounted at its centre.
        seed: of the whole simulation.
        robot: which of the fleet, from 0; each has its own tour and noise.
        rate_hz: scans per second.
        speed_m_s: on straight ways.
        turn_rate_rad_s: at most.
        start_ns: stamp of the first scan.

    Raises:
        ConfigurationError: a rate or speed is not positive.
    """

    def __init__(
        self,
        site: Site,
        sensor: RangeSensor | None = None,
        *,
        seed: int = 0,
        robot: int = 0,
        rate_hz: float = 10.0,
        speed_m_s: float = 0.8,
        turn_rate_rad_s: float = 1.5,
        start_ns: int = 0,
    ) -> None:
        for name, value in (
            ("rate_hz", rate_hz),
            ("speed_m_s", speed_m_s),
            ("turn_rate_rad_s", turn_rate_rad_s),
        ):
            if not (isfinite(value) and value > 0.0):
                message = f"{name} is {value}; expected a positive number"
                raise ConfigurationError(message)
        self._site = site
        self._sensor = sensor or RangeSensor()
        self._seed = (seed, robot)
        self._rate_hz = rate_hz
        self._speed_m_s = speed_m_s
        self._turn_rate_rad_s = turn_rate_rad_s
        self._start_ns = start_ns

    def scans(self, duration_s: float | None = None) -> Iterator[Scan]:
        """Give the scans of the first `duration_s`, or without end; each call starts anew."""
        route_rng, noise_rng = (np.random.default_rng([*self._seed, part]) for part in (1, 2))
        legs = self._legs(route_rng)
        leg, begins_s = next(legs), 0.0
        number = None if duration_s is None else int(np.ceil(duration_s * self._rate_hz - 1e-9))
        for index in islice(count(), number):
            time_s = index / self._rate_hz
            while time_s - begins_s > leg.duration_s:
                begins_s += leg.duration_s
                leg = next(legs)
            pose = leg.pose(time_s - begins_s)
            yield Scan(
                pose=pose,
                ranges_m=self._sensor.measure(self._site.world, pose, noise_rng),
                angle_min_rad=self._sensor.angle_min_rad,
                angle_increment_rad=self._sensor.angle_increment_rad,
                range_min_m=self._sensor.range_min_m,
                range_max_m=self._sensor.range_max_m,
                stamp_ns=self._start_ns + round(time_s * _NANOSECONDS),
                scan_time_s=1.0 / self._rate_hz,
            )

    def _legs(self, rng: np.random.Generator) -> Iterator[Trajectory]:
        """Tour after tour through all rooms, each in a new order, once around each room."""
        rooms = self._site.rooms
        room = self._seed[1] % len(rooms)
        place = int(rng.choice(rooms[room]))
        yaw_rad: float | None = None
        order = [room]
        while True:
            for at in order:
                places = [place]
                for corner in self._around(at, place):
                    places += self._site.route(places[-1], corner)[1:]
                place = places[-1]
                leg = drive(
                    round_corners(self._site.nodes[places]),
                    speed_m_s=self._speed_m_s,
                    turn_rate_rad_s=self._turn_rate_rad_s,
                    start_yaw_rad=yaw_rad,
                )
                yaw_rad = float(leg.yaws_rad[-1])
                yield leg
            order = [int(index) for index in rng.permutation(len(rooms))]

    def _around(self, room: int, start: int) -> list[int]:
        """Give the corners of a room's ring in order, from the one nearest to `start`."""
        ring = self._site.rooms[room]
        offsets = self._site.nodes[list(ring)] - self._site.nodes[start]
        first = int(np.linalg.norm(offsets, axis=1).argmin())
        return [ring[(first + step) % len(ring)] for step in range(len(ring) + 1)]
