"""What a map costs as it grows, measured along a replay, and the picture of it."""

import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from clients.building import furnished_building
from clients.simulate import RobotSimulator
from gpom_core.mapper import Mapper
from gpom_core.rows import BOX
from gpom_core.scan import Pose2D, Scan

TRAIN_EVERY = 10
PARTS = 40
BLOCKS = 4, 5
BLOCK_M = 33.0, 23.0
SECONDS_PER_BUILDING = 300.0


@dataclass
class Growth:
    """Figures after each part of a replay, and how many experts were trained in all."""

    scans: list[int] = field(default_factory=list)
    ms_per_scan: list[float] = field(default_factory=list)
    area_m2: list[float] = field(default_factory=list)
    experts: list[int] = field(default_factory=list)
    observations: list[int] = field(default_factory=list)
    megabytes: list[float] = field(default_factory=list)
    trained: int = 0

    def tenth(self, number: int) -> float:
        """Cost per scan in ms of one tenth of the replay, from 1 to 10."""
        per = len(self.ms_per_scan) // 10
        return float(np.mean(self.ms_per_scan[per * (number - 1) : per * number]))


def replay(mapper: Mapper, scans: list[Scan]) -> Growth:
    """Integrate scans and train after every ten, as a service under load does.

    Costs are processor time of this thread.
    """
    growth = Growth()
    for part in np.array_split(np.arange(len(scans)), PARTS):
        start_s = time.thread_time()
        for i in part.tolist():
            mapper.update(scans[i])
            if i % TRAIN_EVERY == TRAIN_EVERY - 1:
                jobs = mapper.take_jobs(1_000_000)
                growth.trained += len(jobs)
                mapper.swap([job.run() for job in jobs])
        growth.ms_per_scan.append(1e3 * (time.thread_time() - start_s) / max(len(part), 1))
        growth.scans.append(int(part[-1]) + 1)
        growth.area_m2.append(area_m2(mapper))
        growth.experts.append(mapper.expert_count)
        growth.observations.append(mapper.observation_count)
        growth.megabytes.append(megabytes(mapper))
    return growth


def area_m2(mapper: Mapper) -> float:
    """Area of the lattice's cells that a beam went through."""
    rows, n = mapper._evidence.rows, mapper.observation_count
    free = np.maximum(rows.crossed[:n], 1)[rows.kind[:n] == BOX]
    return float(free.sum()) * mapper.config.cell_m**2


def megabytes(mapper: Mapper) -> float:
    """Of the evidence in use and of all trained experts with their index."""
    total = 0.0
    for part in (mapper._evidence.rows, mapper._evidence.tiles, mapper._evidence.clusters):
        share = int(part.size[0]) / max(len(part[-2]), 1)
        total += share * sum(array.nbytes for array in part)
    for member in mapper.snapshot().members.values():
        o = member.expert.observations
        unread = (o.targets, o.noise_variance, o.count)
        total += member.size_bytes + sum(array.nbytes for array in unread)
    return total / 1e6


def campus() -> list[Scan]:
    """Scans of one robot that visits twenty buildings of 30 x 20 m on 129 x 112 m, one by one."""
    scans = []
    for index in range(BLOCKS[0] * BLOCKS[1]):
        x_m, y_m = BLOCK_M[0] * (index % BLOCKS[0]), BLOCK_M[1] * (index // BLOCKS[0])
        robot = RobotSimulator(furnished_building(index), seed=index, rate_hz=1.0)
        for scan in robot.scans(SECONDS_PER_BUILDING):
            pose = Pose2D(scan.pose.x_m + x_m, scan.pose.y_m + y_m, scan.pose.yaw_rad)
            scans.append(Scan(
                pose, scan.ranges_m, scan.angle_min_rad, scan.angle_increment_rad,
                scan.range_min_m, scan.range_max_m,
            ))  # fmt: skip
    return scans


def draw(path: Path, replays: Iterable[tuple[str, Growth]]) -> None:
    """Cost, experts, observations and memory against scans and against explored area."""
    import matplotlib.pyplot as plt  # noqa: PLC0415 - only who keeps the figures needs it

    shown = {
        "ms per scan": "ms_per_scan", "experts": "experts",
        "observations": "observations", "megabytes": "megabytes",
    }  # fmt: skip
    figure, axes = plt.subplots(2, 4, figsize=(11, 4.4), layout="constrained")
    for name, growth in replays:
        for column, (label, attribute) in enumerate(shown.items()):
            values = getattr(growth, attribute)
            axes[0, column].plot(growth.scans, values, lw=1.2, label=name)
            axes[1, column].plot(growth.area_m2, values, lw=1.2)
            axes[0, column].set_title(label, fontsize=9)
    for axis in axes.ravel():
        axis.set_ylim(bottom=0.0)
        axis.tick_params(labelsize=7)
        axis.grid(alpha=0.3)
    for column in range(4):
        axes[0, column].set_xlabel("scans", fontsize=8)
        axes[1, column].set_xlabel("explored area, m²", fontsize=8)
    axes[0, 0].legend(fontsize=7)
    figure.savefig(path, dpi=80)
    plt.close(figure)
