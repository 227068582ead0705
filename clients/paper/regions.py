"""Where maps are scored: cells of the scene, and which of them were in view."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clients.paper.experiment import BOUNDS_M, SENSOR, WALL_M, Experiment
from gpom_core.metrics import score

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

NEAR_L_WALL_M = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """The scene as n cell centres with the truth; row 0 is at ymin.

    Attributes:
        shape: rows, columns.
        points: (n, 2) metres. occupied: (n,).
        regions: name to (n,) mask: `observed`, what the robots had in view, walls to their full
            depth; `everything`; `l_wall`, what was in view within a metre of the L-shaped wall.
    """

    resolution_m: float
    shape: tuple[int, int]
    points: Floats
    occupied: Bools
    regions: dict[str, Bools]

    def scores(self, occupancy: Floats) -> dict[str, dict[str, float]]:
        """AUC, NLL, Brier and ECE per region."""
        return {
            name: {
                key: float(value)
                for key, value in score(occupancy[mask], self.occupied[mask]).as_dict().items()
                if key != "share_unknown"
            }
            for name, mask in self.regions.items()
        }


def cells_of(experiment: Experiment, resolution_m: float) -> Cells:
    """Cut the scene into cells."""
    xmin, ymin, xmax, ymax = BOUNDS_M
    x = np.arange(xmin + resolution_m / 2, xmax, resolution_m)
    y = np.arange(ymin + resolution_m / 2, ymax, resolution_m)
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    observed = in_view(experiment, points)
    near = experiment.l_wall.distance(points) <= NEAR_L_WALL_M
    return Cells(
        resolution_m=resolution_m,
        shape=(len(y), len(x)),
        points=points,
        occupied=experiment.world.is_occupied(points),
        regions={
            "observed": observed,
            "everything": np.ones(len(points), np.bool_),
            "l_wall": observed & near,
        },
    )


def in_view(experiment: Experiment, points: Floats) -> Bools:
    """Which points (n, 2) lie inside a robot's sweep with nothing before them but their own wall.

    The sweep is that of a perfect sensor: space between two beams is in view.
    """
    seen = np.zeros(len(points), np.bool_)
    for scan in experiment.scans:
        offset = points - np.array([scan.pose.x_m, scan.pose.y_m])
        distance_m = np.hypot(*offset.T)
        angle = np.arctan2(offset[:, 1], offset[:, 0])
        turn = np.abs((angle - scan.pose.yaw_rad + np.pi) % (2 * np.pi) - np.pi)
        inside = (turn <= SENSOR.fov_rad / 2) & (distance_m <= SENSOR.range_max_m) & ~seen
        candidates = np.flatnonzero(inside)
        if len(candidates) > 0:
            surface_m = experiment.world.cast(scan.pose[:2], angle[candidates])
            seen[candidates] = distance_m[candidates] <= surface_m + WALL_M
    return seen
