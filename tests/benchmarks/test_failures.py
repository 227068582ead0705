"""What goes wrong with real scanners, one at a time, in a simulated room whose truth is known.

Every row spoils the scans of the same drive in one way; all maps are scored on clean scans from
other places. "there" is where the fault is: the pane, the walked way, the edges of furniture, or
the wall that is driven along. Some rows try what may help: four times as many scans, or
hits with four times the noise, which are believed less.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

from clients.contenders import chosen_grids, gpom_map
from clients.protocol import labelled_points
from clients.sensor import RangeSensor
from clients.world import Box, World
from gpom_core.config import MapConfig
from gpom_core.metrics import negative_log_likelihood
from gpom_core.scan import Pose2D, Scan

SENSOR = RangeSensor(beams=360, noise_std_m=0.01, dropout_probability=0.0)
FURNITURE = [Box(-2.2, 1.2, 0.8, 0.5), Box(1.5, -1.6, 0.5, 0.9, 0.4), Box(2.0, 1.5, 0.3, 0.3)]
WALLS = [
    Box(0.0, 3.1, 8.4, 0.2), Box(0.0, -3.1, 8.4, 0.2),
    Box(4.1, 0.0, 0.2, 6.4), Box(-4.1, 0.0, 0.2, 6.4),
]  # fmt: skip
ROOM = World([*WALLS, *FURNITURE])
PANE = Box(4.1, 0.0, 0.4, 2.4)  # of the right wall
PASSES = 0.7  # share of the beams that a pane lets through
SCANS = 40
LOOK_LONGER = 4  # times as many
ALONG_M = 0.4  # from the lower wall
GRAZING_RAD = np.radians(15.0)  # between beam and wall

Spoil = Callable[[Scan, np.random.Generator], Scan]


def poses(phase: float, scans: int = SCANS) -> list[Pose2D]:
    turn = np.linspace(0.0, 2.0 * np.pi, scans, endpoint=False) + phase
    return [Pose2D(2.8 * np.cos(t), 0.5 * np.sin(t), 3.0 * t) for t in turn]


def scan_from(pose: Pose2D, rng: np.random.Generator, world: World = ROOM) -> Scan:
    return Scan(
        pose, SENSOR.measure(world, pose, rng), SENSOR.angle_min_rad, SENSOR.angle_increment_rad,
        SENSOR.range_min_m, SENSOR.range_max_m,
    )  # fmt: skip


def clean(scan: Scan, _rng: np.random.Generator) -> Scan:
    return scan


def through_glass(reading: float) -> Spoil:
    """Beams through the pane read `reading`: NaN ignores them, inf calls their way free."""

    def spoil(scan: Scan, rng: np.random.Generator) -> Scan:
        angle = scan.beam_angles_rad()
        ends = np.column_stack([np.cos(angle), np.sin(angle)]) * scan.ranges_m[:, None]
        ends += [scan.pose.x_m, scan.pose.y_m]
        lost = (World([PANE]).distance(ends) < 0.05) & (rng.random(len(angle)) < PASSES)
        return replace(scan, ranges_m=np.where(lost, np.float32(reading), scan.ranges_m))

    return spoil


def mixed_pixels(scan: Scan, rng: np.random.Generator) -> Scan:
    """Where the range jumps, half of the beams read something between near and far."""
    r, after = scan.ranges_m, np.roll(scan.ranges_m, -1)
    mixed = (np.abs(after - r) > 0.3) & (rng.random(len(r)) < 0.5)
    return replace(scan, ranges_m=np.where(mixed, r + rng.random(len(r)) * (after - r), r))


def walker(scan: Scan, rng: np.random.Generator) -> Scan:
    """Somebody of 0.4 m walks along the middle of the room, elsewhere in every scan."""
    person = Box(rng.uniform(-3.5, 3.5), 0.0, 0.4, 0.4)
    if World([person]).distance([scan.pose[:2]])[0] < 0.3:
        return scan
    return scan_from(scan.pose, rng, World([*ROOM.boxes, person]))


def poor_poses(scan: Scan, rng: np.random.Generator) -> Scan:
    x, y, yaw = scan.pose
    dx, dy = rng.normal(0.0, 0.03, 2)
    return replace(scan, pose=Pose2D(x + dx, y + dy, yaw + rng.normal(0.0, np.radians(0.5))))


def along_wall(scan: Scan, rng: np.random.Generator) -> Scan:
    """From beside the lower wall, which most beams meet at a small angle."""
    return scan_from(Pose2D(scan.pose.x_m, ALONG_M - 3.0, scan.pose.yaw_rad), rng)


def grazing(scan: Scan, rng: np.random.Generator) -> Scan:
    """Two in five beams that graze that wall are lost, the others are off by 8 cm (1 std)."""
    scan = along_wall(scan, rng)
    down = -np.sin(scan.beam_angles_rad())
    ends = scan.pose.y_m - down * scan.ranges_m
    grazes = (ends < -2.9) & (down < np.sin(GRAZING_RAD))
    lost = grazes & (rng.random(len(down)) < 0.4)
    ranges = scan.ranges_m + np.where(grazes, rng.normal(0.0, 0.08, len(down)), 0.0)
    return replace(scan, ranges_m=np.where(lost, np.nan, ranges))


def at_pane(points: np.ndarray) -> np.ndarray:
    return World([PANE]).distance(points) < 0.05


def on_way(points: np.ndarray) -> np.ndarray:
    return (np.abs(points[:, 1]) < 0.3) & (np.abs(points[:, 0]) < 3.6)


def at_furniture(points: np.ndarray) -> np.ndarray:
    return World(FURNITURE).distance(points) < 0.25


def at_wall(points: np.ndarray) -> np.ndarray:
    return np.abs(points[:, 1] + 3.0) < 0.25


class Fault(NamedTuple):
    """How scans are spoilt, where that is, and what is tried against it."""

    spoil: Spoil
    there: Callable[[np.ndarray], np.ndarray]
    scans: int = SCANS
    config: MapConfig | None = None


LESS = MapConfig(hit_noise_std=4.0 * MapConfig().hit_noise_std)
FAULTS = {
    "none, at the pane": Fault(clean, at_pane),
    "none, on the way": Fault(clean, on_way),
    "none, at furniture": Fault(clean, at_furniture),
    "none, at furniture, hits x 4": Fault(clean, at_furniture, config=LESS),
    "none, driving along a wall": Fault(along_wall, at_wall),
    "glass, ignored": Fault(through_glass(np.nan), at_pane),
    "glass, called free": Fault(through_glass(np.inf), at_pane),
    "mixed pixels": Fault(mixed_pixels, at_furniture),
    "grazing beams": Fault(grazing, at_wall),
    "a walker": Fault(walker, on_way),
    "a walker, 160 scans": Fault(walker, on_way, LOOK_LONGER * SCANS),
    "a walker, hits x 4": Fault(walker, on_way, config=LESS),
    "poses off by 3 cm, 0.5 deg": Fault(poor_poses, at_furniture),
    "poses off, 160 scans": Fault(poor_poses, at_furniture, LOOK_LONGER * SCANS),
    "poses off, hits x 4": Fault(poor_poses, at_furniture, config=LESS),
}


@pytest.mark.benchmark
@pytest.mark.timeout(600)
def test_faults_one_at_a_time() -> None:
    rng = np.random.default_rng(0)
    test = labelled_points([scan_from(pose, rng) for pose in poses(0.07)], seed=0)
    print(f"\n{'fault':29}{'map':16}{'NLL':>8}{'there':>8}{'p hits':>8}{'p free':>8}")
    for name, fault in FAULTS.items():
        rng = np.random.default_rng(1)
        scans = [fault.spoil(scan_from(pose, rng), rng) for pose in poses(0.0, fault.scans)]
        there = fault.there(test.points)
        for contender in [*gpom_map(scans, config=fault.config), *chosen_grids(scans)[:1]]:
            p, _ = contender.predict(test.points)
            near, labels = p[there], test.occupied[there]
            hits = near[labels].mean() if labels.any() else np.nan
            free = near[~labels].mean() if not labels.all() else np.nan
            print(
                f"{name:29}{contender.name:16}{negative_log_likelihood(p, test.occupied):8.4f}"
                f"{negative_log_likelihood(near, labels):8.4f}{hits:8.3f}{free:8.3f}",
                flush=True,
            )
