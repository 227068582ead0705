"""The scene, the robots and their scans: as close to the paper's as its figures tell.

A hall of 22 x 18 m with an L-shaped wall that hangs from the north wall and a box at the bottom
right. Two robots look ahead with 17 beams over 180 degrees, up to 8 m, every half metre::

    +-----------+-------------+
    |           |       ^     |
    |      1-.  |       |     |
    |      .-   +----   |     |
    |    .-             .-2   |
    |   v             +---+   |
    |                 +---+   |
    +-------------------------+
"""

from dataclasses import dataclass
from math import pi
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clients.sensor import RangeSensor
from clients.world import Box, World
from gpom_core.scan import Pose2D, Scan

Floats = NDArray[np.float64]

BOUNDS_M = (-0.5, -0.5, 22.5, 18.5)
WALL_M = 0.3
SENSOR = RangeSensor(
    beams=17, fov_rad=pi, range_max_m=8.0, noise_std_m=0.02, dropout_probability=0.0
)
SCANS_PER_ROBOT = 13
STEP_M = 0.5
_START_STD_M = 0.15  # where the robots start differs from seed to seed

_L_WALL = (Box(11.0, 15.0, WALL_M, 6.0), Box(12.85, 12.0, 4.0, WALL_M))
_OTHERS = (
    Box(11.0, 18.0 + WALL_M / 2, 22.0 + 2 * WALL_M, WALL_M),
    Box(11.0, -WALL_M / 2, 22.0 + 2 * WALL_M, WALL_M),
    Box(-WALL_M / 2, 9.0, WALL_M, 18.0),
    Box(22.0 + WALL_M / 2, 9.0, WALL_M, 18.0),
    Box(17.0, 3.4, 3.0, 2.0),
)
_ROUTES_M = (
    ((5.5, 11.2), (6.7, 11.1), (5.7, 9.7), (2.8, 6.4)),
    ((18.6, 10.4), (17.3, 9.5), (16.9, 13.8), (16.7, 12.6)),
)


class Robot(NamedTuple):
    """Its scans, in order."""

    name: str
    scans: tuple[Scan, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Experiment:
    """What is true and what was measured.

    Attributes:
        l_wall: the L-shaped wall alone.
    """

    seed: int
    world: World
    l_wall: World
    robots: tuple[Robot, ...]

    @property
    def scans(self) -> list[Scan]:
        """All scans, robot by robot."""
        return [scan for robot in self.robots for scan in robot.scans]

    def counts(self) -> dict[str, int]:
        """How many poses, beams, hits and observations; the paper has 26, 442, 254 and 696."""
        hits = sum(int(scan.hits().sum()) for scan in self.scans)
        beams = sum(len(scan.ranges_m) for scan in self.scans)
        return {
            "poses": len(self.scans),
            "beams": beams,
            "hits": hits,
            "no_returns": sum(int(scan.no_returns().sum()) for scan in self.scans),
            "observations": hits + beams,
        }


def make_experiment(seed: int = 0) -> Experiment:
    """Let the robots drive and scan; the seed shifts their routes and draws the noise."""
    rng = np.random.default_rng([seed, 2022])
    world = World([*_L_WALL, *_OTHERS])
    robots = []
    for number, route in enumerate(_ROUTES_M, start=1):
        shifted = np.array(route) + rng.normal(0.0, _START_STD_M, 2)
        scans = tuple(_scan(world, pose, rng) for pose in _poses(shifted))
        robots.append(Robot(f"robot {number}", scans))
    return Experiment(seed, world, World(_L_WALL), tuple(robots))


def _poses(route_m: Floats) -> list[Pose2D]:
    """Places every `STEP_M` along a polyline, looking ahead."""
    legs = np.diff(route_m, axis=0)
    lengths_m = np.hypot(*legs.T)
    ends_m = np.cumsum(lengths_m)
    poses = []
    for at in np.arange(SCANS_PER_ROBOT) * STEP_M:
        leg = min(int(np.searchsorted(ends_m, at, side="right")), len(legs) - 1)
        share = (at - ends_m[leg] + lengths_m[leg]) / lengths_m[leg]
        x, y = route_m[leg] + share * legs[leg]
        poses.append(Pose2D(float(x), float(y), float(np.arctan2(*legs[leg][::-1]))))
    return poses


def _scan(world: World, pose: Pose2D, rng: np.random.Generator) -> Scan:
    return Scan(
        pose=pose,
        ranges_m=SENSOR.measure(world, pose, rng),
        angle_min_rad=SENSOR.angle_min_rad,
        angle_increment_rad=SENSOR.angle_increment_rad,
        range_min_m=SENSOR.range_min_m,
        range_max_m=SENSOR.range_max_m,
    )
