"""The robots that were seen: what arrived from each, where it is, whether it is there."""

import threading
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from math import remainder, tau

from gpom_core.scan import Pose2D


@dataclass(frozen=True, slots=True)
class IntakeStatus:
    """How scans fare that come without a pose, before they are scans of the map.

    Attributes:
        received: messages.
        waiting: for their transforms.
        delayed: waited for a transform, and got it.
        uncorrected: motion within the sweep is left in.
        dropped: by reason.
        age_s: of the last one by its own stamp when it came; far from 0, its clock is off.
        problem: what is wrong now, and since when; None while all is well.
    """

    received: int = 0
    waiting: int = 0
    delayed: int = 0
    uncorrected: int = 0
    dropped: Mapping[str, int] = field(default_factory=dict)
    age_s: float | None = None
    problem: str | None = None


@dataclass(frozen=True, slots=True)
class RobotStatus:
    """One robot at one moment.

    Attributes:
        id: name of the robot, from the key its scans come under.
        scans: accepted ones, over all runs of the robot and of the service.
        lost: scans that its sequence numbers say exist, but that never came.
        last_seen_unix_s: when its last scan came; None before the first.
        pose: of the sensor that sent the last scan, in the map frame; None before the first.
        alive: whether its liveliness token is up.
        intake: of a robot whose scans come without a pose; None of others.
        refused: scans that did not enter the map, by reason, since the service started.
    """

    id: str
    scans: int = 0
    lost: int = 0
    last_seen_unix_s: float | None = None
    pose: Pose2D | None = None
    alive: bool = False
    intake: IntakeStatus | None = None
    refused: Mapping[str, int] = field(default_factory=dict)


@dataclass(slots=True)
class Fleet:
    """All robots, by name; safe to use from any thread. At most `robots_max` are remembered."""

    robots_max: int
    _robots: dict[str, RobotStatus] = field(default_factory=dict, init=False)
    _lock: threading.Lock = field(default_factory=threading.Lock, init=False)

    def restore(self, robots: Iterable[RobotStatus]) -> None:
        """Remember robots of before; when there is not room for all, those seen last."""
        by_age = sorted(robots, key=lambda robot: robot.last_seen_unix_s or 0.0)
        with self._lock:
            self._robots = {robot.id: robot for robot in by_age[-self.robots_max :]}

    def has_room(self, robot: str, newcomers: set[str] | None = None) -> bool:
        """Tell whether scans of this robot can be taken: it is known, or there is room.

        Args:
            robot: its name.
            newcomers: robots that were given room and whose scans are not noted yet.
        """
        with self._lock:
            strangers = {robot}.union(newcomers or ()).difference(self._robots)
            return robot in self._robots or len(self._robots) + len(strangers) <= self.robots_max

    def saw_scan(self, robot: str, pose: Pose2D, lost: int, unix_s: float) -> RobotStatus | None:
        """Note an accepted scan.

        Returns:
            The robot if it is new, else None.
        """
        with self._lock:
            before = self._robots.get(robot, RobotStatus(robot))
            self._robots[robot] = now = replace(
                before,
                scans=before.scans + 1,
                lost=before.lost + lost,
                last_seen_unix_s=unix_s,
                # Wheel odometry often counts its turns; headings are from -π to π for all.
                pose=pose._replace(yaw_rad=remainder(pose.yaw_rad, tau)),
            )
            return now if before.scans == 0 else None

    def refused_scans(self, robot: str, reason: str, count: int = 1) -> None:
        """Note scans that did not enter the map; of robots that are known, so names stay few."""
        with self._lock:
            before = self._robots.get(robot)
            if before is None:
                return
            refused = {**before.refused, reason: before.refused.get(reason, 0) + count}
            self._robots[robot] = replace(before, refused=refused)

    def set_alive(self, robot: str, alive: bool) -> RobotStatus | None:
        """Note that a robot came or went.

        Returns:
            The robot if that is news, else None.
        """
        with self._lock:
            before = self._robots.get(robot)
            if before is None and (not alive or len(self._robots) >= self.robots_max):
                return None
            if before is not None and before.alive == alive:
                return None
            now = replace(before or RobotStatus(robot), alive=alive)
            self._robots[robot] = now
            return now

    def set_intake(self, robot: str, intake: IntakeStatus) -> IntakeStatus | None:
        """Note how scans without a pose fare.

        Returns:
            What was known before; None when that is nothing, or the robot has no room.
        """
        with self._lock:
            before = self._robots.get(robot)
            if before is None and len(self._robots) >= self.robots_max:
                return None
            self._robots[robot] = replace(before or RobotStatus(robot), intake=intake)
            return None if before is None else before.intake

    def robots(self) -> tuple[RobotStatus, ...]:
        """All robots, by name."""
        with self._lock:
            return tuple(self._robots[name] for name in sorted(self._robots))
